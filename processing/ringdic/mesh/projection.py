"""Projection of points onto a triangulated surface along given directions."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from ringdic.arrays import Floats, Indices, Points, Vectors
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.nearest import cubes, near

_CANDIDATES = 8  # triangles that are tried: the centroid of the one that is hit is among the nearest
_NARROW = 2.5  # median radii of triangles: about the distance of the eighth centroid
_INSIDE = 1e-6  # least weight of a corner inside a triangle


@dataclass(frozen=True)
class Hits:
    """P intersections of lines through points with a surface.

    point : (P,) index of the point. face : (P,) index of the triangle that is hit.
    weights : (P, 3) barycentric coordinates of the hit, without unit.
    height : (P,) mm, distance of the point outside the surface, along the line's direction; negative inside.
    """

    point: Indices
    face: Indices
    weights: Floats
    height: Floats


class Projector:
    """A surface prepared for the projection of many points.

    mesh : without lost vertices in its triangles. reach : mm, largest distance of a point from its hit. same_side :
    least cosine between the direction of a line and the normal of the triangle that it hits, so that the far side of a
    body is not hit.
    """

    def __init__(self, mesh: Mesh, reach: float, same_side: float = 0.2) -> None:
        self.mesh = mesh
        self.reach = reach
        self.same_side = same_side
        self._corners = mesh.vertices[mesh.faces]
        centroids, self._normals, self._radius = triangle_spheres(self._corners)
        median = float(np.median(self._radius)) if len(centroids) else 0.0
        self._within = float(np.hypot(np.quantile(self._radius, 0.99), reach)) if len(centroids) else 0.0
        self._narrow = min(_NARROW * median, self._within)
        self._centroids = cubes(centroids, self._narrow)
        at = self._corners.reshape(-1, 3)
        self._low = at.min(axis=0, initial=np.inf) - reach
        self._high = at.max(axis=0, initial=-np.inf) + reach

    def hits(self, points: Points, directions: Vectors) -> Hits:
        """Intersections of lines with the surface.

        points : (n, 3) mm, a point of each line. directions : (n, 3) unit vectors, out of the body.
        """
        if not len(self._corners):
            return Hits(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
        point, face, weights, along = _hits(
            self._centroids, self._corners, self._normals, self._radius, points, directions,
            self._low, self._high, self._narrow, self._within, self.reach, self.same_side,
        )  # fmt: skip
        return Hits(point, face, weights, -along)


@nb.njit(cache=True, nogil=True)
def triangle_spheres(corners):  # type: ignore[no-untyped-def]
    """Centroids, unit normals and radii of triangles.

    corners (M, 3, 3) mm: triangle, corner, coordinate. Returns centroids (M, 3) mm, normals (M, 3), NaN for a triangle
    without area, and radii (M,) mm, the distance of the farthest corner from the centroid.
    """
    M = len(corners)
    centroids, normals, radius = np.empty((M, 3)), np.empty((M, 3)), np.empty(M)
    for f in range(M):
        a, b, c = corners[f]
        for k in range(3):
            centroids[f, k] = (a[k] + b[k] + c[k]) / 3
            m, n = (k + 1) % 3, (k + 2) % 3
            normals[f, k] = (b[m] - a[m]) * (c[n] - a[n]) - (b[n] - a[n]) * (c[m] - a[m])
        length = np.sqrt(normals[f, 0] ** 2 + normals[f, 1] ** 2 + normals[f, 2] ** 2)
        square = 0.0
        for corner in (a, b, c):
            dx, dy, dz = corner[0] - centroids[f, 0], corner[1] - centroids[f, 1], corner[2] - centroids[f, 2]
            square = max(square, dx * dx + dy * dy + dz * dz)
        for k in range(3):
            normals[f, k] = normals[f, k] / length if length > 0 else np.nan
        radius[f] = np.sqrt(square)
    return centroids, normals, radius


@nb.njit(cache=True, nogil=True)
def _hits(  # type: ignore[no-untyped-def]
    centroids, corners, normals, radius, points, directions, low, high, narrow, within, reach, same_side
):
    """Intersections of lines with triangles; those of one line in the order of the centroids' distances.

    centroids : Cubes of the triangles' centroids. corners (M, 3, 3), normals (M, 3), radius (M,): the triangles.
    points (n, 3), directions (n, 3): the lines. low, high (3,) mm: box outside which no point has a hit. within : mm,
    largest distance of a centroid that is tried; narrow : mm, distance within which there are mostly enough of them.

    Returns point (P,), face (P,), weights (P, 3) and position along the line (P,) mm.
    """
    neighbours, distances = np.empty(len(corners), np.int64), np.empty(len(corners))
    point, face = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    place = np.empty((len(points), 4))  # weights, and position along the line
    far = np.empty(len(points))
    count = 0
    for i in range(len(points)):
        x, y, z = points[i]
        if not (low[0] < x < high[0] and low[1] < y < high[1] and low[2] < z < high[2]):
            continue
        first = count
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        beside = near(centroids, x, y, z, narrow, neighbours, distances)
        if beside < _CANDIDATES and narrow < within:
            beside = near(centroids, x, y, z, within, neighbours, distances)
        for k in range(beside):
            at = centroids.at[neighbours[k]]
            along = (at[0] - x) * dx + (at[1] - y) * dy + (at[2] - z) * dz
            f = centroids.order[neighbours[k]]
            if distances[k] - along * along > radius[f] * radius[f]:
                continue
            if not dx * normals[f, 0] + dy * normals[f, 1] + dz * normals[f, 2] > same_side:
                continue
            u, v, along = _line_hit(points[i], dx, dy, dz, corners[f])
            if not (u > _INSIDE and v > _INSIDE and 1 - u - v > _INSIDE and abs(along) < reach):
                continue
            closer = 0
            for m in range(beside):
                closer += distances[m] < distances[k]
            if closer >= _CANDIDATES:
                continue
            if count == len(point):
                point, face, far, place = _longer(point), _longer(face), _longer(far), _longer(place)
            to = count
            while to > first and far[to - 1] > distances[k]:
                face[to], far[to], place[to] = face[to - 1], far[to - 1], place[to - 1]
                to -= 1
            point[count], face[to], far[to] = i, f, distances[k]
            place[to, 0], place[to, 1], place[to, 2], place[to, 3] = 1 - u - v, u, v, along
            count += 1
    return point[:count], face[:count], place[:count, :3].copy(), place[:count, 3].copy()


@nb.njit(cache=True, nogil=True)
def _longer(row):  # type: ignore[no-untyped-def]
    """The array (n, ...) enlarged to 2n rows, the new ones undefined."""
    return np.concatenate((row, np.empty_like(row)))


@nb.njit(cache=True, nogil=True)
def _line_hit(point, dx, dy, dz, corner):  # type: ignore[no-untyped-def]
    """Intersection of one line with the plane of one triangle (Möller and Trumbore 1997).

    Returns the barycentric coordinates of the second and third corner and the position along the line in mm; NaN for a
    line parallel to the plane.
    """
    ex, ey, ez = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    gx, gy, gz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    ax, ay, az = dy * gz - dz * gy, dz * gx - dx * gz, dx * gy - dy * gx
    determinant = ex * ax + ey * ay + ez * az
    if determinant == 0:
        return np.nan, np.nan, np.nan
    px, py, pz = point[0] - corner[0, 0], point[1] - corner[0, 1], point[2] - corner[0, 2]
    bx, by, bz = py * ez - pz * ey, pz * ex - px * ez, px * ey - py * ex
    u = (px * ax + py * ay + pz * az) / determinant
    v = (dx * bx + dy * by + dz * bz) / determinant
    return u, v, (gx * bx + gy * by + gz * bz) / determinant


def line_hits(points: Points, directions: Vectors, corners: Points) -> tuple[Floats, Floats]:
    """Intersections of n lines with the planes of n triangles (Möller and Trumbore 1997).

    points : (n, 3) mm, a point of each line. directions : (n, 3) unit vectors.
    corners : (n, 3, 3) mm, triangle, corner, coordinate.

    Returns barycentric coordinates (n, 3), all positive inside the triangle, and positions along the lines (n,) mm;
    not finite for a line parallel to the plane.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    edge1, edge2 = b - a, c - a
    across = np.cross(directions, edge2)
    determinant = np.einsum("ni,ni->n", edge1, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("ni,ni->n", points - a, across) / determinant
        q = np.cross(points - a, edge1)
        v = np.einsum("ni,ni->n", directions, q) / determinant
        along = np.einsum("ni,ni->n", edge2, q) / determinant
    return np.stack([1 - u - v, u, v], axis=1), along
