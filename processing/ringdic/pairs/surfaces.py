"""The surfaces of the camera pairs in one set of arrays, merged into one surface or side by side, a step at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices
from ringdic.geometry.camera import Camera
from ringdic.pairs.merging import Merged, Mismatch, Seam, SurfacePart, merge, mismatches
from ringdic.pairs.reconstruction import PairMatches, PairShape, PairStep
from ringdic.results.results import Matches, Results
from ringdic.results.series import StepCache, median_deviations
from ringdic.settings import Settings

_MOST = 0.5  # a step at which fewer points of a pair were measured says nothing about single points


@dataclass(frozen=True)
class PairSurface:
    """A pair's surface through F steps, which are read again when they are asked for.

    correlation : (N,) of each point the worst over the steps, NaN if it was lost at one. drift : (F,) px, of
    `PairStep`. noise : (F, 2) px, of `Series`.
    """

    shape: PairShape
    at: Callable[[int], tuple[PairStep, PairMatches]]
    correlation: Floats
    drift: Floats
    noise: Floats

    @property
    def sheet(self) -> SurfacePart:
        """The reference shape, with the worst correlation over the steps."""
        return self._sheet(self.correlation)

    @property
    def sheet_at_reference(self) -> SurfacePart:
        """The same as if there were no other step."""
        return self._sheet(self.shape.at_first.correlation)

    def _sheet(self, correlation: NDArray[Any]) -> SurfacePart:
        return SurfacePart(self.shape.at_first.vertices, self.shape.faces, correlation.astype(float))


Merging = Callable[[Sequence[PairSurface], str], Merged]


def reconstruct_pair(
    shape: PairShape, matched: Callable[[int], PairMatches], steps: int, shelf: StepCache
) -> PairSurface:
    """A pair's surface through its steps. matched : of each. shelf : where the points in space are laid aside."""
    worst = shape.at_first.correlation.astype(float)
    drift, noise = np.full(steps, np.nan), np.full((steps, 2), np.nan)
    for k in range(steps):
        found = matched(k)
        step = shape.step(found) if k else shape.at_first
        shelf.put((shape.ids, k), (step, found))
        drift[k], noise[k] = step.drift, median_deviations(found.sigma, step.status)
        if np.mean(step.status[shape.rows] == 0) >= _MOST:
            worst = np.maximum(worst, step.correlation)
    return PairSurface(shape, lambda k: shelf.get((shape.ids, k)), worst, drift, noise)


def merge_surfaces(pairs: Sequence[PairSurface], heuristic: str) -> Merged:
    """One surface of the pairs' surfaces."""
    return merge([pair.sheet for pair in pairs], heuristic)


def pairs_surface(
    rig: str,
    cameras: Sequence[Camera],
    pairs: Sequence[PairSurface],
    names: Sequence[str],
    settings: Settings,
    merging: Merging = merge_surfaces,
) -> tuple[PairsSeries, dict[str, Any]]:
    """The results of all pairs, and how well the pairs agree and how they were merged, as JSON values.

    With surface.merge "none" the surfaces stay side by side, one over the other where several pairs saw the body.
    rig : its name. cameras : all that were calibrated. names : of the steps, the reference first. merging : what merges
    them otherwise, by that name.
    """
    names = tuple(names)
    beside = _side_by_side(rig, cameras, pairs, names[0], settings)
    heuristic = settings.surface.merge
    if heuristic == "none":
        sheets = [pair.sheet for pair in pairs]
        found = mismatches(sheets, Seam().layers * Seam.mean_edge(sheets))
        series = PairsSeries(names, beside, tuple(pairs), np.arange(len(beside.vertices_ref)))
        return series, {"heuristic": heuristic, **_agreement(beside, found)}
    merged = merging(pairs, heuristic)
    figures = {"heuristic": heuristic, "removed": len(merged.removed), "added": merged.added}
    series = PairsSeries(names, _of_merged(beside, merged), tuple(pairs), merged.vertex)
    return series, {**figures, **_agreement(beside, merged.mismatch)}


@dataclass(frozen=True)
class PairsSeries:
    """The steps of the pairs' surfaces in one set of arrays: see `Series`.

    kept : (N,) vertices that are used, of all the pairs' numbered one pair after the other.
    """

    names: tuple[str, ...]
    reference: Results
    pairs: tuple[PairSurface, ...]
    kept: Indices

    @property
    def noise(self) -> list[Floats]:
        """See `Series`."""
        return [pair.noise for pair in self.pairs]

    def without_matches(self) -> PairsSeries:
        """See `Series`."""
        return replace(self, reference=replace(self.reference, matches=()))

    def at(self, step: int) -> Results:
        """See `Series`."""
        if not step:
            return self.reference
        first, laid = self.reference, [pair.at(step) for pair in self.pairs]
        found = [one for one, _ in laid]
        vertices, correlation, sigma = (
            np.concatenate([getattr(one, name) for one in found])[self.kept]
            for name in ("vertices", "correlation", "sigma")
        )
        status = np.concatenate([one.status[p.shape.rows] for one, p in zip(found, self.pairs, strict=True)])[self.kept]
        return replace(
            first,
            steps=(self.names[0], self.names[step]),
            vertices=np.stack([first.vertices[0], vertices]),
            correlation=np.stack([first.correlation[0], correlation]),
            sigma_xyz=np.stack([first.sigma_xyz[0], sigma]),
            status=np.stack([first.status[0], status]),
            matches=tuple(_with_step(own, *each) for own, each in zip(first.matches, laid, strict=False)),
        )


def _with_step(at_first: Matches, step: PairStep, found: PairMatches) -> Matches:
    """A pair's matches at the reference and at a step."""
    return replace(
        at_first,
        px=np.stack([at_first.px[0], found.px]),
        c_ls=np.stack([at_first.c_ls[0], found.c_ls]),
        sigma=np.stack([at_first.sigma[0], found.sigma]),
        status=np.stack([at_first.status[0], step.status]),
    )


def _side_by_side(
    rig: str, cameras: Sequence[Camera], pairs: Sequence[PairSurface], reference: str, settings: Settings
) -> Results:
    """The results of the reference alone."""
    shapes = [pair.shape for pair in pairs]
    counts = [len(shape.rows) for shape in shapes]
    offsets = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)
    vertices = np.concatenate([shape.at_first.vertices for shape in shapes])
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
        correlation=np.concatenate([shape.at_first.correlation for shape in shapes])[None].astype(float),
        sigma_xyz=np.concatenate([shape.at_first.sigma for shape in shapes])[None].astype(float),
        status=np.concatenate([shape.at_first.status[shape.rows] for shape in shapes])[None],
        matches=tuple(_at_reference(pair, int(offset)) for pair, offset in zip(pairs, offsets, strict=True)),
        settings=settings.to_toml(),
    )


def _at_reference(pair: PairSurface, offset: int) -> Matches:
    shape, found = pair.shape, pair.at(0)[1]
    vertex = shape.vertex
    return Matches(
        cameras=shape.ids,
        xy=shape.xy,
        px=found.px[None],
        c_ls=found.c_ls[None].astype(float),
        sigma=found.sigma[None].astype(float),
        status=shape.at_first.status[None],
        vertex=np.where(vertex >= 0, vertex + offset, -1),
        seconds=dict(found.seconds),
    )


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
    weights: Floats = np.array([one.points for one in beside], dtype=float)
    weights /= weights.sum()
    mean = float(weights @ [one.mean for one in beside])
    square = float(weights @ [one.mean**2 + one.std**2 for one in beside])
    return {"mismatch_mm": mean, "mismatch_std_mm": float(np.sqrt(square - mean**2)), "mismatches": rows}
