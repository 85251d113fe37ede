"""Surfaces of camera pairs made one: overlaps removed, gaps stitched, small holes closed, no vertex added."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.topology import face_neighbours, pieces, without_pinches
from ringdic.pairs.merging.fill import fill
from ringdic.pairs.merging.mismatch import Mismatch, mismatches
from ringdic.pairs.merging.overlap import MEASURES, badness, closer_than, cover, peel, regrow
from ringdic.pairs.merging.stitch import stitch

#: The weights of each heuristic; what "combined" weighs can be given.
HEURISTICS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        **{name: MappingProxyType({name: 1.0}) for name in ("correlation", "distance", "orientation")},
        "combined": MappingProxyType({"correlation": 1.0, "distance": 1.0, "orientation": 1.0, "margin": 1.0}),
    }
)
_FEWEST = 12  # triangles of a piece that is worth keeping


@dataclass(frozen=True)
class SurfacePart:
    """One surface: vertices (N, 3) mm, finite; faces (M, 3), normals outwards; correlation (N,) C_LS, 0 best.

    NaN for a vertex that was lost at some step: where another sheet measured the place, its triangles go first.
    """

    vertices: Floats
    faces: Indices
    correlation: Floats

    def __post_init__(self) -> None:
        N = len(self.vertices)
        if self.vertices.shape != (N, 3) or not np.isfinite(self.vertices).all():
            raise ValueError("vertices of a sheet must be finite, (N, 3)")
        if self.correlation.shape != (N,):
            raise ValueError(f"a sheet of {N} vertices needs as many correlations, not {self.correlation.shape}")


@dataclass(frozen=True)
class Seam:
    """How surfaces are joined, in mean edges of the triangles (areas in their squares).

    gap : left between surfaces before they are stitched. bridge : longest edge of a new triangle. layers : how far
    apart two layers of one surface may lie. hole : largest hole within a surface that is closed; seam_hole : at a seam.
    """

    gap: float = 0.4
    bridge: float = 3.5
    layers: float = 2.0
    hole: float = 6.0
    seam_hole: float = 30.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0:
                raise ValueError(f"{name} of a seam must not be negative, not {value}")

    @staticmethod
    def mean_edge(sheets: Sequence[SurfacePart]) -> float:
        """Mean length of the edges of all triangles, mm; 0 without any."""
        lengths = [np.linalg.norm(np.diff(s.vertices[s.faces[:, [0, 1, 2, 0]]], axis=1), axis=2) for s in sheets]
        every = np.concatenate([np.zeros(0), *(length.ravel() for length in lengths)])
        return float(every.mean()) if len(every) else 0.0


@dataclass(frozen=True)
class Merged:
    """One surface over the vertices of several sheets, numbered one sheet after the other.

    faces : (M, 3). pair : (M,) the sheet of all three corners, -1 where a triangle joins sheets. vertex : (K,) the
    vertices that are used, ascending. removed : (R,) triangles taken out, numbered one sheet after the other.
    added : number of new triangles, the last ones of ``faces``. mismatch : of every two sheets over one another.
    """

    faces: Indices
    pair: Indices
    vertex: Indices
    removed: Indices
    added: int
    mismatch: tuple[Mismatch, ...]


def merge(
    sheets: Sequence[SurfacePart],
    heuristic: str = "combined",
    weights: Mapping[str, float] | None = None,
    seam: Seam = Seam(),
) -> Merged:
    """Join sheets into one surface: sound, without a place covered twice.

    heuristic : "correlation", "distance", "orientation" or "combined": which triangles of an overlap are worst.
    weights : of the combination, by measure.
    Raises ValueError for an unknown heuristic or measure.
    """
    if heuristic not in HEURISTICS:
        raise ValueError(f"no heuristic '{heuristic}'; there are {', '.join(HEURISTICS)}")
    chosen = HEURISTICS[heuristic] if weights is None else weights
    if unknown := set(chosen) - set(MEASURES):
        raise ValueError(f"no measure '{unknown.pop()}'; there are {', '.join(MEASURES)}")
    mesh, owner, correlation = _together(sheets)
    if not len(mesh.faces):
        return Merged(mesh.faces, owner, np.zeros(0, np.int64), np.zeros(0, np.int64), 0, ())
    edge = Seam.mean_edge(sheets)
    overlap = _Overlap.of(mesh, owner, correlation, chosen, seam.layers * edge)
    with ThreadPoolExecutor(1) as pool:  # the mismatches beside what has to go one after the other
        apart = pool.submit(mismatches, sheets, seam.layers * edge)
        kept = _without_overlap(mesh, owner, overlap, seam.gap * edge, seam.layers * edge)
        faces, pair, added = _joined(mesh, mesh.faces[kept], owner, sheets, seam, edge)
        return Merged(faces, pair, np.unique(faces), np.flatnonzero(~kept), added, apart.result())


def _together(sheets: Sequence[SurfacePart]) -> tuple[Mesh, Indices, Floats]:
    """All sheets as one mesh, each triangle's sheet (M,) and worst correlation (M,), NaN if lost."""
    offsets = np.cumsum([0, *(len(sheet.vertices) for sheet in sheets)])
    faces = [sheet.faces + offset for sheet, offset in zip(sheets, offsets, strict=False)]
    mesh = Mesh(
        np.concatenate([np.zeros((0, 3)), *(sheet.vertices for sheet in sheets)]),
        np.concatenate([np.zeros((0, 3), np.int64), *faces]),
    )
    owner = np.repeat(np.arange(len(sheets)), [len(sheet.faces) for sheet in sheets])
    values = np.concatenate([np.zeros(0), *(sheet.correlation for sheet in sheets)])
    return mesh, owner, values[mesh.faces].max(axis=1)


@dataclass(frozen=True)
class _Overlap:
    """What lies over one another: pairs (P, 2) of triangles, the first covered by the second.

    beside : (M, 3), of ``neighbours``. lost : (M,) triangles with a lost corner. bad : (M,), those the worst of all.
    """

    over: Indices
    beside: Indices
    lost: Mask
    bad: Floats

    @classmethod
    def of(
        cls, mesh: Mesh, owner: Indices, correlation: Floats, weights: Mapping[str, float], reach: float
    ) -> _Overlap:
        """Of triangles whose surface (M,) and correlation (M,) are given; reach : mm. Works on all cores."""
        covered, lost, beside = cover(mesh, owner, reach), np.isnan(correlation), face_neighbours(mesh.faces)
        bad = badness(mesh, beside, owner, covered, np.where(lost, 0.0, correlation), weights)
        bad[lost] += 1 + np.ptp(bad)
        return cls(np.stack([covered.own, covered.other], axis=1), beside, lost, bad)


def _without_overlap(mesh: Mesh, owner: Indices, overlap: _Overlap, gap: float, reach: float) -> Mask:
    """Triangles (M,) left when no place is covered twice and the gap, mm, is kept; reach : mm."""
    over, beside, lost, bad = overlap.over, overlap.beside, overlap.lost, overlap.bad
    # First what covers one another's middles, then, of the little that is left, what overlaps or is too close at all.
    left = np.ones(len(mesh.faces), bool)
    left[over[lost[over[:, 0]] & ~lost[over[:, 1]], 0]] = False
    left = peel(beside, left, over, bad)
    left = peel(beside, left, _close(mesh, owner, left, gap, reach), bad)
    for _ in range(2):  # where small pieces were dropped, the others may come back
        left = _tidy(mesh, left)
        free = ~left & ~lost
        free[over[left[over[:, 1]], 0]] = False
        free[over[left[over[:, 0]], 1]] = False
        close = np.concatenate([over, _close(mesh, owner, left | free, gap, reach)])
        left = regrow(beside, left, free, close, bad)
    return _tidy(mesh, left)


def _close(mesh: Mesh, owner: Indices, which: Mask, gap: float, reach: float) -> Indices:
    at = np.flatnonzero(which)
    return at[closer_than(Mesh(mesh.vertices, mesh.faces[at]), owner[at], gap, reach)]


def _tidy(mesh: Mesh, kept: Mask) -> Mask:
    """Triangles (M,) left without pieces of a few triangles and without fans that touch in a point only."""
    at = np.flatnonzero(kept)
    while True:
        part = Mesh(mesh.vertices, mesh.faces[at])
        piece = pieces(part)
        left = (np.bincount(piece)[piece] >= _FEWEST) & without_pinches(part)
        if left.all():
            result = np.zeros(len(kept), bool)
            result[at] = True
            return result
        at = at[left]


def _joined(
    mesh: Mesh, old: Indices, owner: Indices, sheets: Sequence[SurfacePart], seam: Seam, edge: float
) -> tuple[Indices, Indices, int]:
    """Triangles (M, 3) with gaps stitched and holes filled, their sheets (M,), and how many are new."""
    sheet_of = np.repeat(np.arange(len(sheets)), [len(sheet.vertices) for sheet in sheets])
    new = stitch(Mesh(mesh.vertices, old), sheet_of, seam.bridge * edge)
    whole = Mesh(mesh.vertices, np.concatenate([old, new]))
    seam_vertex = np.zeros(len(mesh.vertices), bool)
    seam_vertex[new] = True
    more = fill(whole, seam.hole * edge**2, seam.bridge * edge, seam_vertex, seam.seam_hole * edge**2)
    faces = np.concatenate([whole.faces, more])
    is_new = np.arange(len(faces)) >= len(old)
    sound = without_pinches(Mesh(mesh.vertices, faces))
    faces, is_new = faces[sound], is_new[sound]
    corners = sheet_of[faces]
    pair = np.where((corners == corners[:, :1]).all(axis=1), corners[:, 0], -1)
    return faces, pair, int(is_new.sum())
