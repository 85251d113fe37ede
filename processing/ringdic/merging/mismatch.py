"""Distances between two surfaces in the area that both measured (Solav et al. 2018, Fig. 7a)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numba as nb
import numpy as np

from ringdic.arrays import Floats, Mask
from ringdic.mesh.adjacency import shared_edges
from ringdic.mesh.mesh import Mesh, half_edges, used_vertices
from ringdic.mesh.projection import Projector

_FEWEST = 20  # vertices that two surfaces share for a mismatch


@dataclass(frozen=True)
class Mismatch:
    """Statistics of the distances (mm) between two overlapping surfaces, given by their numbers; both ways together.

    points : number of vertices compared. mean, std : of the absolute distances, as in the article. bias : mean of
    the signed distances, positive where ``second`` lies outside ``first``. rms : of the distances. largest : of
    their absolute values.
    """

    first: int
    second: int
    points: int
    mean: float
    std: float
    bias: float
    rms: float
    largest: float


def mismatches(surfaces: Sequence[Mesh], reach: float) -> tuple[Mismatch, ...]:
    """Mismatch of every two surfaces that share at least twenty vertices.

    surfaces : with normals outwards, vertices NaN where lost. reach : mm, greatest distance along the normal from one
    surface to the other.
    """

    def between(pair: tuple[int, int]) -> Mismatch | None:
        i, j = pair
        signed = np.concatenate([curved[i].outside(curved[j]), -curved[j].outside(curved[i])])
        signed = signed[np.isfinite(signed)]
        return _summary(i, j, signed) if len(signed) >= _FEWEST else None

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        curved = list(pool.map(lambda surface: CurvedSurface(surface.without_lost(), reach), surfaces))
        pairs = pool.map(between, combinations(range(len(curved)), 2))
        return tuple(mismatch for mismatch in pairs if mismatch is not None)


class CurvedSurface:
    """A mesh whose triangles are curved according to the vertex normals, exact for a surface of the second degree.

    The middle of a flat triangle lies below a convex body by edge²/8R, which is no mismatch of two surfaces. The
    curvature added is half of that of Phong tessellation (Boubekeur and Alexa 2008). reach : mm, greatest distance
    of a point.
    """

    def __init__(self, mesh: Mesh, reach: float) -> None:
        half = half_edges(mesh.faces)
        before, alone = shared_edges(half)
        self.mesh = mesh
        self.used = used_vertices(mesh.faces)
        self.normals = _average_normals(np.nan_to_num(mesh.vertex_normals), half, before)
        self._projector = Projector(mesh, reach)
        on_border = np.zeros(len(mesh.vertices), bool)
        on_border[half[alone]] = True
        self._is_inner: Mask = ~np.asarray(on_border[mesh.faces].any(axis=1))

    def outside(self, other: CurvedSurface) -> Floats:
        """Signed distances of the vertices of another surface from this one, along its normal, positive outwards.

        Returns (N,) mm, NaN for a vertex over no triangle, or over one at the border, whose normals are one-sided.
        """
        result = np.full(len(other.mesh.vertices), np.nan)
        points, directions = other.mesh.vertices[other.used], other.normals[other.used]
        hits = self._projector.hits(points, directions)
        over = self._is_inner[hits.face]
        point, face = hits.point[over], self.mesh.faces[hits.face[over]]
        result[other.used[point]] = _above(
            points[point],
            directions[point],
            face,
            hits.weights[over],
            hits.height[over],
            self.mesh.vertices,
            self.normals,
        )
        return result


@nb.njit(cache=True, nogil=True)
def _above(points, directions, corners, weights, height, vertices, normals):  # type: ignore[no-untyped-def]
    """Heights of points above the curved triangles that their lines along given directions hit.

    points, directions : (n, 3). corners (n, 3), weights (n, 3), height (n,) : of the hits. vertices, normals : (N, 3).
    Returns (n,) mm.
    """
    out = np.empty(len(points))
    for p in range(len(points)):
        tangents, cosine, square = 0.0, 0.0, 0.0
        for k in range(3):
            mean, along = 0.0, 0.0
            for i in range(3):  # component k of the normal there
                mean += weights[p, i] * normals[corners[p, i], k]
                # From the plane of the triangle to its corners' tangent planes: the curved surface lies midway.
                foot = points[p, k] - height[p] * directions[p, k]
                along += weights[p, i] * (foot - vertices[corners[p, i], k]) * normals[corners[p, i], k]
            tangents += along
            cosine += mean * directions[p, k]
            square += mean * mean
        out[p] = height[p] * cosine / np.sqrt(square) + 0.5 * tangents
    return out


@nb.njit(cache=True, nogil=True)
def _average_normals(normals, half, before):  # type: ignore[no-untyped-def]
    """Unit normals (N, 3) averaged with those of the neighbours, since measured slopes are noisy.

    half, before : directed edges (3M, 2) and what ``shared_edges`` gives for them.
    """
    total = normals.copy()
    for h in range(len(half)):
        if before[h] < 0:  # every edge once
            a, b = half[h]
            for k in range(3):
                total[a, k] += normals[b, k]
                total[b, k] += normals[a, k]
    for v in range(len(total)):
        length = max(np.sqrt(total[v, 0] ** 2 + total[v, 1] ** 2 + total[v, 2] ** 2), 1e-12)
        for k in range(3):
            total[v, k] /= length
    return total


def _summary(first: int, second: int, signed: Floats) -> Mismatch:
    """Mismatch of two surfaces from their signed distances (n,) mm."""
    length = np.abs(signed)
    return Mismatch(
        first=first,
        second=second,
        points=len(signed),
        mean=float(length.mean()),
        std=float(length.std()),
        bias=float(signed.mean()),
        rms=float(np.sqrt(np.mean(signed**2))),
        largest=float(length.max()),
    )
