"""Inverse-compositional Gauss-Newton in plain double precision, to which the vectorised kernels are compared.

Parameters of a subset, 12: u ux uy uxx uxy uyy v vx vy vxx vxy vyy, so that a pixel at (dx, dy) from the centre (x, y)
lies in the current image at x + dx + u + ux dx + uy dy + ½ uxx dx² + uxy dx dy + ½ uyy dy², likewise in y (Lu & Cary
2000). First order keeps the second derivatives at their start values (zero, or a known curvature): its free parameters
are six. Criterion: zero-mean normalised sum of squared differences; the inverse-compositional scheme is Baker &
Matthews (2004), its second-order composition Gao et al. (2015).
"""

# Everything the kernel calls is in this file: numba's cache follows the file of the compiled function alone.
from __future__ import annotations

import math

import numba as nb
import numpy as np

GOOD, NO_CONVERGENCE, OUTSIDE, NO_TEXTURE = 0, 2, 5, 6
N_PARAMETERS = 12
_PAD = 3
_FAST = {"contract", "reassoc", "arcp", "nsz"}


@nb.njit(inline="always", fastmath=_FAST)
def _weights5(t):  # type: ignore[no-untyped-def]
    """Quintic B-spline at the taps -2 … 3 for a fraction t, times 120."""
    t2 = t * t
    t3 = t2 * t
    t4 = t2 * t2
    t5 = t4 * t
    s = 1.0 - t
    s2 = s * s
    return (
        s2 * s2 * s,
        26.0 - 50.0 * t + 20.0 * t2 + 20.0 * t3 - 20.0 * t4 + 5.0 * t5,
        66.0 - 60.0 * t2 + 30.0 * t4 - 10.0 * t5,
        26.0 + 50.0 * t + 20.0 * t2 - 20.0 * t3 - 20.0 * t4 + 10.0 * t5,
        1.0 + 5.0 * t + 10.0 * t2 + 10.0 * t3 + 5.0 * t4 - 5.0 * t5,
        t5,
    )


@nb.njit(inline="always", fastmath=_FAST)
def _slopes5(t):  # type: ignore[no-untyped-def]
    """Derivative of _weights5 by t."""
    t2 = t * t
    t3 = t2 * t
    t4 = t2 * t2
    s = 1.0 - t
    s2 = s * s
    return (
        -5.0 * s2 * s2,
        -50.0 + 40.0 * t + 60.0 * t2 - 80.0 * t3 + 25.0 * t4,
        -120.0 * t + 120.0 * t3 - 50.0 * t4,
        50.0 + 40.0 * t - 60.0 * t2 - 80.0 * t3 + 50.0 * t4,
        5.0 + 20.0 * t + 30.0 * t2 + 20.0 * t3 - 25.0 * t4,
        5.0 * t4,
    )


@nb.njit(inline="always", fastmath=_FAST)
def _weights3(t):  # type: ignore[no-untyped-def]
    """Cubic B-spline at the taps -1 … 2, times 6, with a zero on either side so that both degrees share the loops."""
    t2 = t * t
    t3 = t2 * t
    s = 1.0 - t
    return (0.0, s * s * s, 4.0 - 6.0 * t2 + 3.0 * t3, 1.0 + 3.0 * t + 3.0 * t2 - 3.0 * t3, t3, 0.0)


@nb.njit(inline="always", fastmath=_FAST)
def _slopes3(t):  # type: ignore[no-untyped-def]
    """Derivative of _weights3 by t."""
    t2 = t * t
    s = 1.0 - t
    return (0.0, -3.0 * s * s, -12.0 * t + 9.0 * t2, 3.0 + 6.0 * t - 9.0 * t2, 3.0 * t2, 0.0)


@nb.njit(inline="always", fastmath=_FAST)
def _row(c, i, j, a):  # type: ignore[no-untyped-def]
    """Σ_k a_k c[i, j + k] over the six taps of the quintic."""
    return (
        a[0] * c[i, j]
        + a[1] * c[i, j + np.uint64(1)]
        + a[2] * c[i, j + np.uint64(2)]
        + a[3] * c[i, j + np.uint64(3)]
        + a[4] * c[i, j + np.uint64(4)]
        + a[5] * c[i, j + np.uint64(5)]
    )


@nb.njit(inline="always", fastmath=_FAST)
def _row3(c, i, j, a):  # type: ignore[no-untyped-def]
    """Σ_k a_k c[i, j + k] over the four taps of the cubic, k = 1 to 4."""
    return (
        a[1] * c[i, j + np.uint64(1)]
        + a[2] * c[i, j + np.uint64(2)]
        + a[3] * c[i, j + np.uint64(3)]
        + a[4] * c[i, j + np.uint64(4)]
    )


@nb.njit(inline="always", fastmath=_FAST)
def _quintic(c, i, j, wx, wy):  # type: ignore[no-untyped-def]
    """Quintic spline at the weights wx, wy of the six taps from (i, j) on."""
    return (
        wy[0] * _row(c, i, j, wx)
        + wy[1] * _row(c, i + np.uint64(1), j, wx)
        + wy[2] * _row(c, i + np.uint64(2), j, wx)
        + wy[3] * _row(c, i + np.uint64(3), j, wx)
        + wy[4] * _row(c, i + np.uint64(4), j, wx)
        + wy[5] * _row(c, i + np.uint64(5), j, wx)
    ) * (1.0 / 14400.0)


@nb.njit(inline="always", fastmath=_FAST)
def _cubic(c, i, j, wx, wy):  # type: ignore[no-untyped-def]
    """Cubic spline at the weights wx, wy of the four taps from (i + 1, j + 1) on."""
    return (
        wy[1] * _row3(c, i + np.uint64(1), j, wx)
        + wy[2] * _row3(c, i + np.uint64(2), j, wx)
        + wy[3] * _row3(c, i + np.uint64(3), j, wx)
        + wy[4] * _row3(c, i + np.uint64(4), j, wx)
    ) * (1.0 / 36.0)


@nb.njit(cache=True)
def cholesky(H, n):  # type: ignore[no-untyped-def]
    """Cholesky factor of H (n, n), in place; False where H is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            total = H[i, j]
            for k in range(j):
                total -= H[i, k] * H[j, k]
            if i == j:
                if not total > 1e-14 * abs(H[i, i]):
                    return False
                H[i, i] = math.sqrt(total)
            else:
                H[i, j] = total / H[j, j]
    return True


@nb.njit(cache=True)
def solve(L, b, n):  # type: ignore[no-untyped-def]
    """Solve L Lᵀ x = b for x (n,), in place of b."""
    for i in range(n):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@nb.njit(cache=True)
def _warp_matrix(p, M):  # type: ignore[no-untyped-def]
    """The warp as a matrix (6, 6) acting on (x², xy, y², x, y, 1), third powers dropped (Gao et al. 2015)."""
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


@nb.njit(cache=True)
def compose_inverse(p, d, A, B):  # type: ignore[no-untyped-def]
    """p ← p ∘ d⁻¹ for small d; False where d cannot be inverted. A, B : (6, 6) scratch.

    The two rows x', y' of W(p) W(d)⁻¹ solve W(d)ᵀ m = rowᵀ.
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


@nb.njit(cache=True)
def compose_inverse_affine(p, d):  # type: ignore[no-untyped-def]
    """p ← p ∘ d⁻¹ of first order, exactly; second derivatives of p stay. False where d cannot be inverted."""
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


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def gather_subset(image, gx, gy, coef, mask, x, y, radius, circle, quintic, px):  # type: ignore[no-untyped-def]
    """Collect the pixels of a subset: rows of px (5, N) become dx, dy, f, ∂f/∂x, ∂f/∂y; returns their number.

    image, gx, gy, mask : (h, w); (x, y) : the centre, px, from which dx and dy are measured. At a fractional centre f
    and its gradient are interpolated from coef (quintic or cubic). radius, circle : of the subset, which the mask cuts.
    """
    jx, iy = math.floor(x + 0.5), math.floor(y + 0.5)
    whole = x == jx and y == iy
    height, width = image.shape
    fx, fy = math.floor(x), math.floor(y)
    if quintic:
        wx, wy = _weights5(x - fx), _weights5(y - fy)
        sx, sy = _slopes5(x - fx), _slopes5(y - fy)
    else:
        wx, wy = _weights3(x - fx), _weights3(y - fy)
        sx, sy = _slopes3(x - fx), _slopes3(y - fy)
    n = 0
    for dy in range(-radius, radius + 1):
        i = iy + dy
        if i < 0 or i >= height:
            continue
        for dx in range(-radius, radius + 1):
            j = jx + dx
            if j < 0 or j >= width or not mask[i, j] or (circle and dx * dx + dy * dy > radius * radius):
                continue
            if whole:
                px[2, n], px[3, n], px[4, n] = image[i, j], gx[i, j], gy[i, j]
            else:
                at_i, at_j = fy + dy, fx + dx
                if at_i < 0 or at_j < 0 or at_i >= height - 1 or at_j >= width - 1:
                    continue
                a, b = np.uint64(at_i + _PAD - 2), np.uint64(at_j + _PAD - 2)
                px[2, n] = _quintic(coef, a, b, wx, wy) if quintic else _cubic(coef, a, b, wx, wy)
                px[3, n] = _quintic(coef, a, b, sx, wy) if quintic else _cubic(coef, a, b, sx, wy)
                px[4, n] = _quintic(coef, a, b, wx, sy) if quintic else _cubic(coef, a, b, wx, sy)
            px[0, n], px[1, n] = dx, dy
            n += 1
    return n


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def accumulate(px, n, coef, x, y, p, second, quintic, sums):  # type: ignore[no-untyped-def]
    """Sum over the n pixels px of a subset in the current image; False where one lies outside the image.

    coef : padded coefficients of the current image; (x, y) : the centre, p (12,) : the warp. second : whether of second
    order; quintic : degree 5, else 3. sums : (16,), filled: Σg, Σg², Σfg, spare, then Σ g ∂f/∂x φ_k (6) and Σ g ∂f/∂y
    φ_k (6) with φ = 1 dx dy dx²/2 dxdy dy²/2.
    """
    last_x, last_y = coef.shape[1] - 2 * _PAD - 1, coef.shape[0] - 2 * _PAD - 1
    s_g = s_gg = s_fg = a0 = a1 = a2 = a3 = a4 = a5 = b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    curved = p[3] != 0.0 or p[4] != 0.0 or p[5] != 0.0 or p[9] != 0.0 or p[10] != 0.0 or p[11] != 0.0
    ux, vy = 1.0 + p[1], 1.0 + p[8]
    x0, y0 = x + p[0], y + p[6]
    for k in range(n):
        dx, dy = px[0, k], px[1, k]
        xx = x0 + ux * dx + p[2] * dy
        yy = y0 + p[7] * dx + vy * dy
        if curved:
            xx += 0.5 * p[3] * dx * dx + p[4] * dx * dy + 0.5 * p[5] * dy * dy
            yy += 0.5 * p[9] * dx * dx + p[10] * dx * dy + 0.5 * p[11] * dy * dy
        if not (xx >= 0.0 and yy >= 0.0 and xx <= last_x and yy <= last_y):
            return False
        j, i = int(xx), int(yy)
        at_i, at_j = np.uint64(i + _PAD - 2), np.uint64(j + _PAD - 2)
        if quintic:
            g = _quintic(coef, at_i, at_j, _weights5(xx - j), _weights5(yy - i))
        else:
            g = _cubic(coef, at_i, at_j, _weights3(xx - j), _weights3(yy - i))
        s_g += g
        s_gg += g * g
        s_fg += g * px[2, k]
        ga, gb = g * px[3, k], g * px[4, k]
        a0 += ga
        a1 += ga * dx
        a2 += ga * dy
        b0 += gb
        b1 += gb * dx
        b2 += gb * dy
        if second:
            q, r, s = 0.5 * dx * dx, dx * dy, 0.5 * dy * dy
            a3 += ga * q
            a4 += ga * r
            a5 += ga * s
            b3 += gb * q
            b4 += gb * r
            b5 += gb * s
    sums[0], sums[1], sums[2] = s_g, s_gg, s_fg
    sums[4], sums[5], sums[6], sums[7], sums[8], sums[9] = a0, a1, a2, a3, a4, a5
    sums[10], sums[11], sums[12], sums[13], sums[14], sums[15] = b0, b1, b2, b3, b4, b5
    return True


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def normal_matrix(px, n, terms, H, sum_J, sum_fJ):  # type: ignore[no-untyped-def]
    """Normal matrix H = Σ JᵀJ (2 terms, 2 terms), sum_J = ΣJ and sum_fJ = Σ f J, with J = (∂f/∂x φ, ∂f/∂y φ).

    px, n : the pixels of the subset and their number. terms : 3 or 6.
    """
    phi = np.empty(6)
    H[: 2 * terms, : 2 * terms] = 0.0
    sum_J[:] = 0.0
    sum_fJ[:] = 0.0
    for k in range(n):
        dx, dy, f, fx, fy = px[0, k], px[1, k], px[2, k], px[3, k], px[4, k]
        phi[0], phi[1], phi[2] = 1.0, dx, dy
        phi[3], phi[4], phi[5] = 0.5 * dx * dx, dx * dy, 0.5 * dy * dy
        for a in range(terms):
            xa, ya = fx * phi[a], fy * phi[a]
            sum_J[a] += xa
            sum_J[terms + a] += ya
            sum_fJ[a] += f * xa
            sum_fJ[terms + a] += f * ya
            for b in range(a + 1):
                H[a, b] += fx * xa * phi[b]
                H[terms + a, terms + b] += fy * ya * phi[b]
            for b in range(terms):
                H[terms + a, b] += fx * ya * phi[b]


@nb.njit(cache=True, nogil=True)
def _refine_point(  # type: ignore[no-untyped-def]
    image, gx, gy, coef_ref, mask, coef, x_ref, y_ref, x_cur, y_cur, p,
    radius, circle, terms, quintic, tolerance, max_iterations, texture, noise,
):  # fmt: skip
    """IC-GN of one subset from the parameters p (12,), refined in place.

    (x_ref, y_ref) and (x_cur, y_cur) : the centre in the two images' own crops. Returns status, ZNCC, iterations,
    sigma of u and of v (px).
    """
    full = (2 * radius + 1) ** 2
    px = np.empty((5, full))
    n = gather_subset(image, gx, gy, coef_ref, mask, x_ref, y_ref, radius, circle, quintic, px)
    if n < max(0.15 * full, 6 * terms):
        return NO_TEXTURE, np.nan, 0, np.nan, np.nan
    mean = np.sum(px[2, :n]) / n
    px[2, :n] -= mean
    norm_f = math.sqrt(np.sum(px[2, :n] ** 2))
    size = 2 * terms
    H, sum_J, sum_fJ = np.empty((size, size)), np.empty(size), np.empty(size)
    normal_matrix(px, n, terms, H, sum_J, sum_fJ)
    half_trace = 0.5 * (H[0, 0] + H[terms, terms])
    spread = math.sqrt((0.5 * (H[0, 0] - H[terms, terms])) ** 2 + H[terms, 0] ** 2)
    if not half_trace - spread > n * texture * texture or not norm_f > 0.0 or not cholesky(H, size):
        return NO_TEXTURE, np.nan, 0, np.nan, np.nan

    sums, b, d = np.empty(16), np.empty(size), np.zeros(12)
    A, B = np.empty((6, 6)), np.empty((6, 6))
    second = terms == 6
    status, zncc, iterations = NO_CONVERGENCE, np.nan, 0
    for _ in range(max_iterations):
        iterations += 1
        if not accumulate(px, n, coef, x_cur, y_cur, p, second, quintic, sums):
            return OUTSIDE, np.nan, iterations, np.nan, np.nan
        mean_g = sums[0] / n
        variance = sums[1] - n * mean_g * mean_g
        if not variance > 1e-9 * n:
            return NO_TEXTURE, np.nan, iterations, np.nan, np.nan
        ratio = norm_f / math.sqrt(variance)
        zncc = sums[2] / norm_f / math.sqrt(variance)
        for k in range(terms):
            b[k] = ratio * (sums[4 + k] - mean_g * sum_J[k]) - sum_fJ[k]
            b[terms + k] = ratio * (sums[10 + k] - mean_g * sum_J[terms + k]) - sum_fJ[terms + k]
        solve(H, b, size)
        for k in range(terms):
            d[k], d[6 + k] = b[k], b[terms + k]
        norm = d[0] ** 2 + d[6] ** 2 + radius**2 * (d[1] ** 2 + d[2] ** 2 + d[7] ** 2 + d[8] ** 2)
        if second:
            norm += 0.25 * radius**4 * (d[3] ** 2 + d[5] ** 2 + d[9] ** 2 + d[11] ** 2 + 4 * (d[4] ** 2 + d[10] ** 2))
        if not norm < 4.0 * radius * radius:
            break
        if not (compose_inverse(p, d, A, B) if second else compose_inverse_affine(p, d)):
            break
        if norm < tolerance * tolerance:
            status = GOOD
            break
    if status != GOOD:
        return status, zncc, iterations, np.nan, np.nan
    # Residual variance f' - r g' holds both images' noise: √2 σ.
    scatter = math.sqrt(2.0) * noise
    if not noise > 0.0:
        scatter = norm_f * math.sqrt(max(2.0 * (1.0 - zncc), 0.0) / (n - size - 2))
    b[:] = 0.0
    b[0] = 1.0
    solve(H, b, size)
    sigma_u = scatter * math.sqrt(b[0])
    b[:] = 0.0
    b[terms] = 1.0
    solve(H, b, size)
    return status, zncc, iterations, sigma_u, scatter * math.sqrt(b[terms])


@nb.njit(cache=True, nogil=True, parallel=True)
def refine(  # type: ignore[no-untyped-def]
    image, gx, gy, coef_ref, mask, origin_ref, coef, origin_cur, xy, parameters, known,
    radius, circle, terms, quintic, tolerance, max_iterations, texture, noise,
    status, zncc, iterations, sigma,
):  # fmt: skip
    """Refine many subsets in parallel; each is independent of the others, and so are the results of the number of
    threads.

    image, gx, gy, mask : (h, w) crop of the reference at origin_ref (x, y), coef_ref its coefficients, padded.
    coef : padded coefficients of the crop of the current image at origin_cur.
    xy : (n, 2) px. parameters : (n, 12), start values in and results out. known : (n,) bool, points to refine.
    radius, circle, terms, quintic, tolerance, max_iterations, texture, noise : as for the kernel ``refine_points``.
    status, zncc, iterations (n,) and sigma (n, 2) are filled where known.
    """
    for k in nb.prange(xy.shape[0]):
        if known[k]:
            result = _refine_point(
                image, gx, gy, coef_ref, mask, coef, xy[k, 0] - origin_ref[0], xy[k, 1] - origin_ref[1],
                xy[k, 0] - origin_cur[0], xy[k, 1] - origin_cur[1], parameters[k],
                radius, circle, terms, quintic, tolerance, max_iterations, texture, noise,
            )  # fmt: skip
            status[k] = result[0]
            zncc[k] = result[1]
            iterations[k] = result[2]
            sigma[k, 0] = result[3]
            sigma[k, 1] = result[4]
