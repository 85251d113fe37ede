"""Compiled search for neighbouring points: points sorted into a regular grid of cubes."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from ringdic.arrays import Floats, Indices, Points
from ringdic.mesh.adjacency import counting_sort

_MOST = 4  # cubes for each point: a few far points must not make very many empty cubes


class Cubes(NamedTuple):
    """Points sorted by the cubes of a regular grid in which they lie.

    low : (3,) mm, lower corner of the grid.
    size : mm, edge of a cube.
    shape : (3,) number of cubes along x, y and z.
    start : (C + 1,) where the points of each cube begin in ``order``; z is the fastest index of the cubes.
    order : (n,) indices of the points, sorted by cube.
    at : (n, 3) mm, the points in that order.
    """

    low: Floats
    size: float
    shape: Indices
    start: Indices
    order: Indices
    at: Points


def cubes(points: Points, size: float) -> Cubes:
    """Sort points into a regular grid of cubes.

    points : (n, 3) mm, finite. size : mm, edge of the cubes; it is enlarged where the grid would have far more cubes
    than points.
    """
    low = points.min(axis=0, initial=np.inf) if len(points) else np.zeros(3)
    extent = (points.max(axis=0, initial=-np.inf) if len(points) else low) - low
    size = size if size > 0 else 1.0
    while np.prod(np.floor(extent / size) + 1) > max(_MOST * len(points), 64):
        size *= 1.26  # twice the volume
    shape = np.floor(extent / size).astype(np.int64) + 1
    cell = np.minimum(((points - low) / size).astype(np.int64), shape - 1)
    start, order = counting_sort(np.ravel_multi_index(tuple(cell.T), shape.tolist()), np.prod(shape))
    return Cubes(low, size, shape, start, order, points[order])


@nb.njit(cache=True, nogil=True)
def away_from_other_labels(sorted_points, label, reach):  # type: ignore[no-untyped-def]
    """Which points certainly have no point of another label within a distance, (n,) bool.

    Whole cubes are compared, so a point near the distance may be False though it is far enough.
    sorted_points : Cubes of n points. label : (n,) number ≥ 0 of each point. reach : mm.
    """
    shape, start, order = sorted_points.shape, sorted_points.start, sorted_points.order
    sole = np.full(len(start) - 1, -1)  # label of each cube's points; -1 for no point, -2 for several labels
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
    """Whether the points of all cubes within some steps of cube (x, y, z) have the label of that cube."""
    mine = sole[(x * shape[1] + y) * shape[2] + z]
    for i in range(max(x - steps, 0), min(x + steps + 1, shape[0])):
        for j in range(max(y - steps, 0), min(y + steps + 1, shape[1])):
            row = (i * shape[1] + j) * shape[2]
            for k in range(max(z - steps, 0), min(z + steps + 1, shape[2])):
                if sole[row + k] not in (-1, mine):
                    return False
    return True


@nb.njit(cache=True, nogil=True)
def near(sorted_points, x, y, z, radius, neighbours, distances):  # type: ignore[no-untyped-def]
    """Points within a radius of the position x, y, z (mm); returns their number.

    sorted_points : Cubes of n points. radius : mm. The first elements of neighbours (n,) and distances (n,) are filled:
    places of the points in the order of the cubes, and squared distances in mm².
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
                    neighbours[count] = k
                    distances[count] = distance
                    count += 1
    return count


@nb.njit(cache=True, nogil=True)
def _range(middle, radius, size, count):  # type: ignore[no-untyped-def]
    """First and last cube along an axis that lie within ``radius`` mm of a coordinate; (1, 0) where none does."""
    first, last = np.floor((middle - radius) / size), np.floor((middle + radius) / size)
    if last < 0 or first > count - 1:
        return 1, 0
    return int(max(first, 0.0)), int(min(last, count - 1.0))
