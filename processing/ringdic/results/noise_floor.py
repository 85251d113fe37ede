"""Noise floor of a run: statistics of the displacement and strain measured on captures of the specimen at rest.

Captures of kind ``static`` are tracked as steps right after the reference and left out of the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ringdic.arrays import Floats
from ringdic.results.results import Results
from ringdic.strain.window import strain_window


def noise_floor(at_rest: Sequence[Results]) -> dict[str, Any]:
    """Statistics of displacement, stretch and strain over all captures at rest, as JSON values.

    at_rest : for each capture at rest results of two steps, the reference and that capture.
    Returns a dictionary: ``captures``, ``steps`` : their number and ids. ``moved_mm`` : the largest median displacement
    of a capture, which shows whether the specimen or the cameras did move. ``quantities`` : by name the label, unit,
    mean, std, rms and median of the values and p95 of their magnitudes, None where nothing was measured;
    ``displacement_rest`` among them is the displacement after the rigid motion is removed.
    """
    displacements = [one.vertices[1] - one.vertices_ref for one in at_rest]
    residuals = [one.motion(1).apply(one.vertices[1]) - one.vertices_ref for one in at_rest]
    deformations = [one.deformation(1) for one in at_rest]
    lengths = [np.linalg.norm(each, axis=1) for each in displacements]
    rows: list[tuple[str, str, str, list[Floats]]] = [
        ("displacement", "Displacement", "mm", lengths),
        *(
            (f"displacement_{a}", f"Displacement {a}", "mm", [d[:, i] for d in displacements])
            for i, a in enumerate("xyz")
        ),
        (
            "displacement_rest",
            "Displacement, rigid motion removed",
            "mm",
            [np.linalg.norm(d, axis=1) for d in residuals],
        ),
        ("lambda1", "Smaller stretch λ1 − 1", "", [each.lambda1 - 1.0 for each in deformations]),
        ("lambda2", "Larger stretch λ2 − 1", "", [each.lambda2 - 1.0 for each in deformations]),
        ("E_magnitude", "Green-Lagrange strain, magnitude", "", [each.E_magnitude for each in deformations]),
    ]
    width = at_rest[0].window_mm
    if width > 0:
        window = strain_window(at_rest[0].mesh, width)
        over = [one.deformation(1, window=window).E_magnitude for one in at_rest]
        rows.append(("window_E_magnitude", f"The same over {width:g} mm", "", over))
    return {
        "captures": len(at_rest),
        "steps": [one.steps[1] for one in at_rest],
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
