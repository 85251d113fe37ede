"""Stars of border vertices in the gap between surfaces, compiled: the Delaunay triangles that touch each of them."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from ringdic.mesh.nearest import near

_TURN = 2 * math.pi
_TOLERANCE = 1e-6  # rad


@nb.njit(cache=True, nogil=True)
def stars(middles, vertices, at, normals, group, start, onward, back, bridge, same_side, thinnest):  # type: ignore[no-untyped-def]
    """Triangles of the stars of border vertices in the gap, one star after the other.

    middles : all vertices (N, 3) mm sorted into cubes. vertices : (B,), the border vertices. at, normals : (N, 3).
    group : (N,). start (N + 1,), onward : ends of the border edges that leave each vertex, in one row. back : (N,),
    start of the border edge that enters each vertex, -1 where none does. bridge : mm, longest edge. same_side :
    least cosine between the normals of vertices of one side of the body. thinnest : least height of a triangle over
    its longest edge. Returns (K, 3), counter-clockwise seen against the normal, the smallest index first.
    """
    N = len(at)
    nearby, distance = np.empty(N, np.int64), np.empty(N)
    flat, inverse = np.empty((N, 2)), np.empty((N, 2))
    position = np.full(N, -1)  # in the list of nearby vertices
    result, count = np.empty((2 * len(vertices) + 16, 3), np.int64), 0
    for v in vertices:
        if start[v + 1] - start[v] != 1 or back[v] < 0:
            continue
        count_nearby = near(middles, at[v, 0], at[v, 1], at[v, 2], bridge, nearby, distance)
        names, meeting = _facing(v, nearby[:count_nearby], middles.order, normals, group, same_side)
        if not meeting or len(names) < 3:
            continue
        across = _tangents(names, normals)
        _spread(across, at, v, names, flat, inverse)
        begin, opening = _gap(across, at, v, back[v], onward[start[v]])
        for i in range(len(names)):
            position[names[i]] = i
        neighbours = delaunay_ring(inverse[: len(names)])
        for k in range(len(neighbours)):
            i, j = neighbours[k], neighbours[(k + 1) % len(neighbours)]
            b, c = names[i], names[j]
            if back[b] < 0 or back[c] < 0 or not _fits(flat[i], flat[j], begin, opening, thinnest):
                continue
            if _crossed(i, position[v], flat, names, position, start, onward):
                continue
            if _crossed(j, position[v], flat, names, position, start, onward):
                continue
            if count == len(result):
                result = np.concatenate((result, np.empty_like(result)))
            result[count, 0], result[count, 1], result[count, 2] = _from_smallest(v, b, c)
            count += 1
        position[names] = -1
    return result[:count]


@nb.njit(cache=True, nogil=True)
def _facing(v, nearby, order, normals, group, same_side):  # type: ignore[no-untyped-def]
    """Vertices near v on its side of the body, sorted, and whether several groups meet there."""
    names, count, meeting = np.empty(len(nearby), np.int64), 0, False
    for k in nearby:
        n = order[k]
        cosine = normals[n, 0] * normals[v, 0] + normals[n, 1] * normals[v, 1] + normals[n, 2] * normals[v, 2]
        if cosine > same_side:
            names[count] = n
            count += 1
            meeting |= group[n] != group[v]
    names = names[:count]
    names.sort()
    return names, meeting


@nb.njit(cache=True, nogil=True)
def _tangents(names, normals):  # type: ignore[no-untyped-def]
    """Two unit vectors (2, 3) across the mean normal of vertices, counter-clockwise seen against it.

    Without a case distinction but the sign (Duff et al. 2017).
    """
    x, y, z = 0.0, 0.0, 0.0
    for n in names:
        x, y, z = x + normals[n, 0], y + normals[n, 1], z + normals[n, 2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    x, y, z = x / length, y / length, z / length
    sign = 1.0 if z >= 0 else -1.0  # Duff et al. 2017
    a = -1.0 / (sign + z)
    return np.array([[1 + sign * x * x * a, sign * x * y * a, -sign * x], [x * y * a, sign + y * y * a, -y]])


@nb.njit(cache=True, nogil=True)
def _flat(across, at, v, n):  # type: ignore[no-untyped-def]
    """Position of vertex n in the tangent plane about v, mm."""
    dx, dy, dz = at[n, 0] - at[v, 0], at[n, 1] - at[v, 1], at[n, 2] - at[v, 2]
    return (
        dx * across[0, 0] + dy * across[0, 1] + dz * across[0, 2],
        dx * across[1, 0] + dy * across[1, 1] + dz * across[1, 2],
    )


@nb.njit(cache=True, nogil=True)
def _spread(across, at, v, names, flat, inverse):  # type: ignore[no-untyped-def]
    """Positions of vertices in the tangent plane about v, and their inversions in the unit circle.

    flat, inverse : (n, 2), filled in place; mm and 1/mm. A vertex that lies on v has no inversion: not a number.
    """
    for i in range(len(names)):
        flat[i, 0], flat[i, 1] = _flat(across, at, v, names[i])
        square = flat[i, 0] ** 2 + flat[i, 1] ** 2
        inverse[i, 0] = flat[i, 0] / square if square > 0 else np.nan
        inverse[i, 1] = flat[i, 1] / square if square > 0 else np.nan


@nb.njit(cache=True, nogil=True)
def delaunay_ring(inverse):  # type: ignore[no-untyped-def]
    """Delaunay neighbours of the origin, counter-clockwise, from the convex hull of the points' inversions.

    The points are inverted in the unit circle. A circle through the origin becomes a line, and is empty where all
    inversions lie on the origin's side of that line. Of neighbours on one circle the two outermost are taken.
    inverse : (n, 2). Returns indices.
    """
    n = len(inverse)
    first, farthest = -1, 0.0
    for i in range(n):
        away = inverse[i, 0] ** 2 + inverse[i, 1] ** 2
        if away > farthest:
            first, farthest = i, away
    neighbours, count, here = np.empty(n, np.int64), 0, first
    while here >= 0 and count < n:
        neighbours[count] = here
        count += 1
        ahead, reach = -1, 0.0
        for j in range(n):
            step = (inverse[j, 0] - inverse[here, 0]) ** 2 + (inverse[j, 1] - inverse[here, 1]) ** 2
            if not step > 0:
                continue
            side = -1.0 if ahead < 0 else _beside(inverse, here, ahead, j)
            if side < 0 or (side == 0 and step > reach):
                ahead, reach = j, step
        here = -1 if ahead == first else ahead
    return neighbours[:count]


@nb.njit(cache=True, nogil=True)
def _beside(points, a, b, c):  # type: ignore[no-untyped-def]
    """Twice the area of the triangle of three of the points (n, 2), positive counter-clockwise."""
    return (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1]) - (points[b, 1] - points[a, 1]) * (
        points[c, 0] - points[a, 0]
    )


@nb.njit(cache=True, nogil=True)
def _gap(across, at, v, behind, ahead):  # type: ignore[no-untyped-def]
    """Direction of the border edge that enters v, and the angle from it counter-clockwise to the one that leaves."""
    x, y = _flat(across, at, v, behind)
    begin = math.atan2(y, x)
    x, y = _flat(across, at, v, ahead)
    return begin, (math.atan2(y, x) - begin) % _TURN


@nb.njit(cache=True, nogil=True)
def _fits(b, c, begin, opening, thinnest):  # type: ignore[no-untyped-def]
    """Whether the triangle of the origin, b and c (2,) is oriented as the surface, not thin, and in the gap."""
    twice_area = b[0] * c[1] - b[1] * c[0]
    longest = max(b[0] ** 2 + b[1] ** 2, c[0] ** 2 + c[1] ** 2, (b[0] - c[0]) ** 2 + (b[1] - c[1]) ** 2)
    if twice_area <= 0 or twice_area < thinnest * longest:
        return False
    first, second = (math.atan2(b[1], b[0]) - begin) % _TURN, (math.atan2(c[1], c[0]) - begin) % _TURN
    if first > _TURN - _TOLERANCE:
        first = 0.0
    return first < second < opening + _TOLERANCE


@nb.njit(cache=True, nogil=True)
def _crossed(i, own, flat, names, position, start, onward):  # type: ignore[no-untyped-def]
    """Whether the segment from the origin to point i crosses a border edge that ends at neither."""
    tx, ty = flat[i, 0], flat[i, 1]
    for j in range(len(names)):
        for e in range(start[names[j]], start[names[j] + 1]):
            k = position[onward[e]]
            if k < 0 or own in (j, k) or i in (j, k):
                continue
            px, py, qx, qy = flat[j, 0], flat[j, 1], flat[k, 0], flat[k, 1]
            ax, ay = qx - px, qy - py
            origin_side = px * ay - py * ax
            if (tx * py - ty * px) * (tx * qy - ty * qx) < 0 and origin_side * (origin_side - (tx * ay - ty * ax)) < 0:
                return True
    return False


@nb.njit(cache=True, nogil=True)
def _from_smallest(a, b, c):  # type: ignore[no-untyped-def]
    """Corners of a triangle rotated so that the smallest index comes first."""
    if a < b and a < c:
        return a, b, c
    return (b, c, a) if b < c else (c, a, b)
