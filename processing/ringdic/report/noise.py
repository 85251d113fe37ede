"""The report's section on noise: the noise floor from captures at rest, and the stated standard deviations."""

from __future__ import annotations

from typing import Any

from ringdic.report.document import Document, figure
from ringdic.report.gathered import Gathered
from ringdic.results.results import Results

#: Fields that state a standard deviation, and of what.
STATED = {
    "sigma": "position", "sigma_displacement": "displacement", "sigma_lambda1": "stretch λ1",
    "sigma_lambda2": "stretch λ2", "sigma_E1": "strain E1", "sigma_E2": "strain E2",
    "sigma_noise": "position, by the image noise",
    "sigma_displacement_noise": "displacement, by the image noise",
    "sigma_lambda_noise1": "stretch λ1, by the image noise",
    "sigma_lambda_noise2": "stretch λ2, by the image noise",
    "window_sigma_lambda1": "stretch λ1 over the window, by the image noise",
    "window_sigma_lambda2": "stretch λ2 over the window, by the image noise",
    "sigma_calibration": "position, by the calibration",
    "sigma_displacement_calibration": "displacement, by the calibration",
    "sigma_lambda_calibration1": "stretch λ1, by the calibration",
    "sigma_lambda_calibration2": "stretch λ2, by the calibration",
}  # fmt: skip


def noise_rows(results: Results, gathered: Gathered) -> dict[str, str]:
    """Noise floors of displacement and strain, as rows of the analysis table."""
    floor = results.summary.get("noise_floor")
    if floor:
        moved, strain = floor["quantities"]["displacement"], floor["quantities"]["E_magnitude"]
        how = f"from {floor['captures']} captures at rest"
        return {
            "Displacement noise floor": f"{figure(moved['rms'], 3)} mm RMS ({how})",
            "Strain noise floor": f"|E| {figure(strain['median'], 3)} median, {figure(strain['p95'], 3)} at 95 % "
            f"({how})",
        }
    stated = _stated(gathered)
    how = "median of the standard deviation stated for the image noise; no capture at rest"
    rows = {}
    for name, title, symbol, unit in (
        ("sigma_displacement_noise", "Displacement noise floor", "", " mm"),
        ("sigma_lambda_noise2", "Strain noise floor", "λ2 ", ""),
    ):
        if name in stated:
            rows[title] = f"{symbol}{figure(stated[name]['median'], 3)}{unit} ({how})"
        else:
            rows[title] = "not measured: no capture at rest, and this way of evaluation states none"
    return rows


def noise(document: Document, results: Results, gathered: Gathered) -> None:
    """Write the section on noise and uncertainty."""
    floor: dict[str, Any] | None = results.summary.get("noise_floor")
    if floor:
        document.heading("Noise floor from captures at rest")
        document.text(
            f"{floor['captures']} captures of kind 'static' were followed as if they were steps. The surface did not "
            "move: what is measured is noise, and with the rigid motion removed, noise without a common drift. The "
            f"median displacement of a capture is at most {figure(floor['moved_mm'], 3)} mm; one far above what stays "
            "after the rigid motion tells of cameras or of a specimen that did move."
        )
        document.table(
            "noise-floor",
            ("quantity", "unit", "mean", "STD", "RMS", "median", "95 % of magnitudes"),
            (
                (row["label"], row["unit"], *(figure(row[name], 3) for name in ("mean", "std", "rms", "median", "p95")))
                for row in floor["quantities"].values()
            ),
        )
    else:
        document.text(
            "No capture at rest (kind 'static') belongs to this session, so the noise floor was not measured; what "
            "follows is the uncertainty that the measurement states of itself. Capture the specimen at rest once or "
            "twice beside its reference to have the noise floor in this report."
        )
    stated = _stated(gathered)
    if stated:
        document.heading("Stated uncertainty")
        document.table(
            "stated",
            ("standard deviation of", "unit", "median", "95 %"),
            ((STATED[name], row["unit"], figure(row["median"], 3), figure(row["p95"], 3))
             for name, row in stated.items()),
            "Over all points or triangles of the last step. By the image noise: scatter over repeated exposures. By "
            "the calibration: from the covariance of the cameras, an error that all points and steps share. With no "
            "cause named: both together, or the noise alone where the part of the calibration is unknown.",
        )  # fmt: skip
    why = results.summary.get("uncertainty", {}).get("why")
    if why:
        document.text(f"{why[0].upper()}{why[1:]}.")


def _stated(gathered: Gathered) -> dict[str, dict[str, Any]]:
    """Median and 95th percentile of each stated standard deviation at the last step."""
    last = len(gathered.steps) - 1
    return {
        name: {"unit": gathered.scales[name].field.unit, **gathered.statistics[name, last]}
        for name in STATED
        if name in gathered.scales and gathered.statistics[name, last]["measured"]
    }
