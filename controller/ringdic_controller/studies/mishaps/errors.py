"""Errors of a run of several steps against the exact truth, and what the stated standard deviations are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ringdic.results.results import Results
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.scenes import SolidSpecimen

from ringdic_controller.studies.gallery.sample import SurfaceSample
from ringdic_controller.studies.solid_errors import SolidErrors, Spread, StatedSpreads, rms

_SAMPLE, _HARDLY = 5000, 0.01  # points of the whole surface, and share of them that is hardly anything
SPREAD, BEYOND = 1.5, 1e-3  # what stated σ must keep: errors over σ (robust), share beyond 5 σ


@dataclass(frozen=True)
class RunErrors:
    """Errors of a run over all its points and steps, those included that are wildly wrong.

    measured : number of points at each step. wrong : share of points off the surface or displaced wrongly by more than
    1 mm at any step. shape_mm : RMS distance from the surface at the reference. displacement_mm, stretch : RMS errors
    over all steps. beyond : share of shape and displacement errors beyond 5 σ. spread : robust, of displacements
    over σ. spreads : of all quantities over σ.
    """

    measured: tuple[int, ...]
    wrong: float
    shape_mm: float
    displacement_mm: float
    stretch: float
    beyond: float
    spread: float
    spreads: StatedSpreads | None = None

    @property
    def holds_in_sigma(self) -> bool:
        """Whether the errors, large or not, are as the stated standard deviations say."""
        return self.beyond <= BEYOND and not self.spread > SPREAD


def run_errors(results: Results, specimens: Sequence[SolidSpecimen]) -> RunErrors:
    """Compare the results of a run with the truth. specimens : the body at each step, the reference first."""
    found = SolidErrors.of(results, specimens)
    length, wrong, spreads = found.length, found.wrong, found.spreads
    return RunErrors(
        measured=(len(found.distance), *(int(each) for each in np.isfinite(length).sum(axis=1))),
        wrong=float(wrong.mean()) if len(wrong) else 0.0,
        shape_mm=rms(found.distance),
        displacement_mm=rms(length),
        stretch=rms(found.stretch),
        beyond=_beyond(spreads.position, spreads.displacement),
        spread=spreads.displacement.robust,
        spreads=spreads,
    )


def uncovered_shares(
    results: Results, specimens: Sequence[SolidSpecimen], cameras: Sequence[VirtualCamera]
) -> dict[str, float]:
    """Share of the true surface that is not covered, 0 to 1, of what each camera and a second one see below 60°, by id.

    specimens : the body at each step. cameras : all of them. The share is 1 for a camera that sees hardly anything
    together with another; that of what any two cameras see has the id "".
    """
    sample = SurfaceSample.of(specimens[0], specimens[-1], cameras, _SAMPLE)
    uncovered = ~sample.covered(results.vertices_ref, results.faces)
    shares = {"": float(uncovered.mean()) if len(uncovered) else 1.0}
    for camera, seen in zip(cameras, specimens[0].visible(cameras, sample.points, sample.normals), strict=True):
        shares[camera.id] = float(uncovered[seen].mean()) if seen.sum() > _HARDLY * _SAMPLE else 1.0
    return shares


def _beyond(*spreads: Spread) -> float:
    """Share of the errors of several quantities that lie beyond 5 σ, NaN where there is no error."""
    known = [each for each in spreads if each.count]
    count = sum(each.count for each in known)
    return sum(each.beyond * each.count for each in known) / count if count else float("nan")
