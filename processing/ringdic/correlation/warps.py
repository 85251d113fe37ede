"""Kernels for the normal equations and for composing warps: Cholesky factor, solution, inverse composition.

All in double precision. The 12 parameters of a warp are those of ``kernels``. The inverse-compositional scheme is Baker
& Matthews (2004), its second-order composition Gao et al. (2015).
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from ringdic.correlation.lanes import INNER

_U = np.uint64


@nb.njit(cache=True, nogil=True, error_model="numpy", **INNER)
def cholesky(H, n):  # type: ignore[no-untyped-def]
    """Cholesky factor of the symmetric matrix H (n, n), in place.

    The lower triangle becomes the factor L with its diagonal inverted. False where H is not positive definite.
    """
    for j in range(_U(n)):
        least, total = 1e-14 * abs(H[j, j]), H[j, j]
        for k in range(j):
            total -= H[j, k] * H[j, k]
        if not total > least:
            return False
        inverse = 1.0 / math.sqrt(total)
        H[j, j] = inverse
        for i in range(j + _U(1), _U(n)):
            total = H[i, j]
            for k in range(j):
                total -= H[i, k] * H[j, k]
            H[i, j] = total * inverse
    return True


@nb.njit(cache=True, nogil=True, **INNER)
def solve_cholesky(L, b, n):  # type: ignore[no-untyped-def]
    """Solve L Lᵀ x = b for x (n,), in place of b; L (n, n) as ``cholesky`` leaves it."""
    for i in range(_U(n)):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * b[k]
        b[i] = total * L[i, i]
    for i in range(n - 1, -1, -1):
        total = b[i]
        for k in range(i + 1, n):
            total -= L[k, i] * b[k]
        b[i] = total * L[i, i]


@nb.njit(cache=True, nogil=True, **INNER)
def variance(L, y, n, which):  # type: ignore[no-untyped-def]
    """Diagonal element (which, which) of the inverse matrix (L Lᵀ)⁻¹, L (n, n) as ``cholesky`` leaves it.

    y : (n,) scratch.
    """
    total = 0.0
    for i in range(_U(which), _U(n)):
        value = 1.0 if i == _U(which) else 0.0
        for k in range(_U(which), i):
            value -= L[i, k] * y[k]
        y[i] = value * L[i, i]
        total += y[i] * y[i]
    return total


@nb.njit(cache=True, nogil=True, error_model="numpy", **INNER)
def _warp_matrix(p, M):  # type: ignore[no-untyped-def]
    """Fill M (6, 6), the matrix of a warp p (12,) that acts on (x², xy, y², x, y, 1) (Gao et al. 2015).

    Third powers are dropped.
    """
    u, ux, uy, uxx, uxy, uyy = p[0], 1.0 + p[1], p[2], p[3], p[4], p[5]
    v, vx, vy, vxx, vxy, vyy = p[6], p[7], 1.0 + p[8], p[9], p[10], p[11]
    M[0, 0], M[0, 1], M[0, 2] = ux * ux + u * uxx, 2 * (ux * uy + u * uxy), uy * uy + u * uyy
    M[0, 3], M[0, 4], M[0, 5] = 2 * u * ux, 2 * u * uy, u * u
    M[1, 0], M[1, 1] = 0.5 * (v * uxx + u * vxx) + ux * vx, v * uxy + u * vxy + ux * vy + uy * vx
    M[1, 2] = 0.5 * (v * uyy + u * vyy) + uy * vy
    M[1, 3], M[1, 4], M[1, 5] = v * ux + u * vx, u * vy + v * uy, u * v
    M[2, 0], M[2, 1], M[2, 2] = vx * vx + v * vxx, 2 * (vx * vy + v * vxy), vy * vy + v * vyy
    M[2, 3], M[2, 4], M[2, 5] = 2 * v * vx, 2 * v * vy, v * v
    M[3, 0], M[3, 1], M[3, 2], M[3, 3], M[3, 4], M[3, 5] = 0.5 * uxx, uxy, 0.5 * uyy, ux, uy, u
    M[4, 0], M[4, 1], M[4, 2], M[4, 3], M[4, 4], M[4, 5] = 0.5 * vxx, vxy, 0.5 * vyy, vx, vy, v
    M[5, 0], M[5, 1], M[5, 2], M[5, 3], M[5, 4], M[5, 5] = 0.0, 0.0, 0.0, 0.0, 0.0, 1.0


@nb.njit(cache=True, nogil=True, error_model="numpy")
def compose_inverse(p, d, A, B):  # type: ignore[no-untyped-def]
    """Compose the warp p (12,) with the inverse of a small increment d (12,), in place: p ← p ∘ d⁻¹, second order.

    The two rows x', y' of W(p) W(d)⁻¹ solve W(d)ᵀ m = rowᵀ. A, B : (6, 6) scratch. False where d cannot be inverted.
    """
    _warp_matrix(d, A)
    _warp_matrix(p, B)
    for col in range(6):  # elimination on Aᵀ; near the identity, so no pivoting
        pivot = A[col, col]
        if not abs(pivot) > 1e-6:
            return False
        for row in range(col + 1, 6):
            factor = A[col, row] / pivot  # Aᵀ[row, col]
            for k in range(col, 6):
                A[k, row] -= factor * A[k, col]
            B[3, row] -= factor * B[3, col]
            B[4, row] -= factor * B[4, col]
    for row in range(5, -1, -1):
        for r in (3, 4):
            total = B[r, row]
            for k in range(row + 1, 6):
                total -= A[k, row] * B[r, k]
            B[r, row] = total / A[row, row]
    p[0], p[1], p[2], p[3], p[4], p[5] = B[3, 5], B[3, 3] - 1.0, B[3, 4], 2 * B[3, 0], B[3, 1], 2 * B[3, 2]
    p[6], p[7], p[8], p[9], p[10], p[11] = B[4, 5], B[4, 3], B[4, 4] - 1.0, 2 * B[4, 0], B[4, 1], 2 * B[4, 2]
    return True


@nb.njit(cache=True, nogil=True, error_model="numpy")
def compose_inverse_affine(p, d):  # type: ignore[no-untyped-def]
    """Compose the affine part of the warp p (12,) with the inverse of that of d (12,), in place: p ← p ∘ d⁻¹, exactly.

    The second derivatives of p stay as they are. False where d cannot be inverted.
    """
    a, b, c, e = 1.0 + d[1], d[2], d[7], 1.0 + d[8]
    det = a * e - b * c
    if not abs(det) > 1e-6:
        return False
    ia, ib, ic, ie = e / det, -b / det, -c / det, a / det
    tx, ty = -(ia * d[0] + ib * d[6]), -(ic * d[0] + ie * d[6])
    ux, uy, vx, vy = 1.0 + p[1], p[2], p[7], 1.0 + p[8]
    p[0] += ux * tx + uy * ty
    p[6] += vx * tx + vy * ty
    p[1], p[2] = ux * ia + uy * ic - 1.0, ux * ib + uy * ie
    p[7], p[8] = vx * ia + vy * ic, vx * ib + vy * ie - 1.0
    return True
