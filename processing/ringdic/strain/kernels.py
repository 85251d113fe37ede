"""Compiled loops over triangles: directors, deformation, linear strain, and variances of the stretches by image noise.

The equations are explained where the kernels are called: :mod:`ringdic.strain.deformation` and
:mod:`ringdic.uncertainty.strain`. S is the number of steps, M that of triangles, N that of vertices.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cross(a, b, c):  # type: ignore[no-untyped-def]
    """Write the vector product ``a × b`` into c."""
    c[0] = a[1] * b[2] - a[2] * b[1]
    c[1] = a[2] * b[0] - a[0] * b[2]
    c[2] = a[0] * b[1] - a[1] * b[0]


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _dot(a, b):  # type: ignore[no-untyped-def]
    """Scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _reciprocal(D, R):  # type: ignore[no-untyped-def]
    """Write the reciprocal directors of D (3, 3) into the rows of R, ``D_i · R^j = δ_ij``; D3 is a unit normal."""
    _cross(D[0], D[1], R[2])
    volume = _dot(R[2], D[2])
    _cross(D[1], D[2], R[0])
    _cross(D[2], D[0], R[1])
    for i in range(3):
        R[0, i] /= volume
        R[1, i] /= volume
        R[2, i] = D[2, i]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def fill_directors(vertices, faces, D, area):  # type: ignore[no-untyped-def]
    """Fill the directors D (S, M, 3, 3) and areas (S, M) mm² of triangles (Solav et al. 2018, eq. 12).

    vertices (S, N, 3) mm. faces (M, 3) vertex indices. area : the array of the areas.
    """
    for s in range(len(vertices)):
        for m in range(len(faces)):
            out = D[s, m]
            for i in range(3):
                first = vertices[s, faces[m, 0], i]
                out[0, i] = vertices[s, faces[m, 1], i] - first
                out[1, i] = vertices[s, faces[m, 2], i] - first
            _cross(out[0], out[1], out[2])
            length = math.sqrt(_dot(out[2], out[2]))
            if not length > 0:
                length = np.nan
            for i in range(3):
                out[2, i] /= length
            area[s, m] = 0.5 * length


@nb.njit(cache=True, nogil=True, error_model="numpy")
def fill_isotropy(vertices, faces, out):  # type: ignore[no-untyped-def]
    """Fill out (S, M) with the isotropy of the shape of triangles, 1 equilateral … 0 degenerate.

    vertices (S, N, 3) mm. faces (M, 3) vertex indices.
    """
    X, S = np.empty((3, 3)), np.empty((3, 3))
    for s in range(len(vertices)):
        for m in range(len(faces)):
            for i in range(3):
                for k in range(3):
                    X[k, i] = vertices[s, faces[m, k], i]
                mean = (X[0, i] + X[1, i] + X[2, i]) / 3.0
                for k in range(3):
                    X[k, i] -= mean
            square = 0.0
            for i in range(3):
                for j in range(3):
                    S[i, j] = (X[0, i] * X[0, j] + X[1, i] * X[1, j] + X[2, i] * X[2, j]) / 3.0
                    square += S[i, j] * S[i, j]
            # One singular value of S is zero; the sum of the others is tr S, their product S's second invariant.
            trace = S[0, 0] + S[1, 1] + S[2, 2]
            product = 0.5 * (trace * trace - square)
            root = trace * trace - 4.0 * product
            out[s, m] = (trace - math.sqrt(root if not root < 0 else 0.0)) / trace


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _smaller_axis(half, E12, radius):  # type: ignore[no-untyped-def]
    """Cosine and sine of the angle ``½ atan2(E12, half) + ½ π`` of the axis of the smaller principal strain.

    half is ½ (E11 - E22), radius that of Mohr's circle.
    """
    if radius == 0:
        return 0.0, 1.0
    larger = math.sqrt(0.5 * (1.0 + abs(half) / radius))
    smaller = 0.5 * abs(E12) / (radius * larger)
    cos, sin = (larger, smaller) if half >= 0 else (smaller, larger)  # of ½ |atan2(E12, half)|
    return -math.copysign(sin, E12), cos


@nb.njit(cache=True, nogil=True, error_model="numpy")
def fill_deformation(D, d, F, E, scalars, directions):  # type: ignore[no-untyped-def]
    """Fill deformation gradient, Green-Lagrange strain and its principal values in the plane (Solav et al., eq. 13-16).

    D (M, 3, 3), d (S M, 3, 3): reference and current directors. Filled: F and E (S M, 3, 3); scalars (5, S M): λ1, λ2,
    J, E1, E2; directions (4, S M, 3): first and second principal direction in the reference, then in the current
    configuration.
    """
    R, a, along = np.empty((3, 3)), np.empty((2, 3)), np.empty((2, 3))
    for n in range(len(d)):
        before = D[n % len(D)]
        _reciprocal(before, R)
        f, e = F[n], E[n]
        for i in range(3):
            for j in range(3):
                f[i, j] = d[n, 0, i] * R[0, j] + d[n, 1, i] * R[1, j] + d[n, 2, i] * R[2, j]
        for i in range(3):
            for j in range(3):
                c = f[0, i] * f[0, j] + f[1, i] * f[1, j] + f[2, i] * f[2, j]
                e[i, j] = 0.5 * (c - (1.0 if i == j else 0.0))
        length = math.sqrt(_dot(before[0], before[0]))
        for i in range(3):
            a[0, i] = before[0, i] / length
        _cross(before[2], a[0], a[1])
        for i in range(3):
            along[0, i] = _dot(e[i], a[0])
            along[1, i] = _dot(e[i], a[1])
        E11, E12, E22 = _dot(a[0], along[0]), _dot(a[0], along[1]), _dot(a[1], along[1])
        mean, half = 0.5 * (E11 + E22), 0.5 * (E11 - E22)
        radius = math.sqrt(half * half + E12 * E12)
        cos, sin = _smaller_axis(half, E12, radius)
        scalars[3, n], scalars[4, n] = mean - radius, mean + radius
        scalars[0, n], scalars[1, n] = math.sqrt(1.0 + 2.0 * (mean - radius)), math.sqrt(1.0 + 2.0 * (mean + radius))
        scalars[2, n] = scalars[0, n] * scalars[1, n]
        for i in range(3):
            directions[0, n, i] = cos * a[0, i] + sin * a[1, i]
            directions[1, n, i] = cos * a[1, i] - sin * a[0, i]
        for k in range(2):
            for i in range(3):
                directions[2 + k, n, i] = _dot(f[i], directions[k, n]) / scalars[k, n]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def euler_almansi(D, d, out):  # type: ignore[no-untyped-def]
    """Euler-Almansi strain ``½ (I - F⁻ᵀ F⁻¹)`` with ``F⁻¹ = Σ D_i ⊗ d^i`` (Solav et al. 2018, eq. 17).

    D (M, 3, 3), d (S M, 3, 3): reference and current directors. out (S M, 3, 3) is filled.
    """
    R, inverse = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(d)):
        before = D[n % len(D)]
        _reciprocal(d[n], R)
        for i in range(3):
            for j in range(3):
                inverse[i, j] = before[0, i] * R[0, j] + before[1, i] * R[1, j] + before[2, i] * R[2, j]
        for i in range(3):
            for j in range(3):
                b = inverse[0, i] * inverse[0, j] + inverse[1, i] * inverse[1, j] + inverse[2, i] * inverse[2, j]
                out[n, i, j] = 0.5 * ((1.0 if i == j else 0.0) - b)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def linear_principal(turn, F, normal, out):  # type: ignore[no-untyped-def]
    """Principal values of the linear strain ``½ (G + Gᵀ) - I`` of ``G = turn F``, in the tangent plane.

    turn (3, 3) rotation. F (M, 3, 3) deformation gradients. normal (M, 3) unit normals of the reference. out (2, M) is
    filled, the smaller value first.
    """
    L, P, G = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for m in range(len(F)):
        for i in range(3):
            for j in range(3):
                G[i, j] = turn[i, 0] * F[m, 0, j] + turn[i, 1] * F[m, 1, j] + turn[i, 2] * F[m, 2, j]
                P[i, j] = (1.0 if i == j else 0.0) - normal[m, i] * normal[m, j]
        for i in range(3):
            for j in range(3):
                L[i, j] = 0.5 * (G[i, j] + G[j, i]) - (1.0 if i == j else 0.0)
        for i in range(3):
            for j in range(3):
                G[i, j] = P[i, 0] * L[0, j] + P[i, 1] * L[1, j] + P[i, 2] * L[2, j]
        trace, square = 0.0, 0.0
        for i in range(3):
            for j in range(3):
                value = G[i, 0] * P[0, j] + G[i, 1] * P[1, j] + G[i, 2] * P[2, j]
                square += value * value
                if i == j:
                    trace += value
        half = 0.5 * trace
        root = 0.5 * square - half * half
        radius = math.sqrt(root if not root < 0 else 0.0)
        out[0, m], out[1, m] = half - radius, half + radius


@nb.njit(cache=True, nogil=True, error_model="numpy")
def stretch_variance(slopes, gain, sigma, alike, faces, variance):  # type: ignore[no-untyped-def]
    """Add the variances of both principal stretches that come from the matching errors in C images to variance (M, 2).

    slopes (2, M, 3, 3) mm⁻¹: d(stretch)/d(corner), axes stretch, triangle, corner, component. gain (C, N, 3, 2) mm/px:
    d(vertex)/d(pixel), zero where an image does not see the vertex. sigma (C, N, 2) px, NaN for an exact pixel. alike
    (C or 1, M, 3): correlation of the errors at corners 0 and 1, 1 and 2, 2 and 0. faces (M, 3) vertex indices.
    """
    felt = np.empty((3, 2))
    for m in range(len(faces)):
        for camera in range(len(gain)):
            rho = alike[camera if len(alike) > 1 else 0, m]
            takes_part = False
            for c in range(3):
                one = gain[camera, faces[m, c]]
                for i in range(3):
                    takes_part |= one[i, 0] != 0 or one[i, 1] != 0
            if not takes_part:
                continue
            for s in range(2):
                total = 0.0
                for c in range(3):
                    one, scatter = gain[camera, faces[m, c]], sigma[camera, faces[m, c]]
                    for j in range(2):
                        width = 0.0 if math.isnan(scatter[j]) else scatter[j]
                        value = 0.0
                        for i in range(3):
                            value += slopes[s, m, c, i] * (one[i, j] * width)
                        felt[c, j] = value
                        total += value * value
                for c in range(3):
                    other = (c + 1) % 3
                    total += 2.0 * rho[c] * (felt[c, 0] * felt[other, 0] + felt[c, 1] * felt[other, 1])
                variance[m, s] += total


@nb.njit(cache=True, nogil=True, error_model="numpy")
def fill_stretch_slopes(D, F, directions, stretches, current, before):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the principal stretches λ1, λ2 with respect to the triangles' corner positions, mm⁻¹.

    D (M, 3, 3) reference directors, F (M, 3, 3) deformation gradients, directions (2, M, 3) principal directions in the
    reference, stretches (2, M). Filled: current and before (2, M, 3, 3), derivatives with respect to the
    current and the reference corners, axes stretch, triangle, corner, component; before is left out if its second axis
    has length 0.
    """
    R = np.empty((3, 3))
    wanted = before.shape[1] > 0
    for m in range(len(F)):
        _reciprocal(D[m], R)
        for k in range(2):
            N, stretch = directions[k, m], stretches[k, m]
            first, second = _dot(R[0], N), _dot(R[1], N)
            for i in range(3):
                after = _dot(F[m, i], N) / stretch
                current[k, m, 1, i], current[k, m, 2, i] = first * after, second * after
                current[k, m, 0, i] = -(current[k, m, 1, i] + current[k, m, 2, i])
                if wanted:
                    before[k, m, 1, i], before[k, m, 2, i] = first * stretch * N[i], second * stretch * N[i]
                    before[k, m, 0, i] = -(before[k, m, 1, i] + before[k, m, 2, i])
