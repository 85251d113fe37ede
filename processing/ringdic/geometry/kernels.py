"""Compiled loops over points: triangulation, propagation of pixel errors to points, residuals against neighbours.

The equations are explained where the kernels are called: :mod:`ringdic.geometry.triangulation`,
:mod:`ringdic.uncertainty.position` and :mod:`ringdic.geometry.outliers`.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

# A positive semi-definite N with det N > s (tr N)³ has no eigenvalue below s times the largest one.
_SURE = 1e-9


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _inverse(N, out):  # type: ignore[no-untyped-def]
    """Write the inverse of a symmetric matrix N (3, 3) into ``out`` by its cofactors; return the determinant of N."""
    out[0, 0] = N[1, 1] * N[2, 2] - N[1, 2] * N[1, 2]
    out[0, 1] = N[0, 2] * N[1, 2] - N[0, 1] * N[2, 2]
    out[0, 2] = N[0, 1] * N[1, 2] - N[0, 2] * N[1, 1]
    out[1, 1] = N[0, 0] * N[2, 2] - N[0, 2] * N[0, 2]
    out[1, 2] = N[0, 1] * N[0, 2] - N[0, 0] * N[1, 2]
    out[2, 2] = N[0, 0] * N[1, 1] - N[0, 1] * N[0, 1]
    determinant = N[0, 0] * out[0, 0] + N[0, 1] * out[0, 1] + N[0, 2] * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= determinant
            out[j, i] = out[i, j]
    return determinant


@nb.njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(P, px, normal, right, seen):  # type: ignore[no-untyped-def]
    """Normal equations of the linear triangulation of n points (Solav et al. 2018, eq. 7-9).

    P (C, 3, 4) projection matrices; px (C, n, 2) undistorted pixels, not finite where a camera does not see the point.
    Filled: normal (n, 3, 3) ``AᵀA``, right (n, 3) ``Aᵀb``, seen (n,) number of cameras. Returns (n,) bool: True where
    the determinant alone proves ``AᵀA`` well conditioned, False where the eigenvalues must decide.
    """
    sure = np.zeros(px.shape[1], np.bool_)
    row = np.empty(4)
    for n in range(px.shape[1]):
        N, b = normal[n], right[n]
        N[:], b[:], seen[n] = 0.0, 0.0, 0
        for c in range(len(P)):
            if not (math.isfinite(px[c, n, 0]) and math.isfinite(px[c, n, 1])):
                continue
            seen[n] += 1
            for k in range(2):
                for i in range(4):
                    row[i] = P[c, k, i] - px[c, n, k] * P[c, 2, i]
                for i in range(3):
                    b[i] -= row[i] * row[3]
                    for j in range(i, 3):
                        N[i, j] += row[i] * row[j]
        for i in range(3):
            for j in range(i):
                N[i, j] = N[j, i]
        determinant = (
            N[0, 0] * (N[1, 1] * N[2, 2] - N[1, 2] * N[1, 2])
            - N[0, 1] * (N[0, 1] * N[2, 2] - N[0, 2] * N[1, 2])
            + N[0, 2] * (N[0, 1] * N[1, 2] - N[0, 2] * N[1, 1])
        )
        sure[n] = determinant > _SURE * (N[0, 0] + N[1, 1] + N[2, 2]) ** 3
    return sure


@nb.njit(cache=True, nogil=True, error_model="numpy")
def solve_normal_equations(normal, right, which, xyz):  # type: ignore[no-untyped-def]
    """Solve ``normal xyz = right`` for each point by the factorisation L D Lᵀ.

    normal (n, 3, 3), right (n, 3), which (n,) bool: points to be solved. xyz (n, 3) is filled, NaN for the others.
    """
    for n in range(len(normal)):
        if not which[n]:
            xyz[n] = np.nan
            continue
        N, b = normal[n], right[n]
        l10, l20 = N[1, 0] / N[0, 0], N[2, 0] / N[0, 0]
        d1 = N[1, 1] - l10 * N[1, 0]
        l21 = (N[2, 1] - l20 * N[1, 0]) / d1
        d2 = N[2, 2] - l20 * N[2, 0] - l21 * l21 * d1
        y1 = b[1] - l10 * b[0]
        y2 = b[2] - l20 * b[0] - l21 * y1
        z = y2 / d2
        y = y1 / d1 - l21 * z
        xyz[n, 0], xyz[n, 1], xyz[n, 2] = b[0] / N[0, 0] - l10 * y - l20 * z, y, z


@nb.njit(cache=True, nogil=True, error_model="numpy")
def gain(slopes, sigma, out):  # type: ignore[no-untyped-def]
    """Sensitivities d(point)/d(pixel) of the weighted triangulation, ``(Σ Jᵀ W J)⁻¹ J_cᵀ W_c`` for camera c.

    slopes (C, n, 2, 3) px/mm, Jacobians J of the projections. sigma (C, n, 2) px, W = diag(σ⁻²). out (C, n, 3, 2) mm/px
    is filled: zero for a camera in which either is not finite.
    """
    normal, inverse, weighted = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 2))
    for n in range(slopes.shape[1]):
        normal[:] = 0.0
        for c in range(len(slopes)):
            J, s = slopes[c, n], sigma[c, n]
            if not math.isfinite(s[0] + s[1] + J[0, 0]):
                continue
            for k in range(2):
                for i in range(3):
                    for j in range(i, 3):
                        normal[i, j] += J[k, i] / (s[k] * s[k]) * J[k, j]
        determinant = _inverse(normal, inverse)
        if not determinant > 0:
            inverse[:] = np.nan
        for c in range(len(slopes)):
            J, s = slopes[c, n], sigma[c, n]
            if not math.isfinite(s[0] + s[1] + J[0, 0]):
                out[c, n] = 0.0
                continue
            for k in range(2):
                for i in range(3):
                    weighted[i, k] = J[k, i] / (s[k] * s[k])
            for i in range(3):
                for k in range(2):
                    out[c, n, i, k] = (
                        inverse[i, 0] * weighted[0, k] + inverse[i, 1] * weighted[1, k] + inverse[i, 2] * weighted[2, k]
                    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def fill_covariance(gain, sigma):  # type: ignore[no-untyped-def]
    """Covariances ``Σ A_c diag(σ_c²) A_cᵀ`` (n, 3, 3) mm² of triangulated points.

    gain (C, n, 3, 2) mm/px, the sensitivities A_c, zero for a camera that does not see the point. sigma (C, n, 2) px.
    NaN for a point with fewer than two cameras.
    """
    total = np.zeros((gain.shape[1], 3, 3))
    for n in range(gain.shape[1]):
        count = 0
        for c in range(len(gain)):
            A, s = gain[c, n], sigma[c, n]
            takes_part = False
            for i in range(3):
                takes_part |= A[i, 0] != 0 or A[i, 1] != 0
            if not takes_part:
                continue
            count += 1
            for i in range(3):
                for j in range(3):
                    total[n, i, j] += A[i, 0] * s[0] * (A[j, 0] * s[0]) + A[i, 1] * s[1] * (A[j, 1] * s[1])
        if count < 2:
            total[n] = np.nan
    return total


@nb.njit(cache=True, nogil=True, error_model="numpy")
def fill_midpoint_residuals(pairs, values, doubt, rows):  # type: ignore[no-untyped-def]
    """Distance (r,) of the values of some grid points from a prediction by their neighbours.

    The prediction is, for each component, the median over the pairs of opposite neighbours of the mean of the pair.
    values (n, k) of all points; rows (r,) the points that are tested; pairs (n, 4, 2) rows of their opposite
    neighbours, -1 where there is none. doubt (n,): a neighbour with a larger doubt than the point itself is not used.
    NaN where no pair is complete.
    """
    out = np.empty(len(rows))
    middle = np.empty(4)
    for r in range(len(rows)):
        n = rows[r]
        square = 0.0
        for k in range(values.shape[1]):
            count = 0
            for p in range(4):
                a, b = pairs[n, p, 0], pairs[n, p, 1]
                if a < 0 or b < 0 or not max(doubt[a], doubt[b]) <= doubt[n]:
                    continue
                value = 0.5 * (values[a, k] + values[b, k])
                if math.isnan(value):
                    continue
                at = count
                while at > 0 and middle[at - 1] > value:
                    middle[at] = middle[at - 1]
                    at -= 1
                middle[at] = value
                count += 1
            median = 0.5 * (middle[(count - 1) // 2] + middle[count // 2]) if count else np.nan
            square += (values[n, k] - median) ** 2
        out[r] = math.sqrt(square)
    return out
