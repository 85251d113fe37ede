"""Points in space that cannot be right: lines of sight that miss one another, places off the surface around them."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_OPPOSITE = ((1, 0), (0, 1), (1, 1), (1, -1))
_SIGMA_OF_MAD = 1.4826  # of a normal distribution


class Lost(IntEnum):
    """Why a matched point was dropped in space; continues the status codes of the correlation."""

    RESIDUAL = 16  # the lines of sight miss one another
    SURFACE = 17  # off the surface that its neighbours form
    UNCERTAIN = 18  # matched, but with too large a standard deviation in an image


def crossing_outliers(residuals: Array, factor: float = 8.0, floor: float = 0.3) -> Mask:
    """Points (n,) whose reprojection residuals (C, n, 2) px stand out.

    A common offset of a camera (it may have moved a little between frames) is no fault of the point: residuals are
    taken about their median, in units of the median absolute deviation, and never below ``floor`` px.
    """
    with np.errstate(invalid="ignore"):
        about = np.abs(residuals - _median(residuals, axis=1)[:, None])
        limit = np.maximum(factor * _SIGMA_OF_MAD * _median(about, axis=1), floor)
        return np.asarray((about > limit[:, None]).any(axis=(0, 2)))


def midpoint_residuals(xy: Array, values: Array, step: int, doubt: Array | None = None) -> Array:
    """How far values lie from the middle of opposite neighbours on the grid, (n,).

    xy : (n, 2) grid positions, multiples of ``step``. values : (n, k), NaN where lost. The prediction is the median
    over up to four pairs of opposite neighbours of the pair's mean: exact for a linear field and blind to one wrong
    neighbour. NaN where no pair is complete. Where a ``doubt`` (n,) is given, nobody is judged by a neighbour more
    doubtful than himself.
    """
    cells = np.round(xy / step).astype(int)
    cells -= cells.min(axis=0) - 1
    doubt = np.zeros(len(xy)) if doubt is None else doubt
    field = np.full((*(cells.max(axis=0) + 2), values.shape[1] + 1), np.nan)
    field[cells[:, 0], cells[:, 1]] = np.column_stack([values, doubt])
    means = []
    for i, j in _OPPOSITE:
        after = field[cells[:, 0] + i, cells[:, 1] + j]
        before = field[cells[:, 0] - i, cells[:, 1] - j]
        fit_to_judge = np.fmax(after[:, -1], before[:, -1]) <= doubt
        means.append(np.where(fit_to_judge[:, None], 0.5 * (after + before)[:, :-1], np.nan))
    return np.asarray(np.linalg.norm(values - _median(np.stack(means), axis=0), axis=1))


def surface_outliers(xy: Array, values: Array, step: int, factor: float = 10.0, floor: float = 0.1) -> Mask:
    """Points (n,) whose values (n, 3) mm contradict their neighbours by more than ``floor`` mm and usual scatter."""
    residual = midpoint_residuals(xy, values, step)
    usual = float(np.nanmedian(residual)) if np.isfinite(residual).any() else 0.0
    limit = max(factor * usual, floor)
    with np.errstate(invalid="ignore"):
        suspect = residual > limit
        # At the rim a good point may have been judged by a wrong one, which then lies further off itself.
        again = midpoint_residuals(xy, values, step, doubt=np.where(suspect, residual, 0.0))
        return suspect & (again > limit)


def _median(values: Array, axis: int) -> Array:
    """Median without NaN along an axis, without the warning where nothing is left."""
    ordered = np.sort(values, axis=axis)  # NaN last
    last = np.maximum(np.isfinite(values).sum(axis=axis, keepdims=True) - 1, 0)
    lower = np.take_along_axis(ordered, last // 2, axis=axis)
    upper = np.take_along_axis(ordered, (last + 1) // 2, axis=axis)
    return np.squeeze(0.5 * (lower + upper), axis=axis)
