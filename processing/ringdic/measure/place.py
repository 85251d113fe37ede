"""Material points of the surface, each given by a triangle and barycentric weights in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point, points_to_barycentric

from ringdic.arrays import Floats, Indices
from ringdic.errors import InputError
from ringdic.mesh.mesh import Mesh


@dataclass(frozen=True)
class Place:
    """A material point in triangle ``face`` with barycentric ``weights`` (3,), which sum to 1. label : its name."""

    face: int
    weights: tuple[float, float, float]
    label: str

    def __post_init__(self) -> None:
        if abs(sum(self.weights) - 1.0) > 1e-9 or min(self.weights) < -1e-9:
            raise ValueError(f"weights {self.weights} are not those of a place in a triangle")

    def at(self, values: Floats, faces: Indices) -> Floats:
        """Values interpolated at the point, in their unit; NaN where a corner with weight is NaN.

        values : (N,) or (N, k) of the vertices. faces : (M, 3).
        """
        corners = faces[self.face]
        weights = np.array(self.weights)
        used = weights > 0
        return np.asarray(np.tensordot(weights[used], values[corners[used]], axes=1))


def nearest_place(mesh: Mesh, position: Sequence[float], within: float = 5.0) -> Place:
    """The point of the surface nearest to a position (3,) mm in space.

    Raises InputError if the surface is farther than ``within`` mm; the sentence names its nearest point.
    """
    xyz = np.asarray(position, dtype=float)
    whole = np.flatnonzero(mesh.whole_faces())
    label = f"({', '.join(f'{c:g}' for c in xyz)})"
    if not len(whole):
        raise InputError("the surface has no triangles")
    centroids = mesh.centroids[whole]
    size = float(np.linalg.norm(mesh.vertices[mesh.faces[whole]] - centroids[:, None], axis=2).max())
    tree = cKDTree(centroids)
    nearest, _ = tree.query(xyz)
    # The centroid of the nearest triangle cannot be farther than the nearest centroid and the largest triangle.
    near = whole[tree.query_ball_point(xyz, nearest + size)]
    closest = closest_point(mesh.vertices[mesh.faces[near]], np.broadcast_to(xyz, (len(near), 3)))
    distance = np.linalg.norm(closest - xyz, axis=1)
    best = int(distance.argmin())
    if distance[best] > within:
        raise InputError(
            f"{label} mm is {distance[best]:.1f} mm away from the surface; the nearest place on it is "
            f"({', '.join(f'{c:.1f}' for c in closest[best])}) mm"
        )
    weights = points_to_barycentric(mesh.vertices[mesh.faces[near[best : best + 1]]], closest[best : best + 1])[0]
    weights = np.clip(weights, 0.0, 1.0)
    a, b, c = (float(w) for w in weights / weights.sum())
    return Place(int(near[best]), (a, b, c), label)


def place_of_vertex(mesh: Mesh, vertex: int) -> Place:
    """The material point at a vertex, by index from 0. Raises InputError if there is none or it is in no triangle."""
    if not 0 <= vertex < len(mesh.vertices):
        raise InputError(f"no point {vertex}; there are {len(mesh.vertices)}, from 0")
    face, corner = np.nonzero(mesh.faces == vertex)
    if not len(face):
        raise InputError(f"point {vertex} belongs to no triangle")
    weights = [0.0, 0.0, 0.0]
    weights[int(corner[0])] = 1.0
    return Place(int(face[0]), (weights[0], weights[1], weights[2]), f"point {vertex}")


def place_of_face(mesh: Mesh, face: int) -> Place:
    """The material point at the centroid of a triangle, by index from 0. Raises InputError if there is none."""
    if not 0 <= face < len(mesh.faces):
        raise InputError(f"no face {face}; there are {len(mesh.faces)}, from 0")
    third = 1.0 / 3.0
    return Place(face, (third, third, third), f"face {face}")
