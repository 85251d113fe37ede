"""Inverse-compositional Gauss-Newton of one subset, and of many on all cores. Plain numbers and arrays only.

Parameters of a subset, 12: u ux uy uxx uxy uyy v vx vy vxx vxy vyy, so that a pixel at (dx, dy) from the centre
(x, y) lies in the current image at x + dx + u + ux dx + uy dy + ½ uxx dx² + uxy dx dy + ½ uyy dy², likewise in y
(Lu & Cary 2000). First order keeps the second derivatives as they come in (zero, or a known curvature): its free
parameters are six. Criterion: zero-mean normalised sum of squared differences; scheme: Baker & Matthews (2004).

Shape of the code. A subset is packed once into vectors of 16 pixels of one row: weight (1, or 0 outside the subset and
the mask), f and its gradient, so a circle and a mask cost nothing. In an iteration every vector finds its place in
the current image (``_place``), all are interpolated (``interpolation``), and one pass over the packed pixels sums all
that a step needs. The Hessian comes from moments Σ q dx^i dy^k of the products of the gradients, no steepest-descent
image is stored.

What the speed hangs on: loops of constant length over unsigned indices (signed ones are checked for wrapping round,
which breaks the vectors), single-precision constants, no array stored per pixel but g. What the digits hang on: t is
small, so single precision resolves it to 1e-7 px; g is taken about its mean; everything after the sums is double.
"""

# Numba's cache follows the file of the compiled function alone: after a change in what it imports, remove __pycache__.
from __future__ import annotations

import math

import numba as nb
import numpy as np

from processing.correlation.interpolation import (
    ACROSS_X,
    ACROSS_Y,
    FAST,
    LANES,
    SCATTERED,
    between_pixels,
    interpolate,
)
from processing.correlation.spline import PAD
from processing.correlation.warps import cholesky, compose_inverse, compose_inverse_affine, solve

GOOD, NO_CONVERGENCE, OUTSIDE, NO_TEXTURE = 0, 2, 5, 6
N_PARAMETERS = 12
_F, _U = np.float32, np.uint64
_WEIGHT, _REF, _GX, _GY, _CUR = range(5)  # rows of a packed subset
_LAST_DIGIT = 1e-5  # px; steps below it that shrink no more are the rounding of single precision
_CHUNK = 64  # points that share their scratch memory
_PAD = PAD


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def _place(shape, first_tap, x, y, p, radius, corner, weight, n, base, case, place):  # type: ignore[no-untyped-def]
    """Where n vectors lie in the current image: first tap, fraction, slope and case of each; False if one leaves it.

    corner : (2, n) dx, dy of lane 0; weight : (16 n,) of the lanes, those of weight 0 may lie anywhere.
    """
    stride = shape[1]
    last_x, last_y = float(shape[1] - 2 * _PAD - 1), float(shape[0] - 2 * _PAD - 1)
    x0, y0 = x + p[0], y + p[6]
    far = float(LANES - 1)
    qx, qy, mx, my = 0.5 * p[3], 0.5 * p[9], 0.5 * p[5], 0.5 * p[11]
    bend_x, bend_y = abs(qx) * 0.25 * far * far, abs(qy) * 0.25 * far * far
    # Clearly inside the image with all lanes; otherwise each vector is looked at.
    r = radius + far
    reach_x = r * (1.0 + abs(p[1]) + abs(p[2]) + r * (abs(qx) + abs(p[4]) + abs(mx)))
    reach_y = r * (1.0 + abs(p[7]) + abs(p[8]) + r * (abs(qy) + abs(p[10]) + abs(my)))
    inside = x0 > reach_x and y0 > reach_y and x0 + reach_x < last_x and y0 + reach_y < last_y
    if not inside and not _stays(last_x, last_y, x0, y0, p, corner, weight, n):
        return False
    for v in range(_U(n)):
        dx, dy = float(corner[0, v]), float(corner[1, v])
        xx = x0 + dx + dx * (p[1] + qx * dx + p[4] * dy) + dy * (p[2] + mx * dy)
        yy = y0 + dy + dx * (p[7] + qy * dx + p[10] * dy) + dy * (p[8] + my * dy)
        sx, sy = p[1] + p[3] * dx + p[4] * dy, p[7] + p[9] * dx + p[10] * dy
        x_far, y_far = far * (sx + far * qx), far * (sy + far * qy)
        x_low, y_low = xx + min(0.0, x_far) - bend_x, yy + min(0.0, y_far) - bend_y
        j, i = math.floor(x_low), math.floor(y_low)
        wide = math.floor(xx + max(0.0, x_far) + bend_x) - j
        high = math.floor(yy + max(0.0, y_far) + bend_y) - i
        case[v] = wide * ACROSS_X + high * ACROSS_Y if max(wide, high) < 2 else SCATTERED
        base[v] = _U((i + (_PAD - first_tap)) * stride + j + (_PAD - first_tap))
        place[0, v], place[1, v], place[2, v], place[3, v] = xx - j, sx, yy - i, sy
    return True


@nb.njit(nogil=True, cache=True)
def _stays(last_x, last_y, x0, y0, p, corner, weight, n):  # type: ignore[no-untyped-def]
    """Whether the pixels that count lie in the image, and the others in its padding."""
    for v in range(n):
        for lane in range(LANES):
            dx, dy = float(corner[0, v] + lane), float(corner[1, v])
            x = x0 + dx + dx * (p[1] + 0.5 * p[3] * dx + p[4] * dy) + dy * (p[2] + 0.5 * p[5] * dy)
            y = y0 + dy + dx * (p[7] + 0.5 * p[9] * dx + p[10] * dy) + dy * (p[8] + 0.5 * p[11] * dy)
            edge = 0.0 if weight[v * LANES + lane] > 0 else _PAD - 6.0
            if not (x >= -edge and y >= -edge and x <= last_x + edge and y <= last_y + edge):
                return False
    return True


@nb.njit(cache=True)
def template(radius, circle):  # type: ignore[no-untyped-def]
    """The uncut subset of n vectors: corner (2, n), dx and dy of lane 0; pixels (3, 16 n), weight, dx and dy.

    And rows (4, 2 radius + 1): dx and dy of the first pixel of a row, its place among the pixels, their number.
    """
    most = (2 * radius + 1) * ((2 * radius + LANES) // LANES)
    corner, pixels = np.empty((2, most), np.int64), np.empty((3, most * LANES), np.float32)
    rows = np.empty((4, 2 * radius + 1), np.int64)
    n = 0
    for dy in range(-radius, radius + 1):
        half = int(math.sqrt(radius * radius - dy * dy)) if circle else radius
        at = n * LANES
        for dx in range(-half, half + 1, LANES):
            corner[0, n], corner[1, n] = dx, dy
            for lane in range(LANES):
                k = n * LANES + lane
                pixels[0, k], pixels[1, k], pixels[2, k] = dx + lane <= half, dx + lane, dy
            n += 1
        row = dy + radius
        rows[0, row], rows[1, row], rows[2, row], rows[3, row] = -half, dy, at, n * LANES - at
    return corner[:, :n].copy(), pixels[:, : n * LANES].copy(), rows


@nb.njit(forceinline=True, fastmath=FAST)
def _times(weight, source, begin, out, at, count):  # type: ignore[no-untyped-def]
    """A row of the source times the weights. One output a loop, and its length not a constant: so it is vectorised."""
    for lane in range(count):
        out[at + lane] = weight[at + lane] * source[begin + lane]


@nb.njit(forceinline=True, fastmath=FAST)
def _where(mask, begin, whole, out, at, count):  # type: ignore[no-untyped-def]
    """The uncut weights of a row where the mask is set, else 0."""
    for lane in range(count):
        out[at + lane] = whole[at + lane] if mask[begin + lane] > 0 else _F(0)


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def _pack(image, gx, gy, coef, stride, mask, shape, x, y, radius, quintic, rows, subset, px):  # type: ignore[no-untyped-def]
    """Weight, f and its gradient of the subset about (x, y), row by row, into px.

    The subset is measured from (x, y); at a fractional centre f and its gradient are interpolated. The mask cuts.
    image, gx, gy, mask : flat (h w,).
    """
    height, width = shape
    weight, f, fx, fy, whole = px[_WEIGHT], px[_REF], px[_GX], px[_GY], subset[0]
    jx, iy = math.floor(x), math.floor(y)
    between = not (x == jx and y == iy)
    near_x, near_y = math.floor(x + 0.5) - jx, math.floor(y + 0.5) - iy  # the pixel whose mask counts
    inside = jx >= radius and jx + radius + LANES < width and iy >= radius and iy + radius < height - 1
    for row in range(rows.shape[1]):
        i, j, at, count = iy + rows[1, row], jx + rows[0, row], rows[2, row], rows[3, row]
        begin = i * width + j
        if inside:
            _where(mask, _U(begin + near_y * width + near_x), whole, weight, _U(at), _U(count))
        else:
            for k in range(count):
                here = i >= 0 and i < height - between and j + k >= 0 and j + k < width - between
                here = here and mask[(i + near_y) * width + j + k + near_x] > 0
                weight[at + k] = whole[at + k] if here else 0
        if between:
            i, j = min(max(i, -8), height + 8), min(max(j, -8), width)
            first = _U((i + _PAD) * np.int64(stride) + j + _PAD)
            between_pixels(
                coef,
                first,
                stride,
                px.dtype.type(x - jx),
                px.dtype.type(y - iy),
                quintic,
                weight,
                f,
                fx,
                fy,
                _U(at),
                _U(count),
            )
        elif inside:
            _times(weight, image, _U(begin), f, _U(at), _U(count))
            _times(weight, gx, _U(begin), fx, _U(at), _U(count))
            _times(weight, gy, _U(begin), fy, _U(at), _U(count))
        else:
            for k in range(count):
                m, source = weight[at + k], begin + k if weight[at + k] > 0 else 0
                f[at + k], fx[at + k], fy[at + k] = m * image[source], m * gx[source], m * gy[source]


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def _centre(px, n):  # type: ignore[no-untyped-def]
    """f less its mean, in place. Returns the number of pixels, the mean and Σ f²."""
    count = total = _F(0)
    for k in range(_U(n)):
        count += px[_WEIGHT, k]
        total += px[_REF, k]
    mean, squares = total / max(count, _F(1)), _F(0)
    for k in range(_U(n)):
        f = px[_REF, k] - mean * px[_WEIGHT, k]
        px[_REF, k] = f
        squares += f * f
    return int(count), float(mean), float(squares)


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def _moments(px, subset, n, out):  # type: ignore[no-untyped-def]
    """Σ q dx^i dy^k for i + k ≤ 2, in the order 1 x y xx xy yy.

    out : (7, 15), rows q = gx², gx gy, gy², gx, gy, f gx, f gy.
    """
    for row in range(3):
        one, other = _GX + row // 2, _GX + (row + 1) // 2
        m0 = m1 = m2 = m3 = m4 = m5 = _F(0)
        for k in range(_U(n)):
            x, y, q = subset[1, k], subset[2, k], px[one, k] * px[other, k]
            qx, qy = q * x, q * y
            m0 += q
            m1 += qx
            m2 += qy
            m3 += qx * x
            m4 += qx * y
            m5 += qy * y
        out[row, 0], out[row, 1], out[row, 2], out[row, 3], out[row, 4], out[row, 5] = m0, m1, m2, m3, m4, m5
    a0 = a1 = a2 = b0 = b1 = b2 = c0 = c1 = c2 = d0 = d1 = d2 = _F(0)
    for k in range(_U(n)):
        x, y, f, fx, fy = subset[1, k], subset[2, k], px[_REF, k], px[_GX, k], px[_GY, k]
        f_x, f_y = f * fx, f * fy
        a0 += fx
        a1 += fx * x
        a2 += fx * y
        b0 += fy
        b1 += fy * x
        b2 += fy * y
        c0 += f_x
        c1 += f_x * x
        c2 += f_x * y
        d0 += f_y
        d1 += f_y * x
        d2 += f_y * y
    out[3, 0], out[3, 1], out[3, 2], out[4, 0], out[4, 1], out[4, 2] = a0, a1, a2, b0, b1, b2
    out[5, 0], out[5, 1], out[5, 2], out[6, 0], out[6, 1], out[6, 2] = c0, c1, c2, d0, d1, d2


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def _high_moments(px, subset, n, out):  # type: ignore[no-untyped-def]
    """What second order needs besides: i + k = 3 and 4 of rows 0-2, i + k = 2 of rows 3-6."""
    for row in range(3):
        one, other = _GX + row // 2, _GX + (row + 1) // 2
        m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = m8 = _F(0)
        for k in range(_U(n)):
            x, y, q = subset[1, k], subset[2, k], px[one, k] * px[other, k]
            xx, xy, yy = x * x, x * y, y * y
            qxx, qyy = q * xx, q * yy
            m0 += qxx * x
            m1 += qxx * y
            m2 += qyy * x
            m3 += qyy * y
            m4 += qxx * xx
            m5 += qxx * xy
            m6 += qxx * yy
            m7 += qyy * xy
            m8 += qyy * yy
        out[row, 6], out[row, 7], out[row, 8], out[row, 9] = m0, m1, m2, m3
        out[row, 10], out[row, 11], out[row, 12], out[row, 13], out[row, 14] = m4, m5, m6, m7, m8
    for row in range(3, 7):
        one, other = _GX + (row - 3) % 2, _WEIGHT if row < 5 else _REF
        m3 = m4 = m5 = _F(0)
        for k in range(_U(n)):
            x, y, q = subset[1, k], subset[2, k], px[one, k] * px[other, k]
            m3 += q * x * x
            m4 += q * x * y
            m5 += q * y * y
        out[row, 3], out[row, 4], out[row, 5] = m3, m4, m5


# φ = 1 dx dy dx²/2 dxdy dy²/2: exponents of dx and dy, and factor.
_EX, _EY = np.array([0, 1, 0, 2, 1, 0]), np.array([0, 0, 1, 0, 1, 2])
_FACTOR = np.array([1.0, 1.0, 1.0, 0.5, 1.0, 0.5])


@nb.njit(nogil=True, cache=True)
def _normal_matrix(px, subset, n, terms, moments, H, sum_J, sum_fJ):  # type: ignore[no-untyped-def]
    """H = Σ JᵀJ (2 terms, 2 terms), ΣJ and Σ f J of the subset from its moments; J = (∂f/∂x φ, ∂f/∂y φ)."""
    _moments(px, subset, n, moments)
    if terms > 3:
        _high_moments(px, subset, n, moments)
    for a in range(terms):
        for b in range(terms):
            i, k = _EX[a] + _EX[b], _EY[a] + _EY[b]
            at, factor = (i + k) * (i + k + 1) // 2 + k, _FACTOR[a] * _FACTOR[b]
            H[a, b] = factor * moments[0, at]
            H[terms + a, b] = factor * moments[1, at]
            H[terms + a, terms + b] = factor * moments[2, at]
        sum_J[a], sum_J[terms + a] = _FACTOR[a] * moments[3, a], _FACTOR[a] * moments[4, a]
        sum_fJ[a], sum_fJ[terms + a] = _FACTOR[a] * moments[5, a], _FACTOR[a] * moments[6, a]


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def _accumulate(px, subset, n, level, second, sums):  # type: ignore[no-untyped-def]
    """One pass over the subset, g taken about ``level``.

    sums : (16,), Σg, Σg², Σfg, spare, then Σ g ∂f/∂x φ_k (6) and Σ g ∂f/∂y φ_k (6) with φ as above.
    """
    s_g = s_gg = s_fg = a0 = a1 = a2 = a3 = a4 = a5 = b0 = b1 = b2 = b3 = b4 = b5 = _F(0)
    for k in range(_U(n)):
        x, y = subset[1, k], subset[2, k]
        g = (px[_CUR, k] - level) * px[_WEIGHT, k]
        s_g += g
        s_gg += g * g
        s_fg += g * px[_REF, k]
        ga, gb = g * px[_GX, k], g * px[_GY, k]
        a0 += ga
        a1 += ga * x
        a2 += ga * y
        b0 += gb
        b1 += gb * x
        b2 += gb * y
    sums[0], sums[1], sums[2] = s_g, s_gg, s_fg
    sums[4], sums[5], sums[6], sums[10], sums[11], sums[12] = a0, a1, a2, b0, b1, b2
    if second:
        for k in range(_U(n)):
            x, y = subset[1, k], subset[2, k]
            g = px[_CUR, k] - level
            ga, gb = g * px[_GX, k], g * px[_GY, k]
            xx, xy, yy = x * x, x * y, y * y
            a3 += ga * xx
            a4 += ga * xy
            a5 += ga * yy
            b3 += gb * xx
            b4 += gb * xy
            b5 += gb * yy
        half = _F(0.5)
        sums[7], sums[8], sums[9] = half * a3, a4, half * a5
        sums[13], sums[14], sums[15] = half * b3, b4, half * b5


@nb.njit(cache=True, nogil=True)
def _step(H, sums, sum_J, sum_fJ, mean_g, ratio, terms, b, d):  # type: ignore[no-untyped-def]
    """The increment d (12,) of the parameters from one pass; b : (2 terms,) scratch."""
    for k in range(terms):
        b[k] = ratio * (sums[4 + k] - mean_g * sum_J[k]) - sum_fJ[k]
        b[terms + k] = ratio * (sums[10 + k] - mean_g * sum_J[terms + k]) - sum_fJ[terms + k]
    solve(H, b, 2 * terms)
    for k in range(terms):
        d[k], d[6 + k] = b[k], b[terms + k]


@nb.njit(cache=True, nogil=True)
def _length(d, radius):  # type: ignore[no-untyped-def]
    """Square of the motion of the subset's rim under an increment, px²."""
    r2 = float(radius * radius)
    first = d[1] ** 2 + d[2] ** 2 + d[7] ** 2 + d[8] ** 2
    second = d[3] ** 2 + d[5] ** 2 + d[9] ** 2 + d[11] ** 2 + 4 * (d[4] ** 2 + d[10] ** 2)
    return d[0] ** 2 + d[6] ** 2 + r2 * first + 0.25 * r2 * r2 * second


@nb.njit(cache=True, nogil=True)
def _refine_point(  # type: ignore[no-untyped-def]
    image, gx, gy, coef_ref, stride_ref, mask, shape_ref, coef, shape, x_ref, y_ref, x_cur, y_cur, p,
    corner, rows, subset, radius, terms, quintic, tolerance, max_iterations, texture, noise,
    px, base, case, place, H, moments, vectors, A, B,
):  # fmt: skip
    """IC-GN of one subset from the parameters p (12,), refined in place.

    (x_ref, y_ref) and (x_cur, y_cur) : the centre in the two images' own crops; corner, rows, subset : the
    template; the last line is scratch. Returns status, ZNCC, iterations, sigma of u and of v (px).
    """
    n, count, size, kind = corner.shape[1], px.shape[1], 2 * terms, px.dtype.type
    sums, sum_J, sum_fJ, b, d = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    d[:] = 0.0
    _pack(image, gx, gy, coef_ref, stride_ref, mask, shape_ref, x_ref, y_ref, radius, quintic, rows, subset, px)
    pixels, level, squares = _centre(px, count)
    if pixels < max(0.15 * (2 * radius + 1) ** 2, 6 * terms):
        return NO_TEXTURE, np.nan, 0, np.nan, np.nan
    norm_f = math.sqrt(squares)
    _normal_matrix(px, subset, count, terms, moments, H, sum_J, sum_fJ)
    half_trace = 0.5 * (H[0, 0] + H[terms, terms])
    spread = math.sqrt((0.5 * (H[0, 0] - H[terms, terms])) ** 2 + H[terms, 0] ** 2)
    if not half_trace - spread > pixels * texture * texture or not norm_f > 0.0 or not cholesky(H, size):
        return NO_TEXTURE, np.nan, 0, np.nan, np.nan

    stride, first_tap = _U(shape[1]), 2 if quintic else 1
    level *= 14400.0 if quintic else 36.0  # the scale of the interpolated g
    second = terms == 6
    last_digit = _LAST_DIGIT if px.itemsize == 4 else 0.0
    status, zncc, iterations, previous = NO_CONVERGENCE, np.nan, 0, np.inf
    for _ in range(max_iterations):
        iterations += 1
        if not _place(shape, first_tap, x_cur, y_cur, p, radius, corner, px[_WEIGHT], n, base, case, place):
            return OUTSIDE, np.nan, iterations, np.nan, np.nan
        interpolate(coef, stride, base, case, place, kind(0.5 * p[3]), kind(0.5 * p[9]), quintic, n, px[_CUR])
        level = np.float64(kind(level))
        _accumulate(px, subset, count, kind(level), second, sums)
        mean_g = sums[0] / pixels
        variance = sums[1] - pixels * mean_g * mean_g
        if not variance > 1e-9 * pixels:
            return NO_TEXTURE, np.nan, iterations, np.nan, np.nan
        zncc = min(sums[2] / norm_f / math.sqrt(variance), 1.0)
        _step(H, sums, sum_J, sum_fJ, mean_g, norm_f / math.sqrt(variance), terms, b, d)
        level += mean_g
        moved = _length(d, radius)
        if not moved < 4.0 * radius * radius:
            break
        if not (compose_inverse(p, d, A, B) if second else compose_inverse_affine(p, d)):
            break
        if moved < tolerance * tolerance or previous <= moved < last_digit * last_digit:
            status = GOOD
            break
        previous = moved
    if status != GOOD:
        return status, zncc, iterations, np.nan, np.nan
    # Residual variance f' - r g' holds both images' noise: √2 σ.
    scatter = math.sqrt(2.0) * noise
    if not noise > 0.0:
        scatter = norm_f * math.sqrt(max(2.0 * (1.0 - zncc), 0.0) / (pixels - size - 2))
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
    """IC-GN of many subsets in parallel; each is independent of the others, so of the number of threads too.

    image, gx, gy, mask : (h, w) crop of the reference at origin_ref (x, y), coef_ref its coefficients, padded.
    coef : padded coefficients of the crop of the current image at origin_cur.
    xy : (n, 2) px. parameters : (n, 12), start values in and results out. known : (n,) bool, points to refine.
    status, zncc, iterations (n,) and sigma (n, 2) are filled where known.
    """
    corner, subset, rows = template(radius, circle)
    flat_ref, flat, n = coef_ref.ravel(), coef.ravel(), corner.shape[1]
    image_, gx_, gy_, mask_ = image.ravel(), gx.ravel(), gy.ravel(), mask.ravel()
    for chunk in nb.prange((xy.shape[0] + _CHUNK - 1) // _CHUNK):
        px, place = np.empty((5, n * LANES), coef.dtype), np.empty((4, n), coef.dtype)
        base, case = np.empty(n, np.uint64), np.empty(n, np.int64)
        H, moments, vectors = np.empty((2 * terms, 2 * terms)), np.empty((7, 15)), np.empty((5, 16))
        A, B = np.empty((6, 6)), np.empty((6, 6))
        for k in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, xy.shape[0])):
            if known[k]:
                result = _refine_point(
                    image_, gx_, gy_, flat_ref, _U(coef_ref.shape[1]), mask_, image.shape, flat, coef.shape,
                    xy[k, 0] - origin_ref[0], xy[k, 1] - origin_ref[1], xy[k, 0] - origin_cur[0],
                    xy[k, 1] - origin_cur[1], parameters[k], corner, rows, subset,
                    radius, terms, quintic, tolerance, max_iterations, texture, noise,
                    px, base, case, place, H, moments, vectors, A, B,
                )  # fmt: skip
                status[k] = result[0]
                zncc[k] = result[1]
                iterations[k] = result[2]
                sigma[k, 0] = result[3]
                sigma[k, 1] = result[4]
