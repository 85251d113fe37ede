"""Where surfaces lie over one another, and which triangles go.

Two triangles of different surfaces *compete* when they cover the same place, or come closer to one another than the
gap that is to be left. Triangles at the border of their surface are removed, the worst of all first, until no two
compete (Solav et al. 2018, overlap removal; there for two surfaces, here for any number at once).
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from processing.mesh import Mesh
from processing.projection import Projector
from processing.topology import neighbours

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: What the combination weighs, each relative to its median over the overlaps.
MEASURES = ("correlation", "distance", "orientation", "margin")

_SMOOTHING = 6  # rounds of averaging over neighbouring triangles: a single triangle's noise does not decide
_SAME_SIDE = 0.2  # least cosine between the normals of two layers of one surface


@dataclass(frozen=True)
class Cover:
    """Triangles that lie under or over the middle of a triangle of another surface: P ordered pairs.

    own, other : (P,) triangles. height : (P,) mm, from the middle of ``own`` to ``other`` along the normal.
    angle : (P,) rad between the normals.
    """

    own: Indices
    other: Indices
    height: Array
    angle: Array


def cover(mesh: Mesh, owner: Indices, reach: float) -> Cover:
    """Which triangles' middles are covered by another surface. owner : (M,) surface of each triangle; reach : mm."""
    centroids, normals = mesh.centroids, mesh.normals
    parts = [np.flatnonzero(owner == k) for k in range(owner.max(initial=-1) + 1)]
    surfaces = [Projector(Mesh(mesh.vertices, mesh.faces[part]), reach, _SAME_SIDE) for part in parts]
    found = []
    for k, part in enumerate(parts):
        for j, surface in enumerate(surfaces):
            if j != k:
                hits = surface.hits(centroids[part], normals[part])
                found.append((part[hits.point], parts[j][hits.face], hits.height))
    own, other = (np.concatenate([row[i] for row in found] or [np.zeros(0)]).astype(np.int64) for i in (0, 1))
    height = np.concatenate([row[2] for row in found] or [np.zeros(0)])
    cosine = np.einsum("ni,ni->n", normals[own], normals[other])
    return Cover(own, other, height, np.arccos(np.clip(cosine, -1, 1)))


def closer_than(mesh: Mesh, owner: Indices, gap: float, reach: float) -> Indices:
    """Pairs (P, 2) of triangles of different surfaces that lie over one another or closer than ``gap`` mm beside.

    Seen along the mean of the two normals; ``reach`` mm is how far apart along it two layers may lie.
    """
    centroids, normals, corners = mesh.centroids, mesh.normals, mesh.vertices[mesh.faces]
    radius = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
    usual = 1.5 * float(np.median(radius))
    tree = cKDTree(centroids)
    pairs = tree.query_pairs(float(np.hypot(2 * usual + gap, reach)), output_type="ndarray").astype(np.int64)
    large = np.flatnonzero(radius > usual)
    around = tree.query_ball_point(centroids[large], np.hypot(radius[large] + radius.max() + gap, reach))
    more = np.array([(a, b) for a, row in zip(large, around, strict=True) for b in row if a != b], np.int64)
    pairs = np.concatenate([pairs, more.reshape(-1, 2)])
    pairs = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]]
    first, second = pairs.T
    normal = normals[first] + normals[second]
    apart = centroids[second] - centroids[first]
    same_side = np.einsum("ni,ni->n", normals[first], normals[second]) > _SAME_SIDE
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    height = np.einsum("ni,ni->n", apart, normal)
    beside = np.sqrt(np.maximum(np.einsum("ni,ni->n", apart, apart) - height**2, 0.0))
    near = same_side & (np.abs(height) < reach) & (beside < radius[first] + radius[second] + gap)
    first, second, normal = first[near], second[near], normal[near]
    return np.stack([first, second], 1)[_separation(corners[first], corners[second], normal) < gap]


def _separation(first: Array, second: Array, normal: Array) -> Array:
    """Widest gap (n,) between two triangles (n, 3, 3) seen along normals, over the directions across their edges."""
    widest = np.full(len(first), -np.inf)
    for one, two in ((first, second), (second, first)):
        for k in range(3):
            across = np.cross(one[:, (k + 1) % 3] - one[:, k], normal)  # outwards from the triangle
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
            widest = np.maximum(widest, np.einsum("nki,ni->nk", two - one[:, k, None], across).min(axis=1))
    return widest


def badness(mesh: Mesh, owner: Indices, covered: Cover, correlation: Array, weights: Mapping[str, float]) -> Array:
    """How bad each triangle is, (M,), in medians over the overlaps: the weighted sum of the measures.

    owner : (M,) surface of each triangle. correlation : (M,) its C_LS. Measures: ``correlation``; ``distance`` to the
    other surfaces; ``orientation``, the angle to the other surfaces' normals; ``margin``, how near the triangle lies
    to the border of its own surface, where it was seen at the steepest angles.
    """
    M = len(mesh.faces)
    hits = np.bincount(covered.own, minlength=M)
    hidden = hits > 0
    measures = {
        "correlation": correlation,
        "distance": np.bincount(covered.own, np.abs(covered.height), M) / np.maximum(hits, 1),
        "orientation": np.bincount(covered.own, covered.angle, M) / np.maximum(hits, 1),
    }
    beside = neighbours(mesh.faces)
    total = np.zeros(M)
    for name, values in measures.items():
        if weights.get(name, 0.0):
            smooth = _smoothed(values, np.ones(M, bool) if name == "correlation" else hidden, beside)
            usual = float(np.median(smooth[hidden])) if hidden.any() else 0.0
            total += weights[name] * smooth / (usual or 1.0)
    if weights.get("margin", 0.0):
        depth = _from_border(mesh, owner)
        usual = float(np.median(depth[hidden])) if hidden.any() else 0.0
        total -= weights["margin"] * depth / (usual or 1.0)
    return total


def _smoothed(values: Array, known: Mask, beside: Indices) -> Array:
    """Values averaged with those of the neighbours that are known; 0 where nothing is."""
    weight = known.astype(float)
    total = np.where(known, values, 0.0)
    for _ in range(_SMOOTHING):
        inner = beside >= 0
        total = total + np.where(inner, total[beside], 0.0).sum(axis=1)
        weight = weight + np.where(inner, weight[beside], 0.0).sum(axis=1)
    return np.asarray(total / np.maximum(weight, 1e-300) * (weight > 0))


def _from_border(mesh: Mesh, owner: Indices) -> Array:
    """Distance of each triangle from the border of its own surface, (M,) mm; 0 for a closed surface."""
    centroids, distance = mesh.centroids, np.zeros(len(mesh.faces))
    for k in range(owner.max(initial=-1) + 1):
        part = owner == k
        border = Mesh(mesh.vertices, mesh.faces[part]).boundary_edges()
        if len(border):
            distance[part] = cKDTree(mesh.vertices[border].mean(axis=1)).query(centroids[part])[0]
    return distance


def peel(faces: Indices, alive: Mask, competing: Indices, bad: Array) -> Mask:
    """Triangles (M,) left when, worst first, border triangles that compete with others left are removed.

    alive : (M,) to begin with. competing : (P, 2). bad : (M,).
    """
    competing = competing[alive[competing].all(axis=1)]
    start, rival = _rivals(len(faces), competing)
    left = np.diff(start).tolist()
    beside = neighbours(faces).tolist()
    living: list[bool] = alive.tolist()
    order = (-bad).tolist()
    queue = [(order[f], f) for f in np.unique(competing).tolist() if any(g < 0 or not living[g] for g in beside[f])]
    if not queue and len(competing):  # closed surfaces: somewhere the first has to go
        worst = int(competing.ravel()[np.argmax(bad[competing])])
        queue = [(order[worst], worst)]
    heapq.heapify(queue)
    while queue:
        _, f = heapq.heappop(queue)
        if not living[f] or not left[f]:
            continue
        living[f] = False
        for g in rival[start[f] : start[f + 1]]:
            left[g] -= 1
        for g in beside[f]:
            if g >= 0 and living[g] and left[g]:
                heapq.heappush(queue, (order[g], g))
    kept = np.array(living, dtype=bool)
    for first, second in competing[kept[competing].all(axis=1)].tolist():  # what no border reached
        if kept[first] and kept[second]:
            kept[first if order[first] < order[second] else second] = False
    return kept


def regrow(faces: Indices, alive: Mask, candidate: Mask, competing: Indices, bad: Array) -> Mask:
    """Triangles (M,) there when those that compete with none left are put back, beside what is left of their surface.

    candidate : (M,) that may come back. competing : (P, 2) among those alive and the candidates. The ones with most
    neighbours there come first, of these the best.
    """
    start, rival = _rivals(len(faces), competing)
    beside = neighbours(faces).tolist()
    living: list[bool] = alive.tolist()
    wanted: list[bool] = (candidate & ~alive).tolist()
    order = bad.tolist()
    queue = [(-_count(beside[f], living), order[f], f) for f in np.flatnonzero(candidate & ~alive).tolist()]
    queue = [entry for entry in queue if entry[0] < 0]
    heapq.heapify(queue)
    while queue:
        _, _, f = heapq.heappop(queue)
        if living[f] or any(living[g] for g in rival[start[f] : start[f + 1]]):
            continue
        living[f] = True
        for g in beside[f]:
            if g >= 0 and wanted[g] and not living[g]:
                heapq.heappush(queue, (-_count(beside[g], living), order[g], g))
    return np.array(living, dtype=bool)


def _count(beside: list[int], living: list[bool]) -> int:
    return sum(g >= 0 and living[g] for g in beside)


def _rivals(M: int, competing: Indices) -> tuple[list[int], list[int]]:
    """For each triangle, where its competitors begin (M + 1) in a row of all of them."""
    both = np.concatenate([competing, competing[:, ::-1]])
    matrix = coo_array((np.ones(len(both), bool), (both[:, 0], both[:, 1])), shape=(M, M)).tocsr()
    return matrix.indptr.tolist(), matrix.indices.tolist()
