"""Detection of overlaps between several surfaces, and choice of the triangles to remove.

Two triangles of different surfaces *compete* when they overlap, or are closer to one another than the
gap that is to be left. Triangles at the border of their surface are removed, the worst first, until no two compete
(overlap removal of Solav et al. 2018, for any number of surfaces at once instead of two).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask
from ringdic.merging import kernels
from ringdic.mesh.adjacency import counting_sort
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.nearest import away_from_other_labels, cubes
from ringdic.mesh.projection import Projector, triangle_spheres

_SMOOTHING = 6  # rounds of averaging over neighbouring triangles, so that no single triangle's noise decides
_PARTS = 16  # into which the triangles are divided among the cores
_SAME_SIDE = 0.2  # least cosine between the normals of two layers of one surface


@dataclass(frozen=True)
class Cover:
    """Pairs of triangles of different surfaces, the one over or under the centroid of the other: P ordered pairs.

    own, other : (P,) int, triangles. height : (P,) mm, from the centroid of ``own`` to ``other`` along the normal.
    angle : (P,) rad, between the normals.
    """

    own: Indices
    other: Indices
    height: Floats
    angle: Floats


def cover(mesh: Mesh, owner: Indices, reach: float) -> Cover:
    """Determine which triangles' centroids are covered by another surface.

    owner : (M,) int, surface of each triangle. reach : mm, greatest distance along the normal.
    """
    centroids, normals = mesh.centroids, mesh.normals
    parts = [np.flatnonzero(owner == k) for k in range(owner.max(initial=-1) + 1)]

    def projector(part: Indices) -> Projector:
        return Projector(Mesh(mesh.vertices, mesh.faces[part]), reach, _SAME_SIDE)

    def over(k: int) -> list[tuple[Indices, Indices, Floats]]:
        """Triangles of surface k that other surfaces cover, the triangles that cover them, and the heights between
        them.
        """
        part, covers = parts[k], []
        for j, surface in enumerate(surfaces):
            if j != k:
                hits = surface.hits(centroids[part], normals[part])
                covers.append((part[hits.point], parts[j][hits.face], hits.height))
        return covers

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        surfaces = list(pool.map(projector, parts))
        covers = [row for rows in pool.map(over, range(len(parts))) for row in rows]
    own, other = (np.concatenate([row[i] for row in covers] or [np.zeros(0)]).astype(np.int64) for i in (0, 1))
    height = np.concatenate([row[2] for row in covers] or [np.zeros(0)])
    cosine = np.einsum("ni,ni->n", normals[own], normals[other])
    return Cover(own, other, height, np.arccos(np.clip(cosine, -1, 1)))


def close_pairs(mesh: Mesh, owner: Indices, gap: float, reach: float) -> Indices:
    """Pairs of triangles of different surfaces that overlap or are separated by less than a gap.

    Both are judged along the mean of the two normals. owner : (M,) int, surface of each triangle. gap : mm, along the
    surface. reach : mm, greatest distance of two layers along that mean. Returns (P, 2) indices.
    """
    corners = mesh.vertices[mesh.faces]
    centroids, normals, radius = triangle_spheres(corners)
    if not len(radius):
        return np.zeros((0, 2), np.int64)
    usual = 1.5 * float(np.median(radius))
    common = float(np.hypot(2 * usual + gap, reach))
    middles = cubes(centroids, common / 2)
    inside = away_from_other_labels(middles, owner, common)

    def pairs(first: int, last: int) -> Indices:
        close = kernels.closer(
            middles, inside, owner, normals, corners, radius, usual, gap, reach, _SAME_SIDE, first, last
        )
        return np.asarray(close)

    bounds = np.linspace(0, len(radius), _PARTS + 1).astype(np.int64)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.concatenate(list(pool.map(pairs, bounds[:-1], bounds[1:])))


def badness(
    mesh: Mesh, neighbours: Indices, owner: Indices, covered: Cover, correlation: Floats, weights: Mapping[str, float]
) -> Floats:
    """Badness of each triangle, by which it is removed from an overlap: weighted sum of measures, each over its median.

    The measures are ``correlation``, the coefficient C_LS; ``distance`` to the other surfaces; ``orientation``, the
    angle to the other surfaces' normals; and ``margin``, how near the triangle is to the border of its own
    surface, where the angles of incidence are largest.

    Parameters
    ----------
    mesh : all surfaces as one mesh.
    neighbours : (M, 3) indices of the neighbours of each triangle.
    owner : (M,) int, its surface.
    covered : the overlaps.
    correlation : (M,) C_LS.
    weights : of the measures, by name.

    Returns
    -------
    (M,) without unit, the larger the worse.
    """
    M = len(mesh.faces)
    hits = np.bincount(covered.own, minlength=M)
    hidden = hits > 0
    measures = {
        "correlation": correlation,
        "distance": np.bincount(covered.own, np.abs(covered.height), M) / np.maximum(hits, 1),
        "orientation": np.bincount(covered.own, covered.angle, M) / np.maximum(hits, 1),
    }
    everywhere = np.ones(M, bool)
    total = np.zeros(M)
    for name, values in measures.items():
        if weights.get(name, 0.0):
            smooth = kernels.smooth_over_neighbours(
                values, everywhere if name == "correlation" else hidden, neighbours, _SMOOTHING
            )
            median = float(np.median(smooth[hidden])) if hidden.any() else 0.0
            total += weights[name] * smooth / (median or 1.0)
    if weights.get("margin", 0.0):
        depth = _from_border(mesh, owner)
        median = float(np.median(depth[hidden])) if hidden.any() else 0.0
        total -= weights["margin"] * depth / (median or 1.0)
    return total


def _from_border(mesh: Mesh, owner: Indices) -> Floats:
    """Distance of each triangle from the border of its own surface, (M,) mm; 0 for a closed surface."""
    centroids, distance = mesh.centroids, np.zeros(len(mesh.faces))

    def of(k: int) -> None:
        part = owner == k
        border = Mesh(mesh.vertices, mesh.faces[part]).boundary_edges()
        if len(border):
            distance[part] = scipy.spatial.cKDTree(mesh.vertices[border].mean(axis=1)).query(centroids[part])[0]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(of, range(owner.max(initial=-1) + 1)))
    return distance


def _rivals(count: int, competing: Indices) -> tuple[Indices, Indices]:
    """For each of ``count`` triangles those that it competes with, one list after the other, and where each begins."""
    both = np.concatenate([competing, competing[:, ::-1]])
    start, order = counting_sort(both[:, 0], count)
    return start, both[order, 1]


def peel(neighbours: Indices, alive: Mask, competing: Indices, bad: Floats) -> Mask:
    """Remove border triangles that compete with remaining ones, the worst first, until no two compete.

    neighbours : (M, 3) indices of the neighbours of each triangle. alive : (M,) bool, to begin with. competing : (P, 2)
    indices. bad : (M,), the larger the worse. Returns the triangles that remain, (M,) bool.
    """
    competing = competing[alive[competing].all(axis=1)]
    start, rival = _rivals(len(neighbours), competing)
    living = alive.copy()
    kernels.peel_triangles(start, rival, neighbours, living, bad)
    for first, second in competing[living[competing].all(axis=1)].tolist():  # pairs that no border reached
        if living[first] and living[second]:
            living[first if bad[first] > bad[second] else second] = False
    return living


def regrow(neighbours: Indices, alive: Mask, candidate: Mask, competing: Indices, bad: Floats) -> Mask:
    """Restore removed triangles that compete with none of the remaining ones and adjoin those of their own surface.

    Those with most neighbours come first, of these the best. neighbours : (M, 3) indices of the neighbours of each
    triangle. alive : (M,) bool, triangles that remain. candidate : (M,) bool, triangles that may be restored.
    competing : (P, 2) indices, among those alive and the candidates. bad : (M,), the larger the worse. Returns the
    triangles that then remain, (M,) bool.
    """
    start, rival = _rivals(len(neighbours), competing)
    living = alive.copy()
    kernels.regrow_triangles(start, rival, neighbours, living, candidate & ~alive, bad)
    return living
