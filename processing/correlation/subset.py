"""A subset in vectors of sixteen pixels of one row: where they lie, what they hold, and the normal matrix of it.

The vectors are ordered by strips sixteen columns wide, so that within a strip the lanes keep their dx: powers of dy
enter a sum once a vector, powers of dx once a strip. Which of the sixteen belong to the subset are the bits of a
uint16.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from processing.correlation.interpolation import FAST, between_pixels
from processing.correlation.lanes import LANES, chosen, load, marked, pointer, put, ramp, select, store, total
from processing.correlation.spline import PAD

REF, GX, GY = range(3)  # rows of a packed subset
MOMENTS = 72  # rows of scratch that ``moments`` needs
_F, _U = np.float32, np.uint64
_L = np.uint64(LANES)
_PAD = PAD
_OUT = PAD - 4  # px outside the image that sixteen lanes and their taps may begin


@nb.njit(cache=True)
def template(radius, circle):  # type: ignore[no-untyped-def]
    """The uncut subset of n vectors in s strips.

    Returns corner (2, n) int64, dx and dy of lane 0; bits (n,) uint16; strips (s + 1,), the first vector of each
    and n.
    """
    half = np.empty(2 * radius + 1, np.int64)
    for row in range(2 * radius + 1):
        half[row] = int(math.sqrt(radius * radius - (row - radius) ** 2)) if circle else radius
    count = (2 * radius + LANES) // LANES
    best, shift = 2**62, 0
    for slack in range(count * LANES - 2 * radius):  # the strips reach over the subset; where they begin is free
        vectors = 0
        for s in range(count):
            left = s * LANES - radius - slack
            vectors += np.sum((half >= left) & (-half < left + LANES))
        if vectors < best:
            best, shift = vectors, slack
    corner, bits = np.empty((2, best), np.int64), np.zeros(best, np.uint16)
    strips = np.zeros(count + 1, np.int64)
    n = 0
    for s in range(count):
        left = s * LANES - radius - shift
        for row in range(2 * radius + 1):
            if half[row] >= left and -half[row] < left + LANES:
                corner[0, n], corner[1, n] = left, row - radius
                for lane in range(LANES):
                    bits[n] |= np.uint16((abs(left + lane) <= half[row]) << lane)
                n += 1
        strips[s + 1] = n
    return corner, bits, strips


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def pack(  # type: ignore[no-untyped-def]
    image, gx, gy, coef, stride, mask, shape, x, y, radius, quintic, corner, uncut, px, bits
):  # fmt: skip
    """Fill px (3, 16 n) with f and its gradient of the subset about (x, y), bits (n,) with what the mask leaves of it.

    The subset is measured from (x, y); at a fractional centre f and its gradient are interpolated.
    image, gx, gy, mask : flat (h w,); coef : flat, its rows ``stride`` apart. Returns the level that f is about, and
    the number of pixels.
    """
    height, width = shape
    jx, iy = math.floor(x), math.floor(y)
    between = not (x == jx and y == iy)
    near_x, near_y = math.floor(x + 0.5) - jx, math.floor(y + 0.5) - iy  # the pixel whose mask counts
    reach = radius + LANES
    inside = jx >= reach and jx + reach < width and iy >= radius and iy + radius < height - 1
    level, count = image[min(max(iy, 0), height - 1) * width + min(max(jx, 0), width - 1)], 0
    source, slope_x, slope_y, region, c = pointer(image), pointer(gx), pointer(gy), pointer(mask), pointer(coef)
    f, fx, fy = pointer(px[REF]), pointer(px[GX]), pointer(px[GY])
    tx, ty = px.dtype.type(x - jx), px.dtype.type(y - iy)
    for v in range(_U(corner.shape[1])):
        j, i, at = jx + corner[0, v], iy + corner[1, v], v * _L
        begin, kept = _U(i * width + j), uncut[v]
        if inside:
            kept &= marked(region, _U((i + near_y) * width + j + near_x))
        else:
            for lane in range(LANES):
                k = j + lane
                here = i >= 0 and i < height - between and k >= 0 and k < width - between
                row, column = min(max(i, 0), height - 1), min(max(k, 0), width - 1)
                here = here and mask[min(row + near_y, height - 1) * width + min(column + near_x, width - 1)] > 0
                kept &= np.uint16(0xFFFF ^ ((not here) << lane))
                put(f, at + _U(lane), image[row * width + column] - level)
                put(fx, at + _U(lane), gx[row * width + column])
                put(fy, at + _U(lane), gy[row * width + column])
        bits[v], w = kept, chosen(kept)
        count += _population(kept)
        if between:
            i, j = min(max(i, -_OUT), height), min(max(j, -_OUT), width)
            first = _U((i + _PAD) * np.int64(stride) + j + _PAD)
            here_f, here_x, here_y = between_pixels(c, first, stride, tx, ty, quintic)
        elif inside:
            here_f, here_x, here_y = load(source, begin), load(slope_x, begin), load(slope_y, begin)
        else:
            here_f, here_x, here_y = load(f, at) + level, load(fx, at), load(fy, at)
        store(f, at, select(w, here_f - level, _F(0)))
        store(fx, at, select(w, here_x, _F(0)))
        store(fy, at, select(w, here_y, _F(0)))
    return level, count


@nb.njit(forceinline=True)
def _population(bits):  # type: ignore[no-untyped-def]
    """The number of set bits of a uint16."""
    n = np.uint64(bits)
    n -= (n >> _U(1)) & _U(0x5555)
    n = (n & _U(0x3333)) + ((n >> _U(2)) & _U(0x3333))
    n = (n + (n >> _U(4))) & _U(0x0F0F)
    return np.int64((n + (n >> _U(8))) & _U(0x1F))


@nb.njit(forceinline=True, fastmath=FAST)
def add(at, row, value):  # type: ignore[no-untyped-def]
    """Sixteen lanes added to a row of scratch."""
    store(at, _U(row) * _L, load(at, _U(row) * _L) + value)


@nb.njit(forceinline=True, fastmath=FAST)
def _by_power(at, row, x, q0, q1, q2):  # type: ignore[no-untyped-def]
    """Lanes of q dx^i dy^k, i + k ≤ 2, of a strip added to six rows of scratch: 1 x y xx xy yy. q_k : Σ q dy^k."""
    qx = q0 * x
    add(at, row, q0)
    add(at, row + 1, qx)
    add(at, row + 2, q1)
    add(at, row + 3, qx * x)
    add(at, row + 4, q1 * x)
    add(at, row + 5, q2)


@nb.njit(forceinline=True, fastmath=FAST)
def _by_high_power(at, row, x, q0, q1, q2, q3, q4):  # type: ignore[no-untyped-def]
    """The same for i + k = 3 and 4: xxx xxy xyy yyy xxxx xxxy xxyy xyyy yyyy."""
    xx = x * x
    x0, x1, x2 = q0 * xx, q1 * xx, q2 * xx
    add(at, row, x0 * x)
    add(at, row + 1, x1)
    add(at, row + 2, q2 * x)
    add(at, row + 3, q3)
    add(at, row + 4, x0 * xx)
    add(at, row + 5, x1 * x)
    add(at, row + 6, x2)
    add(at, row + 7, q3 * x)
    add(at, row + 8, q4)


@nb.njit(fastmath=FAST, nogil=True, cache=True)
def moments(px, corner, strips, second, scratch, out):  # type: ignore[no-untyped-def]
    """Σ q dx^i dy^k of the subset, in the order 1 x y xx xy yy (xxx xxy xyy yyy xxxx xxxy xxyy xyyy yyyy).

    corner : (2, n) as floats; out : (7, 15), rows q = gx², gx gy, gy², gx, gy, f gx, f gy; scratch : (MOMENTS, 16).
    Returns Σ f and Σ f².
    """
    at_sum, ref, gx, gy = pointer(scratch), pointer(px[REF]), pointer(px[GX]), pointer(px[GY])
    scratch[:] = 0.0
    for s in range(strips.shape[0] - 1):
        zero = ramp(ref) * _F(0)
        sf = sff = a0 = a1 = a2 = b0 = b1 = b2 = c0 = c1 = c2 = zero
        d0 = d1 = d2 = e0 = e1 = e2 = g0 = g1 = g2 = h0 = h1 = h2 = zero
        for v in range(_U(strips[s]), _U(strips[s + 1])):
            at, y = v * _L, corner[1, v]
            f, fx, fy = load(ref, at), load(gx, at), load(gy, at)
            sf += f
            sff += f * f
            xx, xy, yy, kx, ky = fx * fx, fx * fy, fy * fy, f * fx, f * fy
            a0 += xx
            b0 += xy
            c0 += yy
            d0 += fx
            e0 += fy
            g0 += kx
            h0 += ky
            xx, xy, yy, fx, fy, kx, ky = xx * y, xy * y, yy * y, fx * y, fy * y, kx * y, ky * y
            a1 += xx
            b1 += xy
            c1 += yy
            d1 += fx
            e1 += fy
            g1 += kx
            h1 += ky
            a2 += xx * y
            b2 += xy * y
            c2 += yy * y
            if second:
                d2 += fx * y
                e2 += fy * y
                g2 += kx * y
                h2 += ky * y
        x = ramp(ref) + corner[0, strips[s]]
        add(at_sum, 69, sf)
        add(at_sum, 70, sff)
        _by_power(at_sum, 0, x, a0, a1, a2)
        _by_power(at_sum, 6, x, b0, b1, b2)
        _by_power(at_sum, 12, x, c0, c1, c2)
        _by_power(at_sum, 18, x, d0, d1, d2)
        _by_power(at_sum, 24, x, e0, e1, e2)
        _by_power(at_sum, 30, x, g0, g1, g2)
        _by_power(at_sum, 36, x, h0, h1, h2)
        if second:
            a3 = a4 = b3 = b4 = c3 = c4 = zero
            for v in range(_U(strips[s]), _U(strips[s + 1])):
                at, y = v * _L, corner[1, v]
                fx, fy, yyy = load(gx, at), load(gy, at), y * y * y
                kx = fx * yyy
                xx, xy, yy = fx * kx, fy * kx, fy * fy * yyy
                a3 += xx
                b3 += xy
                c3 += yy
                a4 += xx * y
                b4 += xy * y
                c4 += yy * y
            _by_high_power(at_sum, 42, x, a0, a1, a2, a3, a4)
            _by_high_power(at_sum, 51, x, b0, b1, b2, b3, b4)
            _by_high_power(at_sum, 60, x, c0, c1, c2, c3, c4)
    for row in range(7):
        for k in range(6 if row < 3 or second else 3):
            out[row, k] = total(load(at_sum, _U(6 * row + k) * _L))
    if second:
        for row in range(3):
            for k in range(9):
                out[row, 6 + k] = total(load(at_sum, _U(42 + 9 * row + k) * _L))
    return total(load(at_sum, _U(69) * _L)), total(load(at_sum, _U(70) * _L))


# φ = 1 dx dy dx²/2 dxdy dy²/2: exponents of dx and dy, and factor.
_EX, _EY = np.array([0, 1, 0, 2, 1, 0]), np.array([0, 0, 1, 0, 1, 2])
_FACTOR = np.array([1.0, 1.0, 1.0, 0.5, 1.0, 0.5])


@nb.njit(nogil=True, cache=True)
def normal_matrix(sums, mean, terms, H, sum_J, sum_fJ):  # type: ignore[no-untyped-def]
    """H = Σ JᵀJ (2 terms, 2 terms), ΣJ and Σ (f − mean) J from the moments; J = (∂f/∂x φ, ∂f/∂y φ)."""
    for a in range(terms):
        for b in range(a + 1):
            i, k = _EX[a] + _EX[b], _EY[a] + _EY[b]
            at, factor = (i + k) * (i + k + 1) // 2 + k, _FACTOR[a] * _FACTOR[b]
            H[a, b] = factor * sums[0, at]
            H[terms + a, b] = H[terms + b, a] = factor * sums[1, at]
            H[terms + a, terms + b] = factor * sums[2, at]
        sum_J[a], sum_J[terms + a] = _FACTOR[a] * sums[3, a], _FACTOR[a] * sums[4, a]
        sum_fJ[a] = _FACTOR[a] * sums[5, a] - mean * sum_J[a]
        sum_fJ[terms + a] = _FACTOR[a] * sums[6, a] - mean * sum_J[terms + a]
