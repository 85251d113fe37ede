"""The speckled cylinder of 114.00 mm: its diameter, the merging of Fig. 7a, the steps of Fig. 7b."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from ringdic.arrays import Floats
from ringdic.geometry.camera import Camera
from ringdic.results.results import Results
from ringdic_node.virtual_rig.scenes import Cylinder

from ringdic_controller.studies.truth import errors
from ringdic_controller.studies.validate.calibration import ExactRays
from ringdic_controller.studies.validate.figures import BETTER, PAPER, Figure, Findings
from ringdic_controller.studies.validate.shapes import fitted_cylinder
from ringdic_controller.studies.validate.tracks import Tracks, mismatch

TRUE = 114.0  # mm
ALL, PAIRS = "all views", "pairs"


@dataclass(frozen=True)
class CylinderRun:
    """Results of the speckled cylinder by one way of processing. cameras : as calibrated by this way, by id."""

    results: Results
    cameras: Mapping[str, Camera]
    tracks: Tracks

    @classmethod
    def of(cls, results: Results) -> CylinderRun:
        """Take cameras and matches from the results of a run."""
        return cls(results, {camera.id: camera for camera in results.cameras}, Tracks.of(results))

    def cloud(self, pairs: tuple[tuple[str, str], ...], step: int | None = None) -> Floats:
        """Points triangulated by each camera pair alone, (P, N, 3) mm, NaN where the pair has no match.

        step : of the tracking in time; None for the reference as matched between the cameras.
        """
        return np.stack([self.tracks.of_pair(self.cameras, pair, step) for pair in pairs])


def diameter(runs: Mapping[str, CylinderRun], pairs: tuple[tuple[str, str], ...]) -> Findings:
    """Diameter of the fitted cylinder and standard deviation of twice the points' radii."""
    fits = {way: fitted_cylinder(run.results.vertices_ref) for way, run in runs.items()}
    single = {way: fitted_cylinder(np.concatenate(run.cloud(pairs))) for way, run in runs.items()}
    bias = {way: fit.diameter - TRUE for way, fit in fits.items()}
    figures = (
        Figure("diameter", f"bias, {ALL}", "mm", bias, "−0.07", 0.003),
        Figure("diameter", f"STD, {ALL}", "mm", {way: fit.spread for way, fit in fits.items()}, "0.27", 0.005),
        Figure("diameter", f"bias, {PAIRS}", "mm", {w: f.diameter - TRUE for w, f in single.items()}, "−0.07", 0.003),
        Figure("diameter", f"STD, {PAIRS}", "mm", {way: fit.spread for way, fit in single.items()}, "0.27", 0.008),
    )
    return Findings(figures, {way: {"radii": 0.5 * fit.diameter + fit.radial} for way, fit in fits.items()})


def figure_7a(runs: Mapping[str, CylinderRun], pairs: tuple[tuple[str, str], ...]) -> Findings:
    """Merging mismatch: the distance between points measured by two pairs that share a camera (Fig. 7a)."""
    distances = {way: mismatch(run.tracks, run.cameras, pairs) for way, run in runs.items()}
    mean = {way: float(each.mean()) for way, each in distances.items() if len(each)}
    spread = {way: float(each.std()) for way, each in distances.items() if len(each)}
    figures = (
        Figure("Fig. 7a", "merging mismatch, mean", "mm", mean, "0.06", 0.005),
        Figure("Fig. 7a", "merging mismatch, STD", "mm", spread, "0.03"),
    )
    return Findings(figures, distances)


@dataclass(frozen=True)
class _Steps:
    """Errors of each step: mean and std of displacement, (F - 1, 3) mm; strain (F - 1, 2): median and 95 % of |E|."""

    mean: Floats
    std: Floats
    strain: Floats


def figure_7b(runs: Mapping[str, CylinderRun], surface: Cylinder, pairs: tuple[tuple[str, str], ...]) -> Findings:
    """Displacement and strain of each rigid step of 0.1 mm against the reference; true strain is zero (Fig. 7b)."""
    every = {way: _all_views(run, surface) for way, run in runs.items()}
    single = {way: _from_pairs(run, surface, pairs) for way, run in runs.items()}
    figures: list[Figure] = []
    for name, steps_of, std_limit in ((ALL, every, 0.0007), (PAIRS, single, 0.001)):
        for when, rows in (("first step", slice(0, 1)), ("worst of all steps", slice(None))):
            mean = {way: float(np.abs(each.mean[rows]).max()) for way, each in steps_of.items()}
            std = {way: float(each.std[rows].max()) for way, each in steps_of.items()}
            figures += [
                Figure("Fig. 7b", f"displacement, |mean|, {name}, {when}", "mm", mean, "0.01", 0.0003, digits=5),
                Figure("Fig. 7b", f"displacement, STD, {name}, {when}", "mm", std, "0.01", std_limit, digits=5),
            ]
    for when, rows in (("first step", slice(0, 1)), ("worst of all steps", slice(None))):
        median = {way: float(each.strain[rows, 0].max()) for way, each in every.items()}
        high = {way: float(each.strain[rows, 1].max()) for way, each in every.items()}
        figures += [
            Figure("Fig. 7b", f"|E|, median, {when}", "", median, "1e-3", 3.2e-4, digits=6),
            Figure("Fig. 7b", f"|E|, 95 %, {when}", "", high, "", 6.5e-4, digits=6),
        ]
    curves: dict[str, Any] = {
        way: {"mean": each.mean, "std": each.std, "strain": each.strain} for way, each in every.items()
    }
    return Findings(tuple(figures), curves)


def separate_errors(
    runs: Mapping[str, CylinderRun], rays: ExactRays, true: Mapping[str, Camera], uncorrected: Mapping[str, Camera]
) -> Findings:
    """Diameter errors of the calibration and of the matching, each without the other.

    The calibration is applied to exact pixels (``rays``), the matches are triangulated with the true cameras.
    uncorrected : the paper's cameras without correction of distortion.
    """
    calibration = {way: rays.diameter_bias(run.cameras) for way, run in runs.items()}
    matching = {way: fitted_cylinder(run.tracks.reconstruct(true)).diameter - TRUE for way, run in runs.items()}
    both = {way: fitted_cylinder(run.tracks.reconstruct(run.cameras)).diameter - TRUE for way, run in runs.items()}
    figures = [
        Figure("apart", "diameter, exact lines of sight, this calibration", "mm", calibration, note="centre model"),
        Figure("apart", "diameter, this matching, true cameras", "mm", matching, note="order of the subset"),
        Figure("apart", "diameter, this matching, this calibration", "mm", both),
    ]
    if PAPER in runs:
        crossed = (
            {"paper's matching, better calibration": runs[PAPER].tracks.reconstruct(runs[BETTER].cameras)}
            if (BETTER in runs)
            else {}
        )
        crossed["paper's matching, no correction of distortion"] = runs[PAPER].tracks.reconstruct(uncorrected)
        for name, points in crossed.items():
            fit = fitted_cylinder(points)
            paper = ("−0.09", "0.56") if "distortion" in name else ("", "")
            figures += [
                Figure("apart", f"diameter bias, {name}", "mm", {PAPER: fit.diameter - TRUE}, paper[0]),
                Figure("apart", f"diameter STD, {name}", "mm", {PAPER: fit.spread}, paper[1]),
            ]
    return Findings(tuple(figures))


def diameter_with_print_errors(runs: Mapping[str, CylinderRun]) -> Findings:
    """Diameter error after a calibration with a target whose dots have print errors."""
    bias = {way: fitted_cylinder(run.results.vertices_ref).diameter - TRUE for way, run in runs.items()}
    return Findings((Figure("print errors 0.03 mm", "diameter bias", "mm", bias, "", 0.005),))


def _all_views(run: CylinderRun, surface: Cylinder) -> _Steps:
    deviations = errors(run.results, surface)
    steps = range(1, len(run.results.steps))
    strain = []
    for step in steps:
        magnitude = run.results.deformation(step).E_magnitude
        strain.append([np.nanmedian(magnitude), np.nanpercentile(magnitude, 95)])
    return _Steps(
        np.array([np.nanmean(deviations.displacement[step], axis=0) for step in steps]),
        np.array([np.nanstd(deviations.displacement[step], axis=0) for step in steps]),
        np.array(strain),
    )


def _from_pairs(run: CylinderRun, surface: Cylinder, pairs: tuple[tuple[str, str], ...]) -> _Steps:
    """Errors of each step when every camera pair triangulates on its own."""
    mean, std = [], []
    before = run.cloud(pairs, 0)
    for step in range(1, len(run.results.steps)):
        error = run.cloud(pairs, step) - before - step * np.array(surface.per_step)
        mean.append(np.nanmean(error, axis=(0, 1)))
        std.append(np.nanstd(error, axis=(0, 1)))
    return _Steps(np.array(mean), np.array(std), np.zeros((0, 2)))
