"""Errors of a run of several steps against the exact truth, and what the stated standard deviations are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ringdic.results.results import Results
from ringdic_node.virtual_rig.scenes import SolidSpecimen

from ringdic_controller.studies.solid_errors import SolidErrors, Spread, StatedSpreads, rms

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


def _beyond(*spreads: Spread) -> float:
    """Share of the errors of several quantities that lie beyond 5 σ, NaN where there is no error."""
    known = [each for each in spreads if each.count]
    count = sum(each.count for each in known)
    return sum(each.beyond * each.count for each in known) / count if count else float("nan")
