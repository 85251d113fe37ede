"""From the scatter of displacements to the scatter of stretches, with what neighbouring subsets have in common.

Subsets overlap: a pixel's noise moves all the points whose subsets hold it, and strain is a difference of neighbours.
Independent errors would make it look far too uncertain. The stretch along a unit vector N of the reference is
``λ = |F N|``, with m = F N / λ and F of the triangle (Solav et al. 2018, eq. 13) it moves by
``δλ = Σ_k g_k · δx_k``, ``g_2 = (D¹·N) m``, ``g_3 = (D²·N) m``, ``g_1 = -(g_2 + g_3)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.deformation import Deformation, directors

Array = NDArray[np.float64]
Faces = NDArray[np.int_]

# Slopes are not spread evenly over a subset, and its gradient is found with its place: both make neighbours a little
# less alike than the overlap of two discs. Measured on speckles of 14 px with radius 20.
_UNEVEN = 1.15


def overlap(distance: Array, radius: float, order: int = 1) -> Array:
    """Correlation of the errors that white noise gives two subsets at a distance, px, of one image. (...).

    First order: the place is the mean over the disc, and two means have in common what the discs do. Second order: the
    place is the mean with the weight ``4 - 6 ρ²``, ρ the distance from the centre in radii, which the quadratic terms
    leave, and two of them have the correlation of that weight with itself.
    """
    h = np.clip(np.asarray(distance, dtype=float) / (2.0 * radius + 1.0), 0.0, 1.0)
    if order == 1:
        return np.asarray((2.0 / np.pi * (np.arccos(h) - h * np.sqrt(1.0 - h * h))) ** _UNEVEN)
    grid, values = _curved()
    return np.asarray(np.interp(h, grid, values))


def stretch_sigma(
    found: Deformation,
    reference: Array,
    faces: Faces,
    gain: Array,
    px: Array,
    sigma: Array,
    radius: float,
    order: int = 1,
) -> Array:
    """Standard deviations (M, 2) of λ1 and λ2 of one step from the noise of its images.

    Parameters
    ----------
    found : deformation of the step, M triangles. reference : (N, 3) mm. faces : (M, 3).
    gain : (C, N, 3, 2) mm a px, of ``position_gain`` at the step. px : (C, N, 2) where each camera saw the points in
        its reference image. sigma : (C, N, 2) px, of the displacement in each camera, by noise.
    radius, order : of the subsets.

    Where λ1 and λ2 are nearly alike their order sorts the noise too; there the figures are a little large.
    """
    variance = np.zeros((len(faces), 2))
    slopes, _ = stretch_slopes(found, reference, faces)
    for one, at, scatter in zip(gain, px, sigma, strict=True):
        _add_camera(variance, slopes, one, at, scatter, faces, radius, order)
    return np.sqrt(np.maximum(variance, 0.0))


def stretch_slopes(found: Deformation, reference: Array, faces: Faces) -> tuple[Array, Array]:
    """How λ1 and λ2 move with the current positions of the corners, and, turned about, with the reference ones.

    (2, M, 3, 3) each: stretch, triangle, corner, component. ``δλ = Σ_k g_k · δx_k - Σ_k h_k · δX_k`` with
    ``h_2 = (D¹·N) λ N`` and its like: the corners that an edge is measured from count against those it is measured to.
    """
    D, _ = directors(reference, faces)
    first, second = _reciprocal_in_plane(D)
    current, before = np.empty((2, len(faces), 3, 3)), np.empty((2, len(faces), 3, 3))
    lines = ((found.direction1_reference, found.lambda1), (found.direction2_reference, found.lambda2))
    for k, (N, stretch) in enumerate(lines):
        after = np.einsum("mij,mj->mi", found.F, N) / stretch[:, None]
        for slopes, along in ((current, after), (before, stretch[:, None] * N)):
            slopes[k, :, 1] = np.einsum("mi,mi->m", first, N)[:, None] * along
            slopes[k, :, 2] = np.einsum("mi,mi->m", second, N)[:, None] * along
            slopes[k, :, 0] = -(slopes[k, :, 1] + slopes[k, :, 2])
    return current, before


def _add_camera(
    variance: Array, slopes: Array, gain: Array, px: Array, sigma: Array, faces: Faces, radius: float, order: int
) -> None:
    """Add what one camera's noise makes of the stretches to their variances (M, 2)."""
    takes_part: NDArray[np.bool_] = np.asarray(gain.any(axis=(1, 2)))
    some = np.flatnonzero(takes_part[faces].any(axis=1))
    corners = faces[some]
    scaled = np.where(takes_part[:, None, None], gain * np.nan_to_num(sigma)[:, None, :], 0.0)[corners]  # (m, 3, 3, 2)
    felt = np.einsum("smci,mcij->smcj", slopes[:, some], scaled)  # stretch, triangle, corner, pixel coordinate
    total = np.einsum("smcj,smcj->ms", felt, felt)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        apart = np.linalg.norm(px[corners[:, a]] - px[corners[:, b]], axis=1)
        alike = np.nan_to_num(overlap(apart, radius, order))
        total += 2.0 * alike[:, None] * np.einsum("smj,smj->ms", felt[:, :, a], felt[:, :, b])
    variance[some] += total


def _reciprocal_in_plane(D: Array) -> tuple[Array, Array]:
    """D¹ and D² (M, 3) of directors (M, 3, 3)."""
    D1, D2, D3 = D[:, 0], D[:, 1], D[:, 2]
    volume = np.einsum("mi,mi->m", np.cross(D1, D2), D3)[:, None]
    return np.cross(D2, D3) / volume, np.cross(D3, D1) / volume


def _curved() -> tuple[Array, Array]:
    """Correlation of the weight 4 - 6 ρ² on a disc with itself, at distances 0 … 1 diameters."""
    n = 40
    axis = (np.arange(2 * n + 1) - n) / n
    x, y = np.meshgrid(axis, axis)
    square = x * x + y * y
    weight = np.where(square <= 1.0, 4.0 - 6.0 * square, 0.0)
    values = [float(np.sum(weight[:, k:] * weight[:, : 2 * n + 1 - k])) for k in range(2 * n + 1)]
    return np.arange(2 * n + 1) / (2.0 * n), np.array(values) / values[0]
