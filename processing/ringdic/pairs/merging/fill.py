"""Small holes closed with triangles over the vertices round them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.mesh.mesh import Mesh, half_edges
from ringdic.mesh.topology import Border, Kind, borders

_LONGEST = 150  # vertices of a border that is filled
_THIN = 0.1  # height over longest edge of triangles that are made only where there is no other way
_FACING = 0.5  # least cosine between a hole's own normal and those of the surface round it


def fill(mesh: Mesh, area: float, bridge: float, seam: Mask, seam_area: float) -> Indices:
    """Triangles (K, 3) that close holes, turned as the surface is.

    area : mm², of the largest hole that is closed; seam_area : of the largest that touches the seam, (N,) vertices.
    bridge : mm, longest edge of a new triangle. A hole whose outline folds over, or that would need a longer edge or
    an edge that the mesh has already, stays open.
    """
    normals = np.nan_to_num(mesh.vertex_normals)
    found = [np.zeros((0, 3), np.int64)]
    around = borders(mesh)
    known = _edges_between(mesh, around)
    for border in around:
        if border.kind is not Kind.HOLE and len(border.loop) == len(set(border.loop.tolist())):
            continue
        for loop in simple_loops(border.loop.tolist()):
            if not 3 <= len(loop) <= _LONGEST:
                continue
            outline = np.array(loop[::-1])  # counter-clockwise round the hole
            points = mesh.vertices[outline]
            vector = 0.5 * np.cross(points - points[0], np.roll(points, -1, axis=0) - points[0]).sum(axis=0)
            size = float(np.linalg.norm(vector))
            limit = seam_area if seam[outline].any() else area
            if size == 0 or size > limit or normals[outline].mean(axis=0) @ vector < _FACING * size:
                continue
            barred = _forbidden(outline, known)
            triangles = polygon(points, vector / size, bridge, barred, _THIN)
            if triangles is None:
                triangles = polygon(points, vector / size, bridge, barred)
            if triangles is not None:
                found.append(outline[triangles])
                known.update(_edges_of(found[-1]))
    return np.concatenate(found)


def simple_loops(loop: list[int]) -> list[list[int]]:
    """A closed row of vertices split where it passes one twice."""
    parts: list[list[int]] = []
    path: list[int] = []
    for v in loop:
        if v in path:
            first = path.index(v)
            parts.append(path[first:])
            path = path[:first]
        path.append(v)
    return [*parts, path]


def _edges_between(mesh: Mesh, around: Sequence[Border]) -> set[tuple[int, int]]:
    """Edges of a mesh that have both ends on borders, smaller vertex first."""
    on_border = np.zeros(len(mesh.vertices), bool)
    for border in around:
        on_border[border.loop] = True
    half = half_edges(mesh.faces)
    half = np.sort(half[on_border[half].all(axis=1)], axis=1)
    return set(map(tuple, half.tolist()))


def _edges_of(faces: Indices) -> set[tuple[int, int]]:
    return {(int(min(e)), int(max(e))) for e in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)}


def _forbidden(outline: Indices, known: set[tuple[int, int]]) -> Mask:
    """Diagonals (n, n) of an outline that are edges of the mesh already."""
    n = len(outline)
    barred = np.zeros((n, n), bool)
    names = outline.tolist()
    for i in range(n):
        for j in range(i + 2, n):
            if (i, j) != (0, n - 1):
                barred[i, j] = (min(names[i], names[j]), max(names[i], names[j])) in known
    return barred


def polygon(points: Floats, normal: Floats, bridge: float, barred: Mask, thinnest: float = 0.0) -> Indices | None:
    """Triangles (n - 2, 3) of a polygon (n, 3) mm counter-clockwise about a normal, or None.

    thinnest : least height of a triangle over its longest edge.

    Of all triangulations whose triangles face the normal and whose edges are no longer than ``bridge`` and not
    ``barred`` (n, n), the one with the smallest sum of squared edges (dynamic programming, Klincsek 1980).
    """
    n = len(points)
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    side = np.where(barred | (apart > bridge), np.inf, apart**2)
    rim = np.arange(n - 1)
    side[rim, rim + 1] = side[0, n - 1] = 0.0
    cost = np.full((n, n), np.inf)
    cost[rim, rim + 1] = 0.0
    choice = np.zeros((n, n), np.int64)
    for width in range(2, n):
        for i in range(n - width):
            j = i + width
            between = slice(i + 1, j)
            twice_area = np.cross(points[between] - points[i], points[j] - points[i]) @ normal
            longest = np.maximum(np.maximum(apart[i, between], apart[between, j]), apart[i, j])
            facing = twice_area > thinnest * longest**2
            total = np.where(facing, cost[i, between] + cost[between, j], np.inf) + side[i, j]
            best = int(np.argmin(total))
            cost[i, j], choice[i, j] = total[best], i + 1 + best
    if not np.isfinite(cost[0, n - 1]):
        return None
    triangles, open_ = [], [(0, n - 1)]
    while open_:
        i, j = open_.pop()
        if j - i > 1:
            k = int(choice[i, j])
            triangles.append((i, k, j))
            open_ += [(i, k), (k, j)]
    return np.array(triangles, np.int64)
