"""Sums over a subset that an iteration needs: its grey levels in the current image, interpolated and summed at once.

Interpolation and sums need some twenty vectors at a time. Where the processor has only sixteen registers for vectors
(``FEW_REGISTERS``), the grey levels of all vectors are interpolated first and stored, and then summed: each of the two
loops finds room in the registers, which makes up for the loads and stores.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from ringdic.correlation.interpolation import FAST, make_interpolation
from ringdic.correlation.lanes import (
    FEW_REGISTERS,
    INNER,
    LANES,
    blend,
    lane_sum,
    load,
    mask_from_bits,
    pointer,
    ramp,
    store,
)
from ringdic.correlation.subset import GREY, GX, GY, REF, add_to_row

_F, _U = np.float32, np.uint64
_L = np.uint64(LANES)


@nb.njit(forceinline=True, fastmath=FAST, **INNER)
def _by_power(at, row, x, q0, q1, q2, second):  # type: ignore[no-untyped-def]
    """Add a strip's sums of q φ to three rows of scratch, to six for second order; q_k : Σ q dy^k of each lane."""
    qx = q0 * x
    add_to_row(at, row, q0)
    add_to_row(at, row + 1, qx)
    add_to_row(at, row + 2, q1)
    if second:
        add_to_row(at, row + 3, _F(0.5) * (qx * x))
        add_to_row(at, row + 4, q1 * x)
        add_to_row(at, row + 5, _F(0.5) * q2)


def _make_levels(quintic: bool) -> tuple[Any, Any]:
    """Compile the grey levels of a subset in the current image, for one degree of the spline.

    The first function gives those of one vector, the second fills a row with those of all vectors. In the second, the
    vectors that cross no pixel border have a loop of their own, for which few registers suffice.
    """
    inside, crossing = make_interpolation(quintic)

    @nb.njit(forceinline=True, **INNER)
    def first_tap(stride, origin, cell, v):  # type: ignore[no-untyped-def]
        """Index of the first tap of lane 0 of vector v."""
        return _U(origin + np.int64(cell[1, v]) * np.int64(stride) + np.int64(cell[0, v]))

    @nb.njit(forceinline=True, fastmath=FAST, **INNER)
    def of_vector(c, stride, origin, place, cell, bend, bits, level, v, spare):  # type: ignore[no-untyped-def]
        """Grey levels of vector v about ``level``, 0 outside the subset. The arguments are those of ``accumulate``."""
        p, case, qx, qy = first_tap(stride, origin, cell, v), cell[2, v], bend[0], bend[1]
        tx, sx, ty, sy = place[0, v], place[1, v], place[2, v], place[3, v]
        if case == 0:
            g = inside(c, p, stride, tx, sx, qx, ty, sy, qy)
        else:
            g = crossing(c, p, stride, case, tx, sx, qx, ty, sy, qy, spare)
        return blend(mask_from_bits(bits[v]), g - level, _F(0))

    @nb.njit(fastmath=FAST, nogil=True, **INNER)
    def of_subset(coef, stride, origin, place, cell, bend, bits, level, spare, grey):  # type: ignore[no-untyped-def]
        """Fill the row ``grey`` with the grey levels of all vectors. The arguments are those of ``accumulate``."""
        c, out, qx, qy, v, n = pointer(coef), pointer(grey), bend[0], bend[1], _U(0), _U(bits.shape[0])
        while v < n:
            while v < n and cell[2, v] == 0:
                p = first_tap(stride, origin, cell, v)
                tx, sx, ty, sy = place[0, v], place[1, v], place[2, v], place[3, v]
                g = inside(c, p, stride, tx, sx, qx, ty, sy, qy)
                store(out, v * _L, blend(mask_from_bits(bits[v]), g - level, _F(0)))
                v += _U(1)
            if v < n:
                p = first_tap(stride, origin, cell, v)
                tx, sx, ty, sy = place[0, v], place[1, v], place[2, v], place[3, v]
                g = crossing(c, p, stride, cell[2, v], tx, sx, qx, ty, sy, qy, pointer(spare))
                store(out, v * _L, blend(mask_from_bits(bits[v]), g - level, _F(0)))
                v += _U(1)

    return of_vector, of_subset


_cubic_of_vector, _cubic_of_subset = _make_levels(False)
_quintic_of_vector, _quintic_of_subset = _make_levels(True)


def _make_pass(quintic: bool, second: bool) -> Any:
    """Compile the pass over a subset for one degree of the spline and one order of the shape functions.

    Interpolation and sums need some twenty vectors at a time. Where the processor has fewer registers than that, the
    grey levels are interpolated first and stored, and then summed.
    """
    of_vector, of_subset = (_quintic_of_vector, _quintic_of_subset) if quintic else (_cubic_of_vector, _cubic_of_subset)

    @nb.njit(fastmath=FAST, nogil=True, **INNER)
    def accumulate(  # type: ignore[no-untyped-def]
        coef, stride, origin, place, cell, bend, px, bits, corner, strips, level, scratch, sums
    ):  # fmt: skip
        """Interpolate the subset in the current image, g about ``level``, and sum what a step needs.

        coef : flat coefficients; origin : index of the centre's first tap; place, cell : of the vectors; bend : (2,),
        their quadratic terms; px, bits, corner, strips : the packed subset; scratch : (17, LANES). sums : (16,),
        filled: Σg, Σg², Σfg, unused, then Σ g ∂f/∂x φ_k (6) and Σ g ∂f/∂y φ_k (6) with φ = 1 dx dy dx²/2 dxdy dy²/2.
        """
        ref, gx, gy, grey = pointer(px[REF]), pointer(px[GX]), pointer(px[GY]), pointer(px[GREY])
        c, at_sum, spare = pointer(coef), pointer(scratch), pointer(scratch[16])
        if FEW_REGISTERS:
            of_subset(coef, stride, origin, place, cell, bend, bits, level, scratch[16], px[GREY])
        scratch[:16] = 0.0
        for s in range(strips.shape[0] - 1):
            sg = sgg = sfg = a0 = a1 = a2 = b0 = b1 = b2 = ramp(c) * _F(0)
            for v in range(_U(strips[s]), _U(strips[s + 1])):
                at, y = v * _L, corner[1, v]
                if FEW_REGISTERS:
                    g = load(grey, at)
                else:
                    g = of_vector(c, stride, origin, place, cell, bend, bits, level, v, spare)
                sg += g
                sgg += g * g
                sfg += g * load(ref, at)
                ga, gb = g * load(gx, at), g * load(gy, at)
                a0 += ga
                b0 += gb
                a1 += ga * y
                b1 += gb * y
                if second:
                    a2 += ga * (y * y)
                    b2 += gb * (y * y)
            x = ramp(c) + corner[0, strips[s]]
            add_to_row(at_sum, 0, sg)
            add_to_row(at_sum, 1, sgg)
            add_to_row(at_sum, 2, sfg)
            _by_power(at_sum, 4, x, a0, a1, a2, second)
            _by_power(at_sum, 10, x, b0, b1, b2, second)
        for k in range(16):
            if k < 3 or k in (4, 5, 6, 10, 11, 12) or (second and k > 3):
                sums[k] = lane_sum(load(at_sum, _U(k) * _L))

    return accumulate


_cubic_first, _cubic_second = _make_pass(False, False), _make_pass(False, True)
_quintic_first, _quintic_second = _make_pass(True, False), _make_pass(True, True)


@nb.njit(nogil=True, forceinline=True, **INNER)
def sum_levels(cubic, second, *given):  # type: ignore[no-untyped-def]
    """Run the pass over a subset that is compiled for this degree and order.

    cubic : True for a spline of degree 3, None for degree 5. second : True for shape functions of second order, None
    for first. given : the arguments of the compiled ``accumulate``.
    """
    if cubic is not None:
        if second is not None:
            _cubic_second(*given)
        else:
            _cubic_first(*given)
    elif second is not None:
        _quintic_second(*given)
    else:
        _quintic_first(*given)
