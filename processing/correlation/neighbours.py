"""Which points of a correlation are neighbours, and what they say about one another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

COUNT = 8
# A jump across one grid step that no real surface makes, px; grows with the scatter of the field.
_LEAST_JUMP = 0.5
_SCATTERS = 8.0
_LEAST_ISLAND = 4


def neighbours(xy: Array, step: float) -> NDArray[np.int64]:
    """The up to eight nearest points within 1.6 steps of each point, nearest first, -1 beyond. (n, 8)."""
    if len(xy) < 2:
        return np.full((len(xy), COUNT), -1, np.int64)
    distance, index = cKDTree(xy).query(xy, k=COUNT + 1, distance_upper_bound=1.6 * step)
    index = np.where(np.isfinite(distance), index, -1).astype(np.int64)
    own = index == np.arange(len(xy))[:, None]
    # Drop each point itself; where duplicates hide it, drop the last column.
    own[~own.any(axis=1), -1] = True
    return index[~own].reshape(len(xy), COUNT)


def predicted(xy: Array, parameters: Array, source: NDArray[np.int64], target: NDArray[np.int64]) -> Array:
    """Parameters (k, 12) of target points extrapolated from source points with their derivatives."""
    out = parameters[source]
    d = xy[target] - xy[source]
    dx, dy = d[:, 0], d[:, 1]
    for at in (0, 6):
        p = parameters.T[at : at + 6, source]
        out[:, at] += p[1] * dx + p[2] * dy + 0.5 * p[3] * dx**2 + p[4] * dx * dy + 0.5 * p[5] * dy**2
        out[:, at + 1] += p[3] * dx + p[4] * dy
        out[:, at + 2] += p[4] * dx + p[5] * dy
    return out


def _expected(xy: Array, parameters: Array, use: NDArray[np.bool_], near: NDArray[np.int64]) -> Array:
    """What each neighbour in use expects of the displacement of each point; NaN of the others. (n, k, 2)."""
    source = np.maximum(near, 0)
    d = xy[:, None] - xy[source]
    dx, dy = np.where(use, d[..., 0], np.nan), d[..., 1]
    half_xx, xy_, half_yy = 0.5 * dx * dx, dx * dy, 0.5 * dy * dy
    curved = bool(np.any(parameters[:, [3, 4, 5, 9, 10, 11]]))
    out = np.empty((*near.shape, 2))
    for axis, at in enumerate((0, 6)):
        p = np.ascontiguousarray(parameters[:, at : at + 6].T)
        out[..., axis] = p[0][source] + p[1][source] * dx + p[2][source] * dy
        if curved:
            out[..., axis] += p[3][source] * half_xx + p[4][source] * xy_ + p[5][source] * half_yy
    return out


def inconsistent(xy: Array, parameters: Array, good: NDArray[np.bool_], near: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Good points that contradict the median of what their good neighbours predict, and small islands. (n,) bool.

    The median of affine predictions is the robust local fit: half the neighbours may be wrong.
    """
    use = (near >= 0) & good[near] & good[:, None]
    prediction = _expected(xy, parameters, use, near)
    # NaN sorts last, so the median of the m others lies at their middle; a point without any has none.
    ranked, m = np.sort(prediction, axis=1), use.sum(axis=1)
    rows = np.arange(len(xy))
    median = 0.5 * (ranked[rows, np.maximum(m - 1, 0) // 2] + ranked[rows, np.minimum(m // 2, near.shape[1] - 1)])
    jump = np.hypot(*(parameters[:, [0, 6]] - median).T)
    known = good & np.isfinite(jump)
    scatter = 1.4826 * np.median(jump[known]) if known.any() else 0.0
    limit = max(_LEAST_JUMP, _SCATTERS * scatter)
    bad = known & (jump > limit)
    each = np.hypot(*np.moveaxis(parameters[:, None, [0, 6]] - prediction, -1, 0))
    agree = use & (each <= 2 * limit) & ~bad[:, None] & ~bad[np.maximum(near, 0)]
    return bad | _islands(agree, near, good & ~bad)


def _islands(agree: NDArray[np.bool_], near: NDArray[np.int64], good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Good points in groups of mutually agreeing neighbours too small to trust, where larger ones exist."""
    target, slot = np.nonzero(agree)
    n = len(near)
    links = coo_matrix((np.ones(len(target)), (target, near[target, slot])), shape=(n, n))
    _, label = connected_components(links, directed=False)
    size = np.bincount(label[good], minlength=label.max(initial=0) + 1)[label]
    if size[good].max(initial=0) < 4 * _LEAST_ISLAND:
        return np.zeros(n, bool)
    return good & (size < _LEAST_ISLAND)


def local_fit(
    xy: Array, parameters: Array, good: NDArray[np.bool_], wanted: NDArray[np.int64], count: int = 12
) -> Array:
    """Parameters (k, 12) of wanted points from an affine least-squares fit of their nearest good points."""
    out = np.full((len(wanted), parameters.shape[1]), np.nan)
    source = np.flatnonzero(good)
    if len(source) < 6 or not len(wanted):
        return out
    _, index = cKDTree(xy[source]).query(xy[wanted], k=min(count, len(source)))
    pick = source[index]
    d = xy[pick] - xy[wanted][:, None]
    A = np.concatenate([np.ones((*d.shape[:2], 1)), d], axis=2)
    fit = np.linalg.pinv(A) @ parameters[pick][:, :, [0, 6]]
    out[:] = 0.0
    out[:, [0, 1, 2]], out[:, [6, 7, 8]] = fit[:, :, 0], fit[:, :, 1]
    return out
