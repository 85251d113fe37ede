"""Points sorted into cubes, so that compiled loops find what lies near without a tree."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from ringdic.arrays import Floats, Indices

_MOST = 4  # cubes a point: a few far points do not make many empty cubes


class Cubes(NamedTuple):
    """Points in the order of the cubes in which they lie.

    low : (3,) mm, corner of the first cube. size : mm, edge of a cube. shape : (3,) number of cubes along x, y and z.
    start : (C + 1,) where each cube begins in ``order``; cubes beside one another in z follow one another.
    order : (n,) numbers of the points. at : (n, 3) mm, the points in that order.
    """

    low: Floats
    size: float
    shape: Indices
    start: Indices
    order: Indices
    at: Floats


def cubes(points: Floats, size: float) -> Cubes:
    """Points (n, 3) mm, finite, in cubes with edges of ``size`` mm, or larger ones where these would be too many."""
    low = points.min(axis=0, initial=np.inf) if len(points) else np.zeros(3)
    extent = (points.max(axis=0, initial=-np.inf) if len(points) else low) - low
    size = size if size > 0 else 1.0
    while np.prod(np.floor(extent / size) + 1) > max(_MOST * len(points), 64):
        size *= 1.26  # twice the volume
    shape = np.floor(extent / size).astype(np.int64) + 1
    start, order = _sorted(points, low, size, shape)
    return Cubes(low, size, shape, start, order, points[order])


@nb.njit(cache=True, nogil=True)
def _sorted(points, low, size, shape):  # type: ignore[no-untyped-def]
    """Where each cube begins (C + 1,), and the points (n,) in the order of their cubes."""
    n = len(points)
    cube = np.empty(n, np.int64)
    start = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    for i in range(n):
        x, y, z = (points[i, 0] - low[0]) / size, (points[i, 1] - low[1]) / size, (points[i, 2] - low[2]) / size
        cube[i] = (min(int(x), shape[0] - 1) * shape[1] + min(int(y), shape[1] - 1)) * shape[2] + min(
            int(z), shape[2] - 1
        )
        start[cube[i] + 1] += 1
    for c in range(1, len(start)):
        start[c] += start[c - 1]
    free = start[:-1].copy()
    order = np.empty(n, np.int64)
    for i in range(n):
        order[free[cube[i]]] = i
        free[cube[i]] += 1
    return start, order


@nb.njit(cache=True, nogil=True)
def among_alike(sorted_points, label, reach):  # type: ignore[no-untyped-def]
    """Which points (n,) have none of another label nearer than ``reach`` mm for certain: by whole cubes.

    label : (n,), not negative, of each point.
    """
    shape, start, order = sorted_points.shape, sorted_points.start, sorted_points.order
    sole = np.full(len(start) - 1, -1)  # of a cube: no point, -2 several labels
    for c in range(len(sole)):
        for k in range(start[c], start[c + 1]):
            mine = label[order[k]]
            sole[c] = mine if sole[c] in (-1, mine) else -2
    alike, steps = np.zeros(len(order), np.bool_), int(np.ceil(reach / sorted_points.size))
    for x in range(shape[0]):
        for y in range(shape[1]):
            for z in range(shape[2]):
                c = (x * shape[1] + y) * shape[2] + z
                if sole[c] >= 0:
                    same = _all_alike(sole, shape, x, y, z, steps)
                    for k in range(start[c], start[c + 1]):
                        alike[order[k]] = same
    return alike


@nb.njit(cache=True, nogil=True)
def _all_alike(sole, shape, x, y, z, steps):  # type: ignore[no-untyped-def]
    """Whether all points in the cubes up to some steps beside one have its label."""
    mine = sole[(x * shape[1] + y) * shape[2] + z]
    for i in range(max(x - steps, 0), min(x + steps + 1, shape[0])):
        for j in range(max(y - steps, 0), min(y + steps + 1, shape[1])):
            row = (i * shape[1] + j) * shape[2]
            for k in range(max(z - steps, 0), min(z + steps + 1, shape[2])):
                if sole[row + k] not in (-1, mine):
                    return False
    return True


@nb.njit(cache=True, nogil=True)
def near(sorted_points, x, y, z, radius, found, apart):  # type: ignore[no-untyped-def]
    """Number of points no farther than ``radius`` mm from a place.

    found : (n,), changed in place: their places in the order of the cubes. apart : (n,), their squared distances mm².
    """
    low, size, shape, start, at = (
        sorted_points.low, sorted_points.size, sorted_points.shape, sorted_points.start, sorted_points.at,
    )  # fmt: skip
    x0, x1 = _range(x - low[0], radius, size, shape[0])
    y0, y1 = _range(y - low[1], radius, size, shape[1])
    z0, z1 = _range(z - low[2], radius, size, shape[2])
    count, square = 0, radius * radius
    for i in range(x0, x1 + 1):
        for j in range(y0, y1 + 1):
            row = (i * shape[1] + j) * shape[2]
            for k in range(start[row + z0], start[row + z1 + 1]):
                dx, dy, dz = at[k, 0] - x, at[k, 1] - y, at[k, 2] - z
                distance = dx * dx + dy * dy + dz * dz
                if distance <= square:
                    found[count] = k
                    apart[count] = distance
                    count += 1
    return count


@nb.njit(cache=True, nogil=True)
def _range(middle, radius, size, count):  # type: ignore[no-untyped-def]
    """First and last cube along an axis that come within ``radius`` of a place; the last before the first if none."""
    first, last = np.floor((middle - radius) / size), np.floor((middle + radius) / size)
    if last < 0 or first > count - 1:
        return 1, 0
    return int(max(first, 0.0)), int(min(last, count - 1.0))
