"""From the scatter of matched pixels to the scatter of points in space, to first order.

With δ_c the error of camera c's pixel, a point triangulated from all cameras moves by ``Σ A_c δ_c``,
``A_c = (Σ Jᵀ W J)⁻¹ J_cᵀ W_c``. A point *named* by a whole pixel p of its reference camera r carries more: the noise of
the reference image shifts which place of the surface the pattern about p stands for, and every match with it. With
``B = ∂X/∂p`` along the surface the reference position is off by ``Σ A_c δ_c - B δ_r``.

The displacement of each camera's pixel is measured from that camera's own reference image, at the projection of the
point. What the point was off by cancels: ``Σ A'_c (ε_c(t) - ε_c(0))`` is left, ε of the subsets in time.
The position at a step is the sum of both. It holds each reference image twice, once matched between cameras by a subset
that is narrow where the view is steep (δ), once in time by a whole one (ε); the whole one contains the narrow one, so
``⟨δ ε⟩ = ⟨ε ε⟩``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Floats, Indices
from ringdic.geometry import kernels
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import LinearSystem


def position_gain(cameras: Sequence[Camera], xyz: Floats, sigma: Floats) -> Floats:
    """``A_c``: how points move with each pixel of each camera, mm a px. (C, n, 3, 2), zero where one takes no part.

    xyz : (n, 3) mm, as ``triangulate_weighted`` found them with sigma : (C, n, 2) px, NaN for a camera that took no
    part.
    """
    sigma = np.ascontiguousarray(sigma, dtype=float)
    slopes = np.full((len(cameras), len(xyz), 2, 3), np.nan)
    for k, camera in enumerate(cameras):
        index = np.flatnonzero(np.isfinite(sigma[k]).all(axis=1) & np.isfinite(xyz).all(axis=1))
        slopes[k, index] = camera.project_with_jacobian(xyz[index])[1]
    gain = np.empty((len(cameras), len(xyz), 3, 2))
    kernels.gain(slopes, sigma, gain)
    return gain


def covariance(gain: Floats, sigma: Floats) -> Floats:
    """``Σ A_c diag(σ_c²) A_cᵀ`` (n, 3, 3) mm², of a gain (C, n, 3, 2) and independent errors (C, n, 2) px.

    NaN where fewer than two cameras take part.
    """
    found = kernels.fill_covariance(np.ascontiguousarray(gain, dtype=float), np.ascontiguousarray(sigma, dtype=float))
    return np.asarray(found)


def along_surface(cameras: Sequence[Camera], reference: Indices, xyz: Floats, normals: Floats) -> Floats:
    """``B = ∂X/∂p``: how the point of the surface that a pixel shows moves with that pixel, mm a px. (n, 3, 2).

    reference : (n,) index of the camera. xyz, normals : (n, 3). The inverse of the projection, restricted to the
    surface: ``B = T (J T)⁻¹`` with any basis T of the tangent plane.
    """
    out = np.full((len(xyz), 3, 2), np.nan)
    helper = np.eye(3)[np.argmin(np.abs(np.nan_to_num(normals)), axis=1)]
    first = np.cross(normals, helper)
    tangents = np.stack([first, np.cross(normals, first)], axis=-1)  # (n, 3, 2)
    for k in np.unique(reference[reference >= 0]):
        index = np.flatnonzero(reference == k)
        _, slope = cameras[k].project_with_jacobian(xyz[index])
        out[index] = tangents[index] @ np.linalg.inv(slope @ tangents[index])
    return out


def reference_covariance(gain: Floats, sigma: Floats, reference: Indices, label: Floats) -> Floats:
    """Covariance (n, 3, 3) mm² of reference positions named by a pixel of their reference camera, over repeated noise.

    gain : (C, n, 3, 2). sigma : (C, n, 2) px, of the noise of each image alone. reference : (n,). label : (n, 3, 2) of
    ``along_surface``.
    """
    moved = gain.copy()
    moved[reference, np.arange(len(reference))] -= label
    return covariance(moved, sigma)


def step_covariance(
    gains: tuple[Floats, Floats], sigma: Floats, tracked: tuple[Floats, Floats], reference: Indices, label: Floats
) -> Floats:
    """Covariance (n, 3, 3) mm² of the same points at a later step.

    gains : (C, n, 3, 2), of the reference and of the step. sigma : (C, n, 2) px, as for the reference. tracked :
    (C, n, 2) px each, of the subsets in time by the noise of the reference image alone and of the step's image alone.
    """
    at_first, now = gains
    sigma_first, sigma_now = tracked
    total = covariance(now, sigma_now)
    n = np.arange(len(reference))
    for k in range(len(now)):
        named = np.where((reference == k)[:, None, None], label, 0.0)
        # Where a camera has only one of the two subsets nothing cancels.
        whole = np.nan_to_num(sigma_first[k])
        narrow = np.nan_to_num(sigma[k])
        both = at_first[k].any(axis=(1, 2)) & now[k].any(axis=(1, 2))
        common = np.where(both[:, None], np.minimum(whole, narrow), 0.0)
        parts = (
            ((at_first[k] - now[k] - named), common),
            (at_first[k] - named, np.sqrt(np.maximum(narrow**2 - common**2, 0.0))),
            (now[k], np.sqrt(np.maximum(whole**2 - common**2, 0.0))),
        )
        for slope, scatter in parts:
            scaled = slope * scatter[n, None, :]
            total += scaled @ scaled.transpose(0, 2, 1)
    return total


def position_sigma(cameras: Sequence[Camera], px: Floats, sigma: Floats) -> Floats:
    """Standard deviations of linearly triangulated points from those of their pixels, taken as independent.

    Parameters
    ----------
    cameras : the C cameras.
    px, sigma : (C, n, 2) image pixels and their standard deviations, px; NaN where a camera did not match.

    Returns
    -------
    (n, 3) mm, world frame; NaN where fewer than two cameras know the point and its scatter.
    """
    px = np.where(np.isfinite(sigma), np.asarray(px, dtype=float), np.nan)
    return linear_sigma(cameras, LinearSystem.of(cameras, px), sigma)


def linear_sigma(cameras: Sequence[Camera], system: LinearSystem, sigma: Floats) -> Floats:
    """The same of points whose equations are there already; sigma (C, n, 2) px.

    The linear solution minimises ``|A(px) X - b(px)|²``; for consistent pixels its change is ``dX = -(AᵀA)⁻¹ Aᵀ dr``
    with ``dr = (dA) X - db``, and the residual of a camera moves by ``-(p3 · (X, 1))`` times the change of its pixel.
    """
    slopes = np.full((*system.undistorted.shape, 2), np.nan)
    for k, camera in enumerate(cameras):
        if camera.intrinsics is not None:
            slopes[k] = camera.intrinsics.jacobian(system.undistorted[k])
    scatter = np.ascontiguousarray(sigma, dtype=float)
    solved = system.normal, system.solvable, system.solution
    return np.sqrt(kernels.linear_variance(system.P, system.undistorted, slopes, *solved, scatter))
