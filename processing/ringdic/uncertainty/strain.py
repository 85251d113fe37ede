"""Standard deviations of the stretches of triangles from those of the pixels, for subsets that overlap.

The noise of a pixel moves all the points whose subsets contain it, so the errors of neighbouring points are correlated.
Strain is a difference of neighbours: taking their errors as independent would greatly overestimate its standard
deviation. The stretch along a unit vector N of the reference is ``λ = |F N|``, F the deformation gradient of the
triangle (Solav et al. 2018, eq. 13). With m = F N / λ and the dual directors D¹, D² of the reference triangle,
displacements δx_k of its corners change it by ``δλ = Σ_k g_k · δx_k``, ``g_2 = (D¹·N) m``, ``g_3 = (D²·N) m``,
``g_1 = -(g_2 + g_3)``.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Pixels, Points
from ringdic.strain import kernels
from ringdic.strain.deformation import Deformation, directors
from ringdic.uncertainty.position import Deviations, Gain

# Exponent on the correlation of two discs. Slopes are not spread evenly over a subset, and its gradient is fitted
# together with its position: both make neighbours a little less correlated than the overlap of the discs. Measured on
# speckles of 14 px with radius 20 px.
_UNEVEN = 1.15


def subset_correlation(distance: Floats, radius: float, order: int = 1) -> Floats:
    """Correlation coefficient of the errors that white noise gives two round subsets of one image.

    distance : (...,) px, between the centres. radius : of the subsets, px. order : of their shape functions, 1 or 2.
    Returns (...,) from 0, for subsets that do not overlap, to 1.

    At first order the position is a mean over the disc, and the correlation is the share of the discs' overlap. At
    second order it is a mean with the weight ``4 - 6 ρ²``, ρ the distance from the centre in radii, which remains after
    the quadratic terms are fitted, and the correlation is the autocorrelation of that weight.
    """
    h = np.clip(np.asarray(distance, dtype=float) / (2.0 * radius + 1.0), 0.0, 1.0)
    if order == 1:
        return np.asarray((2.0 / np.pi * (np.arccos(h) - h * np.sqrt(1.0 - h * h))) ** _UNEVEN)
    grid, values = _second_order_correlation()
    return np.asarray(np.interp(h, grid, values))


def corner_correlations(px: Pixels, faces: Indices, radius: float, order: int = 1) -> NDArray[np.float32]:
    """Correlation coefficients of the errors of corners 0 and 1, 1 and 2, 2 and 0 of each triangle, in each camera.

    px : (C, N, 2) px, the vertices in the reference image of each camera, NaN where it does not see them.
    faces : (M, 3) vertex indices. radius : of the subsets, px. order : of their shape functions, 1 or 2.
    Returns (C, M, 3); 0 where a camera does not see both corners.
    """
    out = np.zeros((len(px), len(faces), 3), np.float32)
    for at, correlation in zip(px, out, strict=True):
        seen = np.isfinite(at[:, 0])
        for k in range(3):
            first, second = faces[:, k], faces[:, (k + 1) % 3]
            both = np.flatnonzero(seen[first] & seen[second])
            apart = at[first[both]] - at[second[both]]
            correlation[both, k] = subset_correlation(np.hypot(apart[:, 0], apart[:, 1]), radius, order)
    return out


def stretch_sigma(
    deformed: Deformation,
    reference: Points,
    faces: Indices,
    gain: Gain,
    correlation: NDArray[np.floating],
    sigma: Deviations,
) -> Floats:
    """Standard deviations of the stretches λ1 and λ2 at one step due to image noise.

    Where λ1 and λ2 are nearly equal, sorting them by size sorts the noise as well; there the standard deviations are a
    little too large.

    Parameters
    ----------
    deformed : deformation of the M triangles at the step.
    reference : (N, 3) mm, reference positions of the vertices.
    faces : (M, 3) vertex indices.
    gain : (C, N, 3, 2) mm a px, of `position_gain` at the step.
    correlation : (C, M, 3), of `corner_correlations`; (1, M, 3) where it is equal in all cameras.
    sigma : (C, N, 2) px, of the displacement in each camera, due to noise.

    Returns
    -------
    (M, 2), no unit.
    """
    variance = np.zeros((len(faces), 2))
    slopes = stretch_slopes(deformed, reference, faces, current_only=True)[0]
    kernels.stretch_variance(
        slopes, np.ascontiguousarray(gain), np.ascontiguousarray(sigma), correlation, np.ascontiguousarray(faces),
        variance,
    )  # fmt: skip
    return np.sqrt(np.maximum(variance, 0.0))


def stretch_slopes(
    deformed: Deformation, reference: Points, faces: Indices, current_only: bool = False
) -> tuple[Floats, Floats]:
    """Derivatives g and h of the stretches with respect to the current and, negated, the reference positions.

    They give ``δλ = Σ_k g_k · δx_k - Σ_k h_k · δX_k`` for displacements δx_k of the corners at the step and δX_k at the
    reference, with ``h_2 = (D¹·N) λ N``, ``h_3 = (D²·N) λ N``, ``h_1 = -(h_2 + h_3)``.

    deformed : deformation of the M triangles. reference : (N, 3) mm. faces : (M, 3) vertex indices.
    current_only : leave h empty.
    Returns g and h, (2, M, 3, 3) a mm each: stretch λ1 or λ2, triangle, corner, component.
    """
    D, _ = directors(reference, faces)
    current = np.empty((2, len(faces), 3, 3))
    before = np.empty((2, 0 if current_only else len(faces), 3, 3))
    directions = np.stack([deformed.direction1_reference, deformed.direction2_reference])
    stretches = np.stack([deformed.lambda1, deformed.lambda2])
    kernels.fill_stretch_slopes(D, deformed.F, directions, stretches, current, before)
    return current, before


@cache
def _second_order_correlation() -> tuple[Floats, Floats]:
    """Autocorrelation (k,) of the weight 4 - 6 ρ² on a disc at distances (k,) from 0 to 1 diameter, both returned."""
    n = 40
    axis = (np.arange(2 * n + 1) - n) / n
    x, y = np.meshgrid(axis, axis)
    square = x * x + y * y
    weight = np.where(square <= 1.0, 4.0 - 6.0 * square, 0.0)
    values = [float(np.sum(weight[:, k:] * weight[:, : 2 * n + 1 - k])) for k in range(2 * n + 1)]
    return np.arange(2 * n + 1) / (2.0 * n), np.array(values) / values[0]
