"""B-spline interpolation of LANES pixels of a row at once.

While the fractional position t = t0 + s l + q l² of the lanes l = 0, 1 … stays inside one pixel interval, lane l needs
the coefficients at base + l + tap: every tap is one contiguous load for all lanes, without a gather. Where t crosses
one whole number there is one tap more, and a select moves the weights along. The two axes are independent, which gives
four cases.

With larger gradients the pixels lie within 32 coefficients of a row: each tap is picked from two loads by a
permutation, in as many rows as the lanes reach. Beyond that (a stretch of 1.7 or more) each pixel is interpolated
alone.

Weights are those of the B-spline times 6 (cubic) or 120 (quintic), so that g is 36 or 14400 times the grey level: the
criterion is invariant to contrast.

Common parameters: c, pointer to the coefficients, whose rows are ``stride`` apart; p, index of the first tap of lane 0;
tx, sx, qx, the position t0 + s l + q l² along x, and ty, sy, qy along y; wx, wy, weights of the taps.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from ringdic.correlation.lanes import (
    INNER,
    LANES,
    WINDOW,
    absolute,
    blend,
    floor,
    load,
    load_one,
    lookup,
    ramp,
    store,
    store_one,
)

FAST = {"contract", "reassoc", "arcp", "nsz"}
# Cases of a vector by the pixel borders that its positions cross: 0, none; one along x, one along y, their sum for
# both; WIDE + n, n along y and any number along x; SCATTERED, more than the window of ``_wide`` reaches.
ACROSS_X, ACROSS_Y, WIDE, SCATTERED = 1, 2, 4, -1
REACH_OF_WINDOW = WINDOW - 1 - 5  # px that a vector's positions may span so that the window holds six taps of each
_F, _U = np.float32, np.uint64


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _cubic(t):  # type: ignore[no-untyped-def]
    """Weights of the cubic B-spline at the taps -1 … 2 for a fraction t, times 6."""
    s, t2 = _F(1) - t, t * t
    s2 = s * s
    return s2 * s, t2 * (_F(3) * t - _F(6)) + _F(4), s2 * (_F(3) * s - _F(6)) + _F(4), t2 * t


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _quintic(t):  # type: ignore[no-untyped-def]
    """Weights of the quintic B-spline at the taps -2 … 3 for a fraction t, times 120.

    The even and odd parts about t = ½ share factors.
    """
    t2, q = t * t, _F(5) * t - _F(2.5)
    h, f = t2 - t, t2 * t2 * t
    h2 = h * h
    a = _F(5) * (h + h2) + (_F(1) - f)
    k = h2 - _F(3) * h
    inner, outer = _F(5) * (h2 - _F(5) * h) + _F(46), _F(13.5) - _F(7.5) * k
    u, v = q * (k + _F(4)), q * (h2 - h - _F(5))
    u = u + u
    return a, outer + v, inner - u, inner + u, outer - v, f


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _cubic_across(t):  # type: ignore[no-untyped-def]
    """Weights of the cubic B-spline at five taps for t in [0, 2), which may lie in either of two pixel intervals."""
    k, zero = t >= _F(1), _F(0)
    a, b, c, d = _cubic(blend(k, t - _F(1), t))
    return blend(k, zero, a), blend(k, a, b), blend(k, b, c), blend(k, c, d), blend(k, d, zero)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _quintic_across(t):  # type: ignore[no-untyped-def]
    """Weights of the quintic B-spline at seven taps for t in [0, 2), which may lie in either of two pixel intervals."""
    k, zero = t >= _F(1), _F(0)
    a, b, c, d, e, f = _quintic(blend(k, t - _F(1), t))
    first, second, third = blend(k, zero, a), blend(k, a, b), blend(k, b, c)
    return first, second, third, blend(k, c, d), blend(k, d, e), blend(k, e, f), blend(k, f, zero)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def maximum(one, other):  # type: ignore[no-untyped-def]
    """The larger of two vectors ``one`` and ``other``, lane by lane."""
    return blend(one >= other, one, other)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _positive(t):  # type: ignore[no-untyped-def]
    """Each lane of t, or 0 where it is negative."""
    return blend(t >= _F(0), t, _F(0))


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _cubic_at(t):  # type: ignore[no-untyped-def]
    """Cubic B-spline at any distance t, times 6."""
    a = absolute(t)
    one, two = _positive(_F(1) - a), _positive(_F(2) - a)
    return two * two * two - _F(4) * (one * one * one)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _quintic_at(t):  # type: ignore[no-untyped-def]
    """Quintic B-spline at any distance t, times 120."""
    a = absolute(t)
    one, two, three = _positive(_F(1) - a), _positive(_F(2) - a), _positive(_F(3) - a)
    one2, two2, three2 = one * one, two * two, three * three
    return three2 * three2 * three - _F(6) * (two2 * two2 * two) + _F(15) * (one2 * one2 * one)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _cubic_slope(t):  # type: ignore[no-untyped-def]
    """Derivative by t of the weights of ``_cubic``."""
    s = _F(1) - t
    b = t * (_F(9) * t - _F(12))
    a, d = -_F(3) * s * s, _F(3) * t * t
    return a, b, -a - b - d, d


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _quintic_slope(t):  # type: ignore[no-untyped-def]
    """Derivative by t of the weights of ``_quintic``."""
    s, t2 = _F(1) - t, t * t
    a, f = -_F(5) * s * s * s * s, _F(5) * t2 * t2
    b = -_F(50) + t * (_F(40) + t * (_F(60) + t * (_F(25) * t - _F(80))))
    c = t * (t2 * (_F(120) - _F(50) * t) - _F(120))
    d = -s * (s * s * (_F(120) - _F(50) * s) - _F(120))
    return a, b, c, d, -a - b - c - d - f, f


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _row4(c, p, w):  # type: ignore[no-untyped-def]
    """Weighted sum of 4 taps of a row, w their weights."""
    return w[0] * load(c, p) + w[1] * load(c, p + _U(1)) + w[2] * load(c, p + _U(2)) + w[3] * load(c, p + _U(3))


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _row5(c, p, w):  # type: ignore[no-untyped-def]
    """Weighted sum of 5 taps of a row, w their weights."""
    return _row4(c, p, w) + w[4] * load(c, p + _U(4))


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _row6(c, p, w):  # type: ignore[no-untyped-def]
    """Weighted sum of 6 taps of a row, w their weights."""
    return _row5(c, p, w) + w[5] * load(c, p + _U(5))


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _row7(c, p, w):  # type: ignore[no-untyped-def]
    """Weighted sum of 7 taps of a row, w their weights."""
    return _row6(c, p, w) + w[6] * load(c, p + _U(6))


def _make_sum(row: Any, taps: int) -> Any:
    """Compile the weighted sum over a number of rows, each with the taps of ``row``."""

    @nb.njit(forceinline=True, fastmath=FAST, **INNER)
    def spline(c, p, stride, wx, wy):  # type: ignore[no-untyped-def]
        out = wy[0] * row(c, p, wx) + wy[1] * row(c, p + stride, wx)
        out += wy[2] * row(c, p + _U(2) * stride, wx) + wy[3] * row(c, p + _U(3) * stride, wx)
        if taps > 4:
            out += wy[4] * row(c, p + _U(4) * stride, wx)
        if taps > 5:
            out += wy[5] * row(c, p + _U(5) * stride, wx)
        if taps > 6:
            out += wy[6] * row(c, p + _U(6) * stride, wx)
        return out

    return spline


_c44, _c54, _c45, _c55 = _make_sum(_row4, 4), _make_sum(_row5, 4), _make_sum(_row4, 5), _make_sum(_row5, 5)
_q66, _q76, _q67, _q77 = _make_sum(_row6, 6), _make_sum(_row7, 6), _make_sum(_row6, 7), _make_sum(_row7, 7)


@nb.njit(fastmath=FAST, nogil=True, cache=True, **INNER)
def _wide(c, p, stride, tx, sx, qx, ty, sy, qy, rows, cubic, g):  # type: ignore[no-untyped-def]
    """Interpolate pixels that lie within 32 coefficients of a row, taps picked by permutation, into LANES numbers at g.

    rows : how many rows of coefficients the pixels reach over, besides those of the taps.
    """
    e = ramp(c)
    x, y = e * (e * qx + sx) + tx + e, e * (e * qy + sy) + ty
    whole = floor(x)
    out, t = ramp(c) * _F(0), x - whole
    if cubic is None:
        w, row = _quintic(t), y + _F(2)
        for _ in range(rows + _U(6)):
            taps = w[0] * lookup(c, p, whole) + w[1] * lookup(c, p, whole + _F(1)) + w[2] * lookup(c, p, whole + _F(2))
            taps += w[3] * lookup(c, p, whole + _F(3)) + w[4] * lookup(c, p, whole + _F(4))
            out += _quintic_at(row) * (taps + w[5] * lookup(c, p, whole + _F(5)))
            row -= _F(1)
            p += stride
    else:
        v, row = _cubic(t), y + _F(1)
        for _ in range(rows + _U(4)):
            taps = v[0] * lookup(c, p, whole) + v[1] * lookup(c, p, whole + _F(1))
            taps += v[2] * lookup(c, p, whole + _F(2)) + v[3] * lookup(c, p, whole + _F(3))
            out += _cubic_at(row) * taps
            row -= _F(1)
            p += stride
    store(g, _U(0), out)


@nb.njit(fastmath=FAST, nogil=True, cache=True, **INNER)
def _scattered(c, p, stride, tx, sx, qx, ty, sy, qy, cubic, g):  # type: ignore[no-untyped-def]
    """Interpolate pixels anywhere, one after the other, into LANES numbers at g."""
    for lane in range(LANES):
        e = _F(lane)
        x, y = tx + e * (sx + e * qx), ty + e * (sy + e * qy)
        i, j = math.floor(y), math.floor(x)
        first = _U(np.int64(p) + np.int64(lane) + np.int64(i) * np.int64(stride) + np.int64(j))
        out = x * _F(0)
        if cubic is None:
            wx, wy = _quintic(x - _F(j)), _quintic(y - _F(i))
            for k in range(6):
                for m in range(6):
                    out += wy[k] * wx[m] * load_one(c, first + _U(k) * stride + _U(m))
        else:
            vx, vy = _cubic(x - _F(j)), _cubic(y - _F(i))
            for k in range(4):
                for m in range(4):
                    out += vy[k] * vx[m] * load_one(c, first + _U(k) * stride + _U(m))
        store_one(g, lane, out)


@nb.njit(nogil=True, cache=True, **INNER)
def _general(c, p, stride, case, tx, sx, qx, ty, sy, qy, cubic, g):  # type: ignore[no-untyped-def]
    """Interpolate by ``_wide`` or ``_scattered``, as the case demands."""
    if case == SCATTERED:
        _scattered(c, p, stride, tx, sx, qx, ty, sy, qy, cubic, g)
    else:
        _wide(c, p, stride, tx, sx, qx, ty, sy, qy, _U(case - WIDE), cubic, g)


def make_interpolation(quintic: bool) -> tuple[Any, Any]:
    """Compile the interpolation with a cubic or a quintic B-spline.

    The functions that it returns give the grey levels of LANES pixels of the current image, in the scale of the
    weights: the first one for case 0, the second for all others.
    """
    weights, across = (_quintic, _quintic_across) if quintic else (_cubic, _cubic_across)
    cubic = None if quintic else True
    still, over_x, over_y, over = (_q66, _q76, _q67, _q77) if quintic else (_c44, _c54, _c45, _c55)

    @nb.njit(forceinline=True, fastmath=FAST, **INNER)
    def inside(c, p, stride, tx, sx, qx, ty, sy, qy):  # type: ignore[no-untyped-def]
        """Grey levels of LANES pixels whose fractions all lie in [0, 1). p : index of the first tap of lane 0."""
        e = ramp(c)
        x, y = e * (e * qx + sx) + tx, e * (e * qy + sy) + ty
        return still(c, p, stride, weights(x), weights(y))

    @nb.njit(forceinline=True, fastmath=FAST, **INNER)
    def crossing(c, p, stride, case, tx, sx, qx, ty, sy, qy, spare):  # type: ignore[no-untyped-def]
        """Grey levels of LANES pixels whose fractions do not all lie in [0, 1).

        p : index of the first tap of lane 0 for t in [0, 1). case : what the lanes cross, as ``_locate_vectors`` of the
            kernels computes it. spare : pointer to LANES numbers of scratch.
        """
        e = ramp(c)
        x, y = e * (e * qx + sx) + tx, e * (e * qy + sy) + ty
        if case == ACROSS_X:
            g = over_x(c, p, stride, across(x), weights(y))
        elif case == ACROSS_Y:
            g = over_y(c, p, stride, weights(x), across(y))
        elif case == ACROSS_X + ACROSS_Y:
            g = over(c, p, stride, across(x), across(y))
        else:
            _general(c, p, stride, case, tx, sx, qx, ty, sy, qy, cubic, spare)
            g = load(spare, _U(0))
        return g

    return inside, crossing


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def value_and_gradient(c, p, stride, tx, ty, cubic):  # type: ignore[no-untyped-def]
    """Grey level f and its derivatives ∂f/∂x and ∂f/∂y of LANES pixels of a row with the same fractions of position.

    c : pointer to the coefficients, rows ``stride`` apart. p : index of the pixel to the upper left of the first one.
    tx, ty : fractions of the positions, in px. cubic : True for a spline of degree 3, None for degree 5.
    """
    if cubic is None:
        p -= _U(2) * stride + _U(2)
        wx, wy, sx, sy = _quintic(tx), _quintic(ty), _quintic_slope(tx), _quintic_slope(ty)
        f = _q66(c, p, stride, wx, wy) * _F(1 / 14400)
        fx, fy = _q66(c, p, stride, sx, wy) * _F(1 / 14400), _q66(c, p, stride, wx, sy) * _F(1 / 14400)
    else:
        p -= stride + _U(1)
        vx, vy, rx, ry = _cubic(tx), _cubic(ty), _cubic_slope(tx), _cubic_slope(ty)
        f = _c44(c, p, stride, vx, vy) * _F(1 / 36)
        fx, fy = _c44(c, p, stride, rx, vy) * _F(1 / 36), _c44(c, p, stride, vx, ry) * _F(1 / 36)
    return f, fx, fy
