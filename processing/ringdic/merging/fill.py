"""Filling of small holes of a surface with triangles between the vertices of their outlines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Indices, Mask
from ringdic.mesh.mesh import Mesh, half_edges
from ringdic.mesh.polygon import triangulate_polygon
from ringdic.mesh.topology import Border, Kind, borders, vector_area

_LONGEST = 150  # vertices of a border whose hole may be filled
_THIN = 0.1  # height over longest edge of triangles that are used only where there is no other way
_FACING = 0.5  # least cosine between a hole's own normal and those of the surface round it


def fill(mesh: Mesh, area: float, bridge: float, seam: Mask, seam_area: float) -> Indices:
    """Fill the small holes of a surface with triangles between its vertices.

    A hole whose outline folds over, or that would need an edge that is too long or that the mesh has already, stays
    open.

    Parameters
    ----------
    mesh : a sound surface.
    area : mm², largest hole that is filled.
    bridge : mm, longest edge of a new triangle.
    seam : (N,) bool, vertices on the seam between surfaces.
    seam_area : mm², largest hole that is filled where its outline touches the seam.

    Returns
    -------
    New triangles (K, 3) int, oriented as the surface.
    """
    normals = np.nan_to_num(mesh.vertex_normals)
    fillings = [np.zeros((0, 3), np.int64)]
    all_borders = borders(mesh)
    edges = _edges_between(mesh, all_borders)
    for border in all_borders:
        if border.kind is not Kind.HOLE and len(border.loop) == len(set(border.loop.tolist())):
            continue
        for loop in simple_loops(border.loop.tolist()):
            if not 3 <= len(loop) <= _LONGEST:
                continue
            outline = np.array(loop[::-1])  # counter-clockwise round the hole
            points = mesh.vertices[outline]
            vector = vector_area(points)
            size = float(np.linalg.norm(vector))
            limit = seam_area if seam[outline].any() else area
            if size == 0 or size > limit or normals[outline].mean(axis=0) @ vector < _FACING * size:
                continue
            barred = _barred_diagonals(outline, edges)
            triangles = triangulate_polygon(points, vector / size, bridge, barred, _THIN)
            if triangles is None:
                triangles = triangulate_polygon(points, vector / size, bridge, barred)
            if triangles is not None:
                fillings.append(outline[triangles])
                edges.update(_edges_of(fillings[-1]))
    return np.concatenate(fillings)


def simple_loops(loop: list[int]) -> list[list[int]]:
    """Split a closed row of vertices wherever it passes a vertex twice."""
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
    """Edges of triangles (K, 3), smaller vertex first."""
    return {(int(min(e)), int(max(e))) for e in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)}


def _barred_diagonals(outline: Indices, known: set[tuple[int, int]]) -> Mask:
    """Diagonals (n, n) of an outline (n,) that are edges of the mesh already."""
    n = len(outline)
    barred = np.zeros((n, n), bool)
    names = outline.tolist()
    for i in range(n):
        for j in range(i + 2, n):
            if (i, j) != (0, n - 1):
                barred[i, j] = (min(names[i], names[j]), max(names[i], names[j])) in known
    return barred
