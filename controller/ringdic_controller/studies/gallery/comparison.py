"""A run of the gallery compared with the truth: what is covered, how wrong it is, and what the stated σ is worth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from ringdic.arrays import Floats, Mask, Vectors
from ringdic.results.results import Results
from ringdic_node.virtual_rig.scenes import SolidSpecimen

from ringdic_controller.studies.gallery.sample import SurfaceSample
from ringdic_controller.studies.solid_errors import SolidErrors, StatedSpreads, rms

COVERED, SHAPE, SPREAD = 0.97, 1.3, (0.80, 1.25)  # what is aimed at


@dataclass(frozen=True)
class RowFigures:
    """Figures of one row of the gallery.

    seen_cm2 : area that two cameras see below 60°. covered : share of it under measured triangles; covered_later : of
    what two cameras see before and after the motion, the share under triangles measured at both. points : number
    measured; wrong : of these, off the surface or displaced wrongly by more than 1 mm. shape_mm : RMS distance of the
    others from the surface. displacement_mm : RMS of their error. stretch_rms : of the stretches' errors. spreads :
    errors of all points over their stated standard deviations.
    """

    seen_cm2: float
    covered: float
    covered_later: float
    points: int
    wrong: int
    shape_mm: float
    displacement_mm: float
    stretch_rms: float
    spreads: StatedSpreads

    @property
    def missed(self) -> list[str]:
        """Names of the aims that are not reached."""
        low, high = SPREAD
        reached = {
            "coverage": self.covered >= COVERED,
            "wrong points": self.wrong == 0,
            "shape": self.spreads.position.plain <= SHAPE,
            "displacement": low <= self.spreads.displacement.robust <= high,
            "stretches": low <= self.spreads.stretch.robust <= high,
        }
        return [name for name, each in reached.items() if not each]


@dataclass(frozen=True)
class JudgedRun:
    """A run compared with the truth.

    figures : its row. normals : (N, 3) unit vectors of the surface at the vertices. distance : (N,) mm of the vertices
    from the surface, outside positive. displacement : (N,) mm, length of the error, NaN where lost. covered : (n,) of
    the sample's points.
    """

    figures: RowFigures
    normals: Vectors
    distance: Floats
    displacement: Floats
    sample: SurfaceSample
    covered: Mask = field(repr=False)


def judged(results: Results, before: SolidSpecimen, after: SolidSpecimen, sample: SurfaceSample) -> JudgedRun:
    """Compare the results of a run of two steps with the truth.

    before, after : the body at the reference and at the second step.
    """
    found = SolidErrors.of(results, (before, after))
    xyz, faces, length, wrong = results.vertices_ref, results.faces, found.length[0], found.wrong
    stretch = found.stretch[0].copy()
    stretch[wrong[faces].any(axis=1)] = np.nan
    covered = sample.covered(xyz, faces)
    followed = sample.covered(xyz, faces[np.isfinite(length)[faces].all(axis=1)])
    figures = RowFigures(
        seen_cm2=len(sample.points) * sample.area / 100.0,
        covered=_share(covered),
        covered_later=_share(followed[sample.later]),
        points=len(xyz),
        wrong=int(wrong.sum()),
        shape_mm=rms(found.distance[~wrong]),
        displacement_mm=rms(length[~wrong]),
        stretch_rms=rms(stretch),
        spreads=found.spreads,
    )
    return JudgedRun(figures, found.normals, found.distance, length, sample, covered)


def _share(which: Mask) -> float:
    return float(which.mean()) if len(which) else float("nan")
