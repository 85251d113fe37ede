"""Triangulation of points in space from pixels with known standard deviations, with the covariance of each point.

A point minimises ``χ² = Σ ((u_c - û_c(X))/σ_c)²`` over the cameras that see it, with ``û_c`` its projection through the
lens. Gauss-Newton starts at the weighted linear solution (Solav et al. 2018, eq. 7-9). With m cameras χ² has 2 m - 3
degrees of freedom, and the covariance of the point is ``(Σ Jᵀ W J)⁻¹``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import pixels_of_cameras

_STEPS = 8  # most Gauss-Newton steps; two or three are enough unless a match is wrong
_SETTLED = 1e-7  # mm, step at which the iteration has converged
_CROSSING = 1e-10  # least 27 det N / (tr N)³ of a normal matrix N; 1 where all directions are known equally well


@dataclass(frozen=True)
class WeightedPoints:
    """Triangulated points with their covariances and fit; NaN where a point is not determined by its views.

    xyz : (n, 3) mm, world frame.
    covariance : (n, 3, 3) mm², for independent pixel errors with the standard deviations that were given.
    chi2 : (n,) sum of squared residuals in units of their standard deviations.
    degrees : (n,) degrees of freedom of chi2, 2 m - 3 for m cameras, 0 where the point is not determined.
    """

    xyz: Points
    covariance: Floats
    chi2: Floats
    degrees: Indices

    def __post_init__(self) -> None:
        n = len(self.xyz)
        if self.xyz.shape != (n, 3) or self.covariance.shape != (n, 3, 3) or self.chi2.shape != (n,):
            raise ValueError("weighted points need a place, a covariance and a chi-square each")

    @property
    def sigma(self) -> Floats:
        """Standard deviations of x, y and z. (n, 3) mm."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))


@dataclass(frozen=True)
class _View:
    """The points seen by one camera: their indices (k,), pixels (k, 2) px and weights 1/σ (k, 2) px⁻¹."""

    camera: Camera
    index: Indices
    px: Pixels
    weight: Floats


def triangulate_weighted(cameras: Sequence[Camera], px: Pixels, sigma: Pixels) -> WeightedPoints:
    """Points in space from their pixels in two or more images, weighted by the pixels' standard deviations.

    Parameters
    ----------
    cameras : the C cameras, C ≥ 2.
    px, sigma : (C, n, 2) image pixels as they are in the images (distorted) and their standard deviations, px. A
        camera in which either is not finite is not used for the point.

    Raises
    ------
    ValueError : arrays of other shapes, or a standard deviation that is not positive.
    """
    px, sigma = pixels_of_cameras(cameras, px), np.asarray(sigma, dtype=float)
    if sigma.shape != px.shape:
        raise ValueError(f"standard deviations of shape {sigma.shape} do not go with pixels of shape {px.shape}")
    if (sigma <= 0).any():
        raise ValueError("a pixel with a standard deviation of zero or less has no weight; give it a positive one")
    n = px.shape[1]
    views = [_view(camera, image, scatter) for camera, image, scatter in zip(cameras, px, sigma, strict=True)]
    count = np.zeros(n, dtype=np.int64)
    for view in views:
        count[view.index] += 1
    xyz, normal = _linear(views, n)
    xyz[(count < 2) | ~_determined(normal)] = np.nan
    xyz, normal, chi2 = _gauss_newton(views, xyz)
    lost = ~(np.isfinite(xyz).all(axis=1) & np.isfinite(chi2) & _determined(normal))
    covariance = _inverse(normal)
    xyz[lost], covariance[lost], chi2[lost] = np.nan, np.nan, np.nan
    return WeightedPoints(xyz, covariance, chi2, np.where(lost, 0, 2 * count - 3))


def _view(camera: Camera, px: Pixels, sigma: Pixels) -> _View:
    """The points whose pixels (n, 2) and standard deviations (n, 2) px are finite in one camera."""
    index = np.flatnonzero(np.isfinite(px).all(axis=1) & np.isfinite(sigma).all(axis=1))
    return _View(camera, index, px[index], 1.0 / sigma[index])


def _linear(views: list[_View], n: int) -> tuple[Points, Floats]:
    """Weighted linear solutions of n points (n, 3) mm (eq. 7-9) and their normal matrices (n, 3, 3)."""
    normal, right = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for view in views:
        P = view.camera.P
        px = view.camera.undistort(view.px)
        known = np.isfinite(px).all(axis=1)
        # A row's residual is the pixel's times the depth, which is 1 at the world's origin and about 1 on a specimen.
        rows = (P[:2] - px[known][..., None] * P[2]) * view.weight[known][..., None]
        A, b = rows[..., :3], -rows[..., 3]
        normal[view.index[known]] += A.transpose(0, 2, 1) @ A
        right[view.index[known]] += (A.transpose(0, 2, 1) @ b[..., None])[..., 0]
    return (_inverse(normal) @ right[..., None])[..., 0], normal


def _gauss_newton(views: list[_View], xyz: Points) -> tuple[Points, Floats, Floats]:
    """Points of least χ² (n, 3) mm, from starts (n, 3) mm; their normal matrices (n, 3, 3) mm⁻² and χ² (n,)."""
    for _ in range(_STEPS):
        normal, right, chi2 = _normal_equations(views, xyz)
        step = (_inverse(normal) @ right[..., None])[..., 0]
        xyz = xyz + step
        # χ² at the minimum of its quadratic; exact where the step was small.
        chi2 = chi2 - np.einsum("ni,ni->n", step, right)
        if not (np.abs(step) > _SETTLED).any():
            break
    else:
        xyz[np.abs(step).max(axis=1) > 1e3 * _SETTLED] = np.nan
    return xyz, normal, np.maximum(chi2, 0.0)


def _normal_equations(views: list[_View], xyz: Points) -> tuple[Floats, Floats, Floats]:
    """Normal matrices JᵀWJ (n, 3, 3), right sides JᵀWr (n, 3) with the residuals r, and χ² (n,) at points (n, 3)."""
    n = len(xyz)
    normal, right, chi2 = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros(n)
    for view in views:
        projected, jacobian = view.camera.project_with_jacobian(xyz[view.index])
        residual = (view.px - projected) * view.weight
        J = jacobian * view.weight[..., None]
        normal[view.index] += J.transpose(0, 2, 1) @ J
        right[view.index] += (J.transpose(0, 2, 1) @ residual[..., None])[..., 0]
        chi2[view.index] += (residual**2).sum(axis=1)
    return normal, right, chi2


def _determined(normal: Floats) -> Mask:
    """Which points (n,) have lines of sight that cross, by their normal matrices (n, 3, 3)."""
    trace = np.einsum("nii->n", normal)
    return np.asarray(27.0 * _determinant(normal) > _CROSSING * trace**3)


def _determinant(N: Floats) -> Floats:
    """Determinants (n,) of symmetric matrices (n, 3, 3)."""
    a, b, c, d, e, f = (N[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return np.asarray(a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d))


def _inverse(N: Floats) -> Floats:
    """Inverses of positive definite matrices (n, 3, 3) by their adjugates; NaN where singular."""
    a, b, c, d, e, f = (N[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    out = np.empty_like(N)
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = d * f - e * e, a * f - c * c, a * d - b * b
    out[:, 0, 1] = out[:, 1, 0] = c * e - b * f
    out[:, 0, 2] = out[:, 2, 0] = b * e - c * d
    out[:, 1, 2] = out[:, 2, 1] = b * c - a * e
    determinant = a * out[:, 0, 0] + b * out[:, 0, 1] + c * out[:, 0, 2]
    return out / np.where(determinant > 0, determinant, np.nan)[:, None, None]
