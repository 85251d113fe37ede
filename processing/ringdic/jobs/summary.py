"""The summary of a run: counts, quality of the calibration, and figures of every step, as JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ringdic.arrays import Floats
from ringdic.calibration.calibrated_rig import CalibratedRig
from ringdic.calibration.quality import ReconstructionError
from ringdic.findings import Finding, verdict_figures
from ringdic.measure.window_study import gauge
from ringdic.results.fields import available
from ringdic.results.results import Results
from ringdic.results.unmeasured import unmeasured_areas, unmeasured_findings, unmeasured_rows
from ringdic.session.json_values import json_value
from ringdic.strain.deformation import Deformation
from ringdic.strain.rigid_motion import RigidMotion

#: Why the uncertainty due to the calibration is unknown where each camera was calibrated alone.
ALONE = (
    "each camera was calibrated alone, which states no covariance: what the calibration adds to the uncertainty is not "
    "known; with calibration.method=bundle it is"
)


@dataclass(frozen=True)
class StepFigures:
    """Summary of one step: counts, medians and standard deviations.

    row : counts and medians of the step. uncertainty : medians of its standard deviations by cause.
    """

    row: dict[str, Any]
    uncertainty: dict[str, Any]


def summarise(
    reference: Results,
    steps: Sequence[StepFigures],
    rig: CalibratedRig,
    errors: dict[tuple[str, str], ReconstructionError],
    drift: Mapping[str, Floats],
    agreement: Mapping[str, Any],
    findings: tuple[Finding, ...],
    accepted: Sequence[str] = (),
) -> dict[str, Any]:
    """Summarise a run as JSON values; ``table`` holds the rows that the terminal shows.

    Parameters
    ----------
    reference : the results of the reference alone.
    steps : figures of all steps, the reference first.
    rig : the calibrated cameras.
    errors : reconstruction errors of the control points, by pair.
    drift : (F,) px by camera, the mean vertical reprojection residual at each step, which shows cameras that
        moved between the steps.
    agreement : figures of how well the cameras' views of a point, and the charts where they overlap, agree.
    findings : of calibration and matching. accepted : codes of findings that the operator accepts.
    """
    control = {
        "mean_mm": float(np.mean([error.mean for error in errors.values()])),
        "rms_mm": float(np.mean([error.rms for error in errors.values()])),
    }
    last = [step for step in steps if step.row["measured"]][-1]
    area_mm2 = float(reference.mesh.areas.sum())
    unmeasured = unmeasured_areas(reference.unmeasured, area_mm2) if reference.unmeasured else None
    figures = {
        "points": len(reference.vertices_ref),
        "faces": len(reference.faces),
        "pairs": len(reference.pairs),
        "area_mm2": round(area_mm2, 1),
        "unmeasured": unmeasured,
        "control_points": control,
        "cameras": [asdict(row) for row in rig.quality],
        "calibration": _calibration(rig),
        "drift_px": json_value(dict(drift)),
        "agreement": dict(agreement),
        "strain": _strain(reference),
        "uncertainty": {**last.uncertainty, "why": None if rig.bundle is not None else ALONE},
        "steps": [step.row for step in steps],
    }
    findings = (*findings, *unmeasured_findings(unmeasured))
    figures = {**verdict_figures(findings, accepted), **figures}
    return {**figures, "table": _table(figures)}


def step_figures(results: Results, motion: RigidMotion, deformation: Deformation) -> StepFigures:
    """Summarise the last step of some results.

    motion : takes this step back onto the reference. deformation : of this step since the reference.
    """
    last = len(results.steps) - 1
    return StepFigures(_row(results, last, motion, deformation), _uncertainty(results, last))


def _calibration(rig: CalibratedRig) -> dict[str, Any]:
    """Method and quality of the calibration: figures of the pairs and of the adjustment, and advice."""
    return {
        "method": "dlt" if rig.bundle is None else "bundle",
        "pairs": [asdict(row) for row in rig.pairs],
        "bundle": None if rig.bundle is None else rig.bundle.figures(rig.target),
        "advice": list(rig.advice),
    }


def _strain(results: Results) -> dict[str, float | None]:
    """Gauge lengths of the strains, mm: of the triangles, and of the strain window where the run has one."""
    alone = gauge(results, 0.0)
    over = replace(alone, width=results.window_mm)
    return {
        "step_mm": _number(alone.step),
        "subset_mm": _number(alone.subset),
        "gauge_mm": _number(alone.length),
        "window_mm": results.window_mm,
        "window_gauge_mm": _number(over.length) if results.window_mm > 0 else None,
    }


def _uncertainty(results: Results, step: int) -> dict[str, Any]:
    """Medians of the standard deviations at a step, due to noise and to the calibration; None where unknown."""
    arrays = results.quality(step)
    known = {entry.name: entry for entry in available(arrays.names)}

    def row(names: Mapping[str, str]) -> dict[str, float | None]:
        return {what: _median(arrays.scalar(known[n])) if n in known else None for what, n in names.items()}

    return {
        "step": results.steps[step],
        "noise": row(
            {
                "position_mm": "sigma_noise",
                "displacement_mm": "sigma_displacement_noise",
                "stretch": "sigma_lambda_noise2",
            }
        ),
        "calibration": row(
            {
                "position_mm": "sigma_calibration",
                "displacement_mm": "sigma_displacement_calibration",
                "stretch": "sigma_lambda_calibration2",
            }
        ),
    }


def _row(results: Results, step: int, motion: RigidMotion, deformation: Deformation) -> dict[str, Any]:
    """Counts, displacement, rigid motion and medians of the strains of a step."""
    current = results.vertices[step]
    measured = np.isfinite(current).all(axis=1)
    residual = np.linalg.norm(motion.apply(current) - results.vertices_ref, axis=1)
    return {
        "step": results.steps[step],
        "measured": int(measured.sum()),
        "lost": int((~measured).sum()),
        "c_ls_median": _median(results.correlation[step]),
        "displacement_mm": _median(np.linalg.norm(current - results.vertices_ref, axis=1)),
        "rigid_translation_mm": float(np.linalg.norm(np.nanmean(results.vertices_ref - current, axis=0)))
        if measured.any()
        else None,
        "rigid_rotation_deg": float(np.degrees(motion.angle)),
        "rigid_residual_rms_mm": _rms(residual),
        "E_magnitude_median": _median(deformation.E_magnitude),
        "lambda1_median": _median(deformation.lambda1),
        "lambda2_median": _median(deformation.lambda2),
    }


def _table(figures: dict[str, Any]) -> list[dict[str, str]]:
    """The rows of a summary that the terminal and the web page show, as text."""
    control, bundle = figures["control_points"], figures["calibration"]["bundle"]
    agreement, strain = figures["agreement"], figures["strain"]
    rows = [
        ("verdict", figures["verdict"]),
        *((each["verdict"], each["sentence"]) for each in figures["findings"]),
        ("camera pairs, points, triangles", f"{figures['pairs']}, {figures['points']:,}, {figures['faces']:,}"),
        ("measured area", f"{figures['area_mm2'] / 100:,.1f} cm²"),
        *unmeasured_rows(figures["unmeasured"]),
        ("control points: mean vector, RMS", f"{control['mean_mm']:.4f}, {control['rms_mm']:.4f} mm"),
    ]
    if bundle is not None:
        value = f"{bundle['centroid_sigma_px']:.4f} px, {bundle['print_errors_rms_mm']:.3f} mm"
        rows.append(("bundle: centroids, print errors, radius", f"{value}, {bundle['radius_mm']:.3f} mm"))
    if agreement.get("mismatch_mm") is not None:
        value = f"{agreement['mismatch_mm']:.4f} ± {agreement['mismatch_std_mm']:.4f} mm"
        rows.append(("distance between the surfaces where they overlap", value))
    if agreement.get("residual_px") is not None:
        value = f"{agreement['views']:.1f}, {agreement['residual_px']:.4f} px"
        rows.append(("cameras a point, how far they miss it", value))
    if strain["gauge_mm"] is not None:
        value = f"{strain['gauge_mm']:.1f} mm"
        if strain["window_gauge_mm"] is not None:
            value += f", over the window of {strain['window_mm']:g} mm {strain['window_gauge_mm']:.1f} mm"
        rows.append(("a strain averages over (virtual strain gauge)", value))
    for part, cause in (("noise", "image noise"), ("calibration", "calibration")):
        known = figures["uncertainty"][part]
        if None not in known.values():
            value = f"{known['position_mm']:.4f} mm, {known['displacement_mm']:.5f} mm, {known['stretch']:.1e}"
            rows.append((f"standard deviations by the {cause}: place, displacement, λ2", value))
    for step in figures["steps"][1:]:
        known = None not in (step["displacement_mm"], step["lambda1_median"], step["lambda2_median"])
        value = f"{step['lost']:,}"
        if known:
            value = (
                f"{step['displacement_mm']:.3f} mm, {step['lambda1_median']:.4f}, {step['lambda2_median']:.4f}, {value}"
            )
        elif not step["measured"]:
            value = f"nothing measured, {value}"
        rows.append((f"{step['step']}: displacement, λ1, λ2 (medians), lost", value))
    return [{"figure": figure, "value": value} for figure, value in rows]


def _median(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else None


def _rms(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else None


def _number(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
