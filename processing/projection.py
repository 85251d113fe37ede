"""Points carried onto a surface along given directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.mesh import Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_CANDIDATES = 8  # nearest triangles that are tried: the one that is hit has its middle among the nearest


@dataclass(frozen=True)
class Hits:
    """P hits of lines on a surface.

    point : (P,) number of the point. face : (P,) triangle that is hit. weights : (P, 3) of its corners. height :
    (P,) mm, of the point outside the surface, against the direction from the point to the hit.
    """

    point: Indices
    face: Indices
    weights: Array
    height: Array


class Projector:
    """A surface with whole triangles, made ready for points to be projected onto.

    reach : mm, how far off a point may be. same_side : least cosine between a point's direction and the normal of the
    triangle that it hits: other sides of the body are not hit.
    """

    def __init__(self, mesh: Mesh, reach: float, same_side: float = 0.2) -> None:
        self.mesh = mesh
        self.reach = reach
        self.same_side = same_side
        self._corners, self._normals, centroids = mesh.vertices[mesh.faces], mesh.normals, mesh.centroids
        self._tree = cKDTree(centroids)
        radius = np.linalg.norm(self._corners - centroids[:, None], axis=2).max(axis=1)
        self._within = float(np.hypot(np.quantile(radius, 0.99), reach)) if len(radius) else 0.0
        at = mesh.vertices[mesh.faces.ravel()]
        self._low = at.min(axis=0, initial=np.inf) - reach
        self._high = at.max(axis=0, initial=-np.inf) + reach

    def hits(self, points: Array, directions: Array) -> Hits:
        """Where lines through points (n, 3) mm along unit directions (n, 3), outwards, pass the surface."""
        there = np.flatnonzero(((points > self._low) & (points < self._high)).all(axis=1))
        n, count = len(there), min(_CANDIDATES, len(self._corners))
        if not count or not n:
            return Hits(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
        near, candidate = self._tree.query(points[there], k=count, distance_upper_bound=self._within)
        near, candidate = near.reshape(n, count), candidate.reshape(n, count)
        row, column = np.nonzero(np.isfinite(near))
        point, face = there[row], candidate[row, column]
        weights, along = line_hits(points[point], directions[point], self._corners[face])
        hit = (weights > 1e-6).all(axis=1) & (np.abs(along) < self.reach)
        hit &= np.einsum("ni,ni->n", directions[point], self._normals[face]) > self.same_side
        return Hits(point[hit], face[hit], weights[hit], -along[hit])


def line_hits(points: Array, directions: Array, corners: Array) -> tuple[Array, Array]:
    """Where lines through points along unit directions (n, 3) pass the planes of triangles (n, 3, 3) mm.

    Returns the weights of the corners (n, 3), all positive inside the triangle, and the place along the line (n,) mm;
    not finite for a line along the plane. (Möller and Trumbore 1997.)
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    edge1, edge2 = b - a, c - a
    across = np.cross(directions, edge2)
    determinant = np.einsum("ni,ni->n", edge1, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("ni,ni->n", points - a, across) / determinant
        beside = np.cross(points - a, edge1)
        v = np.einsum("ni,ni->n", directions, beside) / determinant
        along = np.einsum("ni,ni->n", edge2, beside) / determinant
    return np.stack([1 - u - v, u, v], axis=1), along
