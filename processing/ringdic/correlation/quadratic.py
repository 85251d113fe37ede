"""Local least squares: a quadratic of a measured field over the neighbours of every point, on any set of points.

About point i the field is ``f(x_j) = a + b dx + c dy + p dx²/2 + q dx dy + r dy²/2`` with (dx, dy) = x_j - x_i; each
neighbour is weighted by the inverse square of its uncertainty. The coefficients are the field, its gradient and its
second derivatives at the point, far less noisy than those of one subset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.correlation.interpolation import FAST
from ringdic.correlation.lanes import INNER
from ringdic.correlation.parallel import in_ranges
from ringdic.correlation.warps import cholesky, solve_cholesky, variance

_MIN_NEIGHBOURS = 10  # for six coefficients, the point itself included
_MIN_SIGMA = 0.3  # least uncertainty that counts, as a share of the median: bounds the weight of a single point
_LEAST = 200  # points that are worth a thread
_RIDGE = 1e-10  # share of the trace added to the diagonal: points on a line give a large sigma, not a singular matrix


@dataclass(frozen=True)
class QuadraticFit:
    """Local quadratics of a field of k components at n points; NaN where too few neighbours are measured.

    The units are those of the field, per px for the gradient and per px² for second derivatives.

    value : (n, k) float64, smoothed field. gradient : (n, k, 2) float64, its derivatives by x, y.
    curvature : (n, k, 3) float64, its second derivatives by xx, xy, yy.
    value_sigma : (n,) float64, curvature_sigma : (n, 3) float64, standard uncertainties, the neighbours' noise taken as
        independent.
    leave_one_out : (n, k) float64, residual of each point against the quadratic of the other points; NaN where it is
        not measured.
    """

    value: Floats
    gradient: Floats
    curvature: Floats
    value_sigma: Floats
    curvature_sigma: Floats
    leave_one_out: Floats

    def extrapolate(self, index: Indices, offset: Pixels) -> Floats:
        """The field at given offsets from points, by their quadratics.

        index : (j,) int64, of the points. offset : (j, 2) float64, px, from them. Returns (j, k) in the field's unit.
        """
        dx, dy = offset[:, 0, None], offset[:, 1, None]
        (gx, gy), (xx, xy, yy) = np.moveaxis(self.gradient[index], -1, 0), np.moveaxis(self.curvature[index], -1, 0)
        curved = 0.5 * xx * dx**2 + xy * dx * dy + 0.5 * yy * dy**2
        return np.asarray(self.value[index] + gx * dx + gy * dy + curved)


class Neighbourhoods:
    """Neighbours within a radius of points of a set, each point itself included, for local quadratic fits.

    xy : (n, 2) float64, px, the points. window : px, the radius. index : (m,) int, the points about which quadratics
    are fitted; by default all, m = n. Raises ValueError unless the window is positive.
    """

    def __init__(self, xy: Pixels, window: float, index: Indices | None = None) -> None:
        if not window > 0:
            raise ValueError(f"the window must be positive, not {window}")
        self.xy = np.ascontiguousarray(xy, dtype=np.float64)
        self.window = float(window)
        self.index = np.arange(len(xy)) if index is None else index
        self._first, self._members = neighbours_within(self.centres, self.xy, self.window)

    @property
    def centres(self) -> Pixels:
        """The points about which quadratics are fitted, (m, 2) float64, px."""
        return self.xy[self.index]

    @cached_property
    def eccentricity(self) -> Floats:
        """Distance (m,) from a point to its neighbours' mean over the window, no unit; 0.4 at a straight rim."""
        # One coordinate after the other: sums over rows of two numbers take five times as long.
        total = [np.add.reduceat(one[self._members], self._first[:-1]) for one in np.ascontiguousarray(self.xy.T)]
        mean = np.stack(total, axis=1) / np.diff(self._first)[:, None]
        return np.asarray(np.hypot(*(mean - self.centres).T) / self.window)

    def fit(self, values: Floats, sigma: Floats | None = None) -> QuadraticFit:
        """Fit a quadratic to a field about each of the points of ``index``, by weighted least squares.

        values : (n, k) float64, the field in any unit; a row with NaN counts as not measured.
        sigma : (n,) float64, standard uncertainty in the field's unit; 1 for all by default.
        """
        m, k, at = len(self.index), values.shape[1], self.index
        known: Mask = np.asarray(np.isfinite(values).all(axis=1))
        weight = _weights(known, sigma)
        measured = np.ascontiguousarray(np.where(known[:, None], values, 0.0).T)
        c, scatter = np.full((m, k, 6), np.nan), np.full((m, 6), np.nan)
        in_ranges(
            _fit, m, self.xy, at, self._first, self._members, self.window, weight, measured, c, scatter, least=_LEAST
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            own = weight[at] * scatter[:, 0] ** 2
            leave_one_out = np.where(known[at, None], (values[at] - c[..., 0]) / (1.0 - own)[:, None], np.nan)
        w = self.window
        return QuadraticFit(
            c[..., 0], c[..., 1:3] / w, c[..., 3:] / w**2, scatter[:, 0], scatter[:, 3:] / w**2, leave_one_out
        )

    def lower_quartile(self, values: Floats) -> Floats:
        """Lower quartile of values around points, of which those with NaN are left out.

        values : (n,) float64, in any unit. Returns (m,) in that unit, NaN where no value is known.
        """
        out = np.full(len(self.index), np.nan)
        given = np.ascontiguousarray(values, dtype=np.float64)
        in_ranges(_quartiles, len(out), self._first, self._members, given, out, least=_LEAST)
        return out


def _weights(known: Mask, sigma: Floats | None) -> Floats:
    """Weights (n,) of the points, 0 where not measured; no point has much less than the median uncertainty."""
    if sigma is None:
        return known.astype(np.float64)
    with np.errstate(invalid="ignore"):
        ready = known & np.isfinite(sigma) & (sigma > 0)
    if not ready.any():
        return known.astype(np.float64)
    median = float(np.median(sigma[ready]))
    limited = np.where(ready, np.maximum(np.nan_to_num(sigma, nan=median), _MIN_SIGMA * median), median)
    return np.where(known, 1.0 / limited**2, 0.0)


def neighbours_within(centres: Pixels, xy: Pixels, window: float) -> tuple[Indices, NDArray[np.int32]]:
    """Points within a radius of each of a set of centres.

    centres : (n, 2) float64, px. xy : (m, 2) float64, px, the points. window : px, the radius.
    Returns where the points of each centre begin, (n + 1,) int64, and the indices of the points, one centre after the
    other, (k,) int32.
    """
    low = np.minimum(xy.min(axis=0), centres.min(axis=0)) if len(xy) and len(centres) else np.zeros(2)
    last = int(max(np.max((xy - low)[:, 0] // window, initial=0), np.max((centres - low)[:, 0] // window, initial=0)))
    columns = last + 3  # an empty cell on either side
    cell, of_centre = (_cells(points - low, window, columns) for points in (xy, centres))
    by_cell = np.argsort(cell, kind="stable")
    rows = int(max(cell.max(initial=0), of_centre.max(initial=0))) // columns + 2
    starts = np.searchsorted(cell[by_cell], np.arange(rows * columns + 1))
    return _within(centres, xy, window, of_centre, columns, by_cell, starts)  # type: ignore[no-any-return]


def _cells(xy: Pixels, side: float, columns: int) -> Indices:
    """Number (n,) of the square of a grid that holds each point, row by row."""
    column, row = np.floor(xy / side).astype(np.int64).T + 1
    return np.asarray(row * columns + column)


@nb.njit(cache=True, nogil=True)
def _within(centres, xy, window, cell, columns, by_cell, starts):  # type: ignore[no-untyped-def]
    """Neighbourhoods of ``neighbours_within``: where each begins (n + 1,), and the members (k,) of all.

    cell : (n,), square of side ``window`` that holds each centre, row by row; by_cell : the points in the order of
    their cells; starts : where each cell begins among them.
    """
    n = len(centres)
    first = np.zeros(n + 1, np.int64)
    members = np.empty(0, np.int32)
    for filling in (False, True):
        at = 0
        for i in range(n):
            first[i] = at
            for row in (-1, 0, 1):
                middle = cell[i] + row * columns
                for slot in range(starts[middle - 1], starts[middle + 2]):
                    j = by_cell[slot]
                    if (xy[j, 0] - centres[i, 0]) ** 2 + (xy[j, 1] - centres[i, 1]) ** 2 <= window * window:
                        if filling:
                            members[at] = j
                        at += 1
        first[n] = at
        if not filling:
            members = np.empty(at, np.int32)
    return first, members


@nb.njit(cache=True, nogil=True, **INNER)
def _gather(xy, i, members, window, weight, values, near):  # type: ignore[no-untyped-def]
    """Copy the members with a weight into the rows of ``near`` (3 + k, at least their number).

    The rows are x and y from point i in units of the window, the weight, and the k weighted values. Returns the
    number of these members.
    """
    count, scale = 0, 1.0 / window
    for j in members:
        w = weight[j]
        if w > 0.0:
            near[0, count], near[1, count] = (xy[j, 0] - xy[i, 0]) * scale, (xy[j, 1] - xy[i, 1]) * scale
            near[2, count] = w
            for m in range(len(values)):
                near[3 + m, count] = w * values[m, j]
            count += 1
    return count


@nb.njit(fastmath=FAST, cache=True, nogil=True, **INNER)
def _normal_matrix(near, count, M):  # type: ignore[no-untyped-def]
    """Fill the lower half of the normal matrix M (6, 6) from the neighbours of ``_gather``."""
    at_x, at_y, weights = near[0], near[1], near[2]
    m00 = m10 = m01 = m20 = m11 = m02 = m30 = m21 = m12 = m03 = m40 = m31 = m22 = m13 = m04 = 0.0
    for j in range(np.uint64(count)):
        x, y, w = at_x[j], at_y[j], weights[j]
        wx, wy = w * x, w * y
        wxx, wxy, wyy = wx * x, wx * y, wy * y
        m00 += w
        m10 += wx
        m01 += wy
        m20 += wxx
        m11 += wxy
        m02 += wyy
        m30 += wxx * x
        m21 += wxx * y
        m12 += wyy * x
        m03 += wyy * y
        m40 += wxx * x * x
        m31 += wxx * x * y
        m22 += wxx * y * y
        m13 += wyy * x * y
        m04 += wyy * y * y
    M[0, 0], M[1, 0], M[2, 0], M[1, 1], M[2, 1], M[2, 2] = m00, m10, m01, m20, m11, m02
    M[3, 0], M[3, 1], M[3, 2], M[3, 3] = 0.5 * m20, 0.5 * m30, 0.5 * m21, 0.25 * m40
    M[4, 0], M[4, 1], M[4, 2], M[4, 3], M[4, 4] = m11, m21, m12, 0.5 * m31, m22
    M[5, 0], M[5, 1], M[5, 2], M[5, 3], M[5, 4], M[5, 5] = (
        0.5 * m02, 0.5 * m12, 0.5 * m03, 0.25 * m22, 0.5 * m13, 0.25 * m04,
    )  # fmt: skip


@nb.njit(fastmath=FAST, cache=True, nogil=True, **INNER)
def _right_side(near, component, count, b):  # type: ignore[no-untyped-def]
    """Fill the right side b (6,) of the normal equations of one component from the neighbours of ``_gather``."""
    at_x, at_y, weighted = near[0], near[1], near[3 + component]
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for j in range(np.uint64(count)):
        x, y, v = at_x[j], at_y[j], weighted[j]
        vx, vy = v * x, v * y
        b0 += v
        b1 += vx
        b2 += vy
        b3 += vx * x
        b4 += vx * y
        b5 += vy * y
    b[0], b[1], b[2], b[3], b[4], b[5] = b0, b1, b2, 0.5 * b3, b4, 0.5 * b5


@nb.njit(cache=True, nogil=True)
def _fit(begin, end, xy, index, first, members, window, weight, values, c, scatter):  # type: ignore[no-untyped-def]
    """Fit the quadratics of number ``begin`` to ``end``: fills c (m, k, 6) and scatter (m, 6).

    Lengths are in units of the window. index : (m,), the points that they are about. scatter : square roots of the
    diagonal of the inverse normal matrix. values : (k, n). weight : (n,), 0 where not measured.
    """
    k, most = len(values), 0
    for i in range(begin, end):
        most = max(most, first[i + 1] - first[i])
    near, M, e = np.empty((3 + k, most)), np.empty((6, 6)), np.empty(6)
    for i in range(begin, end):
        count = _gather(xy, index[i], members[first[i] : first[i + 1]], window, weight, values, near)
        if count < _MIN_NEIGHBOURS:
            continue
        _normal_matrix(near, count, M)
        trace = M[0, 0] + M[1, 1] + M[2, 2] + M[3, 3] + M[4, 4] + M[5, 5]
        for p in range(6):
            M[p, p] += _RIDGE * trace
        if not cholesky(M, 6):
            continue
        for m in range(k):
            _right_side(near, m, count, c[i, m])
            solve_cholesky(M, c[i, m], 6)
        for p in range(6):
            scatter[i, p] = math.sqrt(variance(M, e, 6, p))


@nb.njit(cache=True, nogil=True)
def _quartiles(begin, end, first, members, values, out):  # type: ignore[no-untyped-def]
    """Fill out (n,), from ``begin`` to ``end``, with the lower quartile of the finite values in each neighbourhood."""
    for i in range(begin, end):
        about = values[members[first[i] : first[i + 1]]]
        about = about[np.isfinite(about)]
        if len(about):
            out[i] = np.partition(about, len(about) // 4)[len(about) // 4]
