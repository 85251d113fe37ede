"""The deforming limb of Fig. 9 compared with its formulas, in clean and in spoilt images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from ringdic.arrays import Floats, Mask
from ringdic.correlation.status import Status
from ringdic.geometry.outliers import LostPoint
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.topology import holes, is_closed_tube, non_manifold_edges, overlap_area
from ringdic.results.results import Results
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.scenes import Specimen

from ringdic_controller.studies.truth import Errors, SurfaceGrid, errors
from ringdic_controller.studies.validate.figures import Figure, Findings

_WRONG = 1.0  # mm
_HOLE = 5.0  # mm²


@dataclass(frozen=True)
class LimbRun:
    """Results of the limb by one way of processing. steps : step of the limb at each step of the results."""

    results: Results
    steps: tuple[int, ...]
    errors: Errors

    @classmethod
    def of(cls, results: Results, scenes: Sequence[Specimen]) -> LimbRun:
        """Compare the results of a run with the truth. scenes : the limb at each step of the results."""
        steps = tuple(scene.step for scene in scenes)
        return cls(results, steps, errors(results, scenes[0].surface, steps))

    @property
    def displacement(self) -> Floats:
        """Length of the error of every point's displacement, (F, N) mm, NaN where lost."""
        return np.asarray(np.linalg.norm(self.errors.displacement, axis=2))

    @property
    def wrong(self) -> int:
        """Number of points whose distance from the surface or error of displacement exceeds one millimetre."""
        off = np.abs(self.errors.distance) > _WRONG
        return int((off | (self.displacement > _WRONG).any(axis=0)).sum())

    def covered(self, grid: SurfaceGrid, step: int) -> Mask:
        """Which cells of the grid lie under triangles measured at a step, (rows, columns) bool."""
        measured = np.isfinite(self.results.vertices[step]).all(axis=1)
        faces = self.results.faces
        return grid.covered(self.errors.theta, self.errors.z, faces[measured[faces].all(axis=1)])


def figure_9(runs: Mapping[str, LimbRun], scenes: Sequence[Specimen], cameras: Sequence[VirtualCamera]) -> Findings:
    """Coverage, shape, displacement, stretches and topology of the limb (Fig. 9)."""
    grid = SurfaceGrid.of(scenes[0])
    visible, _ = grid.views(cameras)
    two = grid.area * (visible.sum(axis=0) >= 2)
    covered = {way: float(100 * two[run.covered(grid, 0)].sum() / two.sum()) for way, run in runs.items()}
    distance = {way: _rms(run.errors.distance) for way, run in runs.items()}
    wrong = {way: float(run.wrong) for way, run in runs.items()}
    moved = {way: max(_rms(run.displacement[k]) for k in range(1, len(run.steps))) for way, run in runs.items()}
    stretch = {way: float(np.nanmax(np.nanstd(run.errors.stretches[1:], axis=1))) for way, run in runs.items()}
    bias = {way: float(np.nanmax(np.abs(np.nanmean(run.errors.stretches[1:], axis=1)))) for way, run in runs.items()}
    closed = {way: float(is_closed_tube(run.results.mesh, _HOLE)) for way, run in runs.items()}
    lost = {way: float(100 * (1 - np.isfinite(run.displacement[1:]).mean())) for way, run in runs.items()}
    figures = (
        Figure("Fig. 9", "covered of what two cameras see under 60°", "%", covered, "", 98.0, least=True, digits=2),
        Figure("Fig. 9", "points wrong by more than 1 mm", "", wrong, "", 0.0, digits=0),
        Figure("Fig. 9", "distance from the true surface, RMS", "mm", distance),
        Figure("Fig. 9", "displacement, RMS, worst step", "mm", moved, "", 0.005),
        Figure("Fig. 9", "stretches, STD, worst step", "", stretch, "", 1.1e-3, digits=5),
        Figure("Fig. 9", "stretches, |mean|, worst step", "", bias, digits=5),
        Figure("Fig. 9", "points lost after the reference", "%", lost, digits=2),
        Figure("Fig. 9", "one closed tube", "", closed, "", 1.0, least=True, digits=0),
        *_topology({way: run.results.mesh for way, run in runs.items()}),
    )
    curves = {
        way: {
            "displacement": [_rms(run.displacement[k]) for k in range(1, len(run.steps))],
            "stretches": np.nanstd(run.errors.stretches[1:], axis=1).tolist(),
            "theta": run.errors.theta,
            "z": run.errors.z,
            "error": run.displacement[-1],
        }
        for way, run in runs.items()
    }
    return Findings(figures, curves)


def compare_spoilt(
    runs: Mapping[str, LimbRun],
    clean: Mapping[str, LimbRun],
    scenes: Sequence[Specimen],
    cameras: Sequence[VirtualCamera],
) -> Findings:
    """Wrong and lost points of the limb in images with worn speckles, reflections, bars and JPEG.

    An area is spoilt where a bar, a reflection or a worn patch hides it from a camera that sees it at less than 60° to
    the normal, at the reference or at the step. It is blind where fewer than two cameras see it unspoilt at both. It is
    lost where the run of undisturbed images (``clean``) covers it and this one does not.
    """
    grids = [SurfaceGrid.of(scene) for scene in scenes]
    views = [grid.views(cameras) for grid in grids]
    seen = views[0][0] & views[-1][0]
    unspoilt = views[0][1] & views[-1][1]
    area, known = grids[0].area, seen.sum(axis=0) >= 2
    hit, blind = known & (seen & ~unspoilt).any(axis=0), known & (unspoilt.sum(axis=0) < 2)
    lost: dict[str, float] = {}
    gone: dict[str, Mask] = {}
    reasons = []
    for way, run in runs.items():
        last = clean[way].steps.index(run.steps[-1])
        gone[way] = clean[way].covered(grids[0], last) & ~run.covered(grids[0], -1) & known
        lost[way] = float(area[gone[way]].sum())
        reasons.append(f"{way}: {_reasons(run.results)}")
    wrong = {way: float(run.wrong) for way, run in runs.items()}
    rms = {way: _rms(run.displacement[-1]) for way, run in runs.items()}
    worst = {way: float(np.nanmax(run.displacement[-1])) for way, run in runs.items()}
    named = {way: float(_unnamed(run.results)) for way, run in runs.items()}
    any_view, no_view = float(area[hit].sum()), float(area[blind].sum())
    spoilt_area, blind_area = dict.fromkeys(runs, any_view / 100), dict.fromkeys(runs, no_view / 100)
    lost_area = {way: value / 100 for way, value in lost.items()}
    to_spoilt = {way: value / any_view for way, value in lost.items()}
    to_blind = {way: value / no_view for way, value in lost.items()}
    what = "spoilt images"
    figures = (
        Figure(what, "points wrong by more than 1 mm", "", wrong, "", 0.0, digits=0),
        Figure(what, "displacement, RMS", "mm", rms),
        Figure(what, "displacement, largest error", "mm", worst, digits=3),
        Figure(what, "spoilt area, in any view", "cm²", spoilt_area, digits=1),
        Figure(what, "blind area, fewer than two clean views", "cm²", blind_area, digits=1),
        Figure(what, "lost area", "cm²", lost_area, digits=1),
        Figure(what, "lost / spoilt area", "", to_spoilt, "", 1.2, digits=2),
        Figure(what, "lost / blind area", "", to_blind, "", 1.2, digits=2),
        Figure(what, "lost points without a reason", "", named, "", 0.0, digits=0, note="; ".join(reasons)),
    )
    return Findings(figures, {"hit": hit, "blind": blind, "grid": grids[0], "lost": gone})


def _topology(meshes: Mapping[str, Mesh]) -> list[Figure]:
    """Figures of the mesh's faults: non-manifold edges, holes, area covered twice."""
    edges = {way: float(len(non_manifold_edges(mesh))) for way, mesh in meshes.items()}
    gaps = {way: float(len(holes(mesh, _HOLE))) for way, mesh in meshes.items()}
    twice = {way: float(overlap_area(mesh, 2.0)) for way, mesh in meshes.items()}
    return [
        Figure("Fig. 9", "non-manifold edges", "", edges, "", 0.0, digits=0),
        Figure("Fig. 9", "holes above 5 mm²", "", gaps, "", 0.0, digits=0),
        Figure("Fig. 9", "area covered twice", "mm²", twice, "", 0.0, digits=1),
    ]


def _unnamed(results: Results) -> int:
    """Number of points that are lost without a status that says why."""
    lost = ~np.isfinite(results.vertices).all(axis=2)
    return int((lost & (results.status == 0)).sum())


def _reasons(results: Results) -> str:
    """Number of lost points by reason, as text."""
    names = {int(each): each.name.lower() for kind in (Status, LostPoint) for each in kind}
    counts = Counter(results.status[results.status != 0].tolist())
    return ", ".join(f"{count:,} {names.get(code, code)}" for code, count in counts.most_common()) or "none lost"


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
