"""How far two surfaces lie apart where both measured the same place (Solav et al. 2018, Fig. 7a)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol

import numba as nb
import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.mesh.adjacency import shared_edges
from ringdic.mesh.mesh import Mesh, half_edges
from ringdic.mesh.projection import Projector


class Surface(Protocol):
    """Vertices (N, 3) mm and faces (M, 3), normals outwards."""

    @property
    def vertices(self) -> Floats: ...
    @property
    def faces(self) -> Indices: ...


@dataclass(frozen=True)
class Mismatch:
    """Of two sheets, by their numbers: distances between them where they lie over one another, both ways, mm.

    points : how many vertices were compared. mean, std : of the distances' lengths, the paper's figure. bias : mean
    with sign, positive where ``second`` lies outside ``first``. rms : of the distances. largest : of their lengths.
    """

    first: int
    second: int
    points: int
    mean: float
    std: float
    bias: float
    rms: float
    largest: float


def mismatches(sheets: Sequence[Surface], reach: float, fewest: int = 20) -> tuple[Mismatch, ...]:
    """The mismatch of every two sheets that share at least ``fewest`` vertices; reach : mm, of one to the other."""

    def between(pair: tuple[int, int]) -> Mismatch | None:
        i, j = pair
        signed = np.concatenate([curved[i].outside(curved[j]), -curved[j].outside(curved[i])])
        signed = signed[np.isfinite(signed)]
        return _summary(i, j, signed) if len(signed) >= fewest else None

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        curved = list(pool.map(lambda s: Curved(Mesh(s.vertices, s.faces).without_lost(), reach), sheets))
        found = pool.map(between, combinations(range(len(curved)), 2))
        return tuple(one for one in found if one is not None)


class Curved:
    """A surface that is curved between its vertices, by their normals: exactly for one of the second degree.

    (Half of what Phong tessellation adds, Boubekeur and Alexa 2008.) A flat triangle's middle lies below a convex
    body by edge²/8R, which is no mismatch of two surfaces. reach : mm, how far off a point may lie.
    """

    def __init__(self, mesh: Mesh, reach: float) -> None:
        half = half_edges(mesh.faces)
        before, alone = shared_edges(half)
        self.mesh = mesh
        self.used = np.unique(mesh.faces)
        self.normals = _averaged(np.nan_to_num(mesh.vertex_normals), half, before)
        self._projector = Projector(mesh, reach)
        on_border = np.zeros(len(mesh.vertices), bool)
        on_border[half[alone]] = True
        self._inner: Mask = ~np.asarray(on_border[mesh.faces].any(axis=1))

    def outside(self, other: Curved) -> Floats:
        """How far the vertices (N,) of another surface lie outside this one, along its normal, mm.

        NaN for a vertex over no triangle, or over one at the border, whose normals are one-sided.
        """
        result = np.full(len(other.mesh.vertices), np.nan)
        points, directions = other.mesh.vertices[other.used], other.normals[other.used]
        hits = self._projector.hits(points, directions)
        over = self._inner[hits.face]
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
    """How far points (n, 3) lie above the curved triangles that their lines along directions (n, 3) hit, (n,) mm.

    corners (n, 3), weights (n, 3), height (n,) of the hits. vertices, normals (N, 3).
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
def _averaged(normals, half, before):  # type: ignore[no-untyped-def]
    """Unit normals (N, 3) averaged with those of the neighbours: measured slopes are noisy.

    half, before : directed edges (3M, 2) and what ``shared_edges`` tells of them.
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
