"""Stitching of the gaps between surfaces, with triangles between existing vertices.

Every border vertex is considered in its own tangent plane: the Delaunay triangles of its neighbourhood that touch it
are its star. A triangle is accepted when it is in the stars of all three of its corners, overlaps none of the existing
triangles, crosses none of their borders and has no edge longer than the bridge. Where the stars do not agree (four
points on a circle, a border that is not Delaunay) the gap is left to :mod:`ringdic.merging.fill`.
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Floats, Indices
from ringdic.merging.stars import stars
from ringdic.mesh.mesh import Mesh, used_vertices
from ringdic.mesh.nearest import cubes

_SAME_SIDE = 0.2  # least cosine between the normals of vertices of one side of the body
THINNEST = 0.1  # least height of a new triangle over its longest edge: a thinner one has no usable normal or strain


def stitch(mesh: Mesh, group: Indices, bridge: float) -> Indices:
    """Triangles that join different groups of vertices across the gaps between them.

    mesh : sound pieces side by side. group : (N,) int, of each vertex; gaps are closed only where groups meet.
    bridge : mm, longest edge of a new triangle. Returns (K, 3) indices, oriented as the surface.
    """
    border = mesh.boundary_edges()
    if not len(border):
        return np.zeros((0, 3), np.int64)
    used = used_vertices(mesh.faces)
    at, normals = mesh.vertices[used], np.nan_to_num(mesh.vertex_normals[used])
    index = np.full(len(mesh.vertices), -1)
    index[used] = np.arange(len(used))
    edges = index[border]
    edges = edges[np.argsort(edges[:, 0], kind="stable")]
    start = np.searchsorted(edges[:, 0], np.arange(len(used) + 1))
    back = np.full(len(used), -1)
    back[edges[:, 1]] = edges[:, 0]
    triangles_of_stars = stars(
        cubes(at, bridge / 2), np.unique(edges), at, normals, group[used], start, edges[:, 1].copy(), back,
        bridge, _SAME_SIDE, THINNEST,
    )  # fmt: skip
    triangles, first, votes = np.unique(triangles_of_stars, axis=0, return_index=True, return_counts=True)
    agreed = np.argsort(first[votes == 3])
    return used[_consistent(triangles[votes == 3][agreed], at, edges)]


def _consistent(candidates: Indices, at: Floats, edges: Indices) -> Indices:
    """Triangles (K, 3) compatible with the border edges and with one another, chosen in order of edge length."""
    corners = at[candidates]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    half_edges = set(map(tuple, edges.tolist()))
    consistent = []
    for a, b, c in candidates[np.argsort(longest, kind="stable")].tolist():
        half = {(a, b), (b, c), (c, a)}
        if half_edges.isdisjoint(half):  # no triangle runs along these edges in the same direction
            half_edges |= half
            consistent.append((a, b, c))
    return np.array(consistent, np.int64).reshape(-1, 3)
