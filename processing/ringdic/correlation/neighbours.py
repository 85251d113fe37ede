"""Which points of a correlation are neighbours, and what they say about one another."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask

COUNT = 8
_AROUND = ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
_MOST_CELLS = 64  # of a grid a point of it; a sparser one has its neighbours looked for
# A jump across one grid step that no real surface makes, px; grows with the scatter of the field.
_LEAST_JUMP = 0.5
_SCATTERS = 8.0
_LEAST_ISLAND = 4


def point_neighbours(xy: Floats, step: float) -> Indices:
    """The up to eight nearest points within 1.6 steps of each point, nearest first, -1 where there is none. (n, 8)."""
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


def predicted(xy: Floats, parameters: Floats, source: Indices, target: Indices) -> Floats:
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


def inconsistent(
    xy: Floats,
    parameters: Floats,
    good: Mask,
    near: Indices,
    jump: Floats,
    stale: Mask,
) -> Mask:
    """Good points that contradict the median of what their good neighbours predict; if none does, small islands. (n,).

    The median of affine predictions is the robust local fit: half the neighbours may be wrong.
    jump : (n,) px, how far each lies from that median, as this function left it; stale : (n,) bool, what has changed
    since, all at first. Both are brought up to date.
    """
    _jumps(xy, parameters, good, near, stale, jump)
    stale[:] = False
    known = np.isfinite(jump)
    scatter = 1.4826 * np.median(jump[known]) if known.any() else 0.0
    limit = max(_LEAST_JUMP, _SCATTERS * scatter)
    bad = known & (jump > limit)
    if bad.any():
        return bad
    return _islands(xy, parameters, good, near, 2.0 * limit, _LEAST_ISLAND)


@nb.njit(cache=True, nogil=True)
def _expected(xy, parameters, source, target, at):  # type: ignore[no-untyped-def]
    """The displacement along x (at 0) or y (at 6) that a point expects of another."""
    dx, dy, p, s = xy[target, 0] - xy[source, 0], xy[target, 1] - xy[source, 1], parameters, source
    curved = 0.5 * p[s, at + 3] * dx * dx + p[s, at + 4] * dx * dy + 0.5 * p[s, at + 5] * dy * dy
    return p[s, at] + p[s, at + 1] * dx + p[s, at + 2] * dy + curved


@nb.njit(cache=True, nogil=True, parallel=True)
def _jumps(xy, parameters, good, near, stale, jump):  # type: ignore[no-untyped-def]
    """Distance (n,) px of each good point from the median of what its good neighbours expect; NaN without any.

    Only where the point or a neighbour is stale (n,).
    """
    for k in nb.prange(len(xy)):
        changed = stale[k]
        for slot in range(near.shape[1]):
            changed |= near[k, slot] >= 0 and stale[near[k, slot]]
        if not changed:
            continue
        jump[k] = np.nan
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
            jump[k] = math.hypot(parameters[k, 0] - u, parameters[k, 6] - v)


@nb.njit(cache=True, nogil=True)
def _median(values, count):  # type: ignore[no-untyped-def]
    """Median of the first few values: those with half of the others below them, without a branch that is not known."""
    low, high = 0.0, 0.0
    for k in range(count):
        rank = 0
        for m in range(count):
            rank += (values[m] < values[k]) | ((values[m] == values[k]) & (m < k))
        low = values[k] if rank == (count - 1) // 2 else low
        high = values[k] if rank == count // 2 else high
    return 0.5 * (low + high)


@nb.njit(cache=True, nogil=True)
def _agree(xy, parameters, one, other, limit):  # type: ignore[no-untyped-def]
    """Whether either of two points lies where the other expects it."""
    for source, target in ((one, other), (other, one)):
        u = _expected(xy, parameters, source, target, 0) - parameters[target, 0]
        v = _expected(xy, parameters, source, target, 6) - parameters[target, 6]
        if u * u + v * v <= limit * limit:
            return True
    return False


@nb.njit(cache=True, nogil=True)
def _hangs_together(xy, parameters, good, near, limit, k, found, most):  # type: ignore[no-untyped-def]
    """The number of good points that point k hangs together with by mutual agreement, ``most`` if more.

    found : (at least most,) scratch.
    """
    found[0], count, at = k, 1, 0
    while at < count < most:
        for slot in range(near.shape[1]):
            other, new = near[found[at], slot], True
            if other < 0 or not good[other]:
                continue
            for m in range(count):
                new &= found[m] != other
            if new and _agree(xy, parameters, found[at], other, limit):
                found[count] = other
                count += 1
                if count == most:
                    break
        at += 1
    return count


@nb.njit(cache=True, nogil=True, parallel=True)
def _islands(xy, parameters, good, near, limit, least):  # type: ignore[no-untyped-def]
    """Good points (n,) that hang together with fewer than ``least``, themselves included; none where nothing hangs
    together with four times as many."""
    out, many, most = np.zeros(len(xy), np.bool_), False, 4 * least
    found = np.empty(most, np.int64)
    for k in range(len(xy)):
        many = good[k] and _hangs_together(xy, parameters, good, near, limit, k, found, most) == most
        if many:
            break
    if not many:
        return out
    for k in nb.prange(len(xy)):
        few = np.empty(least, np.int64)
        out[k] = good[k] and _hangs_together(xy, parameters, good, near, limit, k, few, least) < least
    return out


def local_fit(
    xy: Floats,
    parameters: Floats,
    good: Mask,
    near: Indices,
    wanted: Indices,
    count: int = 12,
) -> Floats:
    """Parameters (k, 12) of wanted points from an affine least-squares fit of so many good points near them.

    near : (n, 8), neighbours; they lead from point to point. NaN where they lead to fewer than six good ones.
    """
    out = np.full((len(wanted), parameters.shape[1]), np.nan)
    _fits(xy, parameters, good, near, wanted, count, out)
    return out


@nb.njit(cache=True, nogil=True)
def _ring_by_ring(good, near, k, count, seen, stamp):  # type: ignore[no-untyped-def]
    """Good points around point k, from neighbour to neighbour until at least ``count`` are found.

    seen : (n,), what is not ``stamp`` has not been looked at; filled.
    """
    reached, picked = [np.int64(k)], [np.int64(k)]
    picked.pop()
    seen[k] = stamp
    begin = 0
    while len(picked) < count and begin < len(reached):
        end = len(reached)
        for at in range(begin, end):
            for slot in range(near.shape[1]):
                other = near[reached[at], slot]
                if other >= 0 and seen[other] != stamp:
                    seen[other] = stamp
                    reached.append(other)
                    if good[other]:
                        picked.append(other)
        begin = end
    return np.array(picked)


@nb.njit(cache=True, nogil=True)
def _fits(xy, parameters, good, near, wanted, count, out):  # type: ignore[no-untyped-def]
    """The affine fits of ``local_fit``: the nearest of the points that are found ring by ring, by normal equations."""
    seen = np.full(len(xy), -1, np.int64)
    for w in range(len(wanted)):
        picked = _ring_by_ring(good, near, wanted[w], count, seen, w)
        if len(picked) < 6:
            continue
        off = xy[picked] - xy[wanted[w]]
        square = off[:, 0] ** 2 + off[:, 1] ** 2
        nearest = np.argsort(square, kind="mergesort")[:count]
        side = math.sqrt(np.mean(square[nearest]))
        N, b = np.zeros((3, 3)), np.zeros((3, 2))
        for at in nearest:
            row = (1.0, off[at, 0] / side, off[at, 1] / side)
            for i in range(3):
                for j in range(3):
                    N[i, j] += row[i] * row[j]
                b[i, 0] += row[i] * parameters[picked[at], 0]
                b[i, 1] += row[i] * parameters[picked[at], 6]
        for i in range(3):
            N[i, i] += 1e-9 * len(nearest)  # points in a row tell nothing across it: no gradient is taken there
        fit = np.linalg.solve(N, b)
        out[w] = 0.0
        for axis in range(2):
            out[w, 6 * axis] = fit[0, axis]
            out[w, 6 * axis + 1], out[w, 6 * axis + 2] = fit[1, axis] / side, fit[2, axis] / side
