"""Poses refined on points of a specimen that several cameras see: what calibration and jitter left over is taken off.

Minimised is ``Σ ρ(r / σ) + pᵀ Σ⁻¹ p`` over the points and a small motion p of each camera (ω, τ), lenses held: lines of
sight must meet (the epipolar condition), and the poses may leave what the dots of the target said of them only as far
as their covariance Σ allows. The dots hold what points alone cannot tell: place, turn and scale of the world. The
points are eliminated from the normal equations (Schur complement); ρ is Huber's.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats
from ringdic.calibration.bundle import BundleFit
from ringdic.calibration.parameters import LENS, PER_CAMERA, POSE, Parameters, projection_jacobians
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import reprojection_residuals, triangulate

log = logging.getLogger(__name__)

#: Residuals beyond this many σ count by their length, not by its square (Huber 1964).
_HUBER = 2.5
#: More points than this tell nothing new; fewer than this tell too little.
_MOST, _FEWEST = 6000, 50
#: Standard errors of a pose of which nothing else is known: rad and mm.
LOOSE = (1e-3, 0.5)


@dataclass(frozen=True)
class Refinement:
    """Refined poses of C cameras.

    cameras : in the order given. motion : (C, 6) ω (rad) and τ (mm), by which ``R ← exp([ω]×) R``, ``t ← t + τ``.
    sigma : (C, 6) its standard errors. before, after : (C,) RMS distance of a camera's points from the reprojection of
    where lines of sight meet best, px; the epipolar residual. NaN for a camera without points.
    scale : by what the given σ must be multiplied to agree with what is left over. points : that were used.
    """

    cameras: tuple[Camera, ...]
    motion: Floats
    sigma: Floats
    before: Floats
    after: Floats
    scale: float
    points: int


def pose_covariance(fit: BundleFit, ids: Sequence[str]) -> Floats:
    """Covariance of the poses (6 C, 6 C) of some cameras, from the bundle adjustment, whatever their lenses are."""
    at = [PER_CAMERA * fit.cameras.index(id_) + LENS + k for id_ in ids for k in range(POSE)]
    return fit.covariance[np.ix_(at, at)]


def loose_covariance(count: int) -> Floats:
    """Covariance of poses of which nothing is known but that they are about right. (6 C, 6 C)."""
    return np.diag(np.tile(np.repeat(np.square(LOOSE), 3), count))


def refine_poses(
    cameras: Sequence[Camera],
    px: Floats,
    sigma: Floats | float,
    covariance: Floats | None = None,
    *,
    iterations: int = 10,
) -> Refinement:
    """Poses after which the lines of sight of matched points meet best.

    cameras : C. px : (C, n, 2) image px, NaN where a camera does not see the point.
    sigma : (C, n, 2) px, or one number.
    covariance : (6 C, 6 C) of the poses given, see ``pose_covariance``; None for poses known loosely.

    Raises ComputationError where fewer than 50 points are seen by two cameras.
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
    start = [Parameters.of(camera) for camera in cameras]
    covariance = loose_covariance(count) if covariance is None else covariance
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    correlation = covariance / np.outer(spread, spread)
    prior = np.asarray(np.linalg.pinv(correlation, rcond=1e-10, hermitian=True), dtype=np.float64)
    prior = prior / np.outer(spread, spread)
    poses, motion = list(start), np.zeros((count, POSE))
    xyz = triangulate(cameras, px)
    whole = np.isfinite(xyz).all(axis=1)
    px, sigma, xyz = px[:, whole], sigma[:, whole], xyz[whole]
    before = _meeting(cameras, px)
    scale, inverse = 1.0, np.zeros_like(prior)
    for _ in range(iterations):
        scale = _scale(poses, xyz, px, sigma)
        step, moved, inverse = _step(poses, xyz, px, sigma, scale, prior, motion)
        motion = motion + step
        xyz = xyz + moved
        poses = [_at(first, each) for first, each in zip(start, motion, strict=True)]
        if np.all(np.abs(step) <= 1e-3 * np.sqrt(np.diag(inverse)).reshape(count, POSE) + 1e-12):
            break
    refined = tuple(each.camera(camera) for each, camera in zip(poses, cameras, strict=True))
    after = _meeting(refined, px)
    log.info("poses of %d cameras refined on %d points: %s to %s px", count, len(xyz), before.round(3), after.round(3))
    return Refinement(refined, motion, np.sqrt(np.diag(inverse)).reshape(count, POSE), before, after, scale, len(xyz))


def _at(start: Parameters, motion: Floats) -> Parameters:
    return start.moved(np.concatenate([np.zeros(LENS), motion]))


def _meeting(cameras: Sequence[Camera], px: Floats) -> Floats:
    """RMS distance of each camera's points from the reprojection. (C,) px."""
    residuals = reprojection_residuals(cameras, triangulate(cameras, px), px)
    squares = np.sum(residuals**2, axis=2)
    count = np.isfinite(squares).sum(axis=1)
    return np.sqrt(np.where(count > 0, np.nansum(squares, axis=1) / np.maximum(count, 1), np.nan))


def _scale(poses: Sequence[Parameters], xyz: Floats, px: Floats, sigma: Floats) -> float:
    """Robust standard deviation of what is left over in units of σ: 1 or more.

    A point seen by m cameras leaves 2 m − 3 degrees of freedom; the median of its χ² is known.
    """
    left = np.stack([projection_jacobians(pose, xyz)[0] for pose in poses])
    pulls = ((px - left) / sigma) ** 2
    views = np.isfinite(pulls).all(axis=2).sum(axis=0)
    usual = 2.0 * scipy.special.gammaincinv(0.5 * np.maximum(2 * views - 3, 1), 0.5)  # the median of χ²
    ratio = np.nansum(pulls, axis=(0, 2)) / usual
    return max(1.0, float(np.sqrt(np.median(ratio[views >= 2]))))


def _step(
    poses: Sequence[Parameters], xyz: Floats, px: Floats, sigma: Floats, scale: float, prior: Floats, motion: Floats
) -> tuple[Floats, Floats, Floats]:
    """One Gauss-Newton step of the poses (C, 6) and of the points (n, 3), and the covariance of the poses."""
    count, n = len(poses), len(xyz)
    N, right = prior.copy(), -prior @ motion.ravel()
    H, h = np.zeros((n, 3, 3)), np.zeros((n, 3))
    B = np.zeros((n, 3, POSE * count))
    for c, pose in enumerate(poses):
        expected, by_parameters, by_point = projection_jacobians(pose, xyz)
        r = px[c] - expected
        spread = scale * sigma[c]
        seen = np.isfinite(r)
        r = np.where(seen, r, 0.0)
        w = np.where(seen, np.minimum(1.0, _HUBER * spread / np.maximum(np.abs(r), 1e-300)) / spread**2, 0.0)
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
    moved = solved[..., -1] - solved[..., :-1] @ step
    return step.reshape(count, POSE), moved, inverse
