"""Where surfaces lie over one another, and which triangles go.

Two triangles of different surfaces *compete* when they cover the same place, or come closer to one another than the
gap that is to be left. Triangles at the border of their surface are removed, the worst of all first, until no two
compete (Solav et al. 2018, overlap removal; there for two surfaces, here for any number at once).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.nearest import away_from_other_labels, cubes
from ringdic.mesh.projection import Projector, triangle_spheres
from ringdic.pairs.merging import kernels

#: What the combination weighs, each relative to its median over the overlaps.
MEASURES = ("correlation", "distance", "orientation", "margin")

_SMOOTHING = 6  # rounds of averaging over neighbouring triangles: a single triangle's noise does not decide
_PARTS = 16  # of the triangles, that cores share
_SAME_SIDE = 0.2  # least cosine between the normals of two layers of one surface


@dataclass(frozen=True)
class Cover:
    """Triangles that lie under or over the middle of a triangle of another surface: P ordered pairs.

    own, other : (P,) triangles. height : (P,) mm, from the middle of ``own`` to ``other`` along the normal.
    angle : (P,) rad between the normals.
    """

    own: Indices
    other: Indices
    height: Floats
    angle: Floats


def cover(mesh: Mesh, owner: Indices, reach: float) -> Cover:
    """Which triangles' middles are covered by another surface. owner : (M,) surface of each triangle; reach : mm."""
    centroids, normals = mesh.centroids, mesh.normals
    parts = [np.flatnonzero(owner == k) for k in range(owner.max(initial=-1) + 1)]

    def projector(part: Indices) -> Projector:
        return Projector(Mesh(mesh.vertices, mesh.faces[part]), reach, _SAME_SIDE)

    def over(k: int) -> list[tuple[Indices, Indices, Floats]]:
        """What the other surfaces cover of surface k."""
        part, found = parts[k], []
        for j, surface in enumerate(surfaces):
            if j != k:
                hits = surface.hits(centroids[part], normals[part])
                found.append((part[hits.point], parts[j][hits.face], hits.height))
        return found

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        surfaces = list(pool.map(projector, parts))
        found = [row for rows in pool.map(over, range(len(parts))) for row in rows]
    own, other = (np.concatenate([row[i] for row in found] or [np.zeros(0)]).astype(np.int64) for i in (0, 1))
    height = np.concatenate([row[2] for row in found] or [np.zeros(0)])
    cosine = np.einsum("ni,ni->n", normals[own], normals[other])
    return Cover(own, other, height, np.arccos(np.clip(cosine, -1, 1)))


def closer_than(mesh: Mesh, owner: Indices, gap: float, reach: float) -> Indices:
    """Pairs (P, 2) of triangles of different surfaces that lie over one another or closer than ``gap`` mm beside.

    Seen along the mean of the two normals; ``reach`` mm is how far apart along it two layers may lie.
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
        found = kernels.closer(
            middles, inside, owner, normals, corners, radius, usual, gap, reach, _SAME_SIDE, first, last
        )
        return np.asarray(found)

    bounds = np.linspace(0, len(radius), _PARTS + 1).astype(np.int64)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.concatenate(list(pool.map(pairs, bounds[:-1], bounds[1:])))


def badness(
    mesh: Mesh, beside: Indices, owner: Indices, covered: Cover, correlation: Floats, weights: Mapping[str, float]
) -> Floats:
    """How bad each triangle is, (M,), in medians over the overlaps: the weighted sum of the measures.

    beside : (M, 3), of ``neighbours``. owner : (M,) surface of each triangle. correlation : (M,) its C_LS.
    Measures: ``correlation``; ``distance`` to the other surfaces; ``orientation``, the angle to the other surfaces'
    normals; ``margin``, how near the triangle lies to the border of its own surface, where it was seen at the steepest
    angles.
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
            smooth = kernels.smoothed(values, everywhere if name == "correlation" else hidden, beside, _SMOOTHING)
            usual = float(np.median(smooth[hidden])) if hidden.any() else 0.0
            total += weights[name] * smooth / (usual or 1.0)
    if weights.get("margin", 0.0):
        depth = _from_border(mesh, owner)
        usual = float(np.median(depth[hidden])) if hidden.any() else 0.0
        total -= weights["margin"] * depth / (usual or 1.0)
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


def peel(beside: Indices, alive: Mask, competing: Indices, bad: Floats) -> Mask:
    """Triangles (M,) left when, worst first, border triangles that compete with others left are removed.

    beside : (M, 3), of ``neighbours``. alive : (M,) to begin with. competing : (P, 2). bad : (M,).
    """
    competing = competing[alive[competing].all(axis=1)]
    start, rival = kernels.rivals(len(beside), competing)
    kept = alive.copy()
    kernels.peel_triangles(start, rival, beside, kept, bad)
    for first, second in competing[kept[competing].all(axis=1)].tolist():  # what no border reached
        if kept[first] and kept[second]:
            kept[first if bad[first] > bad[second] else second] = False
    return kept


def regrow(beside: Indices, alive: Mask, candidate: Mask, competing: Indices, bad: Floats) -> Mask:
    """Triangles (M,) there when those that compete with none left are put back, beside what is left of their surface.

    beside : (M, 3), of ``neighbours``. candidate : (M,) that may come back. competing : (P, 2) among those alive and
    the candidates. The ones with most neighbours there come first, of these the best.
    """
    start, rival = kernels.rivals(len(beside), competing)
    living = alive.copy()
    kernels.regrow_triangles(start, rival, beside, living, candidate & ~alive, bad)
    return living
