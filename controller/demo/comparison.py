"""What was measured against what is true: shape, displacement, stretch."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from node_agent.virtual_rig.scenes import Limb
from processing.results import Results, read_results

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """One row: measured minus true. mean and rms (about zero), and the largest; in ``unit``; ``true`` for scale."""

    quantity: str
    step: str
    true: str
    mean: float
    rms: float
    largest: float
    unit: str
    lost: int

    def row(self) -> dict[str, str]:
        """The figure as text."""
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


def compare_with_truth(results_file: Path, limb: Limb) -> list[Figure]:
    """Every step of the results against the limb's formulas; step k of the results is step k of the limb."""
    results = read_results(results_file)
    theta, z, distance = limb.material_coordinates(results.vertices_ref)
    reference = limb.position(theta, z, 0)
    figures = [
        _figure("distance from the surface", "reference", _span(np.hypot(*reference.T[:2]), "mm"), distance, "mm")
    ]
    for step in range(1, len(results.steps)):
        moved = limb.position(theta, z, step) - reference
        error = results.vertices[step] - results.vertices_ref - moved
        length = np.linalg.norm(moved, axis=1)
        name = results.steps[step]
        figures.append(_figure("displacement", name, _span(length, "mm"), np.linalg.norm(error, axis=1), "mm"))
        figures += _stretches(results, step, limb, theta, z)
    return figures


def _stretches(results: Results, step: int, limb: Limb, theta: Array, z: Array) -> list[Figure]:
    """The two principal stretches of the triangles against those at their centres."""
    corners = theta[results.faces]
    corners = corners[:, :1] + np.mod(corners - corners[:, :1] + np.pi, 2 * np.pi) - np.pi
    truth = limb.stretches(corners.mean(axis=1), z[results.faces].mean(axis=1), step)
    found = results.deformation(step)
    return [
        _figure(f"stretch {name}", results.steps[step], _span(true), measured - true, "")
        for name, true, measured in (("λ1", truth[0], found.lambda1), ("λ2", truth[1], found.lambda2))
    ]


def _figure(quantity: str, step: str, true: str, error: Array, unit: str) -> Figure:
    known = error[np.isfinite(error)]
    return Figure(
        quantity,
        step,
        true,
        float(known.mean()),
        float(np.sqrt(np.mean(known**2))),
        float(np.abs(known).max()),
        unit,
        int(len(error) - len(known)),
    )


def _span(values: Array, unit: str = "") -> str:
    digits = 2 if unit else 3
    return f"{values.min():.{digits}f} … {values.max():.{digits}f}"
