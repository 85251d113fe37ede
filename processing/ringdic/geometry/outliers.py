"""Outlier test for triangulated points: positions off the surface around them, and the reasons why points are lost."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.geometry import kernels

_OPPOSITE = ((1, 0), (0, 1), (1, 1), (1, -1))  # half of a grid point's eight neighbours; the others lie opposite
SIGMA_OF_MAD = 1.4826  # standard deviation by median absolute deviation, of a normal distribution


class LostPoint(IntEnum):
    """Status of a point matched in the images but rejected in space; continues the codes of the correlation."""

    RESIDUAL = 16  # the lines of sight miss one another
    SURFACE = 17  # off the surface that its neighbours form
    UNCERTAIN = 18  # matched, but with too large a standard deviation in an image
    OBLIQUE = 19  # matched, but seen too obliquely


def grid_neighbours(xy: Pixels, step: int) -> Indices:
    """Opposite neighbours of each point of a regular grid: row, column and both diagonals.

    xy : (n, 2) px, grid positions, multiples of ``step`` px. Returns indices (n, 4, 2) into xy, -1 where there is none.
    """
    cells = np.round(xy / step).astype(int)
    cells -= cells.min(axis=0) - 1
    row = np.full(cells.max(axis=0) + 2, -1)
    row[cells[:, 0], cells[:, 1]] = np.arange(len(xy))
    pairs = [[row[cells[:, 0] + sign * i, cells[:, 1] + sign * j] for sign in (1, -1)] for i, j in _OPPOSITE]
    return np.ascontiguousarray(np.moveaxis(np.array(pairs), -1, 0))


def _residuals(pairs: Indices, values: Floats, doubt: Floats, rows: Indices) -> Floats:
    """Distances (r,) of the values at some rows (r,) from a prediction by their neighbours, in the unit of the values.

    The prediction is the median, over up to four pairs of opposite neighbours, of the mean of the pair: exact for a
    linear field, and one wrong neighbour does not change it. NaN where no pair is complete.

    pairs : (n, 4, 2) indices of opposite neighbours. values : (n, k), NaN where lost. doubt : (n,); a neighbour with a
    larger doubt than the point itself is not used.
    """
    return np.asarray(kernels.fill_midpoint_residuals(pairs, np.ascontiguousarray(values, dtype=float), doubt, rows))


def surface_outliers(pairs: Indices, values: Points, floor: float | Floats = 0.1) -> Mask:
    """Which points lie off the surface that their neighbours form, (n,) bool.

    pairs : (n, 4, 2) indices of opposite neighbours, of :func:`grid_neighbours`.
    values : (n, 3) mm, positions, NaN where lost.
    floor : mm, one for all or (n,); an outlier lies off the middle of its neighbours by more than this, and by more
        than ten times the median of that distance over all points.
    """
    n = len(values)
    residual = _residuals(pairs, values, np.zeros(n), np.arange(n))
    median = float(np.nanmedian(residual)) if np.isfinite(residual).any() else 0.0
    limit = np.maximum(10.0 * median, np.broadcast_to(floor, n))
    with np.errstate(invalid="ignore"):
        suspect = residual > limit
        # At the rim a good point may have a wrong one as its only neighbour, which then lies further off itself.
        doubt = np.where(suspect, residual, 0.0)
        suspect[suspect] = _residuals(pairs, values, doubt, np.flatnonzero(suspect)) > limit[suspect]
        return np.asarray(suspect)
