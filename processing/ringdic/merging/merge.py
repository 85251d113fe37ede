"""Merging of several surfaces into one without new vertices: overlaps removed, gaps stitched, small holes filled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Points
from ringdic.merging.fill import fill
from ringdic.merging.mismatch import Mismatch, mismatches
from ringdic.merging.overlap import badness, close_pairs, cover, peel, regrow
from ringdic.merging.stitch import stitch
from ringdic.mesh.mesh import Mesh, used_vertices
from ringdic.mesh.topology import face_neighbours, pieces, without_pinches

#: Weights of the measures of each heuristic.
HEURISTICS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        **{name: MappingProxyType({name: 1.0}) for name in ("correlation", "distance", "orientation")},
        "combined": MappingProxyType({"correlation": 1.0, "distance": 1.0, "orientation": 1.0, "margin": 1.0}),
    }
)
_FEWEST = 12  # triangles of the smallest piece that remains
# Of the seams between parts: lengths in units of the triangles' mean edge, and areas in its square.
_GAP = 0.4  # left between surfaces before they are stitched
_BRIDGE = 3.5  # longest edge of a new triangle
_LAYERS = 2.0  # greatest distance between two layers of one surface
_HOLE, _SEAM_HOLE = 6.0, 30.0  # largest holes that are filled, within a surface and at a seam


@dataclass(frozen=True)
class SurfacePart:
    """One of the surfaces to be merged.

    vertices : (N, 3) float64, mm, finite. faces : (M, 3) int, normals outwards. correlation : (N,) C_LS, 0 best, NaN
    for a vertex that was lost at some step: where another surface covers the same area, its triangles are removed
    first.

    Raises ValueError for arrays of other shapes.
    """

    vertices: Points
    faces: Indices
    correlation: Floats

    def __post_init__(self) -> None:
        N = len(self.vertices)
        if self.vertices.shape != (N, 3) or not np.isfinite(self.vertices).all():
            raise ValueError("vertices of a surface must be finite, (N, 3)")
        if self.correlation.shape != (N,):
            raise ValueError(f"a surface of {N} vertices needs as many correlations, not {self.correlation.shape}")


@dataclass(frozen=True)
class MergedSurface:
    """One surface over the vertices of several parts, which are numbered one part after the other.

    faces : (M, 3) int. pair : (M,) int, the part of all three corners, -1 where a triangle joins parts. vertex :
    (K,) int, vertices that are used, ascending. removed : (R,) int, triangles taken out, numbered one part after the
    other. added : number of new triangles, the last ones of ``faces``. mismatch : of every two parts that
    overlap.
    """

    faces: Indices
    pair: Indices
    vertex: Indices
    removed: Indices
    added: int
    mismatch: tuple[Mismatch, ...]


def merge(parts: Sequence[SurfacePart], heuristic: str = "combined") -> MergedSurface:
    """Merge several surfaces into one manifold surface without overlaps.

    heuristic : which triangles of an overlap are worst: "correlation", "distance", "orientation" or "combined".
    Raises ValueError for an unknown heuristic.
    """
    if heuristic not in HEURISTICS:
        raise ValueError(f"no heuristic '{heuristic}'; there are {', '.join(HEURISTICS)}")
    mesh, owner, correlation = _concatenate(parts)
    if not len(mesh.faces):
        return MergedSurface(mesh.faces, owner, np.zeros(0, np.int64), np.zeros(0, np.int64), 0, ())
    edge = _mean_edge(mesh)
    overlap = _Overlap.of(mesh, owner, correlation, HEURISTICS[heuristic], _LAYERS * edge)
    with ThreadPoolExecutor(1) as pool:  # the mismatches while the rest runs
        distances = pool.submit(_distances, parts, edge)
        living = _without_overlap(mesh, owner, overlap, _GAP * edge, _LAYERS * edge)
        faces, pair, added = _close_gaps(mesh, mesh.faces[living], parts, edge)
        return MergedSurface(faces, pair, used_vertices(faces), np.flatnonzero(~living), added, distances.result())


def side_by_side(parts: Sequence[SurfacePart]) -> MergedSurface:
    """Several surfaces as one mesh, one over the other where they overlap, with their distances there."""
    mesh, owner, _ = _concatenate(parts)
    distances = _distances(parts, _mean_edge(mesh))
    return MergedSurface(mesh.faces, owner, np.arange(len(mesh.vertices)), np.zeros(0, np.int64), 0, distances)


def _mean_edge(mesh: Mesh) -> float:
    """Mean length of the edges of all triangles, mm; 0 without any."""
    lengths = np.linalg.norm(np.diff(mesh.vertices[mesh.faces[:, [0, 1, 2, 0]]], axis=1), axis=2)
    return float(lengths.mean()) if lengths.size else 0.0


def _distances(parts: Sequence[SurfacePart], edge: float) -> tuple[Mismatch, ...]:
    """Distances between every two parts. edge : mm, mean edge of their triangles."""
    return mismatches([Mesh(part.vertices, part.faces) for part in parts], _LAYERS * edge)


def _concatenate(parts: Sequence[SurfacePart]) -> tuple[Mesh, Indices, Floats]:
    """All parts as one mesh, with the part and the largest correlation coefficient, NaN if lost, of each
    triangle (M,).
    """
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
    mesh = Mesh(
        np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)]),
        np.concatenate([np.zeros((0, 3), np.int64), *faces]),
    )
    owner = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    values = np.concatenate([np.zeros(0), *(part.correlation for part in parts)])
    return mesh, owner, values[mesh.faces].max(axis=1)


@dataclass(frozen=True)
class _Overlap:
    """Overlap of the parts: which triangles overlap, and the badness of each triangle.

    over : (P, 2), pairs of triangles, the first covered by the second. neighbours : (M, 3), the neighbours of each
    triangle, -1 at a border. lost : (M,) bool, triangles with a lost corner. bad : (M,), the larger the worse,
    largest where lost.
    """

    over: Indices
    neighbours: Indices
    lost: Mask
    bad: Floats

    @classmethod
    def of(
        cls, mesh: Mesh, owner: Indices, correlation: Floats, weights: Mapping[str, float], reach: float
    ) -> _Overlap:
        """Determine the overlap, on all cores.

        owner : (M,), part of each triangle. correlation : (M,). weights : of the measures. reach : mm, along the
        normals.
        """
        covered, lost, neighbours = cover(mesh, owner, reach), np.isnan(correlation), face_neighbours(mesh.faces)
        bad = badness(mesh, neighbours, owner, covered, np.where(lost, 0.0, correlation), weights)
        bad[lost] += 1 + np.ptp(bad)
        return cls(np.stack([covered.own, covered.other], axis=1), neighbours, lost, bad)


def _without_overlap(mesh: Mesh, owner: Indices, overlap: _Overlap, gap: float, reach: float) -> Mask:
    """Triangles (M,) that remain after overlaps are removed and a gap is cut. gap, reach : mm."""
    over, neighbours, lost, bad = overlap.over, overlap.neighbours, overlap.lost, overlap.bad
    # First triangles that cover one another's centroids, then those of the few left that overlap or are too close.
    living = np.ones(len(mesh.faces), bool)
    living[over[lost[over[:, 0]] & ~lost[over[:, 1]], 0]] = False
    living = peel(neighbours, living, over, bad)
    living = peel(neighbours, living, _close(mesh, owner, living, gap, reach), bad)
    close = over
    near = np.zeros(len(living), bool)  # triangles whose close pairs are known
    for _ in range(2):  # where small pieces were dropped, others may come back
        living = _tidy(mesh, living)
        free = ~living & ~lost
        free[over[living[over[:, 1]], 0]] = False
        free[over[living[over[:, 0]], 1]] = False
        if (free & ~near).any():
            near = living | free
            close = np.concatenate([over, _close(mesh, owner, near, gap, reach)])
        living = regrow(neighbours, living, free, close, bad)
    return _tidy(mesh, living)


def _close(mesh: Mesh, owner: Indices, which: Mask, gap: float, reach: float) -> Indices:
    """Pairs (P, 2) among the triangles of a mask (M,) that overlap or are separated by less than the gap, mm."""
    at = np.flatnonzero(which)
    return at[close_pairs(Mesh(mesh.vertices, mesh.faces[at]), owner[at], gap, reach)]


def _tidy(mesh: Mesh, living: Mask) -> Mask:
    """Triangles (M,) without small separate pieces and without fans that touch in one point only."""
    at = np.flatnonzero(living)
    at = at[without_pinches(Mesh(mesh.vertices, mesh.faces[at]))]
    piece = pieces(Mesh(mesh.vertices, mesh.faces[at]))  # without a small one, the others stay as they are
    result = np.zeros(len(living), bool)
    result[at[np.bincount(piece)[piece] >= _FEWEST]] = True
    return result


def _close_gaps(
    mesh: Mesh, triangles: Indices, parts: Sequence[SurfacePart], edge: float
) -> tuple[Indices, Indices, int]:
    """Stitch the gaps between the parts and fill the holes.

    triangles : (M, 3), left of the parts. edge : mm, their mean edge. Returns all triangles (M', 3), their parts
    (M',), -1 where they join parts, and the number of new ones.
    """
    part_of = np.repeat(np.arange(len(parts)), [len(part.vertices) for part in parts])
    new = stitch(Mesh(mesh.vertices, triangles), part_of, _BRIDGE * edge)
    whole = Mesh(mesh.vertices, np.concatenate([triangles, new]))
    seam_vertex = np.zeros(len(mesh.vertices), bool)
    seam_vertex[new] = True
    fillings = fill(whole, _HOLE * edge**2, _BRIDGE * edge, seam_vertex, _SEAM_HOLE * edge**2)
    faces = np.concatenate([whole.faces, fillings])
    is_new = np.arange(len(faces)) >= len(triangles)
    sound = without_pinches(Mesh(mesh.vertices, faces))
    faces, is_new = faces[sound], is_new[sound]
    corners = part_of[faces]
    pair = np.where((corners == corners[:, :1]).all(axis=1), corners[:, 0], -1)
    return faces, pair, int(is_new.sum())
