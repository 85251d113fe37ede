"""The demo's results compared with the truth of the virtual rig: shape, displacement, stretch."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ringdic.arrays import Floats
from ringdic.results.reader import read_results
from ringdic_node.virtual_rig.scenes import Limb

from ringdic_controller.studies.truth import errors, face_centroids


@dataclass(frozen=True)
class TruthFigure:
    """Error, measured minus true, of one quantity at one step, over all points or triangles.

    mean, rms (about zero), largest : in ``unit``. true : range of the true values, as text. lost : number not measured.
    """

    quantity: str
    step: str
    true: str
    mean: float
    rms: float
    largest: float
    unit: str
    lost: int

    def row(self) -> dict[str, str]:
        """The figure as a row of a table, in text."""
        digits = 4 if self.unit == "mm" else 5
        return {
            "measured − true": self.quantity,
            "step": self.step,
            "true values": self.true,
            "mean": f"{self.mean:+.{digits}f}",
            "RMS": f"{self.rms:.{digits}f}",
            "largest": f"{self.largest:.{digits}f}",
            "unit": self.unit or "–",
            "lost": f"{self.lost:,}",
        }

    def to_dict(self) -> dict[str, Any]:
        """The figure as JSON values."""
        return asdict(self)


def compare_with_truth(results_file: Path, limb: Limb) -> list[TruthFigure]:
    """Errors of shape, displacement and stretches at every step against the limb's formulas.

    Step k of the results must be step k of the limb.
    """
    results = read_results(results_file)
    deviations = errors(results, limb)
    reference = limb.position(deviations.theta, deviations.z, 0)
    radii = _span(np.hypot(*reference.T[:2]), "mm")
    figures = [_figure("distance from the surface", "reference", radii, deviations.distance, "mm")]
    middles = face_centroids(deviations.theta, deviations.z, results.faces)
    for step, name in list(enumerate(results.steps))[1:]:
        length = np.linalg.norm(limb.position(deviations.theta, deviations.z, step) - reference, axis=1)
        error = np.linalg.norm(deviations.displacement[step], axis=1)
        figures.append(_figure("displacement", name, _span(length, "mm"), error, "mm"))
        for k, true in enumerate(limb.stretches(*middles, step)):
            figures.append(_figure(f"stretch λ{k + 1}", name, _span(true), deviations.stretches[step, :, k], ""))
    return figures


def _figure(quantity: str, step: str, true: str, error: Floats, unit: str) -> TruthFigure:
    known = error[np.isfinite(error)]
    return TruthFigure(
        quantity,
        step,
        true,
        float(known.mean()),
        float(np.sqrt(np.mean(known**2))),
        float(np.abs(known).max()),
        unit,
        int(len(error) - len(known)),
    )


def _span(values: Floats, unit: str = "") -> str:
    digits = 2 if unit else 3
    return f"{values.min():.{digits}f} … {values.max():.{digits}f}"
