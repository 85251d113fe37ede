"""Optical proof of synchrony: each camera's true time of exposure, from a moving body that all cameras see.

A camera that exposes by δ later than the others shows each point of a moving body δ times its velocity in the image
further on. No point in space explains that in all images at once, so the reprojection residuals, divided by the
velocities in the images, give δ (least squares over all points and steps). The body rests at the reference, from
which it is tracked: what the residuals are there, because of errors of calibration and matches, is subtracted. What
such an error changes as the body moves on is fitted beside δ, as a small motion of each camera. Only differences
between the cameras can be seen: the offsets are from the mean of all cameras.

The standard deviations are those of a regression with clustered errors: residuals of neighbouring points, at all steps,
may depend on each other in any way (Liang and Zeger, Biometrika 73, 1986).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
from scipy.interpolate import make_interp_spline

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.calibration.adjustment import huber_weights
from ringdic.calibration.parameters import LENS, POSE, CameraParameters, projection_jacobians
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import triangulate

_MOST = 3000  # points that are used
_FEWEST = 50
_LEAST_MOVING = 6  # steps at which the body moves, for its velocities
_DEGREE = 5  # of the splines in time; velocities are used within their ends, where they are exact
_PASSES = 3  # of the robust fit
_ROUNDS = 2  # of fits, each with the velocities that the offsets of the one before give
_POSE_PX = 0.5  # px, by which a camera may have been calibrated wrongly
_CELLS = 6  # of points whose residuals may depend on each other, along each axis of the body
_SLOW_PX = 5.0  # px/s, median velocity in the images below which nothing can be told
_EXACT_PX = 1e-3  # largest residual of points whose pixels at rest are projections
_MEDIAN = 0.6745  # of |x| for a normal variable


@dataclass(frozen=True)
class TimeOffsets:
    """Times at which C cameras expose, from the mean of all of them, as the images tell.

    cameras : (C,) ids. offset : (C,) s, positive where a camera is late. sigma : (C,) s. speed : (C,) px/s, median
    velocity in each image. points, steps : numbers used. scale : residuals in units of their standard deviations.
    """

    cameras: tuple[str, ...]
    offset: Floats
    sigma: Floats
    speed: Floats
    points: int
    steps: int
    scale: float

    def to_json(self) -> dict[str, Any]:
        """The offsets as JSON values, times in ms."""
        rows = zip(self.cameras, 1e3 * self.offset, 1e3 * self.sigma, self.speed, strict=True)
        return {
            "points": self.points,
            "steps": self.steps,
            "scale": round(self.scale, 3),
            "cameras": {
                id_: {"offset_ms": float(ms), "sigma_ms": float(sigma), "px_per_s": float(speed)}
                for id_, ms, sigma, speed in rows
            },
        }


def time_offsets(
    cameras: Sequence[Camera], px: Pixels, sigma: Pixels | float, times: Floats, row_times: Floats | None = None
) -> TimeOffsets:
    """Measure the times at which cameras expose from points that were tracked in all of them.

    Parameters
    ----------
    cameras : the C cameras.
    px : (F, C, n, 2) px, tracks of n points over F steps, NaN where one is lost; the body rests at the first step.
    sigma : (F, C, n, 2) px, their standard deviations, or one number.
    times : (F,) s, of the steps, rising.
    row_times : (C,) s, from one row of an image to the next, of rolling shutters; None for global ones. The offsets
        are those of the middle rows.

    Raises
    ------
    ComputationError : too few steps, too few points that two cameras see throughout, or a body that hardly moves.
    """
    if len(times) < 1 + _LEAST_MOVING:
        raise ComputationError(
            f"{len(times)} steps are too few to measure synchrony: one with the body at rest and at least "
            f"{_LEAST_MOVING} while it moves are needed; capture more"
        )
    px = np.asarray(px, dtype=np.float64)
    sigma = np.broadcast_to(np.asarray(sigma, dtype=np.float64), px.shape)
    whole = np.asarray(np.isfinite(px + sigma).all(axis=(0, 3)))
    shared = np.flatnonzero(whole.sum(axis=0) >= 2)
    if len(shared) < _FEWEST:
        raise ComputationError(
            f"{len(shared)} points are tracked through all steps by two cameras, and synchrony needs {_FEWEST}; let "
            "the body move less far, or more smoothly"
        )
    chosen = shared[np.linspace(0, len(shared) - 1, min(len(shared), _MOST)).astype(int)]
    seen = whole[:, chosen]
    tracks = _Tracks.of(cameras, np.where(seen[..., None], px[:, :, chosen], np.nan), sigma[:, :, chosen], times)
    if row_times is not None:
        tracks = tracks.without_rows(cameras, row_times)
    return _fit(cameras, tracks, seen)


@dataclass(frozen=True)
class _Tracks:
    """Tracks of n points in C images at S steps while the body moves.

    residual : (S, C, n, 2) px, of the projections of the triangulated points, less those at rest. sigma : the same
    shape, px. velocity, acceleration : the same shape, px/s and px/s², each camera's at its own exposure. xyz : (S,
    n, 3) mm. rest : (n, 3) mm. rows : (S, C, n) px.
    """

    residual: Pixels
    sigma: Pixels
    velocity: Pixels
    acceleration: Pixels
    xyz: Points
    rest: Points
    rows: Floats

    @classmethod
    def of(cls, cameras: Sequence[Camera], px: Pixels, sigma: Pixels, times: Floats) -> _Tracks:
        """Triangulate the points at every step, and find their velocities in the images by splines in time."""
        moving = px[1:]
        whole = np.asarray(np.isfinite(moving).all(axis=(0, 3)))
        velocity, acceleration = np.full((2, *moving.shape), np.nan)
        spline = make_interp_spline(times[1:], moving[:, whole], k=_DEGREE, axis=0)
        velocity[:, whole], acceleration[:, whole] = (spline(times[1:], order) for order in (1, 2))
        used = np.arange(2, len(times) - 1)
        xyz = np.stack([triangulate(cameras, each) for each in px[[0, *used]]])
        projected = np.stack([np.stack([camera.project(each) for camera in cameras]) for each in xyz])
        residual = px[[0, *used]] - projected
        exact = np.nanmax(np.abs(residual[0])) < _EXACT_PX  # tracked from projections, not from matches
        both = sigma[used] if exact else np.hypot(sigma[used], sigma[:1])
        of_used = velocity[used - 1], acceleration[used - 1]
        return cls(residual[1:] - residual[:1], both, *of_used, xyz[1:], xyz[0], px[used, ..., 1])

    def between(self, offset: Floats) -> _Tracks:
        """The tracks with the mean velocities between the mean time and the exposures, which are (C,) s after it."""
        return replace(self, velocity=self.velocity - self.acceleration * offset[:, None, None] / 2)

    def without_rows(self, cameras: Sequence[Camera], row_times: Floats) -> _Tracks:
        """The tracks less what the rolling shutter's delay of each row, from the middle one, has moved them by."""
        middle = np.array([camera.size[1] / 2 for camera in cameras])[:, None]
        delay = ((self.rows - middle) * np.asarray(row_times)[:, None])[..., None]
        return replace(self, residual=self.residual - (self.velocity - self.acceleration * delay / 2) * delay)


def _fit(cameras: Sequence[Camera], tracks: _Tracks, seen: Mask) -> TimeOffsets:
    """Fit the offsets, and beside them small motions of the cameras, to the residuals of all steps."""
    count = len(cameras)
    with np.errstate(invalid="ignore"):
        speed = np.array([np.median(np.linalg.norm(tracks.velocity[:, c, seen[c]], axis=-1)) for c in range(count)])
    if np.nanmedian(speed) < _SLOW_PX:
        raise ComputationError(
            f"the body moves by {np.nanmedian(speed):.1f} px/s in the images only, and synchrony needs {_SLOW_PX:g}: "
            "let it move faster, and rest at the first step"
        )
    centred = np.eye(count) - 1.0 / count  # the mean cannot be seen
    scale, theta, offset = 1.0, np.zeros((1 + POSE) * count), np.zeros(count)
    for _ in range(_ROUNDS):
        equations = _Equations(cameras, tracks.between(centred @ offset), seen)
        for _ in range(_PASSES):
            theta, scale = equations.solve(theta, scale)
        offset = theta[:: 1 + POSE]
    covariance = equations.clustered_covariance(theta)[:: 1 + POSE, :: 1 + POSE]
    sigma = np.sqrt(np.diag(centred @ covariance @ centred))
    ids = tuple(camera.id for camera in cameras)
    return TimeOffsets(ids, centred @ offset, sigma, speed, seen.shape[1], len(tracks.xyz), scale)


class _Equations:
    """Observation equations of C cameras: residual = J dX + (velocity, change of the pose's effect) θ."""

    def __init__(self, cameras: Sequence[Camera], tracks: _Tracks, seen: Mask) -> None:
        self.count, self.seen, self.tracks = len(cameras), seen, tracks
        self.cell = _cells(tracks.rest)
        parameters = [CameraParameters.of(camera) for camera in cameras]
        far = [np.median((tracks.rest @ one.rotation.T + one.translation)[:, 2]) for one in parameters]
        prior = [
            np.array([0.0, *[one.inner[0] / _POSE_PX] * 3, *[one.inner[0] / (_POSE_PX * z)] * 3]) ** 2
            for one, z in zip(parameters, far, strict=True)
        ]
        self.prior = np.diag(np.concatenate(prior))
        self.rows: list[list[tuple[Indices, Floats, Floats]]] = []  # by step and camera: points, J, coefficients of θ
        for s, xyz in enumerate(tracks.xyz):
            of_step = []
            for c, one in enumerate(parameters):
                at = np.flatnonzero(seen[c])
                _, by_parameters, by_point = projection_jacobians(one, xyz[at])
                _, at_rest, _ = projection_jacobians(one, tracks.rest[at])
                pose = (by_parameters - at_rest)[:, :, LENS:]
                of_step.append((at, by_point, np.concatenate([tracks.velocity[s, c, at, :, None], pose], axis=2)))
            self.rows.append(of_step)

    def _step(self, s: int, theta: Floats, scale: float) -> tuple[Floats, Floats, Floats, list[Floats]]:
        """Normal equations of one step's points: H (n, 3, 3), h (n, 3), B (n, 3, p), and the weights by camera."""
        n, p = self.seen.shape[1], self.count * (1 + POSE)
        moved: Floats = np.zeros((n, 3))
        for turn in range(2):  # the second time with weights of the residuals after the points have moved too
            H, h, B = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3, p))
            weights: list[Floats] = []
            for c, (at, J, D) in enumerate(self.rows[s]):
                r = self.tracks.residual[s, c, at]
                left = r - D @ theta[self._of(c)] - np.einsum("nij,nj->ni", J, moved[at])
                w = huber_weights(left, scale * self.tracks.sigma[s, c, at])
                weights.append(w)
                across = J * w[..., None]
                H[at] += across.transpose(0, 2, 1) @ J
                h[at] += np.einsum("nri,nr->ni", across, r)
                B[at, :, self._of(c)] += across.transpose(0, 2, 1) @ D
            H += 1e-12 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            if turn == 0:
                moved = np.asarray(np.linalg.solve(H, (h - B @ theta)[..., None])[..., 0], dtype=np.float64)
        return H, h, B, weights

    def _of(self, c: int) -> slice:
        return slice(c * (1 + POSE), (c + 1) * (1 + POSE))

    def solve(self, theta: Floats, scale: float) -> tuple[Floats, float]:
        """One pass of the robust fit: the parameters, and the residuals in units of their standard deviations."""
        N: Floats = self.prior.copy()
        right: Floats = np.zeros(len(theta))
        self._last: list[tuple[Floats, list[Floats]]] = []
        for s in range(len(self.rows)):
            H, h, B, weights = self._step(s, theta, scale)
            for c, ((at, _, D), w) in enumerate(zip(self.rows[s], weights, strict=True)):
                own = D * w[..., None]
                N[self._of(c), self._of(c)] += np.tensordot(D, own, ((0, 1), (0, 1)))
                right[self._of(c)] += np.tensordot(own, self.tracks.residual[s, c, at], ((0, 1), (0, 1)))
            solved = np.linalg.solve(H, np.concatenate([B, h[..., None]], axis=2))
            flat = B.reshape(-1, len(theta)).T
            N -= flat @ solved[..., :-1].reshape(-1, len(theta))
            right -= flat @ solved[..., -1].ravel()
            self._last.append((solved, weights))
        times = np.arange(self.count) * (1 + POSE)
        N[np.ix_(times, times)] += np.trace(N[np.ix_(times, times)]) / self.count**2  # holds the mean of the offsets
        size = 1 / np.sqrt(np.diag(N))
        self._inverse: Floats = scipy.linalg.inv(N * np.outer(size, size)) * np.outer(size, size)
        theta = self._inverse @ right
        ratios = np.concatenate(
            [np.abs(e / self.tracks.sigma[s, c, at]).ravel() for s, c, at, e, _, _ in self._left(theta)]
        )
        return theta, max(1.0, float(np.median(ratios)) / _MEDIAN)

    def _left(self, theta: Floats) -> Any:
        """Residuals that the last pass leaves: step, camera, points, residuals (k, 2), coefficients, weights."""
        for s, (solved, weights) in enumerate(self._last):
            moved = solved[..., -1] - solved[..., :-1] @ theta
            for c, ((at, J, D), w) in enumerate(zip(self.rows[s], weights, strict=True)):
                e = self.tracks.residual[s, c, at] - np.einsum("nij,nj->ni", J, moved[at]) - D @ theta[self._of(c)]
                yield s, c, at, e, D, w

    def clustered_covariance(self, theta: Floats) -> Floats:
        """Covariance of the parameters, from the scatter of what cells of neighbouring points say of them."""
        cells = int(self.cell.max()) + 1
        score = np.zeros((cells, len(theta)))
        for _, c, at, e, D, w in self._left(theta):
            np.add.at(score[:, self._of(c)], self.cell[at], np.einsum("nri,nr->ni", D * w[..., None], e))
        used = max(int((np.abs(score).sum(axis=1) > 0).sum()), 2)
        spread = self._inverse @ (score.T @ score) @ self._inverse * used / (used - 1)
        larger = np.sqrt(np.maximum(np.diag(spread) / np.diag(self._inverse), 1.0))
        return self._inverse * np.outer(larger, larger)


def _cells(xyz: Points) -> Indices:
    """Number (n,) of the cell of neighbouring points that each point (n, 3) mm lies in."""
    low, extent = np.nanmin(xyz, axis=0), max(float(np.nanmax(np.ptp(xyz, axis=0))), 1e-9)
    place = np.minimum((xyz - low) / extent * _CELLS, _CELLS - 1e-9).astype(np.int64)
    _, cell = np.unique(place, axis=0, return_inverse=True)
    return cell.ravel()
