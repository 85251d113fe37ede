"""The surfaces of the camera pairs in one set of arrays, merged into one surface or side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.merging import Merged, Mismatch, Seam, Sheet, merge, mismatches
from processing.results import Matches, Results
from processing.ring import Ring
from processing.session import Capture, Session
from processing.settings import Settings
from processing.surface import PairSurface

Merging = Callable[[Sequence[PairSurface], str], Merged]

_MOST = 0.5  # a step at which fewer points of a pair were measured says nothing about single points


def merge_surfaces(surfaces: Sequence[PairSurface], heuristic: str) -> Merged:
    """One surface of the pairs' surfaces."""
    return merge([_sheet(surface) for surface in surfaces], heuristic)


def at_reference(surface: PairSurface) -> PairSurface:
    """A pair's surface at the reference alone."""
    vertices, correlation = surface.vertices[:1], surface.correlation[:1]
    return replace(
        surface, vertices=vertices, correlation=correlation, sigma=surface.sigma[:1], status=surface.status[:1]
    )


def pairs_surface(
    session: Session,
    ring: Ring,
    surfaces: Sequence[PairSurface],
    steps: Sequence[Capture],
    settings: Settings,
    merging: Merging = merge_surfaces,
) -> tuple[Results, dict[str, Any]]:
    """The results of all pairs, and how well the pairs agree and how they were merged, as JSON values.

    With surface.merge "none" the surfaces stay side by side, one over the other where several pairs saw the body.
    merging : what merges them otherwise, by that name.
    """
    results = _side_by_side(session, ring, surfaces, steps, settings)
    heuristic = settings.surface.merge
    if heuristic == "none":
        sheets = [_sheet(surface) for surface in surfaces]
        edge = Seam.mean_edge(sheets)
        return results, {"heuristic": heuristic, **_agreement(results, mismatches(sheets, Seam().layers * edge))}
    merged = merging(surfaces, heuristic)
    figures = {"heuristic": heuristic, "removed": len(merged.removed), "added": merged.added}
    return _of_merged(results, merged), {**figures, **_agreement(results, merged.mismatch)}


def _sheet(surface: PairSurface) -> Sheet:
    """The reference shape; the correlation of a point is its worst over the steps, NaN if it was lost at one."""
    told = np.mean(surface.status == 0, axis=1) >= _MOST
    told[0] = True
    return Sheet(surface.vertices[0], surface.faces, surface.correlation[told].max(axis=0))


def _side_by_side(
    session: Session, ring: Ring, surfaces: Sequence[PairSurface], steps: Sequence[Capture], settings: Settings
) -> Results:
    counts = [surface.vertices.shape[1] for surface in surfaces]
    offsets = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)
    vertices = np.concatenate([surface.vertices for surface in surfaces], axis=1)
    return Results(
        rig=session.rig.name,
        steps=tuple(step.id for step in steps),
        cameras=tuple(calibration.camera for calibration in ring.cameras.values()),
        pairs=tuple(_pair(surface.matches) for surface in surfaces),
        vertices_ref=vertices[0],
        vertices=vertices,
        faces=np.concatenate([s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]),
        pair=np.repeat(np.arange(len(surfaces)), [len(surface.faces) for surface in surfaces]),
        vertex_pair=np.repeat(np.arange(len(surfaces)), counts),
        correlation=np.concatenate([surface.correlation for surface in surfaces], axis=1),
        sigma_xyz=np.concatenate([surface.sigma for surface in surfaces], axis=1),
        status=np.concatenate([surface.status for surface in surfaces], axis=1),
        matches=tuple(_with_offset(surface, int(offset)) for surface, offset in zip(surfaces, offsets, strict=True)),
        settings=settings.to_toml(),
    )


def _pair(matches: Matches) -> tuple[str, str]:
    first, second = matches.cameras
    return first, second


def _with_offset(surface: PairSurface, offset: int) -> Matches:
    vertex = surface.matches.vertex
    return replace(surface.matches, vertex=np.where(vertex >= 0, vertex + offset, -1))


def _of_merged(results: Results, merged: Merged) -> Results:
    """The merged surface with its own vertices only; a match whose point was taken out has no vertex."""
    kept = merged.vertex
    number = np.full(len(results.vertices_ref) + 1, -1, dtype=np.int64)  # the last one for what has no vertex
    number[kept] = np.arange(len(kept))
    return replace(
        results,
        vertices_ref=results.vertices_ref[kept],
        vertices=results.vertices[:, kept],
        faces=number[merged.faces],
        pair=merged.pair,
        vertex_pair=results.vertex_pair[kept],
        correlation=results.correlation[:, kept],
        sigma_xyz=results.sigma_xyz[:, kept],
        status=results.status[:, kept],
        matches=tuple(replace(matches, vertex=number[matches.vertex]) for matches in results.matches),
    )


def _agreement(results: Results, found: Sequence[Mismatch]) -> dict[str, Any]:
    """Distances between the surfaces of pairs, and their mean and standard deviation over pairs that share a camera."""
    rows = []
    for one in found:
        figures = {"mean_mm": one.mean, "std_mm": one.std, "bias_mm": one.bias, "rms_mm": one.rms}
        pairs = ["-".join(results.pairs[k]) for k in (one.first, one.second)]
        rows.append({"pairs": pairs, "points": one.points, **figures, "largest_mm": one.largest})
    beside = [one for one in found if set(results.pairs[one.first]) & set(results.pairs[one.second])]
    if not beside:
        return {"mismatch_mm": None, "mismatch_std_mm": None, "mismatches": rows}
    weights: NDArray[np.float64] = np.array([one.points for one in beside], dtype=float)
    weights /= weights.sum()
    mean = float(weights @ [one.mean for one in beside])
    square = float(weights @ [one.mean**2 + one.std**2 for one in beside])
    return {"mismatch_mm": mean, "mismatch_std_mm": float(np.sqrt(square - mean**2)), "mismatches": rows}
