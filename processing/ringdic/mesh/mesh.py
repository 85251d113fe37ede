"""A triangle mesh of two arrays, and what can be asked of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Indices, Mask


@dataclass(frozen=True)
class Mesh:
    """Triangles over points.

    vertices : (N, 3) mm, NaN where a point is lost. faces : (M, 3) vertex indices.
    """

    vertices: Floats
    faces: Indices

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", np.asarray(self.vertices, dtype=float).reshape(-1, 3))
        object.__setattr__(self, "faces", np.asarray(self.faces, dtype=np.int64).reshape(-1, 3))
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < len(self.vertices)):
            raise ValueError(f"faces name vertices beyond the {len(self.vertices)} of the mesh")

    @property
    def area_vectors(self) -> Floats:
        """Normals with the length of the areas, (M, 3) mm²."""
        from ringdic.mesh.kernels import area_vectors  # compiled, and loaded only where it is asked for

        vectors = np.empty((len(self.faces), 3))
        area_vectors(np.ascontiguousarray(self.vertices), np.ascontiguousarray(self.faces), vectors)
        return vectors

    @property
    def areas(self) -> Floats:
        """Areas of the triangles, (M,) mm²."""
        return np.linalg.norm(self.area_vectors, axis=1)

    @property
    def normals(self) -> Floats:
        """Unit normals of the triangles, (M, 3); NaN for a triangle without area."""
        vectors = self.area_vectors
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        return vectors / np.where(length > 0, length, np.nan)

    @property
    def centroids(self) -> Floats:
        """Centroids of the triangles, (M, 3) mm."""
        return self.vertices[self.faces].mean(axis=1)

    @property
    def vertex_normals(self) -> Floats:
        """Unit normals of the vertices, weighted by area, (N, 3); NaN for a vertex without a whole triangle."""
        from ringdic.mesh.kernels import corner_sums

        total = np.zeros(self.vertices.shape)
        corner_sums(self.area_vectors, np.ascontiguousarray(self.faces), total)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return total / np.where(length > 0, length, np.nan)

    def edges(self) -> tuple[Indices, Indices]:
        """Unique edges (K, 2), smaller vertex first, and the number of triangles at each (K,)."""
        unique, count = np.unique(self._edge_numbers(), return_counts=True)
        return np.stack(np.divmod(unique, len(self.vertices)), axis=1), count

    def boundary_edges(self) -> Indices:
        """Edges with one triangle, (K, 2), in the direction in which that triangle runs along them."""
        from ringdic.mesh.adjacency import alike  # compiled, and loaded only where it is asked for

        half = half_edges(self.faces)
        _, alone = alike(half)
        return half[alone]

    def _edge_numbers(self) -> Indices:
        """One number for each edge of each triangle, (3M,), the same in both directions; ordered as the edges are."""
        half = half_edges(self.faces)
        return half.min(axis=1) * len(self.vertices) + half.max(axis=1)

    def whole_faces(self) -> Mask:
        """Which triangles have three measured corners and an area. (M,)."""
        return np.isfinite(self.vertices[self.faces]).all(axis=(1, 2)) & (np.nan_to_num(self.areas) > 0)

    def without_lost(self) -> Mesh:
        """The same vertices, without triangles that have lost a corner."""
        return Mesh(self.vertices, self.faces[self.whole_faces()])

    def compact(self) -> tuple[Mesh, Indices]:
        """The mesh without unused vertices, and the old index (K,) of each vertex that is kept."""
        used = np.unique(self.faces)
        renumber = np.full(len(self.vertices), -1, dtype=np.int64)
        renumber[used] = np.arange(len(used))
        return Mesh(self.vertices[used], renumber[self.faces]), used

    def flipped(self, which: Mask) -> Mesh:
        """The mesh with the orientation of some triangles (M,) turned over."""
        faces = self.faces.copy()
        faces[which] = faces[which][:, ::-1]
        return Mesh(self.vertices, faces)

    def facing(self, viewpoints: Floats) -> Mesh:
        """The mesh with every triangle turned towards the cameras that saw it.

        viewpoints : (3,) or (M, 3) mm, a point in front of each triangle, such as the mean of its cameras' centres.
        """
        towards = np.asarray(viewpoints, dtype=float) - self.centroids
        with np.errstate(invalid="ignore"):
            return self.flipped(np.einsum("mi,mi->m", self.area_vectors, towards) < 0)


def half_edges(faces: Indices) -> Indices:
    """Directed edges (3M, 2) of triangles (M, 3): number 3f + k runs from corner k of triangle f to the next."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
