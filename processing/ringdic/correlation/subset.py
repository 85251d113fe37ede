"""A subset as vectors of LANES pixels of one row: their layout, their grey levels and gradients, and its normal matrix.

The vectors are ordered by strips LANES columns wide. Within a strip each lane keeps its dx, so that powers of dy enter
a sum once a vector and powers of dx once a strip. The bits of a number say which pixels of a vector belong to the
subset.

Common parameters: ``image``, ``gx``, ``gy``, ``mask``, the reference's crop of shape (h, w) as flat arrays; ``corner``,
``uncut``, ``strips``, the template; ``px`` (3, LANES n), f and its gradient of all vectors; ``bits`` (n,), which pixels
count; ``at`` or ``scratch``, rows of LANES sums.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from ringdic.correlation.interpolation import FAST, value_and_gradient
from ringdic.correlation.lanes import (
    BITS,
    FEW_REGISTERS,
    INNER,
    LANES,
    bit_count,
    blend,
    lane_sum,
    load,
    load_one,
    mask_from_bits,
    nonzero_bits,
    pointer,
    ramp,
    store,
    store_one,
)
from ringdic.correlation.spline import PAD

REF, GX, GY, GREY = range(4)  # rows of a packed subset: f, its gradient, and g where registers are few
MOMENTS = 72  # rows of scratch for ``moments``
_F, _U = np.float32, np.uint64
_L = np.uint64(LANES)
_PAD = PAD
_OUT = PAD - 4  # px outside the image at which a vector may begin so that its taps lie in the padding


@nb.njit(cache=True)
def template(radius, circle):  # type: ignore[no-untyped-def]
    """Layout of a subset, without the mask, as vectors of pixels: n vectors in s strips.

    radius : px. circle : whether it is a circle, else a square. Returns corner (2, n) int64, dx and dy of lane 0 of
    each vector; bits (n,) BITS, the lanes that belong to the subset; strips (s + 1,), the first vector of each strip
    and n.
    """
    half = np.empty(2 * radius + 1, np.int64)
    for row in range(2 * radius + 1):
        half[row] = int(math.sqrt(radius * radius - (row - radius) ** 2)) if circle else radius
    count = (2 * radius + LANES) // LANES
    best, shift = 2**62, 0
    for slack in range(count * LANES - 2 * radius):  # the strips are wider than the subset: shift them to need fewest
        vectors = 0
        for s in range(count):
            left = s * LANES - radius - slack
            for wide in half:
                vectors += wide >= left and -wide < left + LANES
        if vectors < best:
            best, shift = vectors, slack
    corner, bits = np.empty((2, best), np.int64), np.zeros(best, BITS)
    strips = np.zeros(count + 1, np.int64)
    n = 0
    for s in range(count):
        left = s * LANES - radius - shift
        for row in range(2 * radius + 1):
            if half[row] >= left and -half[row] < left + LANES:
                corner[0, n], corner[1, n] = left, row - radius
                for lane in range(LANES):
                    bits[n] |= BITS((abs(left + lane) <= half[row]) << lane)
                n += 1
        strips[s + 1] = n
    return corner, bits, strips


@nb.njit(fastmath=FAST, nogil=True, cache=True, **INNER)
def pack(  # type: ignore[no-untyped-def]
    image, gx, gy, coef, stride, mask, shape, x, y, radius, cubic, corner, uncut, px, bits
):  # fmt: skip
    """Pack a subset whose centre lies between pixels, or that lies at the border of the crop.

    Fills px (3, LANES n) with f about a level and its gradient, and bits (n,) with the pixels of ``uncut`` (n,) inside
    the mask. image, gx, gy, mask : flat (h w,), of the given shape (h, w). coef : flat coefficients, rows ``stride``
    apart, from which f and its gradient are interpolated at a fractional centre (x, y). radius, corner : of the subset
    and the template. cubic : True for a spline of degree 3, None for degree 5. For other subsets ``moments`` does this
    on the way.
    """
    height, width = shape
    jx, iy = math.floor(x), math.floor(y)
    between = not (x == jx and y == iy)
    near_x, near_y = math.floor(x + 0.5) - jx, math.floor(y + 0.5) - iy  # the pixel whose mask counts
    inside = well_inside(shape, x, y, radius)
    level = centre_level(image, shape, x, y)
    source, region, c = pointer(image), pointer(mask), pointer(coef)
    f, fx, fy = pointer(px[REF]), pointer(px[GX]), pointer(px[GY])
    tx, ty = px.dtype.type(x - jx), px.dtype.type(y - iy)
    for v in range(_U(corner.shape[1])):
        j, i, at, inside_bits = jx + corner[0, v], iy + corner[1, v], v * _L, uncut[v]
        if inside:
            inside_bits &= nonzero_bits(region, _U((i + near_y) * width + j + near_x))
        else:
            for lane in range(LANES):
                k = j + lane
                here = i >= 0 and i < height - between and k >= 0 and k < width - between
                row, column = min(max(i, 0), height - 1), min(max(k, 0), width - 1)
                here = here and mask[min(row + near_y, height - 1) * width + min(column + near_x, width - 1)] > 0
                inside_bits &= BITS(0xFFFF ^ ((not here) << lane))
                store_one(f, at + _U(lane), load_one(source, _U(row * width + column)))
                store_one(fx, at + _U(lane), gx[row * width + column])
                store_one(fy, at + _U(lane), gy[row * width + column])
        bits[v], w = inside_bits, mask_from_bits(inside_bits)
        if between:
            i, j = min(max(i, -_OUT), height), min(max(j, -_OUT), width)
            first = _U((i + _PAD) * np.int64(stride) + j + _PAD)
            here_f, here_x, here_y = value_and_gradient(c, first, stride, tx, ty, cubic)
        else:
            here_f, here_x, here_y = load(f, at), load(fx, at), load(fy, at)
        store(f, at, blend(w, here_f - level, _F(0)))
        store(fx, at, blend(w, here_x, _F(0)))
        store(fy, at, blend(w, here_y, _F(0)))


@nb.njit(fastmath=FAST, nogil=True, cache=True, **INNER)
def pack_interior(image, gx, gy, mask, at_centre, offset, level, uncut, px, bits):  # type: ignore[no-untyped-def]
    """Pack a subset whose centre is a pixel and that lies inside the crop: fills px (3, LANES n) and bits (n,).

    image, gx, gy, mask : flat. at_centre : index of the centre. offset : (n,), of lane 0 of each vector from it.
    level : that f is taken about. uncut : (n,), bits of the template.
    """
    source, slope_x, slope_y, region = pointer(image), pointer(gx), pointer(gy), pointer(mask)
    f, fx, fy = pointer(px[REF]), pointer(px[GX]), pointer(px[GY])
    for v in range(_U(uncut.shape[0])):
        at, begin = v * _L, _U(at_centre + offset[v])
        inside_bits = uncut[v] & nonzero_bits(region, begin)
        bits[v], w = inside_bits, mask_from_bits(inside_bits)
        store(f, at, blend(w, load(source, begin) - level, _F(0)))
        store(fx, at, blend(w, load(slope_x, begin), _F(0)))
        store(fy, at, blend(w, load(slope_y, begin), _F(0)))


@nb.njit(forceinline=True, **INNER)
def well_inside(shape, x, y, radius):  # type: ignore[no-untyped-def]
    """Whether all vectors of the subset lie inside the crop, with a row of pixels to spare.

    shape : (h, w) of the crop. x, y : the centre, px. radius : px.
    """
    jx, iy, reach = math.floor(x), math.floor(y), radius + LANES
    return jx >= reach and jx + reach < shape[1] and iy >= radius and iy + radius < shape[0] - 1


@nb.njit(forceinline=True, **INNER)
def centre_level(image, shape, x, y):  # type: ignore[no-untyped-def]
    """Grey level that is subtracted from f: that of the pixel at or next to the centre.

    image : flat, of the given shape (h, w). x, y : the centre, px.
    """
    row, column = min(max(math.floor(y), 0), shape[0] - 1), min(max(math.floor(x), 0), shape[1] - 1)
    return image[row * shape[1] + column]


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def add_to_row(at, row, value):  # type: ignore[no-untyped-def]
    """Add a vector ``value`` to a row of scratch that begins ``at`` a pointer."""
    store(at, _U(row) * _L, load(at, _U(row) * _L) + value)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _by_power(at, row, x, q0, q1):  # type: ignore[no-untyped-def]
    """Add a strip's sums of q, q dx and q dy to three rows of scratch.

    q_k : Σ q dy^k of each lane. x : dx of each lane.
    """
    add_to_row(at, row, q0)
    add_to_row(at, row + 1, q0 * x)
    add_to_row(at, row + 2, q1)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _by_second_power(at, row, x, q0, q1, q2):  # type: ignore[no-untyped-def]
    """Add a strip's sums of q dx², q dx dy and q dy² to three rows of scratch; q_k : Σ q dy^k of each lane."""
    add_to_row(at, row, q0 * (x * x))
    add_to_row(at, row + 1, q1 * x)
    add_to_row(at, row + 2, q2)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _by_high_power(at, row, x, q0, q1, q2, q3, q4):  # type: ignore[no-untyped-def]
    """Add a strip's sums of q dx^i dy^k, i + k = 3 and 4, to nine rows of scratch; q_k : Σ q dy^k of each lane.

    Their order is xxx xxy xyy yyy xxxx xxxy xxyy xyyy yyyy.
    """
    xx = x * x
    x0, x1, x2 = q0 * xx, q1 * xx, q2 * xx
    add_to_row(at, row, x0 * x)
    add_to_row(at, row + 1, x1)
    add_to_row(at, row + 2, q2 * x)
    add_to_row(at, row + 3, q3)
    add_to_row(at, row + 4, x0 * xx)
    add_to_row(at, row + 5, x1 * x)
    add_to_row(at, row + 6, x2)
    add_to_row(at, row + 7, q3 * x)
    add_to_row(at, row + 8, q4)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _first_and_second(last, s0, s1, s2):  # type: ignore[no-untyped-def]
    """Σ q dy and Σ q dy² of a strip from running sums: s0 of q, s1 of s0, s2 of s1, row by row up to ``last`` - 1.

    Running sums need additions only, where powers of dy would need multiplications.
    """
    e1 = s0 * last
    return e1 - s1, (e1 - s1 - s1) * last + (s2 + s2 - s1)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _third_and_fourth(last, s0, s1, s2, s3, s4):  # type: ignore[no-untyped-def]
    """Σ q dy³ and Σ q dy⁴ of a strip from running sums s0 … s4, each of the one before, row by row up to ``last`` - 1.

    With m = last - dy the running sum s_k is that of q m (m + 1) … (m + k - 1) / k!.
    """
    m2 = s2 + s2 - s1
    m3 = _F(6) * (s3 - s2) + s1
    m4 = _F(24) * s4 - _F(36) * s3 + _F(14) * s2 - s1
    square = last * last
    e3 = last * (square * s0 - _F(3) * last * s1 + _F(3) * m2) - m3
    e4 = square * (square * s0 - _F(4) * last * s1 + _F(6) * m2) - _F(4) * last * m3 + m4
    return e3, e4


def _make_moments(second: bool, direct: bool) -> Any:
    """Compile the sums over a subset for one order, with or without packing the subset on the way.

    direct : whether to pack it; else px holds it, as ``pack`` left it. Long on purpose: one pass over the vectors keeps
    its twenty-three sums in registers, which needs them as variables of one function.
    """

    @nb.njit(fastmath=FAST, nogil=True, **INNER)
    def sums(  # type: ignore[no-untyped-def]
        image, gx, gy, mask, at_centre, offset, level, uncut, px, bits, corner, strips, scratch, out
    ):  # fmt: skip
        """Moments of the products of f and its gradient, for ``moments``: strip by strip, then over the lanes.

        a, b, c hold gx², gx gy and gy², d, e hold gx and gy, g, h hold f gx and f gy; the digit is the power of dy, or
        for a, b, c the depth of the running sum.
        """
        source, slope_x, slope_y, region = pointer(image), pointer(gx), pointer(gy), pointer(mask)
        ref, ref_x, ref_y, at_sum = pointer(px[REF]), pointer(px[GX]), pointer(px[GY]), pointer(scratch)
        scratch[:] = 0.0
        pixels = 0
        for s in range(strips.shape[0] - 1):
            zero = ramp(ref) * _F(0)
            sf = sff = a0 = a1 = a2 = b0 = b1 = b2 = c0 = c1 = c2 = zero
            d0 = d1 = d2 = e0 = e1 = e2 = g0 = g1 = g2 = h0 = h1 = h2 = zero
            for v in range(_U(strips[s]), _U(strips[s + 1])):
                at, y = v * _L, corner[1, v]
                if direct:
                    begin = _U(at_centre + offset[v])
                    inside_bits = uncut[v] & nonzero_bits(region, begin)
                    bits[v], w = inside_bits, mask_from_bits(inside_bits)
                    f, fx = blend(w, load(source, begin) - level, _F(0)), blend(w, load(slope_x, begin), _F(0))
                    fy = blend(w, load(slope_y, begin), _F(0))
                    store(ref, at, f)
                    store(ref_x, at, fx)
                    store(ref_y, at, fy)
                else:
                    f, fx, fy, inside_bits = load(ref, at), load(ref_x, at), load(ref_y, at), bits[v]
                pixels += bit_count(inside_bits)
                sf += f
                sff += f * f
                kx, ky = f * fx, f * fy
                d0 += fx
                e0 += fy
                g0 += kx
                h0 += ky
                d1 += fx * y
                e1 += fy * y
                g1 += kx * y
                h1 += ky * y
                if second:
                    yy = y * y
                    d2 += fx * yy
                    e2 += fy * yy
                    g2 += kx * yy
                    h2 += ky * yy
                elif not FEW_REGISTERS:
                    a0 += fx * fx
                    b0 += fx * fy
                    c0 += fy * fy
                    a1 += a0
                    b1 += b0
                    c1 += c0
                    a2 += a1
                    b2 += b1
                    c2 += c1
            x, last = ramp(ref) + corner[0, strips[s]], corner[1, strips[s + 1] - 1] + _F(1)
            add_to_row(at_sum, 69, sf)
            add_to_row(at_sum, 70, sff)
            _by_power(at_sum, 18, x, d0, d1)
            _by_power(at_sum, 24, x, e0, e1)
            _by_power(at_sum, 30, x, g0, g1)
            _by_power(at_sum, 36, x, h0, h1)
            if second:
                _by_second_power(at_sum, 21, x, d0, d1, d2)
                _by_second_power(at_sum, 27, x, e0, e1, e2)
                _by_second_power(at_sum, 33, x, g0, g1, g2)
                _by_second_power(at_sum, 39, x, h0, h1, h2)
            if second or FEW_REGISTERS:
                a3 = a4 = b3 = b4 = c3 = c4 = zero
                for v in range(_U(strips[s]), _U(strips[s + 1])):
                    fx, fy = load(ref_x, v * _L), load(ref_y, v * _L)
                    a0 += fx * fx
                    b0 += fx * fy
                    c0 += fy * fy
                    a1 += a0
                    b1 += b0
                    c1 += c0
                    a2 += a1
                    b2 += b1
                    c2 += c1
                    if second:
                        a3 += a2
                        b3 += b2
                        c3 += c2
                        a4 += a3
                        b4 += b3
                        c4 += c3
            if second:
                a3, a4 = _third_and_fourth(last, a0, a1, a2, a3, a4)
                b3, b4 = _third_and_fourth(last, b0, b1, b2, b3, b4)
                c3, c4 = _third_and_fourth(last, c0, c1, c2, c3, c4)
            a1, a2 = _first_and_second(last, a0, a1, a2)
            b1, b2 = _first_and_second(last, b0, b1, b2)
            c1, c2 = _first_and_second(last, c0, c1, c2)
            _by_power(at_sum, 0, x, a0, a1)
            _by_power(at_sum, 6, x, b0, b1)
            _by_power(at_sum, 12, x, c0, c1)
            _by_second_power(at_sum, 3, x, a0, a1, a2)
            _by_second_power(at_sum, 9, x, b0, b1, b2)
            _by_second_power(at_sum, 15, x, c0, c1, c2)
            if second:
                _by_high_power(at_sum, 42, x, a0, a1, a2, a3, a4)
                _by_high_power(at_sum, 51, x, b0, b1, b2, b3, b4)
                _by_high_power(at_sum, 60, x, c0, c1, c2, c3, c4)
        for row in range(7):
            for k in range(6 if row < 3 or second else 3):
                out[row, k] = lane_sum(load(at_sum, _U(6 * row + k) * _L))
        if second:
            for row in range(3):
                for k in range(9):
                    out[row, 6 + k] = lane_sum(load(at_sum, _U(42 + 9 * row + k) * _L))
        return lane_sum(load(at_sum, _U(69) * _L)), lane_sum(load(at_sum, _U(70) * _L)), pixels

    return sums


_first, _second = _make_moments(False, True), _make_moments(True, True)
_packed_first, _packed_second = _make_moments(False, False), _make_moments(True, False)


@nb.njit(nogil=True, cache=True, **INNER)
def moments(direct, second, *given):  # type: ignore[no-untyped-def]
    """Moments Σ q dx^i dy^k of a subset, up to second power, for second order up to fourth.

    Their order is 1 x y xx xy yy xxx xxy xyy yyy xxxx xxxy xxyy xyyy yyyy.

    direct : the subset is packed on the way, as by ``pack_interior``; else px and bits are as ``pack`` left them.
    second : True for shape functions of second order, None for first. given : the arguments of the compiled ``sums``,
    among them scratch (MOMENTS, LANES) and out (7, 15), which is filled: rows q = gx², gx gy, gy², gx, gy, f gx, f gy.

    Returns Σ f, Σ f² and the number of pixels.
    """
    if second is not None:
        return _second(*given) if direct else _packed_second(*given)
    return _first(*given) if direct else _packed_first(*given)


# φ = 1 dx dy dx²/2 dxdy dy²/2: exponents of dx and dy, and factor.
_EX, _EY = np.array([0, 1, 0, 2, 1, 0]), np.array([0, 0, 1, 0, 1, 2])
_FACTOR = np.array([1.0, 1.0, 1.0, 0.5, 1.0, 0.5])


@nb.njit(nogil=True, cache=True, **INNER)
def normal_matrix(sums, mean, terms, H, sum_J, sum_fJ):  # type: ignore[no-untyped-def]
    """Normal matrix H = Σ JᵀJ (2 terms, 2 terms), ΣJ and Σ (f − mean) J from the moments; J = (∂f/∂x φ, ∂f/∂y φ).

    sums : (7, 15), as ``moments`` fills them. mean : of f. terms : 3 or 6. H, sum_J, sum_fJ : filled.
    """
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


@nb.njit(cache=True, nogil=True, **INNER)
def write_cache(cache, size, H, sum_J, sum_fJ, mean_f, norm_f, pixels):  # type: ignore[no-untyped-def]
    """Write the sums that do not depend on the current image into cache, a row of ``width_of_subset`` numbers.

    size : of the normal matrix. H : its Cholesky factor (size, size). sum_J, sum_fJ : (size,). mean_f, norm_f, pixels :
    mean of f, norm of f about it, and number of pixels.
    """
    at = 3
    cache[0], cache[1], cache[2] = mean_f, norm_f, pixels
    for i in range(size):
        cache[at], cache[at + 1] = sum_J[i], sum_fJ[i]
        at += 2
        for j in range(i + 1):
            cache[at] = H[i, j]
            at += 1


@nb.njit(cache=True, nogil=True, **INNER)
def read_cache(cache, size, H, sum_J, sum_fJ):  # type: ignore[no-untyped-def]
    """Read H (size, size), sum_J and sum_fJ (size,) from cache, a row that ``write_cache`` filled.

    Returns the mean of f, the norm of f about it, and the number of pixels.
    """
    at = 3
    for i in range(size):
        sum_J[i], sum_fJ[i] = cache[at], cache[at + 1]
        at += 2
        for j in range(i + 1):
            H[i, j] = cache[at]
            at += 1
    return cache[0], cache[1], cache[2]


def width_of_subset(order: int) -> int:
    """Number of values of a subset that do not depend on the current image: the length of a row of the cache."""
    size = 6 * order
    return 3 + 2 * size + size * (size + 1) // 2
