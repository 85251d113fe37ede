"""Neighbours of the points of a correlation, with extrapolation between them and tests for outliers.

Matches are extrapolated from point to point by their derivatives: to give start values, to fit affine fields, and to
find outliers.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.correlation.lanes import INNER
from ringdic.correlation.parallel import in_ranges

COUNT = 8
_AROUND = ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
_MOST_CELLS = 64  # per point, of a grid that neighbours are read from; those of sparser points come from a k-d tree
_MIN_DEVIATION = 0.5  # px; smaller deviations from the neighbours are never outliers
_MAX_SCATTER_RATIO = 8.0  # deviation of an outlier, in standard deviations of all deviations
_FITTED = 12  # good points of an affine fit
_MIN_ISLAND = 4  # points of the smallest group that remains
_LEAST = 1000  # points that are worth a thread


def point_neighbours(xy: Pixels, step: float) -> Indices:
    """Up to eight nearest points within 1.6 steps of each point.

    xy : (n, 2) float64, px. step : px, grid spacing. Returns indices (n, 8), nearest first, -1 where there are fewer.
    """
    if len(xy) < 2:
        return np.full((len(xy), COUNT), -1, np.int64)
    cell = (xy - xy.min(axis=0)) / step
    columns, rows = (int(size) + 1 for size in cell.max(axis=0))
    if columns * rows <= _MOST_CELLS * len(xy) and (cell == np.rint(cell)).all():
        column, row = cell.T.astype(np.int64) + 1
        table = np.full((columns + 2, rows + 2), -1, np.int64)
        table[column, row] = np.arange(len(xy))
        if (table[column, row] == np.arange(len(xy))).all():  # no point twice
            return np.stack([table[column + dx, row + dy] for dx, dy in _AROUND], axis=1)
    distance, index = scipy.spatial.cKDTree(xy).query(xy, k=COUNT + 1, distance_upper_bound=1.6 * step)
    index = np.where(np.isfinite(distance), index, -1).astype(np.int64)
    own = index == np.arange(len(xy))[:, None]
    # Drop each point itself; where duplicates hide it, drop the last column.
    own[~own.any(axis=1), -1] = True
    return index[~own].reshape(len(xy), COUNT)


def extrapolate(xy: Pixels, parameters: Floats, source: Indices, target: Indices) -> Floats:
    """Extrapolate the warps of source points to target points by their derivatives (second-order Taylor series).

    xy : (n, 2) float64, px. parameters : (n, 12) float64, px and derivatives. source, target : (k,) int64, indices of
        points.
    Returns (k, 12), the parameters at the targets.
    """
    out = parameters[source]
    d = xy[target] - xy[source]
    dx, dy = d[:, 0], d[:, 1]
    for at in (0, 6):
        p = parameters.T[at : at + 6, source]
        out[:, at] += p[1] * dx + p[2] * dy + 0.5 * p[3] * dx**2 + p[4] * dx * dy + 0.5 * p[5] * dy**2
        out[:, at + 1] += p[3] * dx + p[4] * dy
        out[:, at + 2] += p[4] * dx + p[5] * dy
    return out


def inconsistent_points(
    xy: Pixels,
    parameters: Floats,
    good: Mask,
    near: Indices,
    deviation: Floats,
    stale: Mask,
) -> Mask:
    """Good points whose displacement contradicts their neighbours; if there are none, points of small isolated groups.

    A point is compared with the median of what its good neighbours extrapolate for it, which is robust: up to half of
    the neighbours may be wrong.

    Parameters
    ----------
    xy : (n, 2) float64, px. parameters : (n, 12) float64, px and derivatives. good : (n,) bool.
    near : (n, 8) int64, indices of neighbours, -1 for none.
    deviation : (n,) float64, px, distance of each point from that median as the last call left it; brought up to date.
    stale : (n,) bool, points whose match has changed since, at first all; cleared.

    Returns
    -------
    bad : (n,) bool.
    """
    in_ranges(_deviations, len(xy), xy, parameters, good, near, stale, deviation, least=_LEAST)
    stale[:] = False
    known = np.isfinite(deviation)
    scatter = 1.4826 * np.median(deviation[known]) if known.any() else 0.0
    limit = max(_MIN_DEVIATION, _MAX_SCATTER_RATIO * scatter)
    bad = known & (deviation > limit)
    if bad.any():
        return bad
    islands = np.zeros(len(xy), bool)
    if _has_large_group(xy, parameters, good, near, 2.0 * limit, 4 * _MIN_ISLAND):
        in_ranges(_islands, len(xy), xy, parameters, good, near, 2.0 * limit, _MIN_ISLAND, islands, least=_LEAST)
    return islands


@nb.njit(cache=True, nogil=True, **INNER)
def _extrapolate_displacement(xy, parameters, source, target, at):  # type: ignore[no-untyped-def]
    """Displacement along x (at 0) or y (at 6) at one point, extrapolated from another."""
    dx, dy, p, s = xy[target, 0] - xy[source, 0], xy[target, 1] - xy[source, 1], parameters, source
    curved = 0.5 * p[s, at + 3] * dx * dx + p[s, at + 4] * dx * dy + 0.5 * p[s, at + 5] * dy * dy
    return p[s, at] + p[s, at + 1] * dx + p[s, at + 2] * dy + curved


@nb.njit(cache=True, nogil=True)
def _deviations(first, last, xy, parameters, good, near, stale, deviation):  # type: ignore[no-untyped-def]
    """Fill deviation (n,) px, the distance of good points from the median of their neighbours' extrapolations.

    NaN without any. Only points from ``first`` to ``last`` that are stale (n,) or have a stale neighbour are computed.
    """
    for k in range(first, last):
        changed = stale[k]
        for slot in range(near.shape[1]):
            changed |= near[k, slot] >= 0 and stale[near[k, slot]]
        if not changed:
            continue
        deviation[k] = np.nan
        if not good[k]:
            continue
        predictions, m = np.empty((2, near.shape[1])), 0
        for slot in range(near.shape[1]):
            source = near[k, slot]
            if source >= 0 and good[source]:
                predictions[0, m] = _extrapolate_displacement(xy, parameters, source, k, 0)
                predictions[1, m] = _extrapolate_displacement(xy, parameters, source, k, 6)
                m += 1
        if m:
            u, v = _median(predictions[0], m), _median(predictions[1], m)
            deviation[k] = math.hypot(parameters[k, 0] - u, parameters[k, 6] - v)


@nb.njit(cache=True, nogil=True, **INNER)
def _median(values, count):  # type: ignore[no-untyped-def]
    """Median of the first ``count`` values, without sorting and without branches that a processor cannot predict."""
    low, high = 0.0, 0.0
    for k in range(count):
        rank = 0
        for m in range(count):
            rank += (values[m] < values[k]) | ((values[m] == values[k]) & (m < k))
        low = values[k] if rank == (count - 1) // 2 else low
        high = values[k] if rank == count // 2 else high
    return 0.5 * (low + high)


@nb.njit(cache=True, nogil=True, **INNER)
def _agree(xy, parameters, one, other, limit):  # type: ignore[no-untyped-def]
    """Whether one of two points lies within ``limit`` px of where the other's extrapolation puts it."""
    for source, target in ((one, other), (other, one)):
        u = _extrapolate_displacement(xy, parameters, source, target, 0) - parameters[target, 0]
        v = _extrapolate_displacement(xy, parameters, source, target, 6) - parameters[target, 6]
        if u * u + v * v <= limit * limit:
            return True
    return False


@nb.njit(cache=True, nogil=True, **INNER)
def _connected_count(xy, parameters, good, near, limit, k, members, max_count):  # type: ignore[no-untyped-def]
    """Number of good points in the connected group of point k, ``max_count`` if there are more.

    Neighbours are connected if they agree (``_agree``). members : (at least max_count,) scratch.
    """
    members[0], count, at = k, 1, 0
    while at < count < max_count:
        for slot in range(near.shape[1]):
            other, new = near[members[at], slot], True
            if other < 0 or not good[other]:
                continue
            for m in range(count):
                new &= members[m] != other
            if new and _agree(xy, parameters, members[at], other, limit):
                members[count] = other
                count += 1
                if count == max_count:
                    break
        at += 1
    return count


@nb.njit(cache=True, nogil=True)
def _has_large_group(xy, parameters, good, near, limit, count):  # type: ignore[no-untyped-def]
    """Whether some connected group has at least ``count`` good points."""
    members = np.empty(count, np.int64)
    for k in range(len(xy)):
        if good[k] and _connected_count(xy, parameters, good, near, limit, k, members, count) == count:
            return True
    return False


@nb.njit(cache=True, nogil=True)
def _islands(first, last, xy, parameters, good, near, limit, min_count, out):  # type: ignore[no-untyped-def]
    """Fill out (n,), from ``first`` to ``last``: good points in connected groups of fewer than ``min_count``."""
    few = np.empty(min_count, np.int64)
    for k in range(first, last):
        out[k] = good[k] and _connected_count(xy, parameters, good, near, limit, k, few, min_count) < min_count


def local_affine_fit(
    xy: Pixels,
    parameters: Floats,
    good: Mask,
    near: Indices,
    wanted: Indices,
) -> Floats:
    """Parameters of unmatched points from an affine least-squares fit of the good points around each.

    Parameters
    ----------
    xy : (n, 2) float64, px. parameters : (n, 12) float64, px and derivatives. good : (n,) bool.
    near : (n, 8) int64, indices of neighbours, -1 for none; good points are collected from neighbour to neighbour.
    wanted : (k,) int64, indices of the points to fit for.

    Returns
    -------
    fit : (k, 12), px and derivatives; NaN where fewer than six good points can be reached.
    """
    out = np.full((len(wanted), parameters.shape[1]), np.nan)
    _fit_affine(xy, parameters, good, near, wanted, _FITTED, out)
    return out


@nb.njit(cache=True, nogil=True, **INNER)
def _nearest_rings(good, near, k, count, seen, stamp):  # type: ignore[no-untyped-def]
    """Indices of good points around point k, ring by ring of neighbours, until there are at least ``count``.

    seen : (n,) scratch; a point that has been visited holds ``stamp``.
    """
    reached, sample = [np.int64(k)], [np.int64(k)]
    sample.pop()
    seen[k] = stamp
    begin = 0
    while len(sample) < count and begin < len(reached):
        end = len(reached)
        for at in range(begin, end):
            for slot in range(near.shape[1]):
                other = near[reached[at], slot]
                if other >= 0 and seen[other] != stamp:
                    seen[other] = stamp
                    reached.append(other)
                    if good[other]:
                        sample.append(other)
        begin = end
    return np.array(sample)


@nb.njit(cache=True, nogil=True)
def _fit_affine(xy, parameters, good, near, wanted, count, out):  # type: ignore[no-untyped-def]
    """Affine fits of ``local_affine_fit`` into out (k, 12), by normal equations."""
    seen = np.full(len(xy), -1, np.int64)
    for w in range(len(wanted)):
        sample = _nearest_rings(good, near, wanted[w], count, seen, w)
        if len(sample) < 6:
            continue
        off = xy[sample] - xy[wanted[w]]
        square = off[:, 0] ** 2 + off[:, 1] ** 2
        nearest = np.argsort(square, kind="mergesort")[:count]
        side = math.sqrt(np.mean(square[nearest]))
        N, b = np.zeros((3, 3)), np.zeros((3, 2))
        for at in nearest:
            row = (1.0, off[at, 0] / side, off[at, 1] / side)
            for i in range(3):
                for j in range(3):
                    N[i, j] += row[i] * row[j]
                b[i, 0] += row[i] * parameters[sample[at], 0]
                b[i, 1] += row[i] * parameters[sample[at], 6]
        for i in range(3):
            N[i, i] += 1e-9 * len(nearest)  # points on a line do not determine the gradient across it: it becomes zero
        fit = np.linalg.solve(N, b)
        out[w] = 0.0
        for axis in range(2):
            out[w, 6 * axis] = fit[0, axis]
            out[w, 6 * axis + 1], out[w, 6 * axis + 2] = fit[1, axis] / side, fit[2, axis] / side
