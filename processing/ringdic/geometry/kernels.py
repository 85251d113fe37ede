"""Compiled loops over points: triangulation, propagation of pixel errors to points, residuals against neighbours.

The equations are explained where the kernels are called: :mod:`ringdic.geometry.triangulation`,
:mod:`ringdic.geometry.weighted_triangulation`, :mod:`ringdic.uncertainty.position` and
:mod:`ringdic.geometry.outliers`.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from ringdic.geometry.lens import projection_of_point, slopes_of_projection, undistort_point

# A positive semi-definite N with det N > s (tr N)³ has no eigenvalue below s times the largest one.
_SURE = 1e-9
_STEPS = 8  # most Gauss-Newton steps; two or three are enough unless a match is wrong
_SETTLED = 1e-7  # mm, step at which the iteration has converged
_CROSSING = 1e-10 / 27.0  # least s of lines of sight that cross; 1 / 27 where all directions are known equally well


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
def _determined(N, least):  # type: ignore[no-untyped-def]
    """Whether the determinant of a symmetric matrix N (3, 3) exceeds the share ``least`` of the cube of its trace."""
    determinant = (
        N[0, 0] * (N[1, 1] * N[2, 2] - N[1, 2] * N[1, 2])
        - N[0, 1] * (N[0, 1] * N[2, 2] - N[0, 2] * N[1, 2])
        + N[0, 2] * (N[0, 1] * N[1, 2] - N[0, 2] * N[1, 1])
    )
    return determinant > least * (N[0, 0] + N[1, 1] + N[2, 2]) ** 3


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
        sure[n] = _determined(N, _SURE)
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
def weighted_points(P, K, lens, px, sigma, xyz, covariance, chi2, degrees):  # type: ignore[no-untyped-def]
    """Points of least χ² of their pixels, by Gauss-Newton steps from the weighted linear solution.

    P (C, 3, 4), K (C, 3, 3), lens (C, 5): projections, camera matrices and distortions of the cameras. px, sigma
    (C, n, 2) px, not finite for a camera that is not used. Filled: xyz (n, 3), covariance (n, 3, 3), chi2
    (n,), NaN where a point is not determined, and degrees (n,) of freedom, 0 there.
    """
    normal, inverse, right, at = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for n in range(px.shape[1]):
        views = _weighted_linear_equations(P, K, lens, px, sigma, n, normal, right)
        settled = views >= 2 and _determined(normal, _CROSSING)
        if settled:
            _inverse(normal, inverse)
            for i in range(3):
                at[i] = inverse[i, 0] * right[0] + inverse[i, 1] * right[1] + inverse[i, 2] * right[2]
            settled, chi2[n] = _gauss_newton(P, K, lens, px, sigma, n, normal, inverse, right, at)
        known = settled and math.isfinite(at[0] + at[1] + at[2]) and math.isfinite(chi2[n])
        if known and _determined(normal, _CROSSING):
            xyz[n], covariance[n], degrees[n] = at, inverse, 2 * views - 3
        else:
            xyz[n], covariance[n], chi2[n], degrees[n] = np.nan, np.nan, np.nan, 0


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gauss_newton(P, K, lens, px, sigma, n, normal, inverse, right, at):  # type: ignore[no-untyped-def]
    """Move the position ``at`` (3,) mm of point n to its least χ²; returns whether it converged, and χ² there.

    normal, inverse (3, 3) and right (3,) are overwritten: of the last step.
    """
    chi2, longest = np.nan, np.inf
    for _ in range(_STEPS):
        chi2 = _weighted_equations(P, K, lens, px, sigma, n, at, normal, right)
        if not _inverse(normal, inverse) > 0:
            return False, np.nan
        longest = 0.0
        for i in range(3):
            step = inverse[i, 0] * right[0] + inverse[i, 1] * right[1] + inverse[i, 2] * right[2]
            at[i] += step
            chi2 -= step * right[i]  # χ² at the minimum of its quadratic; exact where the step was small
            longest = max(longest, abs(step))
        if not longest > _SETTLED:
            break
    return longest <= 1e3 * _SETTLED, max(chi2, 0.0)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _weighted_linear_equations(P, K, lens, px, sigma, n, normal, right):  # type: ignore[no-untyped-def]
    """Weighted normal equations of the linear triangulation of point n, into normal (3, 3) and right (3,).

    A row's residual is the pixel's times the depth, which is 1 at the world's origin and about 1 on a specimen. Returns
    the number of cameras in which the pixel and its standard deviation are known.
    """
    views, row = 0, np.empty(4)
    normal[:], right[:] = 0.0, 0.0
    for c in range(len(P)):
        if not math.isfinite(px[c, n, 0] + px[c, n, 1] + sigma[c, n, 0] + sigma[c, n, 1]):
            continue
        views += 1
        fx, fy, cx, cy = K[c, 0, 0], K[c, 1, 1], K[c, 0, 2], K[c, 1, 2]
        y = (px[c, n, 1] - cy) / fy
        x, y = undistort_point((px[c, n, 0] - cx - K[c, 0, 1] * y) / fx, y, lens[c])
        if math.isnan(x):
            continue
        for k in range(2):
            at = fy * y + cy if k else fx * x + cx
            for i in range(4):
                row[i] = (P[c, k, i] - at * P[c, 2, i]) / sigma[c, n, k]
            for i in range(3):
                right[i] -= row[i] * row[3]
                for j in range(3):
                    normal[i, j] += row[i] * row[j]
    return views


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _weighted_equations(P, K, lens, px, sigma, n, at, normal, right):  # type: ignore[no-untyped-def]
    """Normal matrix JᵀWJ (3, 3), right side JᵀWr (3,) with the residuals r, and χ² of point n at a position (3,) mm."""
    chi2, row = 0.0, np.empty((2, 3))
    normal[:], right[:] = 0.0, 0.0
    for c in range(len(P)):
        if not math.isfinite(px[c, n, 0] + px[c, n, 1] + sigma[c, n, 0] + sigma[c, n, 1]):
            continue
        u, v = projection_of_point(P[c], K[c], lens[c], at[0], at[1], at[2])
        row[0, 0], row[0, 1], row[0, 2], row[1, 0], row[1, 1], row[1, 2] = slopes_of_projection(
            P[c], K[c], lens[c], at[0], at[1], at[2]
        )
        for k in range(2):
            weight = 1.0 / (sigma[c, n, k] * sigma[c, n, k])
            residual = px[c, n, 1] - v if k else px[c, n, 0] - u
            chi2 += residual * weight * residual
            for i in range(3):
                right[i] += row[k, i] * weight * residual
                for j in range(3):
                    normal[i, j] += row[k, i] * weight * row[k, j]
    return chi2


@nb.njit(cache=True, nogil=True, error_model="numpy")
def gain(P, K, lens, xyz, sigma, out):  # type: ignore[no-untyped-def]
    """Sensitivities d(point)/d(pixel) of the weighted triangulation, ``(Σ Jᵀ W J)⁻¹ J_cᵀ W_c`` for camera c.

    P (C, 3, 4), K (C, 3, 3), lens (C, 5): projections, camera matrices and distortions of the cameras.
    J is the Jacobian of the projection at xyz (n, 3) mm, W = diag(σ⁻²) of sigma (C, n, 2) px. out (C, n, 3, 2) mm/px is
    filled: zero for a camera in which either is not finite.
    """
    normal, inverse, slopes = np.empty((3, 3)), np.empty((3, 3)), np.empty((len(P), 2, 3))
    for n in range(len(xyz)):
        normal[:] = 0.0
        for c in range(len(P)):
            s = sigma[c, n]
            if not math.isfinite(s[0] + s[1] + xyz[n, 0] + xyz[n, 1] + xyz[n, 2]):
                continue
            J = slopes[c]
            J[0, 0], J[0, 1], J[0, 2], J[1, 0], J[1, 1], J[1, 2] = slopes_of_projection(
                P[c], K[c], lens[c], xyz[n, 0], xyz[n, 1], xyz[n, 2]
            )
            for k in range(2):
                for i in range(3):
                    for j in range(i, 3):
                        normal[i, j] += J[k, i] / (s[k] * s[k]) * J[k, j]
        if not _inverse(normal, inverse) > 0:
            inverse[:] = np.nan
        for c in range(len(P)):
            J, s = slopes[c], sigma[c, n]
            if not math.isfinite(s[0] + s[1] + xyz[n, 0] + xyz[n, 1] + xyz[n, 2]):
                out[c, n] = 0.0
                continue
            for k in range(2):
                weight = 1.0 / (s[k] * s[k])
                for i in range(3):
                    out[c, n, i, k] = weight * (
                        inverse[i, 0] * J[k, 0] + inverse[i, 1] * J[k, 1] + inverse[i, 2] * J[k, 2]
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
def fill_step_covariance(before, after, narrow, whole, current, reference, label, total):  # type: ignore[no-untyped-def]
    """Covariances of positions at a later step, into total (n, 3, 3) mm²; NaN where fewer than two cameras take part.

    before, after (C, n, 3, 2) mm/px: the sensitivities at the reference and at the step, zero for a camera that does
    not see the point. narrow, whole, current (C, n, 2) px: of the matches between the cameras, and of those in time due
    to the reference image and to the step's; NaN in the first two counts as 0. reference (n,): the camera whose pixel
    defines the point, -1 for none. label (n, 3, 2) mm/px: what that pixel moves.
    """
    own, change = np.empty((3, 2)), np.empty((3, 2))
    for n in range(len(reference)):
        total[n] = 0.0
        first, later, between = 0, 0, 0  # cameras that take part
        for c in range(len(before)):
            step, seen, defines = after[c, n], _any(after[c, n]), c == reference[n]
            both = seen and _any(before[c, n])
            if not (seen or defines or _any(before[c, n])):
                continue
            for i in range(3):
                for k in range(2):
                    own[i, k] = before[c, n, i, k] - (label[n, i, k] if defines else 0.0)
                    change[i, k] = own[i, k] - step[i, k]
            first, later, between = first + _any(own), later + seen, between + _any(change)
            for k in range(2):
                a, b = narrow[c, n, k] ** 2, whole[c, n, k] ** 2
                a, b = a if a >= 0 else 0.0, b if b >= 0 else 0.0
                common = min(a, b) if both else 0.0  # of errors that cancel
                rest = current[c, n, k] ** 2 + b - common if seen else 0.0
                for i in range(3):
                    for j in range(i, 3):
                        total[n, i, j] += (
                            change[i, k] * change[j, k] * common
                            + own[i, k] * own[j, k] * (a - common)
                            + step[i, k] * step[j, k] * rest
                        )
        total[n, 1, 0], total[n, 2, 0], total[n, 2, 1] = total[n, 0, 1], total[n, 0, 2], total[n, 1, 2]
        if min(first, later, between) < 2:
            total[n] = np.nan


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _any(A):  # type: ignore[no-untyped-def]
    """Whether a sensitivity A (3, 2) is not zero."""
    return A[0, 0] != 0 or A[0, 1] != 0 or A[1, 0] != 0 or A[1, 1] != 0 or A[2, 0] != 0 or A[2, 1] != 0


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
