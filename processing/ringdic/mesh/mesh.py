"""A triangle mesh of vertices and faces, with areas, normals, edges and orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Points, Vectors


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh of N vertices and M triangles.

    vertices : (N, 3) mm, world frame, NaN where a point is lost.
    faces : (M, 3) vertex indices, counter-clockwise seen from outside.
    """

    vertices: Points
    faces: Indices

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", np.asarray(self.vertices, dtype=float).reshape(-1, 3))
        object.__setattr__(self, "faces", np.asarray(self.faces, dtype=np.int64).reshape(-1, 3))
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < len(self.vertices)):
            raise ValueError(f"faces name vertices beyond the {len(self.vertices)} of the mesh")

    @property
    def area_vectors(self) -> Vectors:
        """Area vectors of the triangles: normal to them, with the length of their areas, (M, 3) mm²."""
        from ringdic.mesh.kernels import area_vectors  # compiled: loaded only where needed

        vectors = np.empty((len(self.faces), 3))
        area_vectors(np.ascontiguousarray(self.vertices), np.ascontiguousarray(self.faces), vectors)
        return vectors

    @property
    def areas(self) -> Floats:
        """Areas of the triangles, (M,) mm²."""
        return np.linalg.norm(self.area_vectors, axis=1)

    @property
    def normals(self) -> Vectors:
        """Normals of the triangles as unit vectors, (M, 3); NaN for a triangle without area."""
        vectors = self.area_vectors
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        return vectors / np.where(length > 0, length, np.nan)

    @property
    def centroids(self) -> Points:
        """Centroids of the triangles, (M, 3) mm."""
        first, second, third = self.faces.T
        return (self.vertices[first] + self.vertices[second] + self.vertices[third]) / 3.0

    @property
    def vertex_normals(self) -> Vectors:
        """Normals of the vertices as unit vectors, (N, 3); NaN for a vertex without a whole triangle.

        The sum of the area vectors of the triangles round the vertex, so that large triangles count more.
        """
        from ringdic.mesh.kernels import corner_sums

        total = np.zeros(self.vertices.shape)
        corner_sums(self.area_vectors, np.ascontiguousarray(self.faces), total)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return total / np.where(length > 0, length, np.nan)

    def edges(self) -> tuple[Indices, Indices]:
        """All edges, each once, as vertex indices (K, 2), the smaller first; and numbers of triangles at each (K,)."""
        first, second = half_edges(self.faces).T
        numbers = np.minimum(first, second) * len(self.vertices) + np.maximum(first, second)  # ordered as the pairs
        unique, count = np.unique(numbers, return_counts=True)
        return np.stack(np.divmod(unique, len(self.vertices)), axis=1), count

    def boundary_edges(self) -> Indices:
        """Edges with one triangle only: vertex indices (K, 2), in the direction of that triangle's half-edge."""
        from ringdic.mesh.adjacency import shared_edges  # compiled: loaded only where needed

        half = half_edges(self.faces)
        _, alone = shared_edges(half)
        return half[alone]

    def whole_faces(self) -> Mask:
        """Which triangles have three measured corners and an area, (M,) bool."""
        measured: Mask = np.asarray(np.isfinite(self.vertices).all(axis=1))
        return measured[self.faces].all(axis=1) & (np.nan_to_num(self.areas) > 0)

    def without_lost(self) -> Mesh:
        """The mesh with all its vertices but without the triangles that have lost a corner or have no area."""
        return Mesh(self.vertices, self.faces[self.whole_faces()])

    def compact(self) -> tuple[Mesh, Indices]:
        """The mesh without unused vertices, and the index (K,) that each of its K vertices had before."""
        used = used_vertices(self.faces)
        renumber = np.full(len(self.vertices), -1, dtype=np.int64)
        renumber[used] = np.arange(len(used))
        return Mesh(self.vertices[used], renumber[self.faces]), used


def used_vertices(faces: Indices) -> Indices:
    """Vertices that triangles use, each once, ascending. faces : (M, 3) vertex indices. Returns indices (K,)."""
    return np.flatnonzero(np.bincount(faces.ravel()))


def half_edges(faces: Indices) -> Indices:
    """Half-edges of triangles: the directed edge 3f + k runs from corner k of triangle f to its next corner.

    faces : (M, 3) vertex indices. Returns vertex indices (3M, 2), start and end.
    """
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
