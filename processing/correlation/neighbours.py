"""Which points of a correlation are neighbours, and what they say about one another."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray
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


def inconsistent(xy: Array, parameters: Array, good: NDArray[np.bool_], near: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Good points that contradict the median of what their good neighbours predict, and small islands. (n,) bool.

    The median of affine predictions is the robust local fit: half the neighbours may be wrong.
    """
    jump = _jumps(xy, parameters, good, near)
    known = np.isfinite(jump)
    scatter = 1.4826 * np.median(jump[known]) if known.any() else 0.0
    limit = max(_LEAST_JUMP, _SCATTERS * scatter)
    bad = known & (jump > limit)
    size = _island_sizes(xy, parameters, good & ~bad, near, 2.0 * limit)
    if size.max(initial=0) < 4 * _LEAST_ISLAND:
        return bad
    return bad | (good & ~bad & (size < _LEAST_ISLAND))


@nb.njit(cache=True, nogil=True)
def _expected(xy, parameters, source, target, at):  # type: ignore[no-untyped-def]
    """The displacement along x (at 0) or y (at 6) that a point expects of another."""
    dx, dy, p, s = xy[target, 0] - xy[source, 0], xy[target, 1] - xy[source, 1], parameters, source
    curved = 0.5 * p[s, at + 3] * dx * dx + p[s, at + 4] * dx * dy + 0.5 * p[s, at + 5] * dy * dy
    return p[s, at] + p[s, at + 1] * dx + p[s, at + 2] * dy + curved


@nb.njit(cache=True, nogil=True, parallel=True)
def _jumps(xy, parameters, good, near):  # type: ignore[no-untyped-def]
    """Distance (n,) px of each good point from the median of what its good neighbours expect; NaN without any."""
    n = len(xy)
    out = np.full(n, np.nan)
    for k in nb.prange(n):
        if not good[k]:
            continue
        expected, m = np.empty((2, near.shape[1])), 0
        for slot in range(near.shape[1]):
            source = near[k, slot]
            if source >= 0 and good[source]:
                expected[0, m] = _expected(xy, parameters, source, k, 0)
                expected[1, m] = _expected(xy, parameters, source, k, 6)
                m += 1
        if m:
            u, v = _median(expected[0], m), _median(expected[1], m)
            out[k] = math.hypot(parameters[k, 0] - u, parameters[k, 6] - v)
    return out


@nb.njit(cache=True, nogil=True)
def _median(values, count):  # type: ignore[no-untyped-def]
    """Median of the first few values, which it puts in order."""
    for k in range(1, count):
        value, at = values[k], k
        while at and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    return 0.5 * (values[(count - 1) // 2] + values[count // 2])


@nb.njit(cache=True, nogil=True)
def _root(parent, k):  # type: ignore[no-untyped-def]
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@nb.njit(cache=True, nogil=True)
def _island_sizes(xy, parameters, good, near, limit):  # type: ignore[no-untyped-def]
    """The number of good points (n,) that each good point hangs together with by mutual agreement; 0 of the others."""
    n = len(xy)
    parent = np.arange(n)
    for k in range(n):
        if not good[k]:
            continue
        for slot in range(near.shape[1]):
            source = near[k, slot]
            if source >= 0 and good[source]:
                u = _expected(xy, parameters, source, k, 0) - parameters[k, 0]
                v = _expected(xy, parameters, source, k, 6) - parameters[k, 6]
                if u * u + v * v <= limit * limit:
                    parent[_root(parent, k)] = _root(parent, source)
    count = np.zeros(n, np.int64)
    for k in range(n):
        if good[k]:
            count[_root(parent, k)] += 1
    out = np.zeros(n, np.int64)
    for k in range(n):
        if good[k]:
            out[k] = count[_root(parent, k)]
    return out


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
