"""The noise floor of a run: what it measures where nothing happens, from captures of the specimen at rest.

Captures of kind ``static`` are followed as steps right after the reference, then taken out of the results again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ringdic.arrays import Floats
from ringdic.results.results import Results
from ringdic.strain.window import strain_window


def noise_floor(at_rest: Results) -> dict[str, Any]:
    """Statistics over all captures at rest, the steps after the reference, as JSON values.

    ``quantities`` : by name label, unit, mean, std, rms and median of the values and p95 of their magnitudes; None
    where nothing was measured. ``moved_mm`` : the largest median displacement of a capture, which tells of a specimen
    or of cameras that did move. ``displacement_rest`` is what stays after the rigid motion is taken out.
    """
    steps = range(1, len(at_rest.steps))
    moved = [at_rest.vertices[k] - at_rest.vertices_ref for k in steps]
    rest = [at_rest.motion(k).apply(at_rest.vertices[k]) - at_rest.vertices_ref for k in steps]
    alone = [at_rest.deformation(k) for k in steps]
    lengths = [np.linalg.norm(each, axis=1) for each in moved]
    rows: list[tuple[str, str, str, list[Floats]]] = [
        ("displacement", "Displacement", "mm", lengths),
        *((f"displacement_{a}", f"Displacement {a}", "mm", [d[:, i] for d in moved]) for i, a in enumerate("xyz")),
        ("displacement_rest", "Displacement, rigid motion removed", "mm", [np.linalg.norm(d, axis=1) for d in rest]),
        ("lambda1", "Smaller stretch λ1 − 1", "", [found.lambda1 - 1.0 for found in alone]),
        ("lambda2", "Larger stretch λ2 − 1", "", [found.lambda2 - 1.0 for found in alone]),
        ("E_magnitude", "Green-Lagrange strain, magnitude", "", [found.E_magnitude for found in alone]),
    ]
    if at_rest.window_mm > 0:
        window = strain_window(at_rest.mesh, at_rest.window_mm)
        over = [at_rest.deformation(k, window=window).E_magnitude for k in steps]
        rows.append(("window_E_magnitude", f"The same over {at_rest.window_mm:g} mm", "", over))
    return {
        "captures": len(at_rest.steps) - 1,
        "steps": list(at_rest.steps[1:]),
        "moved_mm": max((_median(each) for each in lengths), default=0.0),
        "quantities": {
            name: {"label": label, "unit": unit, **_statistics(np.concatenate(values))}
            for name, label, unit, values in rows
        },
    }


def _median(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def _statistics(values: Floats) -> dict[str, float | None]:
    finite = values[np.isfinite(values)]
    if not len(finite):
        return dict.fromkeys(("mean", "std", "rms", "median", "p95"))
    return {
        "mean": float(finite.mean()),
        "std": float(finite.std()),
        "rms": float(np.sqrt(np.mean(finite**2))),
        "median": float(np.median(finite)),
        "p95": float(np.percentile(np.abs(finite), 95)),
    }
