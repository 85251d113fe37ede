"""Errors of a run of several steps against the exact truth, and what the stated standard deviations are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ringdic.arrays import Floats
from ringdic.results.results import Results
from ringdic.strain.deformation import deformation
from ringdic_node.virtual_rig.scenes import SolidSpecimen

from ringdic_controller.studies.gallery.comparison import (
    WRONG,
    Spread,
    normal_sigma,
    total_sigma,
    viewing_directions,
)

FAR = 5.0  # σ, beyond which hardly an error should lie
SPREAD, BEYOND = 1.5, 1e-3  # what stated σ must keep: errors over σ (robust), share beyond 5 σ


@dataclass(frozen=True)
class RunErrors:
    """Errors of a run over all its points and steps, those included that are wildly wrong.

    measured : number of points at each step. wrong : share of points off the surface or displaced wrongly by more than
    1 mm at any step. shape_mm : RMS distance from the surface at the reference. displacement_mm, stretch : RMS errors
    over all steps. beyond : share of shape and displacement errors beyond 5 σ. spread : robust, of displacements
    over σ.
    """

    measured: tuple[int, ...]
    wrong: float
    shape_mm: float
    displacement_mm: float
    stretch: float
    beyond: float
    spread: float

    @property
    def holds_in_sigma(self) -> bool:
        """Whether the errors, large or not, are as the stated standard deviations say."""
        return self.beyond <= BEYOND and not self.spread > SPREAD


def run_errors(results: Results, specimens: Sequence[SolidSpecimen]) -> RunErrors:
    """Compare the results of a run with the truth. specimens : the body at each step, the reference first."""
    xyz, faces = results.vertices_ref, results.faces
    foot, normals, distance = specimens[0].solid.nearest(xyz)
    sigma_xyz = total_sigma(results.sigma_xyz[0], _at(results.sigma_calibration, 0))
    sigma_shape = normal_sigma(sigma_xyz, normals, viewing_directions(results, normals))
    wrong = np.abs(distance) > WRONG
    measured, stretch, ratios = [len(xyz)], [], [np.abs(distance) / sigma_shape]
    moved, over = [], []
    for step in range(1, len(results.steps)):
        true = specimens[step].moved(foot)
        error = results.vertices[step] - xyz - (true - foot)
        length = np.linalg.norm(error, axis=1)
        measured.append(int(np.isfinite(length).sum()))
        wrong |= length > WRONG
        moved.append(length)
        sigma = total_sigma(_at(results.sigma_displacement, step), _at(results.sigma_displacement_calibration, step))
        over.append(error / sigma)
        found, exact = results.deformation(step), deformation(foot, true, faces)
        stretch += [found.lambda1 - exact.lambda1, found.lambda2 - exact.lambda2]
    every = np.concatenate([*ratios, *(np.abs(each).ravel() for each in over)])
    return RunErrors(
        measured=tuple(measured),
        wrong=float(wrong.mean()) if len(wrong) else 0.0,
        shape_mm=_rms([distance]),
        displacement_mm=_rms(moved),
        stretch=_rms(stretch),
        beyond=float((every[np.isfinite(every)] > FAR).mean()),
        spread=Spread.of(np.concatenate(over), np.array(1.0)).robust if over else float("nan"),
    )


def _at(values: Floats | None, step: int) -> Floats | None:
    return None if values is None else values[step]


def _rms(values: Sequence[Floats]) -> float:
    """Root mean square of all finite values of some arrays, in their unit; NaN where there is none."""
    joined = np.concatenate([np.ravel(each) for each in values]) if values else np.empty(0)
    joined = joined[np.isfinite(joined)]
    return float(np.sqrt(np.mean(joined**2))) if joined.size else float("nan")
