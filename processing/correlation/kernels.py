"""Inverse-compositional Gauss-Newton of one subset, and of many on all cores. Plain numbers and arrays only.

Parameters of a subset, 12: u ux uy uxx uxy uyy v vx vy vxx vxy vyy, so that a pixel at (dx, dy) from the centre
(x, y) lies in the current image at x + dx + u + ux dx + uy dy + ½ uxx dx² + uxy dx dy + ½ uyy dy², likewise in y
(Lu & Cary 2000). First order keeps the second derivatives as they come in (zero, or a known curvature): its free
parameters are six. Criterion: zero-mean normalised sum of squared differences; scheme: Baker & Matthews (2004).

Shape of the code. A subset is packed once into vectors of 16 pixels of one row: weight (the mask, 0 or 1), f, its
gradient and (dx, dy), so a circle and a mask cost nothing. In an iteration every vector finds its place in the
current image; while its fractional position t = t0 + s l + q l² stays inside one pixel interval over the lanes
l = 0 … 15, lane l needs the spline coefficients at base + l + tap: every tap is one contiguous load for all lanes, no
gather. Where t crosses one whole number there is one tap more and the weights move along by a select; the two axes
are independent, so there are four cases, and one general case that addresses each pixel on its own. Then one pass
over the packed pixels sums all that a step needs.

What the speed hangs on: loops of constant length over unsigned indices (signed ones are checked for wrapping round,
which breaks the vectors), single-precision constants, no array stored per pixel but g. What the digits hang on: t is
small, so single precision resolves it to 1e-7 px; g is taken about its mean; everything after the sums is double.
"""

# Numba's cache follows the file of the compiled function alone: after a change in ``warps`` remove the cache.
from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from processing.correlation.spline import PAD
from processing.correlation.warps import cholesky, compose_inverse, compose_inverse_affine, solve

GOOD, NO_CONVERGENCE, OUTSIDE, NO_TEXTURE = 0, 2, 5, 6
N_PARAMETERS = 12
_FAST = {"contract", "reassoc", "arcp", "nsz"}
_F, _U = np.float32, np.uint64
_LANES = 16
_L = _U(_LANES)
_WEIGHT, _REF, _GX, _GY, _DX, _DY, _CUR = range(7)  # rows of a packed subset
_PAD = PAD


@nb.njit(forceinline=True, fastmath=_FAST)
def _cubic(t):  # type: ignore[no-untyped-def]
    """Cubic B-spline at the taps -1 … 2 for a fraction t, times 6; the last but one by the partition of unity."""
    s, t2 = _F(1) - t, t * t
    a, b, d = s * s * s, _F(4) + t2 * (_F(3) * t - _F(6)), t2 * t
    return a, b, _F(6) - a - b - d, d


@nb.njit(forceinline=True, fastmath=_FAST)
def _cubic_across(t):  # type: ignore[no-untyped-def]
    """The five taps where t in [0, 2) may cross 1."""
    k = t >= _F(1)
    a, b, c, d = _cubic(t - _F(1) if k else t)
    return _F(0) if k else a, a if k else b, b if k else c, c if k else d, d if k else _F(0)


@nb.njit(forceinline=True, fastmath=_FAST)
def _quintic(t):  # type: ignore[no-untyped-def]
    """Quintic B-spline at the taps -2 … 3 for a fraction t, times 120."""
    s, t2 = _F(1) - t, t * t
    s2 = s * s
    a, f = s2 * s2 * s, t2 * t2 * t
    c = _F(66) + t2 * (t2 * (_F(30) - _F(10) * t) - _F(60))
    d = _F(66) + s2 * (s2 * (_F(30) - _F(10) * s) - _F(60))
    b = _F(26) + t * (t * (t * (t * (_F(5) * t - _F(20)) + _F(20)) + _F(20)) - _F(50))
    return a, b, c, d, _F(120) - a - b - c - d - f, f


@nb.njit(forceinline=True, fastmath=_FAST)
def _quintic_across(t):  # type: ignore[no-untyped-def]
    """The seven taps where t in [0, 2) may cross 1."""
    k = t >= _F(1)
    a, b, c, d, e, f = _quintic(t - _F(1) if k else t)
    zero = _F(0)
    return zero if k else a, a if k else b, b if k else c, c if k else d, d if k else e, e if k else f, f if k else zero


@nb.njit(forceinline=True, fastmath=_FAST)
def _cubic_slope(t):  # type: ignore[no-untyped-def]
    """Derivative of _cubic by t."""
    s = _F(1) - t
    b = t * (_F(9) * t - _F(12))
    a, d = -_F(3) * s * s, _F(3) * t * t
    return a, b, -a - b - d, d


@nb.njit(forceinline=True, fastmath=_FAST)
def _quintic_slope(t):  # type: ignore[no-untyped-def]
    """Derivative of _quintic by t."""
    s, t2 = _F(1) - t, t * t
    a, f = -_F(5) * s * s * s * s, _F(5) * t2 * t2
    b = -_F(50) + t * (_F(40) + t * (_F(60) + t * (_F(25) * t - _F(80))))
    c = t * (t2 * (_F(120) - _F(50) * t) - _F(120))
    d = -s * (s * s * (_F(120) - _F(50) * s) - _F(120))
    return a, b, c, d, -a - b - c - d - f, f


@nb.njit(forceinline=True, fastmath=_FAST)
def _row4(c, p, w):  # type: ignore[no-untyped-def]
    return w[0] * c[p] + w[1] * c[p + _U(1)] + w[2] * c[p + _U(2)] + w[3] * c[p + _U(3)]


@nb.njit(forceinline=True, fastmath=_FAST)
def _row5(c, p, w):  # type: ignore[no-untyped-def]
    return _row4(c, p, w) + w[4] * c[p + _U(4)]


@nb.njit(forceinline=True, fastmath=_FAST)
def _row6(c, p, w):  # type: ignore[no-untyped-def]
    return _row5(c, p, w) + w[5] * c[p + _U(5)]


@nb.njit(forceinline=True, fastmath=_FAST)
def _row7(c, p, w):  # type: ignore[no-untyped-def]
    return _row6(c, p, w) + w[6] * c[p + _U(6)]


def _make_spans(row: Any, across: Any, weights: Any, long_row: Any, taps: int) -> tuple[Any, ...]:
    """The vector kernels of one degree: neither axis crosses, x does, y does, both do; and one pixel on its own."""

    def make(weights_x: Any, row_x: Any, weights_y: Any, taps_y: int) -> Any:
        @nb.njit(forceinline=True, fastmath=_FAST)
        def span(c, base, stride, tx, sx, qx, ty, sy, qy, g, at):  # type: ignore[no-untyped-def]
            """g[at … at + 15] of the lanes whose taps begin at base + lane."""
            for lane in range(_L):
                e = _F(lane)
                wx, wy = weights_x(tx + e * (sx + e * qx)), weights_y(ty + e * (sy + e * qy))
                p = base + lane
                total = wy[0] * row_x(c, p, wx) + wy[1] * row_x(c, p + stride, wx)
                total += wy[2] * row_x(c, p + _U(2) * stride, wx) + wy[3] * row_x(c, p + _U(3) * stride, wx)
                if taps_y > 4:
                    total += wy[4] * row_x(c, p + _U(4) * stride, wx)
                if taps_y > 5:
                    total += wy[5] * row_x(c, p + _U(5) * stride, wx)
                if taps_y > 6:
                    total += wy[6] * row_x(c, p + _U(6) * stride, wx)
                g[at + lane] = total

        return span

    @nb.njit(forceinline=True, fastmath=_FAST)
    def scattered(c, base, stride, tx, sx, qx, ty, sy, qy, g, at):  # type: ignore[no-untyped-def]
        """The same for any gradient: every lane finds its own taps."""
        for lane in range(_L):
            e = _F(lane)
            x, y = tx + e * (sx + e * qx), ty + e * (sy + e * qy)
            i, j = math.floor(y), math.floor(x)
            wx, wy = weights(x - _F(j)), weights(y - _F(i))
            p = _U(np.int64(base) + np.int64(lane) + np.int64(i) * np.int64(stride) + np.int64(j))
            total = wy[0] * row(c, p, wx) + wy[1] * row(c, p + stride, wx)
            total += wy[2] * row(c, p + _U(2) * stride, wx) + wy[3] * row(c, p + _U(3) * stride, wx)
            if taps > 4:
                total += wy[4] * row(c, p + _U(4) * stride, wx) + wy[5] * row(c, p + _U(5) * stride, wx)
            g[at + lane] = total

    return (
        make(weights, row, weights, taps),
        make(across, long_row, weights, taps),
        make(weights, row, across, taps + 1),
        make(across, long_row, across, taps + 1),
        scattered,
    )


_c0, _cx, _cy, _cxy, _c_any = _make_spans(_row4, _cubic_across, _cubic, _row5, 4)
_q0, _qx, _qy, _qxy, _q_any = _make_spans(_row6, _quintic_across, _quintic, _row7, 6)
_STILL, _ACROSS_X, _ACROSS_Y, _ACROSS, _SCATTERED = range(5)


@nb.njit(fastmath=_FAST, nogil=True, cache=True)
def _interpolate(c, stride, base, case, place, qx, qy, quintic, n, g):  # type: ignore[no-untyped-def]
    """Grey levels g of n vectors in the current image. place : (4, n) tx, sx, ty, sy."""
    for v in range(n):
        at, b, k = _U(v) * _L, base[v], case[v]
        tx, sx, ty, sy = place[0, v], place[1, v], place[2, v], place[3, v]
        if quintic:
            if k == _STILL:
                _q0(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
            elif k == _ACROSS_X:
                _qx(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
            elif k == _ACROSS_Y:
                _qy(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
            elif k == _ACROSS:
                _qxy(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
            else:
                _q_any(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        elif k == _STILL:
            _c0(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        elif k == _ACROSS_X:
            _cx(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        elif k == _ACROSS_Y:
            _cy(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        elif k == _ACROSS:
            _cxy(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        else:
            _c_any(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)


@nb.njit(fastmath=_FAST, nogil=True, cache=True)
def _place(shape, first_tap, x, y, p, corner, ends, n, base, case, place):  # type: ignore[no-untyped-def]
    """Where n vectors lie in the current image: first tap, fraction, slope and case of each; False if one leaves it.

    corner : (2, n) dx, dy of lane 0; ends : (2, n) first and last lane that counts.
    """
    stride = shape[1]
    last_x, last_y = shape[1] - 2 * _PAD - 1, shape[0] - 2 * _PAD - 1
    curved = p[3] != 0.0 or p[4] != 0.0 or p[5] != 0.0 or p[9] != 0.0 or p[10] != 0.0 or p[11] != 0.0
    far = np.float64(_LANES - 1)
    qx, qy = 0.5 * p[3], 0.5 * p[9]
    bend_x, bend_y = abs(qx) * 0.25 * far * far, abs(qy) * 0.25 * far * far
    for v in range(n):
        dx, dy = np.float64(corner[0, v]), np.float64(corner[1, v])
        xx = x + p[0] + dx + p[1] * dx + p[2] * dy
        yy = y + p[6] + dy + p[7] * dx + p[8] * dy
        sx, sy = p[1], p[7]
        if curved:
            xx += qx * dx * dx + p[4] * dx * dy + 0.5 * p[5] * dy * dy
            yy += qy * dx * dx + p[10] * dx * dy + 0.5 * p[11] * dy * dy
            sx += p[3] * dx + p[4] * dy
            sy += p[9] * dx + p[10] * dy
        e, f = np.float64(ends[0, v]), np.float64(ends[1, v])
        xe, xf = xx + e + e * (sx + e * qx), xx + f + f * (sx + f * qx)
        ye, yf = yy + e * (sy + e * qy), yy + f * (sy + f * qy)
        if not (min(xe, xf) >= 0.0 and max(xe, xf) <= last_x and min(ye, yf) >= 0.0 and max(ye, yf) <= last_y):
            return False
        x_far, y_far = far * (sx + far * qx), far * (sy + far * qy)
        x_low, x_high = xx + min(0.0, x_far) - bend_x, xx + max(0.0, x_far) + bend_x
        y_low, y_high = yy + min(0.0, y_far) - bend_y, yy + max(0.0, y_far) + bend_y
        # Lanes that do not count reach beyond the image; the padding holds them unless the stretch is extreme.
        if not (
            x_low > 4 - _PAD and x_high + far < last_x + _PAD - 4 and y_low > 4 - _PAD and y_high < last_y + _PAD - 4
        ):
            return False
        j, i = math.floor(x_low), math.floor(y_low)
        wide, high = math.floor(x_high) - j, math.floor(y_high) - i
        case[v] = _SCATTERED if wide > 1 or high > 1 else wide * _ACROSS_X + high * _ACROSS_Y
        base[v] = _U((i + _PAD - first_tap) * stride + j + _PAD - first_tap)
        place[0, v], place[1, v] = _F(xx - j), _F(sx)
        place[2, v], place[3, v] = _F(yy - i), _F(sy)
    return True


@nb.njit(fastmath=_FAST, nogil=True, cache=True)
def _pack(image, gx, gy, coef, mask, x, y, radius, circle, quintic, px, corner, ends):  # type: ignore[no-untyped-def]
    """The pixels of a subset about (x, y), packed into vectors of 16. Returns the numbers of pixels and of vectors.

    (dx, dy) is measured from (x, y); at a fractional centre f and its gradient are interpolated. The mask cuts.
    """
    height, width = image.shape
    stride = _U(coef.shape[1])
    flat = coef.ravel()
    jx, iy = math.floor(x + 0.5), math.floor(y + 0.5)
    whole = x == jx and y == iy
    if not whole:
        jx, iy = math.floor(x), math.floor(y)
        height, width = height - 1, width - 1  # taps on both sides
    turn_x, turn_y = _F(x - jx), _F(y - iy)
    pixels = n = 0
    for dy in range(-radius, radius + 1):
        i = iy + dy
        if i < 0 or i >= height:
            continue
        half = int(math.sqrt(radius * radius - dy * dy)) if circle else radius
        for dx in range(-half, half + 1, _LANES):
            first, last = _LANES, -1
            for lane in range(_LANES):
                j = jx + dx + lane
                inside = dx + lane <= half and j >= 0 and j < width and mask[i, j]
                px[_WEIGHT, n * _LANES + lane] = inside
                if inside:
                    first, last, pixels = min(first, lane), lane, pixels + 1
            if last < 0:
                continue
            at = _U(n * _LANES)
            corner[0, n], corner[1, n], ends[0, n], ends[1, n] = dx, dy, first, last
            begin = jx + dx
            if not whole:
                b = _U((i + _PAD) * np.int64(stride) + begin + _PAD)
                _between(flat, b, stride, turn_x, turn_y, quintic, px, at)
            elif begin >= 0 and begin + _LANES <= width:
                a, b = _U(i), _U(begin)
                for lane in range(_L):
                    m = px[_WEIGHT, at + lane]
                    px[_REF, at + lane] = m * image[a, b + lane]
                    px[_GX, at + lane] = m * gx[a, b + lane]
                    px[_GY, at + lane] = m * gy[a, b + lane]
            else:
                for lane in range(_LANES):
                    j, k = min(max(begin + lane, 0), width - 1), n * _LANES + lane
                    m = px[_WEIGHT, k]
                    px[_REF, k], px[_GX, k], px[_GY, k] = m * image[i, j], m * gx[i, j], m * gy[i, j]
            for lane in range(_L):
                px[_DX, at + lane], px[_DY, at + lane] = _F(dx) + _F(lane), _F(dy)
            n += 1
    return pixels, n


@nb.njit(fastmath=_FAST, nogil=True, cache=True)
def _between(c, b, stride, tx, ty, quintic, px, at):  # type: ignore[no-untyped-def]
    """f and its gradient between the pixels: 16 lanes with the same fraction."""
    if quintic:
        b -= _U(2) * stride + _U(2)
        wx, wy, sx, sy = _quintic(tx), _quintic(ty), _quintic_slope(tx), _quintic_slope(ty)
        for lane in range(_L):
            f = fx = fy = _F(0)
            for k in range(_U(6)):
                p = b + lane + k * stride
                level = _row6(c, p, wx)
                f, fx, fy = f + wy[k] * level, fx + wy[k] * _row6(c, p, sx), fy + sy[k] * level
            m = px[_WEIGHT, at + lane]
            px[_REF, at + lane], px[_GX, at + lane], px[_GY, at + lane] = m * f, m * fx, m * fy
    else:
        b -= stride + _U(1)
        vx, vy, rx, ry = _cubic(tx), _cubic(ty), _cubic_slope(tx), _cubic_slope(ty)
        for lane in range(_L):
            f = fx = fy = _F(0)
            for k in range(_U(4)):
                p = b + lane + k * stride
                level = _row4(c, p, vx)
                f, fx, fy = f + vy[k] * level, fx + vy[k] * _row4(c, p, rx), fy + ry[k] * level
            m = px[_WEIGHT, at + lane]
            px[_REF, at + lane], px[_GX, at + lane], px[_GY, at + lane] = m * f, m * fx, m * fy


@nb.njit(fastmath=_FAST, nogil=True, cache=True)
def _centre(px, n, pixels):  # type: ignore[no-untyped-def]
    """f less its mean, in place. Returns the mean and Σ f²."""
    total = _F(0)
    for k in range(_U(n)):
        total += px[_REF, k]
    mean = _F(total / pixels)
    for k in range(_U(n)):
        px[_REF, k] -= mean * px[_WEIGHT, k]
    squares = _F(0)
    for k in range(_U(n)):
        squares += px[_REF, k] * px[_REF, k]
    return np.float64(mean), np.float64(squares)


@nb.njit(fastmath=_FAST, nogil=True, cache=True)
def _moments(px, n, one, other, out):  # type: ignore[no-untyped-def]
    """Σ a b dx^i dy^k for i + k ≤ 2, a and b two rows of the packed subset. out : (6+,) in the order 1 x y xx xy yy."""
    m0 = m1 = m2 = m3 = m4 = m5 = _F(0)
    for k in range(_U(n)):
        x, y, q = px[_DX, k], px[_DY, k], px[one, k] * px[other, k]
        qx, qy = q * x, q * y
        m0 += q
        m1 += qx
        m2 += qy
        m3 += qx * x
        m4 += qx * y
        m5 += qy * y
    out[0], out[1], out[2], out[3], out[4], out[5] = m0, m1, m2, m3, m4, m5


@nb.njit(fastmath=_FAST, nogil=True, cache=True)
def _high_moments(px, n, one, other, out):  # type: ignore[no-untyped-def]
    """The same for i + k = 3 and 4, into out[6:15] in the order xxx xxy xyy yyy, xxxx … yyyy."""
    m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = m8 = _F(0)
    for k in range(_U(n)):
        x, y, q = px[_DX, k], px[_DY, k], px[one, k] * px[other, k]
        xx, xy, yy = x * x, x * y, y * y
        qxx, qxy, qyy = q * xx, q * xy, q * yy
        m0 += qxx * x
        m1 += qxx * y
        m2 += qyy * x
        m3 += qyy * y
        m4 += qxx * xx
        m5 += qxx * xy
        m6 += qxx * yy
        m7 += qyy * xy
        m8 += qyy * yy
    out[6], out[7], out[8], out[9] = m0, m1, m2, m3
    out[10], out[11], out[12], out[13], out[14] = m4, m5, m6, m7, m8


# φ = 1 dx dy dx²/2 dxdy dy²/2: exponents of dx and dy, and factor.
_EX, _EY = np.array([0, 1, 0, 2, 1, 0]), np.array([0, 0, 1, 0, 1, 2])
_FACTOR = np.array([1.0, 1.0, 1.0, 0.5, 1.0, 0.5])


@nb.njit(nogil=True, cache=True)
def _normal_matrix(px, n, terms, H, sum_J, sum_fJ):  # type: ignore[no-untyped-def]
    """H = Σ JᵀJ (2 terms, 2 terms), ΣJ and Σ f J of the subset from its moments; J = (∂f/∂x φ, ∂f/∂y φ)."""
    moments = np.empty(15)
    for one, other in ((_GX, _GX), (_GX, _GY), (_GY, _GY)):
        _moments(px, n, one, other, moments)
        if terms > 3:
            _high_moments(px, n, one, other, moments)
        first, second = terms * (one - _GX), terms * (other - _GX)
        for a in range(terms):
            for b in range(terms):
                i, k = _EX[a] + _EX[b], _EY[a] + _EY[b]
                total = _FACTOR[a] * _FACTOR[b] * moments[(i + k) * (i + k + 1) // 2 + k]
                H[second + a, first + b] = total
    for direction in range(2):
        _moments(px, n, _GX + direction, _WEIGHT, moments)
        for a in range(terms):
            sum_J[direction * terms + a] = _FACTOR[a] * moments[a]
        _moments(px, n, _GX + direction, _REF, moments)
        for a in range(terms):
            sum_fJ[direction * terms + a] = _FACTOR[a] * moments[a]


@nb.njit(fastmath=_FAST, nogil=True, cache=True)
def _accumulate(px, n, level, second, sums):  # type: ignore[no-untyped-def]
    """One pass over the subset, g taken about ``level``.

    sums : (16,), Σg, Σg², Σfg, spare, then Σ g ∂f/∂x φ_k (6) and Σ g ∂f/∂y φ_k (6) with φ as above.
    """
    s_g = s_gg = s_fg = a0 = a1 = a2 = a3 = a4 = a5 = b0 = b1 = b2 = b3 = b4 = b5 = _F(0)
    for k in range(_U(n)):
        x, y = px[_DX, k], px[_DY, k]
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
            x, y = px[_DX, k], px[_DY, k]
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
    image, gx, gy, coef_ref, mask, coef, x_ref, y_ref, x_cur, y_cur, p,
    radius, circle, terms, quintic, tolerance, max_iterations, texture, noise,
):  # fmt: skip
    """IC-GN of one subset from the parameters p (12,), refined in place.

    (x_ref, y_ref) and (x_cur, y_cur) : the centre in the two images' own crops. Returns status, ZNCC, iterations,
    sigma of u and of v (px).
    """
    side = 2 * radius + 1
    vectors = side * ((side + _LANES - 1) // _LANES)
    px = np.empty((7, vectors * _LANES), np.float32)
    corner, ends = np.empty((2, vectors), np.int32), np.empty((2, vectors), np.int32)
    base, case = np.empty(vectors, np.uint64), np.empty(vectors, np.int64)
    place = np.empty((4, vectors), np.float32)
    pixels, n = _pack(image, gx, gy, coef_ref, mask, x_ref, y_ref, radius, circle, quintic, px, corner, ends)
    if pixels < max(0.15 * side * side, 6 * terms):
        return NO_TEXTURE, np.nan, 0, np.nan, np.nan
    count = n * _LANES
    level, squares = _centre(px, count, pixels)
    norm_f = math.sqrt(squares)
    size = 2 * terms
    H, sum_J, sum_fJ = np.zeros((size, size)), np.empty(size), np.empty(size)
    _normal_matrix(px, count, terms, H, sum_J, sum_fJ)
    half_trace = 0.5 * (H[0, 0] + H[terms, terms])
    spread = math.sqrt((0.5 * (H[0, 0] - H[terms, terms])) ** 2 + H[terms, 0] ** 2)
    if not half_trace - spread > pixels * texture * texture or not norm_f > 0.0 or not cholesky(H, size):
        return NO_TEXTURE, np.nan, 0, np.nan, np.nan

    sums, b, d = np.empty(16), np.empty(size), np.zeros(12)
    A, B = np.empty((6, 6)), np.empty((6, 6))
    flat, stride, first_tap = coef.ravel(), _U(coef.shape[1]), 2 if quintic else 1
    second = terms == 6
    status, zncc, iterations = NO_CONVERGENCE, np.nan, 0
    for _ in range(max_iterations):
        iterations += 1
        if not _place(coef.shape, first_tap, x_cur, y_cur, p, corner, ends, n, base, case, place):
            return OUTSIDE, np.nan, iterations, np.nan, np.nan
        _interpolate(flat, stride, base, case, place, _F(0.5 * p[3]), _F(0.5 * p[9]), quintic, n, px[_CUR])
        level = np.float64(_F(level))
        _accumulate(px, count, _F(level), second, sums)
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
        if moved < tolerance * tolerance:
            status = GOOD
            break
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
