"""Outlier tests for triangulated points: lines of sight that do not meet, positions off the surface around them."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

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


def crossing_outliers(residuals: Pixels, factor: float = 8.0, floor: float = 0.3) -> Mask:
    """Which points have reprojection residuals that stand out from those of the other points, (n,) bool.

    residuals : (C, n, 2) px, measured minus projected.
    factor, floor : a residual is an outlier if it lies off the camera's median by more than ``factor`` robust standard
        deviations (from the median absolute deviation) and by more than ``floor`` px. Taking the median off keeps a
        small motion of a camera between frames from being counted against the points.
    """
    with np.errstate(invalid="ignore"):
        about = np.abs(residuals - _medians(residuals)[:, None])
        limit = np.maximum(factor * SIGMA_OF_MAD * _medians(about), floor)
        return np.asarray((about > limit[:, None]).any(axis=(0, 2)))


def midpoint_residuals(xy: Pixels, values: Floats, step: int, doubt: Floats | None = None) -> Floats:
    """Distance of the value at each grid point from a prediction by its neighbours.

    The prediction is the median, over up to four pairs of opposite neighbours, of the mean of the pair: exact for a
    linear field, and one wrong neighbour does not change it.

    Parameters
    ----------
    xy : (n, 2) px, grid positions, multiples of ``step`` px.
    values : (n, k), such as displacements in px, NaN where lost.
    doubt : (n,) of any unit, or None; a neighbour with a larger doubt than the point itself is not used.

    Returns
    -------
    (n,) in the unit of the values, NaN where no pair is complete.
    """
    return _residuals(grid_neighbours(xy, step), values, doubt)


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


def _residuals(pairs: Indices, values: Floats, doubt: Floats | None, rows: NDArray[np.intp] | None = None) -> Floats:
    """Distances (n,) of values (n, k) from the prediction by their neighbours; or (r,) of some rows (r,) only."""
    doubt = np.zeros(len(values)) if doubt is None else doubt
    rows = np.arange(len(values)) if rows is None else rows
    return np.asarray(kernels.fill_midpoint_residuals(pairs, np.ascontiguousarray(values, dtype=float), doubt, rows))


def surface_outliers(pairs: Indices, values: Points, factor: float = 10.0, floor: float = 0.1) -> Mask:
    """Which points lie off the surface that their neighbours form, (n,) bool.

    pairs : (n, 4, 2) indices of opposite neighbours, of :func:`grid_neighbours`.
    values : (n, 3) mm, positions, NaN where lost.
    factor, floor : a point is an outlier if it lies off the middle of its neighbours by more than ``factor`` times the
        median of that distance over all points, and by more than ``floor`` mm.
    """
    residual = _residuals(pairs, values, None)
    median = float(np.nanmedian(residual)) if np.isfinite(residual).any() else 0.0
    limit = max(factor * median, floor)
    with np.errstate(invalid="ignore"):
        suspect = residual > limit
        # At the rim a good point may have a wrong one as its only neighbour, which then lies further off itself.
        doubt = np.where(suspect, residual, 0.0)
        suspect[suspect] = _residuals(pairs, values, doubt, np.flatnonzero(suspect)) > limit
        return np.asarray(suspect)


def _medians(values: Floats) -> Floats:
    """Medians (C, 2) of the finite values (C, n, 2) over the points; NaN, without a warning, where there are none."""
    return np.array([[_median(one[np.isfinite(one)]) for one in camera.T] for camera in values])


def _median(values: Floats) -> float:
    """Median of finite values (n,), NaN of none; a partition is faster than ``np.median`` here."""
    half = len(values) // 2
    if not half:
        return float(values[0]) if len(values) else np.nan
    ordered = np.partition(values, (half - 1, half))
    return float(0.5 * (ordered[(len(values) - 1) // 2] + ordered[half]))
