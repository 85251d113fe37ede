"""Gaps between surfaces closed with triangles over the vertices that are there.

Every border vertex is looked at in its own tangent plane: the Delaunay triangles of its neighbourhood that touch it
are its star. A triangle is taken when it is in the stars of all three of its corners, lies beside the triangles that
are there, crosses none of their borders and has no edge longer than the bridge. What the stars do not agree on (four
points on a circle, a border that is not Delaunay) is left to :mod:`processing.merging.fill`.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree

from processing.mesh import Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_SAME_SIDE = 0.2  # least cosine between the normals of vertices of one side of the body
THINNEST = 0.1  # least height of a new triangle over its longest edge: thinner ones have no direction and no strain
_TURN = 2 * np.pi
_TOLERANCE = 1e-6  # rad


def stitch(mesh: Mesh, group: Indices, bridge: float) -> Indices:
    """Triangles (K, 3) that join what belongs to different groups, turned as the surface is.

    mesh : sound pieces side by side. group : (N,) of each vertex; only near where groups meet are gaps closed.
    bridge : mm, longest edge of a new triangle.
    """
    border = mesh.boundary_edges()
    if not len(border):
        return np.zeros((0, 3), np.int64)
    used = np.unique(mesh.faces)
    at, normals = mesh.vertices[used], np.nan_to_num(mesh.vertex_normals[used])
    index = np.full(len(mesh.vertices), -1)
    index[used] = np.arange(len(used))
    tree = cKDTree(at)
    edges = index[border]
    on_border = np.unique(edges)
    after: dict[int, list[int]] = {}
    before: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        after.setdefault(a, []).append(b)
        before.setdefault(b, []).append(a)
    around = tree.query_ball_point(at[on_border], bridge)
    votes: Counter[tuple[int, int, int]] = Counter()
    whole = group[used]
    for v, row in zip(on_border.tolist(), around, strict=True):
        near = np.asarray(row)
        near = near[normals[near] @ normals[v] > _SAME_SIDE]
        if len(after[v]) > 1 or (whole[near] == whole[v]).all():
            continue
        votes.update(_star(v, near, at, normals[near].sum(axis=0), after, before))
    return used[_consistent([corners for corners, count in votes.items() if count == 3], at, edges)]


def _star(
    v: int, near: Indices, at: Array, normal: Array, after: dict[int, list[int]], before: dict[int, list[int]]
) -> list[tuple[int, int, int]]:
    """Triangles of v's star in the gap: corners counter-clockwise, the smallest index first."""
    if len(near) < 3:
        return []
    across = _tangents(normal)
    flat = (at[near] - at[v]) @ across.T
    try:
        triangles = Delaunay(flat).simplices
    except QhullError:  # all on a line
        return []
    names = near.tolist()
    own = names.index(v)
    place = {n: i for i, n in enumerate(names)}
    others = [[i for i in triangle if i != own] for triangle in triangles[(triangles == own).any(axis=1)].tolist()]
    others = [pair for pair in others if names[pair[0]] in after and names[pair[1]] in after]
    if not others:
        return []
    borders = np.array([(i, place[b]) for i, a in enumerate(names) for b in after.get(a, ()) if b in place], np.int64)
    barred = _crossing(flat, own, borders.reshape(-1, 2))
    # The gap opens from the border edge that comes in, counter-clockwise to the one that goes out.
    end, begin = (float(np.arctan2(*(across @ (at[n] - at[v]))[::-1])) for n in (after[v][0], before[v][0]))
    opening = (end - begin) % _TURN
    direction = ((np.arctan2(flat[:, 1], flat[:, 0]) - begin) % _TURN).tolist()
    found = []
    for b, c in others:
        twice_area = flat[b, 0] * flat[c, 1] - flat[b, 1] * flat[c, 0]
        if twice_area < 0:
            b, c = c, b
        if abs(twice_area) < THINNEST * max(flat[b] @ flat[b], flat[c] @ flat[c], np.sum((flat[b] - flat[c]) ** 2)):
            continue
        from_ = 0.0 if direction[b] > _TURN - _TOLERANCE else direction[b]
        if barred[b] or barred[c] or not from_ < direction[c] < opening + _TOLERANCE:
            continue
        found.append(_from_smallest(v, names[b], names[c]))
    return found


def _from_smallest(a: int, b: int, c: int) -> tuple[int, int, int]:
    """The same triangle, its smallest index first."""
    return (a, b, c) if a < b and a < c else (b, c, a) if b < c else (c, a, b)


def _tangents(normal: Array) -> Array:
    """Two unit vectors (2, 3) across a normal, counter-clockwise seen against it."""
    x, y, z = (normal / max(float(np.sqrt(normal @ normal)), 1e-12)).tolist()
    sign = 1.0 if z >= 0 else -1.0  # Duff et al. 2017
    a = -1.0 / (sign + z)
    return np.array([[1 + sign * x * x * a, sign * x * y * a, -sign * x], [x * y * a, sign + y * y * a, -y]])


def _crossing(flat: Array, v: int, borders: Indices) -> Mask:
    """Which segments from v to the other points (n, 2) cross a border edge (B, 2) that has neither as an end. (n,)."""
    p, q = flat[borders[:, 0]] - flat[v], flat[borders[:, 1]] - flat[v]
    to = flat - flat[v]
    beside_p = to[:, None, 0] * p[:, 1] - to[:, None, 1] * p[:, 0]
    beside_q = to[:, None, 0] * q[:, 1] - to[:, None, 1] * q[:, 0]
    along = q - p
    v_side = p[:, 0] * along[:, 1] - p[:, 1] * along[:, 0]
    to_side = v_side - (to[:, None, 0] * along[:, 1] - to[:, None, 1] * along[:, 0])
    crossed = (beside_p * beside_q < 0) & (v_side * to_side < 0)
    apart = (borders != v).all(axis=1) & (borders[None] != np.arange(len(flat))[:, None, None]).all(axis=2)
    return np.asarray((crossed & apart).any(axis=1))


def _consistent(triangles: list[tuple[int, int, int]], at: Array, edges: Indices) -> Indices:
    """Of triangles, those that fit to the border edges and to one another, the ones with short edges first."""
    candidates = np.array(triangles, np.int64).reshape(-1, 3)
    corners = at[candidates]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    taken = set(map(tuple, edges.tolist()))
    count = Counter((min(a, b), max(a, b)) for a, b in taken)
    chosen = []
    for a, b, c in candidates[np.argsort(longest, kind="stable")].tolist():
        half = ((a, b), (b, c), (c, a))
        undirected = [(min(e), max(e)) for e in half]
        if any(e in taken for e in half) or any(count[e] > 1 for e in undirected):
            continue
        taken.update(half)
        count.update(undirected)
        chosen.append((a, b, c))
    return np.array(chosen, np.int64).reshape(-1, 3)
