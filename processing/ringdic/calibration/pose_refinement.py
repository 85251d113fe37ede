"""Refinement of camera poses on matched points of a specimen, so that the cameras' lines of sight meet.

The cost ``Σ ρ(r / σ) + pᵀ Σ⁻¹ p`` is minimised over the points and a small motion p = (ω, τ) of each camera, with the
lenses fixed. r are the reprojection residuals with Huber's ρ, and Σ is the covariance of the calibrated poses, which
fixes what the points alone leave open: position, orientation and scale of the world. The points are eliminated
from the normal equations (Schur complement).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats, Pixels, Points
from ringdic.calibration.adjustment import huber_weights
from ringdic.calibration.parameters import LENS, POSE, CameraParameters, projection_jacobians
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import reprojection_residuals, triangulate

log = logging.getLogger(__name__)

#: Most points that are used, and fewest that are needed.
_MOST, _FEWEST = 6000, 50
#: Standard errors of a pose whose covariance is not known: rad and mm.
LOOSE = (1e-3, 0.5)


@dataclass(frozen=True)
class PoseRefinement:
    """Refined poses of C cameras, with their standard errors and residuals.

    cameras : with the refined poses, in the order given.
    motion : (C, 6) ω (rad) and τ (mm), by which ``R ← exp([ω]×) R``, ``t ← t + τ``. sigma : (C, 6) its standard errors.
    before, after : (C,) px, RMS reprojection error of each camera's points, NaN for a camera without points.
    scale : factor, 1 or more, by which the standard deviations of the pixels must be multiplied to fit the residuals.
    points : number of points that were used.
    """

    cameras: tuple[Camera, ...]
    motion: Floats
    sigma: Floats
    before: Floats
    after: Floats
    scale: float
    points: int


def loose_covariance(count: int) -> Floats:
    """Covariance (6 C, 6 C), rad and mm, of the poses of C cameras that are known only roughly, to ``LOOSE``."""
    return np.diag(np.tile(np.repeat(np.square(LOOSE), 3), count))


def refine_poses(
    cameras: Sequence[Camera],
    px: Pixels,
    sigma: Pixels | float,
    covariance: Floats | None = None,
    *,
    iterations: int = 10,
) -> PoseRefinement:
    """Refine the poses of cameras so that the lines of sight of matched points meet.

    Parameters
    ----------
    cameras : the C cameras, with poses to start from.
    px : (C, n, 2) image px, NaN where a camera does not see the point.
    sigma : (C, n, 2) px, standard deviations of the pixels, or one number.
    covariance : (6 C, 6 C) of the given poses, rad and mm; None for `loose_covariance`.
    iterations : largest number of Gauss-Newton steps.

    Raises
    ------
    ComputationError : fewer than 50 points are seen by two cameras.
    """
    count = len(cameras)
    px = np.asarray(px, dtype=np.float64)
    sigma = np.broadcast_to(np.asarray(sigma, dtype=np.float64), px.shape)
    shared = np.flatnonzero((np.isfinite(px).all(axis=2) & np.isfinite(sigma).all(axis=2)).sum(axis=0) >= 2)
    if len(shared) < _FEWEST:
        raise ComputationError(
            f"{len(shared)} points are seen by two cameras; refining their poses needs at least {_FEWEST}"
        )
    chosen = shared[np.linspace(0, len(shared) - 1, min(len(shared), _MOST)).astype(int)]
    px, sigma = px[:, chosen], sigma[:, chosen]
    start = [CameraParameters.of(camera) for camera in cameras]
    covariance = loose_covariance(count) if covariance is None else covariance
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    correlation = covariance / np.outer(spread, spread)
    prior = np.asarray(np.linalg.pinv(correlation, rcond=1e-10, hermitian=True), dtype=np.float64)
    prior = prior / np.outer(spread, spread)
    poses, motion = list(start), np.zeros((count, POSE))
    xyz = triangulate(cameras, px)
    whole = np.isfinite(xyz).all(axis=1)
    px, sigma, xyz = px[:, whole], sigma[:, whole], xyz[whole]
    before = _reprojection_rms(cameras, px)
    scale, inverse = 1.0, np.zeros_like(prior)
    for _ in range(iterations):
        scale = _scale(poses, xyz, px, sigma)
        step, point_step, inverse = _step(poses, xyz, px, sigma, scale, prior, motion)
        motion = motion + step
        xyz = xyz + point_step
        poses = [_with_motion(first, each) for first, each in zip(start, motion, strict=True)]
        if np.all(np.abs(step) <= 1e-3 * np.sqrt(np.diag(inverse)).reshape(count, POSE) + 1e-12):
            break
    refined = tuple(each.camera(camera) for each, camera in zip(poses, cameras, strict=True))
    after = _reprojection_rms(refined, px)
    log.info("poses of %d cameras refined on %d points: %s to %s px", count, len(xyz), before.round(3), after.round(3))
    return PoseRefinement(
        refined, motion, np.sqrt(np.diag(inverse)).reshape(count, POSE), before, after, scale, len(xyz)
    )


def _with_motion(start: CameraParameters, motion: Floats) -> CameraParameters:
    """The parameters of a camera after a motion (6,) of its pose, ω (rad) and τ (mm)."""
    return start.plus(np.concatenate([np.zeros(LENS), motion]))


def _reprojection_rms(cameras: Sequence[Camera], px: Pixels) -> Floats:
    """RMS reprojection error of each camera's points, (C,) px, after their triangulation. px : (C, n, 2)."""
    residuals = reprojection_residuals(cameras, triangulate(cameras, px), px)
    squares = np.sum(residuals**2, axis=2)
    count = np.isfinite(squares).sum(axis=1)
    return np.sqrt(np.where(count > 0, np.nansum(squares, axis=1) / np.maximum(count, 1), np.nan))


def _scale(poses: Sequence[CameraParameters], xyz: Points, px: Pixels, sigma: Pixels) -> float:
    """Robust ratio, 1 or more, of the residuals to their standard deviations σ.

    It is the square root of the median, over the points, of χ² in units of its expected median; a point seen by m
    cameras has 2 m − 3 degrees of freedom.
    """
    projected = np.stack([projection_jacobians(pose, xyz)[0] for pose in poses])
    squares = ((px - projected) / sigma) ** 2
    views = np.isfinite(squares).all(axis=2).sum(axis=0)
    median = 2.0 * scipy.special.gammaincinv(0.5 * np.maximum(2 * views - 3, 1), 0.5)  # of the χ² distribution
    ratio = np.nansum(squares, axis=(0, 2)) / median
    return max(1.0, float(np.sqrt(np.median(ratio[views >= 2]))))


def _step(
    poses: Sequence[CameraParameters],
    xyz: Points,
    px: Pixels,
    sigma: Pixels,
    scale: float,
    prior: Floats,
    motion: Floats,
) -> tuple[Floats, Points, Floats]:
    """One Gauss-Newton step of the poses (C, 6) and of the points (n, 3) mm, and the poses' covariance (6 C, 6 C).

    prior : (6 C, 6 C) information matrix of the poses. motion : (C, 6) from their prior values so far.
    """
    count, n = len(poses), len(xyz)
    N, right = prior.copy(), -prior @ motion.ravel()
    H, h = np.zeros((n, 3, 3)), np.zeros((n, 3))
    B = np.zeros((n, 3, POSE * count))
    for c, pose in enumerate(poses):
        expected, by_parameters, by_point = projection_jacobians(pose, xyz)
        r = px[c] - expected
        spread = scale * sigma[c]
        visible = np.isfinite(r)
        r = np.where(visible, r, 0.0)
        w = np.where(visible, huber_weights(r, spread), 0.0)
        A = by_parameters[:, :, LENS:]
        at = slice(POSE * c, POSE * (c + 1))
        N[at, at] += np.einsum("nra,nr,nrb->ab", A, w, A)
        right[at] += np.einsum("nra,nr->a", A, w * r)
        H += np.einsum("nri,nr,nrj->nij", by_point, w, by_point)
        h += np.einsum("nri,nr->ni", by_point, w * r)
        B[:, :, at] = np.einsum("nri,nr,nra->nia", by_point, w, A)
    H += 1e-12 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    solved = np.linalg.solve(H, np.concatenate([B, h[..., None]], axis=2))
    N -= np.einsum("nia,nib->ab", B, solved[..., :-1])
    right -= np.einsum("nia,ni->a", B, solved[..., -1])
    size = 1 / np.sqrt(np.diag(N))
    inverse = np.linalg.inv(N * np.outer(size, size)) * np.outer(size, size)
    step = inverse @ right
    point_step = solved[..., -1] - solved[..., :-1] @ step
    return step.reshape(count, POSE), point_step, inverse
