"""From the scatter of displacements to the scatter of stretches, with what neighbouring subsets have in common.

Subsets overlap: a pixel's noise moves all the points whose subsets hold it, and strain is a difference of neighbours.
Independent errors would make it look far too uncertain. The stretch along a unit vector N of the reference is
``λ = |F N|``, with m = F N / λ and F of the triangle (Solav et al. 2018, eq. 13) it moves by
``δλ = Σ_k g_k · δx_k``, ``g_2 = (D¹·N) m``, ``g_3 = (D²·N) m``, ``g_1 = -(g_2 + g_3)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.strain import kernels
from ringdic.strain.deformation import Deformation, directors

Faces = NDArray[np.int_]

# Slopes are not spread evenly over a subset, and its gradient is found with its place: both make neighbours a little
# less alike than the overlap of two discs. Measured on speckles of 14 px with radius 20.
_UNEVEN = 1.15


def overlap(distance: Floats, radius: float, order: int = 1) -> Floats:
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


def corners_alike(px: Floats, faces: Faces, radius: float, order: int = 1) -> Floats:
    """Correlations (C, M, 3) of the errors of corners 0 and 1, 1 and 2, 2 and 0 of each triangle; 0 where not seen.

    px : (C, N, 2) where each camera saw the points in its reference image. faces : (M, 3). radius, order : of subsets.
    """
    out = np.empty((len(px), len(faces), 3))
    for camera, at in enumerate(px):
        for k in range(3):
            apart = at[faces[:, k]] - at[faces[:, (k + 1) % 3]]
            out[camera, :, k] = overlap(np.hypot(apart[:, 0], apart[:, 1]), radius, order)
    return np.nan_to_num(out, copy=False)


def stretch_sigma(
    found: Deformation,
    reference: Floats,
    faces: Faces,
    gain: Floats,
    alike: Floats,
    sigma: Floats,
) -> Floats:
    """Standard deviations (M, 2) of λ1 and λ2 of one step from the noise of its images.

    Parameters
    ----------
    found : deformation of the step, M triangles. reference : (N, 3) mm. faces : (M, 3).
    gain : (C, N, 3, 2) mm a px, of ``position_gain`` at the step. alike : (C, M, 3), of :func:`corners_alike`, or
        (1, M, 3) the same in all cameras. sigma : (C, N, 2) px, of the displacement in each camera, by noise.

    Where λ1 and λ2 are nearly alike their order sorts the noise too; there the figures are a little large.
    """
    variance = np.zeros((len(faces), 2))
    slopes = stretch_slopes(found, reference, faces, current_only=True)[0]
    gain, sigma = np.ascontiguousarray(gain, dtype=float), np.ascontiguousarray(sigma, dtype=float)
    kernels.stretch_variance(slopes, gain, sigma, alike, np.ascontiguousarray(faces), variance)
    return np.sqrt(np.maximum(variance, 0.0))


def stretch_slopes(
    found: Deformation, reference: Floats, faces: Faces, current_only: bool = False
) -> tuple[Floats, Floats]:
    """How λ1 and λ2 move with the current positions of the corners, and, turned about, with the reference ones.

    (2, M, 3, 3) each: stretch, triangle, corner, component. ``δλ = Σ_k g_k · δx_k - Σ_k h_k · δX_k`` with
    ``h_2 = (D¹·N) λ N`` and its like: the corners that an edge is measured from count against those it is measured to.
    """
    D, _ = directors(reference, faces)
    current = np.empty((2, len(faces), 3, 3))
    before = np.empty((2, 0 if current_only else len(faces), 3, 3))
    directions = np.stack([found.direction1_reference, found.direction2_reference])
    kernels.fill_stretch_slopes(D, found.F, directions, np.stack([found.lambda1, found.lambda2]), current, before)
    return current, before


def _curved() -> tuple[Floats, Floats]:
    """Correlation of the weight 4 - 6 ρ² on a disc with itself, at distances 0 … 1 diameters."""
    n = 40
    axis = (np.arange(2 * n + 1) - n) / n
    x, y = np.meshgrid(axis, axis)
    square = x * x + y * y
    weight = np.where(square <= 1.0, 4.0 - 6.0 * square, 0.0)
    values = [float(np.sum(weight[:, k:] * weight[:, : 2 * n + 1 - k])) for k in range(2 * n + 1)]
    return np.arange(2 * n + 1) / (2.0 * n), np.array(values) / values[0]
