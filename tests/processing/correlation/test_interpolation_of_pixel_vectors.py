"""Interpolated grey levels of vectors of pixels are those of the spline for any slope; lanes compute as arrays do."""

import numba as nb
import numpy as np
import pytest
from ringdic.correlation.interpolation import SCATTERED, WIDE, make_interpolation
from ringdic.correlation.kernels import _locate_vectors
from ringdic.correlation.lanes import (
    BITS,
    LANES,
    WINDOW,
    absolute,
    bit_count,
    blend,
    floor,
    lane_sum,
    load,
    lookup,
    mask_from_bits,
    nonzero_bits,
    pointer,
    store,
)
from ringdic.correlation.spline import PAD, coefficients
from scipy import ndimage

_U = np.uint64
_SPLINES = {3: make_interpolation(False), 5: make_interpolation(True)}


def _make_sampler(degree):
    inside, crossing = _SPLINES[degree]

    @nb.njit
    def sample(coef, stride, first, case, place, bend, spare, out):
        c = pointer(coef)
        tx, sx, ty, sy = place
        if case == 0:
            g = inside(c, first, stride, tx, sx, bend[0], ty, sy, bend[1])
        else:
            g = crossing(c, first, stride, case, tx, sx, bend[0], ty, sy, bend[1], pointer(spare))
        store(pointer(out), _U(0), g)

    return sample


_SAMPLERS = {degree: _make_sampler(degree) for degree in _SPLINES}


def levels(image, degree, x, y, slopes, bends):
    """Grey levels (LANES,) of the pixels of a vector from (x, y) on, and the case of the interpolation.

    image : (h, w). degree : 3 or 5. slopes, bends : of the position along the lanes, in x and in y.
    """
    coef = coefficients(image.astype(np.float32), degree)
    p = np.zeros(12)
    p[[1, 7]], p[[3, 9]] = slopes, 2.0 * np.array(bends)
    place, cell = np.zeros((4, LANES), np.float32), np.zeros((3, LANES), np.int32)
    _locate_vectors(np.float32(x % 1), np.float32(y % 1), p, np.zeros((2, LANES), np.float32), 1, place, cell)
    tap = 1 if degree == 3 else 2
    row, column = int(y) + cell[1, 0] + PAD - tap, int(x) + cell[0, 0] + PAD - tap
    out, spare = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    _SAMPLERS[degree](
        coef.ravel(), _U(coef.shape[1]), _U(row * coef.shape[1] + column), int(cell[2, 0]),
        tuple(place[:, 0]), np.array(bends, np.float32), spare, out,
    )  # fmt: skip
    return out / (36.0 if degree == 3 else 14400.0), int(cell[2, 0])


@pytest.mark.parametrize("degree", [3, 5])
def test_levels_are_those_of_the_spline_for_any_slope(degree):
    rng = np.random.default_rng(degree)
    image = rng.uniform(0.0, 255.0, (90, 110))
    spline = ndimage.spline_filter(image, degree, mode="mirror")
    lane, cases = np.arange(LANES), set()
    for size in (0.01, 0.06, 0.15, 0.4, 0.9, 4.0):
        for _ in range(40):
            x, y = rng.uniform([30.0, 30.0], [60.0, 60.0])
            slopes, bends = rng.uniform(-size, size, 2), rng.uniform(-0.002, 0.002, 2)
            grey, case = levels(image, degree, x, y, slopes, bends)
            at = [y + slopes[1] * lane + bends[1] * lane**2, x + lane + slopes[0] * lane + bends[0] * lane**2]
            truth = ndimage.map_coordinates(spline, at, order=degree, mode="mirror", prefilter=False)
            # Positions are rounded to 2e-6 px, and a grey level changes by at most about 400 a pixel.
            np.testing.assert_allclose(grey, truth, atol=2e-3)
            cases.add(min(case, WIDE))
    assert cases == {0, 1, 2, 3, WIDE, SCATTERED}


@nb.njit
def _arithmetic(a, b, bits, out):
    x, y, at = load(pointer(a), _U(0)), load(pointer(b), _U(0)), pointer(out)
    store(at, _U(0), 2.0 * x - y * x + 1.0)
    store(at, _U(LANES), blend(x >= y, floor(x), absolute(y)))
    store(at, _U(2 * LANES), blend(mask_from_bits(bits), x, 0.0))
    return lane_sum(x)


@nb.njit
def _pick(a, which, out):
    store(pointer(out), _U(0), lookup(pointer(a), _U(3), load(pointer(which), _U(0))))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_lanes_compute_as_arrays_do(kind):
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.0, 3.0, (2, LANES)).astype(kind)
    out, bits = np.zeros(3 * LANES, kind), BITS(0b1010_0000_1011_0011 & (2**LANES - 1))
    summed = _arithmetic(a, b, bits, out)
    exact = np.finfo(kind).eps * 200
    np.testing.assert_allclose(out[:LANES], 2 * a - b * a + 1, atol=exact)
    np.testing.assert_array_equal(out[LANES : 2 * LANES], np.where(a >= b, np.floor(a), np.abs(b)))
    np.testing.assert_array_equal(out[2 * LANES :], np.where((int(bits) >> np.arange(LANES)) & 1, a, 0))
    assert abs(summed - a.sum(dtype=np.float64)) < exact
    numbers, which = np.arange(64).astype(kind), rng.integers(0, WINDOW, LANES).astype(kind)
    _pick(numbers, which, out)
    np.testing.assert_array_equal(out[:LANES], which + 3)


@nb.njit
def _marks(mask):
    return nonzero_bits(pointer(mask), _U(1))


def test_bytes_that_are_not_zero_become_bits():
    mask = np.array([7, 1, 0, 255, *[0] * (LANES - 4), 3, 9], np.uint8)
    assert _marks(mask) == 0b101 | 1 << (LANES - 1)


@nb.njit
def _count(bits):
    return bit_count(bits)


def test_bits_are_counted():
    for bits in range(256):
        assert _count(BITS(bits)) == bits.bit_count()
