"""Interpolation of a field, with its derivatives, from the points of a regular lattice.

Between four lattice points the interpolated value is a mean, weighted bilinearly, of two estimates: the corners'
values, and the values extrapolated from each corner with its gradient. The errors of the two are equal and opposite for
a quadratic field, which is therefore interpolated exactly. Where a corner is missing, the other corners' extrapolations
alone are used, with the second derivatives.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Pixels

COMPLETE = 1.0 - 1e-9  # weight from which on no corner that counts is missing


def interpolate_lattice(lattice: NDArray[Any], values: Floats, spacing: float, xy: Pixels) -> tuple[Floats, Floats]:
    """Interpolate displacements and further values from a lattice at given points.

    Parameters
    ----------
    lattice : (m, 2) float64 or integer, px, multiples of ``spacing``.
    values : (m, k) float64, first u v (px), du/dx du/dy dv/dx dv/dy (no unit), and the second derivatives of u by xx,
        xy, yy and those of v (1/px), then any others, which are interpolated bilinearly; a row with NaN counts as
        missing.
    spacing : px, of the lattice.
    xy : (n, 2) float64, px, points to interpolate at.

    Returns
    -------
    values : (n, k), NaN where all four corners are missing.
    weight : (n,), sum of the bilinear weights of the corners that are there, 0 to 1, no unit; 1 where none is missing.
    """
    known = np.isfinite(values).all(axis=1)
    if not known.any():
        return np.full((len(xy), values.shape[1]), np.nan), np.zeros(len(xy))
    cells = np.rint(lattice[known] / spacing).astype(np.int64)
    low = cells.min(axis=0)
    row = np.full(cells.max(axis=0) - low + 1, -1)
    row[tuple((cells - low).T)] = np.arange(len(cells))
    out, weight = np.empty((len(xy), values.shape[1])), np.empty(len(xy))
    _blend(np.ascontiguousarray(values[known]), row, low, float(spacing), np.ascontiguousarray(xy), out, weight)
    return out, weight


@nb.njit(cache=True, nogil=True)
def _blend(values, row, low, spacing, xy, out, weight):  # type: ignore[no-untyped-def]
    """Interpolation of ``interpolate_lattice`` at each point, into out (n, k) and weight (n,).

    row : (columns, rows), index into values of each lattice point, -1 where it is missing; low : (2,), the lattice's
        first column and row, in spacings.
    """
    columns, rows = row.shape
    for p in range(len(xy)):
        out[p], weight[p] = 0.0, 0.0
        if not (math.isfinite(xy[p, 0]) and math.isfinite(xy[p, 1])):
            out[p] = np.nan
            continue
        column, line = math.floor(xy[p, 0] / spacing), math.floor(xy[p, 1] / spacing)
        for turn in range(2):  # first the sum of the corners' weights, then their weighted values
            complete = weight[p] > COMPLETE  # a full set of values already makes half the change
            slopes, bend = (0.5, 0.0) if complete else (1.0, 0.5)
            for i in range(2):
                for j in range(2):
                    c, r = column + i - low[0], line + j - low[1]
                    if c < 0 or r < 0 or c >= columns or r >= rows or row[c, r] < 0:
                        continue
                    dx, dy = xy[p, 0] - (column + i) * spacing, xy[p, 1] - (line + j) * spacing
                    near = (1.0 - abs(dx) / spacing) * (1.0 - abs(dy) / spacing)
                    if turn == 0:
                        weight[p] += near
                    elif near > 0.0:
                        row_values, near = values[row[c, r]], near / weight[p]
                        for m in range(len(row_values)):
                            out[p, m] += near * row_values[m]
                        for m in range(2):
                            by_x, by_y = row_values[2 + 2 * m], row_values[3 + 2 * m]
                            xx, xy_, yy = row_values[6 + 3 * m], row_values[7 + 3 * m], row_values[8 + 3 * m]
                            out[p, m] += near * slopes * (by_x * dx + by_y * dy)
                            out[p, m] += near * bend * (xx * dx * dx + 2.0 * xy_ * dx * dy + yy * dy * dy)
        if not weight[p] > 0.0:
            out[p] = np.nan
