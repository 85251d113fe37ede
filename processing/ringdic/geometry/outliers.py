"""Points in space that cannot be right: lines of sight that miss one another, places off the surface around them."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask
from ringdic.geometry import kernels

_OPPOSITE = ((1, 0), (0, 1), (1, 1), (1, -1))
_SIGMA_OF_MAD = 1.4826  # of a normal distribution


class LostPoint(IntEnum):
    """Why a matched point was dropped in space; continues the status codes of the correlation."""

    RESIDUAL = 16  # the lines of sight miss one another
    SURFACE = 17  # off the surface that its neighbours form
    UNCERTAIN = 18  # matched, but with too large a standard deviation in an image


def crossing_outliers(residuals: Floats, factor: float = 8.0, floor: float = 0.3) -> Mask:
    """Points (n,) whose reprojection residuals (C, n, 2) px stand out.

    A common offset of a camera (it may have moved a little between frames) is no fault of the point: residuals are
    taken about their median, in units of the median absolute deviation, and never below ``floor`` px.
    """
    with np.errstate(invalid="ignore"):
        about = np.abs(residuals - _medians(residuals)[:, None])
        limit = np.maximum(factor * _SIGMA_OF_MAD * _medians(about), floor)
        return np.asarray((about > limit[:, None]).any(axis=(0, 2)))


def midpoint_residuals(xy: Floats, values: Floats, step: int, doubt: Floats | None = None) -> Floats:
    """How far values lie from the middle of opposite neighbours on the grid, (n,).

    xy : (n, 2) grid positions, multiples of ``step``. values : (n, k), NaN where lost. The prediction is the median
    over up to four pairs of opposite neighbours of the pair's mean: exact for a linear field and blind to one wrong
    neighbour. NaN where no pair is complete. Where a ``doubt`` (n,) is given, nobody is judged by a neighbour more
    doubtful than himself.
    """
    return _residuals(grid_neighbours(xy, step), values, doubt)


def grid_neighbours(xy: Floats, step: int) -> Indices:
    """The rows of up to four pairs of opposite neighbours on the grid, (n, 4, 2), -1 where there is none."""
    cells = np.round(xy / step).astype(int)
    cells -= cells.min(axis=0) - 1
    row = np.full(cells.max(axis=0) + 2, -1)
    row[cells[:, 0], cells[:, 1]] = np.arange(len(xy))
    pairs = [[row[cells[:, 0] + sign * i, cells[:, 1] + sign * j] for sign in (1, -1)] for i, j in _OPPOSITE]
    return np.ascontiguousarray(np.moveaxis(np.array(pairs), -1, 0))


def _residuals(pairs: Indices, values: Floats, doubt: Floats | None, rows: NDArray[np.intp] | None = None) -> Floats:
    """The same of all points or of some rows (r,), by their neighbours."""
    doubt = np.zeros(len(values)) if doubt is None else doubt
    rows = np.arange(len(values)) if rows is None else rows
    return np.asarray(kernels.fill_midpoint_residuals(pairs, np.ascontiguousarray(values, dtype=float), doubt, rows))


def surface_outliers(pairs: Indices, values: Floats, factor: float = 10.0, floor: float = 0.1) -> Mask:
    """Points (n,) whose values (n, 3) mm contradict their neighbours by more than ``floor`` mm and usual scatter.

    pairs : (n, 4, 2), of :func:`neighbours`.
    """
    residual = _residuals(pairs, values, None)
    usual = float(np.nanmedian(residual)) if np.isfinite(residual).any() else 0.0
    limit = max(factor * usual, floor)
    with np.errstate(invalid="ignore"):
        suspect = residual > limit
        # At the rim a good point may have been judged by a wrong one, which then lies further off itself.
        doubt = np.where(suspect, residual, 0.0)
        suspect[suspect] = _residuals(pairs, values, doubt, np.flatnonzero(suspect)) > limit
        return np.asarray(suspect)


def _medians(values: Floats) -> Floats:
    """Medians (C, 2) over the points of (C, n, 2), without NaN and without a warning where nothing is left."""
    return np.array([[_median(one[np.isfinite(one)]) for one in camera.T] for camera in values])


def _median(values: Floats) -> float:
    half = len(values) // 2
    if not half:
        return float(values[0]) if len(values) else np.nan
    ordered = np.partition(values, (half - 1, half))
    return float(0.5 * (ordered[(len(values) - 1) // 2] + ordered[half]))
