"""Triangulation of a polygon in space over its own vertices, for closing holes of surfaces.

Libraries triangulate plane polygons by clipping ears or insert vertices of their own. Here the outline lies in space,
some diagonals are not allowed, and thin triangles are to be avoided: of all triangulations the best one is sought.
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Indices, Mask, Points, Vectors


def triangulate_polygon(
    points: Points, normal: Vectors, longest: float = np.inf, barred: Mask | None = None, thinnest: float = 0.0
) -> Indices | None:
    """Triangulate a polygon over its own vertices with the smallest sum of squared edge lengths.

    Only triangulations are considered whose triangles all face the normal, none of them thinner than ``thinnest``, and
    whose diagonals are no longer than ``longest`` and not barred. The best of them is determined by dynamic programming
    in O(n³) (Klincsek 1980).

    Parameters
    ----------
    points : (n, 3) float64, mm, the corners, counter-clockwise seen against the normal.
    normal : (3,) float64, unit normal of the polygon.
    longest : mm, greatest length of a diagonal.
    barred : (n, n) bool, diagonals that are not allowed, by their ends i < j; None: all are allowed.
    thinnest : least height of a triangle over its longest edge.

    Returns
    -------
    Triangles (n - 2, 3) as indices into ``points``, counter-clockwise, or None where no triangulation is allowed.
    """
    n = len(points)
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    not_allowed = distance > longest if barred is None else barred | (distance > longest)
    side = np.where(not_allowed, np.inf, distance**2)
    rim = np.arange(n - 1)
    side[rim, rim + 1] = side[0, n - 1] = 0.0
    about, (x, y, z) = points - points.mean(axis=0), normal
    # Twice the area that two corners enclose with the middle, along the normal; three such make a triangle's.
    sector = about @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) @ about.T
    cost = np.full((n, n), np.inf)
    cost[rim, rim + 1] = 0.0
    choice = np.zeros((n, n), np.int64)
    for width in range(2, n):
        i, j = np.arange(n - width), np.arange(width, n)
        first, last = i[:, None], j[:, None]
        between = first + np.arange(1, width)
        twice_area = sector[first, between] + sector[between, last] + sector[last, first]
        longest_edge = np.maximum(np.maximum(distance[first, between], distance[between, last]), distance[first, last])
        facing = twice_area > thinnest * longest_edge**2
        total = np.where(facing, cost[first, between] + cost[between, last], np.inf)
        best = np.argmin(total, axis=1)
        cost[i, j], choice[i, j] = total[i, best] + side[i, j], between[i, best]
    return _triangles(choice) if np.isfinite(cost[0, n - 1]) else None


def _triangles(choice: Indices) -> Indices:
    """Triangles (n - 2, 3) of the polygon from the third corner (n, n) chosen for each of its diagonals i, j."""
    triangles, edges = [], [(0, len(choice) - 1)]
    while edges:
        i, j = edges.pop()
        if j - i > 1:
            k = int(choice[i, j])
            triangles.append((i, k, j))
            edges += [(i, k), (k, j)]
    return np.array(triangles, np.int64)
