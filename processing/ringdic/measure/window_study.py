"""Study of the strain window: strain and its scatter as functions of the window's width."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ringdic.arrays import Floats
from ringdic.errors import InputError
from ringdic.measure.table import Table
from ringdic.results.results import Results
from ringdic.settings import settings_of_run
from ringdic.strain.deformation import Deformation
from ringdic.strain.window import Gauge, StrainWindow, strain_window


def window_study(results: Results, widths: Sequence[float], previous: bool = False) -> Table:
    """Strain and its scatter for several widths of the strain window, 0 for triangles alone; a row per width and step.

    ``gauge`` is the length of the virtual strain gauge, mm; ``points`` the median number of points in a window.
    ``E1_p5`` and ``E2_p95`` show how much of a strain peak is left; ``E_magnitude_median`` and ``E_magnitude_p95`` the
    scatter where there is no strain; the standard deviations of λ1 and λ2 contain signal and scatter. A good width
    lowers the scatter and leaves the peaks.

    Raises InputError for a width below 0.
    """
    if not widths or min(widths) < 0:
        raise InputError("give widths of strain windows, in mm, 0 or more")
    rows: list[dict[str, Any]] = []
    for width in widths:
        window = strain_window(results.mesh, width) if width > 0 else None
        strain_gauge = gauge(results, width)
        for step, name in enumerate(results.steps):
            deformation = results.deformation(step, previous=previous, window=window)
            row: dict[str, Any] = {"window": width, "gauge": strain_gauge.length, "points": _points(window)}
            rows.append({**row, "step": step, "capture": name, **_figures(deformation)})
    return Table.of_rows(rows, {"window": "mm", "gauge": "mm"})


def gauge(results: Results, width: float) -> Gauge:
    """The virtual strain gauge of a strain window of ``width`` mm: window, spacing of points and size of a subset.

    The spacing is the median edge of the mesh. The size of a subset is the median over the points, measured across the
    line of sight of the first camera of each point's pair; on a surface seen obliquely it is larger. NaN where no
    camera is known.
    """
    mesh = results.mesh
    edges, _ = mesh.edges()
    step = (
        float(np.median(np.linalg.norm(np.diff(mesh.vertices[edges], axis=1)[:, 0], axis=1))) if len(edges) else np.nan
    )
    radius = settings_of_run(results.settings).correlation.radius_px
    return Gauge(float(width), step, (2 * radius + 1) / results.pixels_per_mm)


def _points(window: StrainWindow | None) -> float:
    return 3.0 if window is None else float(np.median(window.points))


def _figures(deformation: Deformation) -> dict[str, float]:
    quantiles = {
        "lambda1_median": (deformation.lambda1, 50), "lambda2_median": (deformation.lambda2, 50),
        "E1_p5": (deformation.E1, 5), "E2_p95": (deformation.E2, 95),
        "E_magnitude_median": (deformation.E_magnitude, 50), "E_magnitude_p95": (deformation.E_magnitude, 95),
    }  # fmt: skip
    figures = {name: _percentile(values, q) for name, (values, q) in quantiles.items()}
    known = np.isfinite(deformation.J)
    spread = {f"lambda{k}_std": float(np.std(v[known])) if known.any() else float("nan")
              for k, v in ((1, deformation.lambda1), (2, deformation.lambda2))}  # fmt: skip
    return {**figures, **spread, "measured": int(known.sum())}


def _percentile(values: Floats, q: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, q)) if len(finite) else float("nan")
