"""Small holes closed with triangles over the vertices round them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Indices, Mask
from ringdic.mesh.mesh import Mesh, half_edges
from ringdic.mesh.polygon import triangulate_polygon
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
            triangles = triangulate_polygon(points, vector / size, bridge, barred, _THIN)
            if triangles is None:
                triangles = triangulate_polygon(points, vector / size, bridge, barred)
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
