"""A field known at points of a regular lattice, read between them.

A value between four corners is the mean of what their values say and of what their gradients say, each weighed by
nearness: the two err by the same amount to either side, so a quadratic field is met exactly. Where a corner is missing
the others say by their gradients alone what lies beside them.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats

ALL = 1.0 - 1e-9  # weight of the known corners from which on none of those that have a say is missing


def between_corners(lattice: NDArray[Any], values: Floats, spacing: float, xy: Floats) -> tuple[Floats, Floats]:
    """Values at points xy (n, 2) px from those at a lattice, and the weight of the corners that were known.

    lattice : (m, 2) px, multiples of ``spacing``. values : (m, k) u v du/dx du/dy dv/dx dv/dy and any others that go
    from corner to corner in a straight line; rows with NaN are not known.
    Returns (n, k), NaN where no corner is known, and (n,) between 0 and 1.
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
    """row : (columns, rows) of the lattice's values, -1 where there are none; low : (2,) its first column and row."""
    columns, rows = row.shape
    for p in range(len(xy)):
        out[p], weight[p] = 0.0, 0.0
        if not (math.isfinite(xy[p, 0]) and math.isfinite(xy[p, 1])):
            out[p] = np.nan
            continue
        column, line = math.floor(xy[p, 0] / spacing), math.floor(xy[p, 1] / spacing)
        for turn in range(2):  # first what the corners weigh, then what they say
            slopes = 0.5 if weight[p] > ALL else 1.0
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
                        told, near = values[row[c, r]], near / weight[p]
                        out[p] += near * told
                        out[p, 0] += near * slopes * (told[2] * dx + told[3] * dy)
                        out[p, 1] += near * slopes * (told[4] * dx + told[5] * dy)
        if not weight[p] > 0.0:
            out[p] = np.nan
