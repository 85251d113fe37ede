"""Results of all camera pairs' surfaces, merged or separate, in one set of arrays, one step at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices
from ringdic.geometry.camera import Camera
from ringdic.merging import MergedSurface, Mismatch, Seam, SurfacePart, merge, mismatches
from ringdic.pairs.reconstruction import PairMatches, PairShape, PairStep
from ringdic.results.results import Matches, Results
from ringdic.results.series import StepCache, median_deviations
from ringdic.settings import Settings

_MOST = 0.5  # share of a pair's points that a step must have measured to distinguish good points from bad ones


@dataclass(frozen=True)
class PairSurface:
    """Surface of a pair at F steps, each read from a cache on request.

    shape : at the reference. at : function that returns the surface and the matches of a step. correlation : (N,) C_LS,
    of each point the largest over the steps, NaN if it was lost at one. drift : (F,) px, of `PairStep`. noise : (F, 2)
    px, median standard deviation of each camera's matches.
    """

    shape: PairShape
    at: Callable[[int], tuple[PairStep, PairMatches]]
    correlation: Floats
    drift: Floats
    noise: Floats

    @property
    def part(self) -> SurfacePart:
        """Reference shape, with the largest correlation coefficients over the steps."""
        return self._part(self.correlation)

    @property
    def part_at_reference(self) -> SurfacePart:
        """Reference shape, with the correlation coefficients of the reference alone."""
        return self._part(self.shape.reference.correlation)

    def _part(self, correlation: NDArray[Any]) -> SurfacePart:
        """Reference shape with correlation coefficients (N,)."""
        return SurfacePart(self.shape.reference.vertices, self.shape.faces, correlation.astype(float))


#: Merges the surfaces of pairs into one, by a heuristic.
Merging = Callable[[Sequence[PairSurface], str], MergedSurface]


def reconstruct_pair(
    shape: PairShape, matches_at: Callable[[int], PairMatches], steps: int, cache: StepCache
) -> PairSurface:
    """Reconstruct a pair's surface at all steps.

    matches_at : function that returns the matches of a step. steps : their number. cache : for the points in space of
    every step.
    """
    worst = shape.reference.correlation.astype(float)
    drift, noise = np.full(steps, np.nan), np.full((steps, 2), np.nan)
    for k in range(steps):
        matches = matches_at(k)
        step = shape.step(matches) if k else shape.reference
        cache.put((shape.ids, k), (step, matches))
        drift[k], noise[k] = step.drift, median_deviations(matches.sigma, step.status)
        if np.mean(step.status[shape.rows] == 0) >= _MOST:
            worst = np.maximum(worst, step.correlation)
    return PairSurface(shape, lambda k: cache.get((shape.ids, k)), worst, drift, noise)


def merge_surfaces(pairs: Sequence[PairSurface], heuristic: str) -> MergedSurface:
    """Merge the pairs' reference surfaces into one, by one of the heuristics of ``merging``."""
    return merge([pair.part for pair in pairs], heuristic)


def pairs_surface(
    rig: str,
    cameras: Sequence[Camera],
    pairs: Sequence[PairSurface],
    names: Sequence[str],
    settings: Settings,
    merging: Merging = merge_surfaces,
) -> tuple[PairsSeries, dict[str, Any]]:
    """Combine the pairs' surfaces into a series of results, with figures of how well they agree, as JSON values.

    With the setting surface.merge "none" the surfaces stay separate, and overlap where several pairs see the body.

    Parameters
    ----------
    rig : its name.
    cameras : all that were calibrated.
    pairs : their surfaces.
    names : of the steps, the reference first.
    settings : of the run.
    merging : function that merges the surfaces by the heuristic that the setting names.
    """
    names = tuple(names)
    separate = _side_by_side(rig, cameras, pairs, names[0], settings)
    heuristic = settings.surface.merge
    if heuristic == "none":
        parts = [pair.part for pair in pairs]
        distances = mismatches(parts, Seam().layers * Seam.mean_edge(parts))
        series = PairsSeries(names, separate, tuple(pairs), np.arange(len(separate.vertices_ref)))
        return series, {"heuristic": heuristic, **_agreement(separate, distances)}
    merged = merging(pairs, heuristic)
    figures = {"heuristic": heuristic, "removed": len(merged.removed), "added": merged.added}
    series = PairsSeries(names, _over_merged_vertices(separate, merged), tuple(pairs), merged.vertex)
    return series, {**figures, **_agreement(separate, merged.mismatch)}


@dataclass(frozen=True)
class PairsSeries:
    """Series of results whose vertices are those of all pairs' surfaces, in one set of arrays.

    names : of the steps. reference : results of the reference alone. pairs : their surfaces. vertex : (N,) int,
    vertices that are used, of those of all pairs numbered one pair after the other.
    """

    names: tuple[str, ...]
    reference: Results
    pairs: tuple[PairSurface, ...]
    vertex: Indices

    @property
    def noise(self) -> list[Floats]:
        """Median standard deviations of the matches of each pair, (F, 2) px for each."""
        return [pair.noise for pair in self.pairs]

    def without_matches(self) -> PairsSeries:
        """Series of the same steps without the matches in the images."""
        return replace(self, reference=replace(self.reference, matches=()))

    def at(self, step: int) -> Results:
        """Results of the reference and a later step; for step 0 those of the reference alone."""
        if not step:
            return self.reference
        reference, steps_and_matches = self.reference, [pair.at(step) for pair in self.pairs]
        steps = [one for one, _ in steps_and_matches]
        vertices, correlation, sigma = (
            np.concatenate([getattr(one, name) for one in steps])[self.vertex]
            for name in ("vertices", "correlation", "sigma")
        )
        rows = [pair.shape.rows for pair in self.pairs]
        status = np.concatenate([one.status[row] for one, row in zip(steps, rows, strict=True)])[self.vertex]
        return replace(
            reference,
            steps=(self.names[0], self.names[step]),
            vertices=np.stack([reference.vertices[0], vertices]),
            correlation=np.stack([reference.correlation[0], correlation]),
            sigma_xyz=np.stack([reference.sigma_xyz[0], sigma]),
            status=np.stack([reference.status[0], status]),
            matches=tuple(
                _with_step(at_reference, *each)
                for at_reference, each in zip(reference.matches, steps_and_matches, strict=False)
            ),
        )


def _with_step(at_reference: Matches, step: PairStep, matches: PairMatches) -> Matches:
    """Matches of a pair at the reference and at a step."""
    return replace(
        at_reference,
        px=np.stack([at_reference.px[0], matches.px]),
        c_ls=np.stack([at_reference.c_ls[0], matches.c_ls]),
        sigma=np.stack([at_reference.sigma[0], matches.sigma]),
        status=np.stack([at_reference.status[0], step.status]),
    )


def _side_by_side(
    rig: str, cameras: Sequence[Camera], pairs: Sequence[PairSurface], reference: str, settings: Settings
) -> Results:
    """Results of the reference alone, of all pairs' surfaces side by side."""
    shapes = [pair.shape for pair in pairs]
    counts = [len(shape.rows) for shape in shapes]
    offsets = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)
    vertices = np.concatenate([shape.reference.vertices for shape in shapes])
    return Results(
        rig=rig,
        steps=(reference,),
        cameras=tuple(cameras),
        pairs=tuple(shape.ids for shape in shapes),
        vertices_ref=vertices,
        vertices=vertices[None],
        faces=np.concatenate([shape.faces + offset for shape, offset in zip(shapes, offsets, strict=True)]),
        pair=np.repeat(np.arange(len(shapes)), [len(shape.faces) for shape in shapes]),
        vertex_pair=np.repeat(np.arange(len(shapes)), counts),
        correlation=np.concatenate([shape.reference.correlation for shape in shapes])[None].astype(float),
        sigma_xyz=np.concatenate([shape.reference.sigma for shape in shapes])[None].astype(float),
        status=np.concatenate([shape.reference.status[shape.rows] for shape in shapes])[None],
        matches=tuple(_at_reference(pair, int(offset)) for pair, offset in zip(pairs, offsets, strict=True)),
        settings=settings.to_toml(),
    )


def _at_reference(pair: PairSurface, offset: int) -> Matches:
    """Matches of a pair at the reference, whose vertices are numbered from an offset on."""
    shape, matches = pair.shape, pair.at(0)[1]
    vertex = shape.vertex
    return Matches(
        cameras=shape.ids,
        xy=shape.xy,
        px=matches.px[None],
        c_ls=matches.c_ls[None].astype(float),
        sigma=matches.sigma[None].astype(float),
        status=shape.reference.status[None],
        vertex=np.where(vertex >= 0, vertex + offset, -1),
        seconds=dict(matches.seconds),
    )


def _over_merged_vertices(results: Results, merged: MergedSurface) -> Results:
    """Results over the vertices of the merged surface alone; a match whose point was taken out has no vertex."""
    used = merged.vertex
    number = np.full(len(results.vertices_ref) + 1, -1, dtype=np.int64)  # the last one for what has no vertex
    number[used] = np.arange(len(used))
    return replace(
        results,
        vertices_ref=results.vertices_ref[used],
        vertices=results.vertices[:, used],
        faces=number[merged.faces],
        pair=merged.pair,
        vertex_pair=results.vertex_pair[used],
        correlation=results.correlation[:, used],
        sigma_xyz=results.sigma_xyz[:, used],
        status=results.status[:, used],
        matches=tuple(replace(matches, vertex=number[matches.vertex]) for matches in results.matches),
    )


def _agreement(results: Results, distances: Sequence[Mismatch]) -> dict[str, Any]:
    """Figures of the distances between the pairs' surfaces, as JSON values.

    They are given for every two pairs, and as mean and standard deviation over those that share a camera.
    """
    rows = []
    for one in distances:
        figures = {"mean_mm": one.mean, "std_mm": one.std, "bias_mm": one.bias, "rms_mm": one.rms}
        pairs = ["-".join(results.pairs[k]) for k in (one.first, one.second)]
        rows.append({"pairs": pairs, "points": one.points, **figures, "largest_mm": one.largest})
    sharing = [one for one in distances if set(results.pairs[one.first]) & set(results.pairs[one.second])]
    if not sharing:
        return {"mismatch_mm": None, "mismatch_std_mm": None, "mismatches": rows}
    weights: Floats = np.array([one.points for one in sharing], dtype=float)
    weights /= weights.sum()
    mean = float(weights @ [one.mean for one in sharing])
    square = float(weights @ [one.mean**2 + one.std**2 for one in sharing])
    return {"mismatch_mm": mean, "mismatch_std_mm": float(np.sqrt(square - mean**2)), "mismatches": rows}
