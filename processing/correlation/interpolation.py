"""B-spline interpolation of vectors of 16 pixels, in single precision.

While the fractional position t = t0 + s l + q l² of the lanes l = 0 … 15 of a vector stays inside one pixel interval,
lane l needs the coefficients at base + l + tap: every tap is one contiguous load for all lanes, no gather. Where t
crosses one whole number there is one tap more, and the weights move along by a select. The two axes are independent:
four cases, and a general one in which each pixel finds its own taps.

Weights are those of the B-spline times 6 (cubic) or 120 (quintic), so g is 36 or 14400 times the grey level: the
criterion does not mind a contrast.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

FAST = {"contract", "reassoc", "arcp", "nsz"}
LANES = 16
STILL, ACROSS_X, ACROSS_Y, ACROSS, SCATTERED = range(5)  # what a vector crosses
_F, _U = np.float32, np.uint64
_L = _U(LANES)


@nb.njit(forceinline=True, fastmath=FAST)
def _cubic(t):  # type: ignore[no-untyped-def]
    """Cubic B-spline at the taps -1 … 2 for a fraction t, times 6; the last but one by the partition of unity."""
    s, t2 = _F(1) - t, t * t
    a, b, d = s * s * s, _F(4) + t2 * (_F(3) * t - _F(6)), t2 * t
    return a, b, _F(6) - a - b - d, d


@nb.njit(forceinline=True, fastmath=FAST)
def _cubic_across(t):  # type: ignore[no-untyped-def]
    """The five taps where t in [0, 2) may cross 1."""
    k = t >= _F(1)
    a, b, c, d = _cubic(t - _F(1) if k else t)
    return _F(0) if k else a, a if k else b, b if k else c, c if k else d, d if k else _F(0)


@nb.njit(forceinline=True, fastmath=FAST)
def _quintic(t):  # type: ignore[no-untyped-def]
    """Quintic B-spline at the taps -2 … 3 for a fraction t, times 120."""
    s, t2 = _F(1) - t, t * t
    s2 = s * s
    a, f = s2 * s2 * s, t2 * t2 * t
    c = _F(66) + t2 * (t2 * (_F(30) - _F(10) * t) - _F(60))
    d = _F(66) + s2 * (s2 * (_F(30) - _F(10) * s) - _F(60))
    b = _F(26) + t * (t * (t * (t * (_F(5) * t - _F(20)) + _F(20)) + _F(20)) - _F(50))
    return a, b, c, d, _F(120) - a - b - c - d - f, f


@nb.njit(forceinline=True, fastmath=FAST)
def _quintic_across(t):  # type: ignore[no-untyped-def]
    """The seven taps where t in [0, 2) may cross 1."""
    k = t >= _F(1)
    a, b, c, d, e, f = _quintic(t - _F(1) if k else t)
    zero = _F(0)
    return zero if k else a, a if k else b, b if k else c, c if k else d, d if k else e, e if k else f, f if k else zero


@nb.njit(forceinline=True, fastmath=FAST)
def _cubic_slope(t):  # type: ignore[no-untyped-def]
    """Derivative of _cubic by t."""
    s = _F(1) - t
    b = t * (_F(9) * t - _F(12))
    a, d = -_F(3) * s * s, _F(3) * t * t
    return a, b, -a - b - d, d


@nb.njit(forceinline=True, fastmath=FAST)
def _quintic_slope(t):  # type: ignore[no-untyped-def]
    """Derivative of _quintic by t."""
    s, t2 = _F(1) - t, t * t
    a, f = -_F(5) * s * s * s * s, _F(5) * t2 * t2
    b = -_F(50) + t * (_F(40) + t * (_F(60) + t * (_F(25) * t - _F(80))))
    c = t * (t2 * (_F(120) - _F(50) * t) - _F(120))
    d = -s * (s * s * (_F(120) - _F(50) * s) - _F(120))
    return a, b, c, d, -a - b - c - d - f, f


@nb.njit(forceinline=True, fastmath=FAST)
def _row4(c, p, w):  # type: ignore[no-untyped-def]
    return w[0] * c[p] + w[1] * c[p + _U(1)] + w[2] * c[p + _U(2)] + w[3] * c[p + _U(3)]


@nb.njit(forceinline=True, fastmath=FAST)
def _row5(c, p, w):  # type: ignore[no-untyped-def]
    return _row4(c, p, w) + w[4] * c[p + _U(4)]


@nb.njit(forceinline=True, fastmath=FAST)
def _row6(c, p, w):  # type: ignore[no-untyped-def]
    return _row5(c, p, w) + w[5] * c[p + _U(5)]


@nb.njit(forceinline=True, fastmath=FAST)
def _row7(c, p, w):  # type: ignore[no-untyped-def]
    return _row6(c, p, w) + w[6] * c[p + _U(6)]


def _make_spans(row: Any, across: Any, weights: Any, long_row: Any, taps: int) -> tuple[Any, ...]:
    """The vector kernels of one degree: neither axis crosses, x does, y does, both do; and one pixel on its own."""

    def make(weights_x: Any, row_x: Any, weights_y: Any, taps_y: int) -> Any:
        @nb.njit(forceinline=True, fastmath=FAST)
        def span(c, base, stride, tx, sx, qx, ty, sy, qy, g, at):  # type: ignore[no-untyped-def]
            """g[at … at + 15] of the lanes whose taps begin at base + lane."""
            for lane in range(_L):
                e = _F(lane)
                wx, wy = weights_x(tx + e * (sx + e * qx)), weights_y(ty + e * (sy + e * qy))
                p = base + lane
                total = wy[0] * row_x(c, p, wx) + wy[1] * row_x(c, p + stride, wx)
                total += wy[2] * row_x(c, p + _U(2) * stride, wx) + wy[3] * row_x(c, p + _U(3) * stride, wx)
                if taps_y == 5:
                    total += wy[4] * row_x(c, p + _U(4) * stride, wx)
                g[at + lane] = total
            if taps_y > 5:  # in two loops: one with as many rows is not vectorised
                for lane in range(_L):
                    e = _F(lane)
                    wx, wy = weights_x(tx + e * (sx + e * qx)), weights_y(ty + e * (sy + e * qy))
                    p = base + lane + _U(4) * stride
                    total = g[at + lane] + wy[4] * row_x(c, p, wx) + wy[5] * row_x(c, p + stride, wx)
                    if taps_y > 6:
                        total += wy[6] * row_x(c, p + _U(2) * stride, wx)
                    g[at + lane] = total

        return span

    @nb.njit(forceinline=True, fastmath=FAST)
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


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def interpolate(c, stride, base, case, place, qx, qy, quintic, n, g):  # type: ignore[no-untyped-def]
    """Grey levels g of n vectors in the current image. place : (4, n) tx, sx, ty, sy."""
    for v in range(n):
        at, b, k = _U(v) * _L, base[v], case[v]
        tx, sx, ty, sy = place[0, v], place[1, v], place[2, v], place[3, v]
        if quintic:
            if k == STILL:
                _q0(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
            elif k == ACROSS_X:
                _qx(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
            elif k == ACROSS_Y:
                _qy(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
            elif k == ACROSS:
                _qxy(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
            else:
                _q_any(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        elif k == STILL:
            _c0(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        elif k == ACROSS_X:
            _cx(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        elif k == ACROSS_Y:
            _cy(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        elif k == ACROSS:
            _cxy(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)
        else:
            _c_any(c, b, stride, tx, sx, qx, ty, sy, qy, g, at)


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def between_pixels(c, b, stride, tx, ty, quintic, weight, out_f, out_x, out_y, at, count):  # type: ignore[no-untyped-def]
    """f and its gradient between the pixels: a row with the same fraction."""
    if quintic:
        b -= _U(2) * stride + _U(2)
        wx, wy, sx, sy = _quintic(tx), _quintic(ty), _quintic_slope(tx), _quintic_slope(ty)
        for lane in range(count):
            f = fx = fy = _F(0)
            for k in range(_U(6)):
                p = b + lane + k * stride
                level = _row6(c, p, wx)
                f, fx, fy = f + wy[k] * level, fx + wy[k] * _row6(c, p, sx), fy + sy[k] * level
            m = weight[at + lane] / _F(14400)
            out_f[at + lane], out_x[at + lane], out_y[at + lane] = m * f, m * fx, m * fy
    else:
        b -= stride + _U(1)
        vx, vy, rx, ry = _cubic(tx), _cubic(ty), _cubic_slope(tx), _cubic_slope(ty)
        for lane in range(count):
            f = fx = fy = _F(0)
            for k in range(_U(4)):
                p = b + lane + k * stride
                level = _row4(c, p, vx)
                f, fx, fy = f + vy[k] * level, fx + vy[k] * _row4(c, p, rx), fy + ry[k] * level
            m = weight[at + lane] / _F(36)
            out_f[at + lane], out_x[at + lane], out_y[at + lane] = m * f, m * fx, m * fy
