"""The tables that a report of a measurement by image correlation must have (iDICs, Good Practices Guide, 2018)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ringdic.correlation.status import Status
from ringdic.geometry.outliers import LostPoint
from ringdic.measure.window_study import gauge
from ringdic.report.document import UNKNOWN, Document, figure
from ringdic.report.hardware import CameraFacts
from ringdic.results.results import Results
from ringdic.session.folder import Capture, Session
from ringdic.settings import settings_of_run

_REASONS: dict[int, str] = {
    Status.GOOD: "measured",
    Status.NOT_REACHED: "no start value led to it",
    Status.NO_CONVERGENCE: "the iteration did not settle",
    Status.LOW_ZNCC: "the images do not look alike there",
    Status.INCONSISTENT: "it contradicts its neighbours",
    Status.OUTSIDE: "it left the image",
    Status.NO_TEXTURE: "too little pattern, or too few pixels inside the mask",
    Status.AMBIGUOUS: "the pattern repeats itself there",
    LostPoint.RESIDUAL: "its cameras contradict one another, or too few see it",
    LostPoint.UNCERTAIN: "its match is too uncertain",
    LostPoint.SURFACE: "it stands out of the surface",
}


def hardware(document: Document, session: Session, results: Results, cameras: Sequence[CameraFacts]) -> None:
    """Write the tables of cameras, optics and pattern."""
    document.facts("hardware-table", _hardware(session, results, cameras))
    document.table(
        "cameras",
        ("camera", "image, px", "focal length, px", "stand-off, mm", "field of view, mm", "px/mm", "exposure, µs",
         "gain", "speckle, px", "speckle, mm", "contrast", "noise"),
        (
            (each.camera, f"{each.size[0]} × {each.size[1]}", figure(each.focal, 5), figure(each.stand_off),
             UNKNOWN if each.field is None else f"{each.field[0]:.0f} × {each.field[1]:.0f}", figure(each.scale),
             figure(each.exposure), figure(each.gain), figure(each.speckle, 3), figure(each.speckle_mm, 3),
             figure(each.contrast, 3), figure(each.noise, 3))
            for each in cameras
        ),
        "Each camera over the points that it sees squarely at the reference. Speckle: width of the autocorrelation's "
        "peak at half height. Contrast and noise: standard deviations of the grey levels; noise "
        + ("from captures at rest." if any(each.at_rest for each in cameras) else
           "from the flattest places of one image: an upper bound for a fine pattern, a lower one for a compressed "
           "image."),
    )  # fmt: skip


def _hardware(session: Session, results: Results, cameras: Sequence[CameraFacts]) -> dict[str, Any]:
    angles = [row["angle_deg"] for row in results.summary.get("calibration", {}).get("pairs", [])]
    captures = [capture for capture in session.captures if capture.id in results.steps]
    skew = [capture.record.skew_ns / 1e3 for capture in captures if capture.record.skew_ns is not None]
    return {
        "Cameras": f"{len(cameras)} in a ring, {len(results.pairs)} pairs ({_pairs(results)})",
        "Camera model": None,
        "Image size": _span({f"{each.size[0]} × {each.size[1]} px" for each in cameras}),
        "Lens": _of(cameras, "focal", "px focal length as calibrated", 5),
        "Aperture": None,
        "Field of view": _fields(cameras),
        "Image scale": _of(cameras, "scale", "px/mm"),
        "Stereo angle": None if not angles else f"{_range(angles, 3)}° between the cameras of a pair",
        "Stand-off distance": _of(cameras, "stand_off", "mm"),
        "Image acquisition": f"{len(captures)} stills on a trigger{_interval(captures)}",
        "Synchronisation": None if not skew else f"largest spread of the exposures' times in a step {max(skew):.0f} µs",
        "Exposure": _of(cameras, "exposure", "µs"),
        "Patterning technique": None,
        "Pattern feature size": _of(cameras, "speckle", "px", 3) and
        f"{_of(cameras, 'speckle', 'px', 3)}, {_of(cameras, 'speckle_mm', 'mm', 3)} (measured)",
        "Image noise": _of(cameras, "noise", "grey levels", 3),
    }  # fmt: skip


def analysis(document: Document, results: Results, version: str, floor: dict[str, str]) -> None:
    """Write the table of the analysis. floor : rows of the noise floors."""
    settings = settings_of_run(results.settings)
    correlation, surface = settings.correlation, settings.surface
    alone, over = gauge(results, 0.0), gauge(results, results.window_mm)
    width = 2 * correlation.radius_px + 1
    shape = {1: "affine (first order)", 2: "quadratic (second order)"}[correlation.order]
    if settings.method == "best":
        shape = "affine (first order); between cameras with the curvature of the measured surface held, in time with "
        shape += "that of the neighbours' displacements"
    window = "none: each triangle alone" if not settings.strain.window_mm else f"{settings.strain.window_mm:g} mm"
    document.facts(
        "analysis-table",
        {
            "Software": f"RingDIC {version}",
            "Image filtering": "none",
            "Subset size": f"{width} px across ({correlation.subset}), {figure(alone.subset, 3)} mm on the surface",
            "Step size": f"{correlation.step_px} px; median edge of the mesh {figure(alone.step, 3)} mm",
            "Subset shape function": shape,
            "Matching criterion": "zero-mean normalised sum of squared differences, C_LS = 2 (1 − ZNCC); inverse "
            f"compositional Gauss-Newton, least ZNCC {correlation.zncc_min:g}",
            "Interpolation": f"{correlation.interpolation} B-spline",
            "Surface": {
                "best": "each camera's part of the surface, every point from all cameras that see it",
                "paper": "each camera pair's surface",
            }[settings.method]
            + f"; overlaps merged: {surface.merge}",
            "Steepest view used": f"{surface.incidence_deg:g}° to the surface's normal",
            "Strain window": window,
            "Virtual strain gauge": f"{figure(alone.length, 3)} mm by the triangle"
            + (f", {figure(over.length, 3)} mm over the window" if results.window_mm else ""),
            "Strain formulation": "from the deformation gradient of each triangle (Solav et al. 2018): stretches, "
            "Green-Lagrange, Euler-Almansi, Hencky, Biot",
            "Post-filtering of strains": "none",
            **floor,
        },
    )


def calibration(document: Document, session: Session, results: Results) -> None:
    """Write the tables of the calibration and its quality."""
    document.facts("calibration-table", _calibration(session, results))
    document.table(
        "camera-calibration",
        ("camera", "azimuth, °", "off nominal, °", "dots", "left out", "dots' residual, px", "board views used",
         "board residual, px", "image covered", "residual distortion, px", "lens error, px"),
        (
            (row["camera"], f"{row['azimuth_deg']:.1f}", f"{row.get('azimuth_off_deg', float('nan')):+.1f}",
             row["dots"], row["left_out"], figure(row["residual_rms"], 3),
             f"{row['board_views_used']} of {row['board_views']}", figure(row["board_rms"], 3),
             _percent(row.get("board_coverage")), figure(row.get("residual_distortion"), 3),
             figure(row.get("lens_error"), 3))
            for row in results.summary.get("cameras", [])
        ),
        "RMS distances. Lens error: how far the standard errors of the lens shift the dots' images.",
    )  # fmt: skip
    figures = results.summary.get("calibration", {})
    rows = [
        (" – ".join(row["pair"]), row["points"], figure(row["mean"], 3), figure(row["rms"], 3),
         f"{row['angle_deg']:.1f}", figure(row["epipolar_rms"], 3))
        for row in figures.get("pairs", [])
    ] or [
        (" – ".join(row["pair"]), row["points"], figure(row["mean_mm"], 3), figure(row["rms_mm"], 3), "–", "–")
        for row in results.calibration.get("pairs", [])
    ]  # fmt: skip
    document.table(
        "pair-calibration",
        ("pair", "dots in common", "mean vector, mm", "RMS, mm", "angle, °", "epipolar residual, px"),
        rows,
        "Control points reconstructed by each pair, held out of the calibration in turn, against their places.",
    )
    if figures.get("advice"):
        document.heading("What would make it better")
        document.sentences(figures["advice"])


def _calibration(session: Session, results: Results) -> dict[str, Any]:
    """Method, lens, board and target of the calibration, and how well the control points are reconstructed."""
    summary, target, board = results.summary, session.rig.target, session.rig.board
    settings = settings_of_run(results.settings).calibration
    methods = {"dlt": "direct linear transformation, each camera alone",
               "bundle": "all cameras, lenses and the target adjusted together (bundle), from the direct linear "
               "transformation"}  # fmt: skip
    control = summary.get("control_points", {})
    facts: dict[str, Any] = {
        "Method": methods[settings.method],
        "Lens": "measured on the checkerboard: "
        + ", ".join(sorted({row["lens_terms"] for row in summary.get("cameras", []) if row.get("lens_terms")}))
        if settings.distortion
        else "distortion not corrected",
        "Checkerboard": f"{board.squares[0]} × {board.squares[1]} squares of {board.square_mm:g} mm",
        "Target": f"cylinder of radius {target.radius_mm:g} mm, {target.rows} × {target.columns} dots "
        f"({target.dot_shape}, {target.dot_size_mm:g} mm)",
        "Control points, all pairs": f"mean vector {figure(control.get('mean_mm'))} mm, RMS "
        f"{figure(control.get('rms_mm'))} mm",
    }
    bundle = summary.get("calibration", {}).get("bundle")
    if bundle:
        facts |= {
            "Centroids of the dots": f"{figure(bundle['centroid_sigma_px'], 3)} px (standard deviation)",
            "Print errors": f"RMS {figure(bundle['print_errors_rms_mm'], 3)} mm, largest "
            f"{figure(bundle['print_errors_largest_mm'], 3)} mm",
            "Target as adjusted": f"radius {bundle['radius_mm']:.3f} mm, pitch {bundle['pitch_mm']:.3f} mm, seam "
            f"{bundle['seam_mm']:.3f} mm, turn of the sheet {bundle['tilt_deg']:.3f}°",
        }
    return facts


def steps(document: Document, session: Session, results: Results) -> None:
    """Write the tables of the steps: captures, measured and lost points by reason, residuals."""
    captures = {capture.id: capture for capture in session.captures}
    document.table(
        "steps",
        ("step", "capture", "opened", "measured", "lost", "C_LS, median", "displacement, mm", "rigid translation, mm",
         "rigid rotation, °", "rest after it, RMS mm", "λ1", "λ2", "|E|"),
        (
            (k, row["step"], _opened(captures.get(row["step"])), row["measured"], row["lost"],
             figure(row["c_ls_median"], 3), figure(row["displacement_mm"]), figure(row["rigid_translation_mm"]),
             figure(row["rigid_rotation_deg"], 3), figure(row["rigid_residual_rms_mm"], 3),
             figure(row["lambda1_median"], 5), figure(row["lambda2_median"], 5), figure(row["E_magnitude_median"], 3))
            for k, row in enumerate(results.summary.get("steps", []))
        ),
        "Displacement, stretches and strain: medians over the surface.",
    )  # fmt: skip
    document.heading("Points lost, by reason")
    present = [int(status) for status in np.unique(results.status)]
    document.table(
        "lost",
        ("step", *(_REASONS.get(status, f"status {status}") for status in present)),
        ((name, *(int((results.status[k] == status).sum()) for status in present))
         for k, name in enumerate(results.steps)),
        "Numbers of points of the surface found at the reference; what has no point there is not counted.",
    )  # fmt: skip
    drift = results.summary.get("drift_px", {})
    if drift:
        document.heading("Cameras at rest?")
        document.table(
            "drift",
            ("step", *drift),
            ((name, *(figure(values[k], 2) for values in drift.values())) for k, name in enumerate(results.steps)),
            "Mean residual across the epipolar lines, px: what a camera that moved between steps leaves.",
        )


def _pairs(results: Results) -> str:
    return ", ".join("–".join(pair) for pair in results.pairs)


def _of(cameras: Sequence[CameraFacts], name: str, unit: str, digits: int = 4) -> str | None:
    values = [getattr(each, name) for each in cameras if getattr(each, name) is not None]
    return f"{_range(values, digits)} {unit}" if values else None


def _range(values: Sequence[float], digits: int) -> str:
    low, high = figure(min(values), digits), figure(max(values), digits)
    return low if low == high else f"{low} to {high}"


def _fields(cameras: Sequence[CameraFacts]) -> str | None:
    known = [each.field for each in cameras if each.field is not None]
    return f"{np.mean(known, axis=0)[0]:.0f} × {np.mean(known, axis=0)[1]:.0f} mm (mean)" if known else None


def _span(values: set[str]) -> str:
    return ", ".join(sorted(values))


def _interval(captures: Sequence[Capture]) -> str:
    times = [capture.record.fire_at_ns for capture in captures]
    if len(times) < 2 or any(time is None for time in times):
        return ", times not recorded"
    apart = np.diff(np.array(times, dtype=float)) / 1e9
    return f", {figure(float(apart.min()), 3)} to {figure(float(apart.max()), 3)} s apart"


def _opened(capture: Capture | None) -> str:
    text = "" if capture is None else capture.record.opened_at or ""
    return text[:19].replace("T", " ")


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"
