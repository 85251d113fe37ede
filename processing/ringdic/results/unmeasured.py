"""Textured places of the reference images that were not measured, each with its reason, and their areas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Pixels
from ringdic.correlation.status import Status
from ringdic.findings import Finding
from ringdic.geometry.outliers import LostPoint

_WORTH_A_FINDING = 0.03  # of the textured area


class UncountedPlace(IntEnum):
    """Status of an unmeasured place that is listed but not counted as lost; continues the codes of the matches."""

    ONE_VIEW = 32  # only one camera shows it
    RIM = 33  # at the edge of the texture, where a subset reaches beyond it


@dataclass(frozen=True)
class Reason:
    """Why places are not measured, and what helps.

    name : in files. code : as in a status. sentence, remedy : for the operator.
    """

    name: str
    code: int
    sentence: str
    remedy: str


def _reason(code: Status | LostPoint | UncountedPlace, sentence: str, remedy: str) -> Reason:
    return Reason(code.name.lower(), int(code), sentence, remedy)


_LIKENESS = "focus the cameras, light the specimen evenly, or make the pattern denser"
_CALIBRATION = "check that no camera moved since the calibration, or calibrate again"
#: All reasons, those that count as lost first.
REASONS = (
    _reason(
        Status.NOT_REACHED,
        "no match in another camera",
        "draw masks where this is not the specimen; else focus the cameras, or bring neighbours closer to one another",
    ),
    _reason(Status.NO_CONVERGENCE, "the match did not settle", _LIKENESS),
    _reason(Status.LOW_ZNCC, "the images do not look alike", _LIKENESS),
    _reason(Status.INCONSISTENT, "the match contradicts its neighbours", _LIKENESS),
    _reason(
        Status.OUTSIDE, "hidden from the other cameras, or outside their images", "add a camera, or turn one towards it"
    ),
    _reason(
        Status.NO_TEXTURE, "too little pattern, or too few pixels inside the mask", "make the pattern denser there"
    ),
    _reason(LostPoint.RESIDUAL, "the lines of sight miss one another", _CALIBRATION),
    _reason(LostPoint.SURFACE, "off the surface around it", _LIKENESS),
    _reason(
        LostPoint.UNCERTAIN,
        "the match is too uncertain",
        "make the pattern denser or of more contrast, or raise surface.sigma_max_px",
    ),
    _reason(
        LostPoint.OBLIQUE,
        "seen squarely enough by one camera only",
        "add a camera that faces it, or raise surface.incidence_deg",
    ),
    _reason(UncountedPlace.ONE_VIEW, "seen by one camera only", "add a camera, or turn one towards it"),
    _reason(UncountedPlace.RIM, "at the edge of the pattern", "extend the pattern beyond what is to be measured"),
)
_BY_NAME = {reason.name: reason for reason in REASONS}
#: All reasons by the status that stands for them.
BY_CODE = {reason.code: reason for reason in REASONS}


@dataclass(frozen=True)
class UnmeasuredPlaces:
    """Textured places of a camera's reference image that were not measured.

    camera : its id. px : (k, 2) px. spacing : px, of the lattice that they lie on. status : (k,), code of a reason.
    area : (k,) mm², this camera's share of the surface about each place, so that places that several cameras show
    count once.
    """

    camera: str
    px: Pixels
    spacing: float
    status: NDArray[np.int8]
    area: Floats

    def __post_init__(self) -> None:
        n = len(self.px)
        if self.px.shape != (n, 2) or self.status.shape != (n,) or self.area.shape != (n,):
            raise ValueError("an unmeasured place has a pixel, a status and an area")


def unmeasured_areas(places: Sequence[UnmeasuredPlaces], measured_mm2: float) -> dict[str, Any]:
    """Areas that were not measured, cm², as JSON values.

    places : of all cameras. measured_mm2 : area of the measured surface.
    ``total_cm2`` is the sum of ``by_reason``, the largest first. What one camera alone shows and the rim of the texture
    are not part of it: ``seen_by_one_cm2``, ``rim_cm2``.
    """
    area: dict[int, float] = {}
    for one in places:
        for code in np.unique(one.status):
            area[int(code)] = area.get(int(code), 0.0) + 0.01 * float(one.area[one.status == code].sum())
    counted = sorted((code for code in area if code < UncountedPlace.ONE_VIEW), key=lambda code: -area[code])
    return {
        "total_cm2": round(sum(area[code] for code in counted), 2),
        "measured_cm2": round(0.01 * measured_mm2, 2),
        "by_reason": {BY_CODE[code].name: round(area[code], 2) for code in counted},
        "seen_by_one_cm2": round(area.get(UncountedPlace.ONE_VIEW, 0.0), 2),
        "rim_cm2": round(area.get(UncountedPlace.RIM, 0.0), 2),
    }


def unmeasured_rows(areas: dict[str, Any] | None) -> list[tuple[str, str]]:
    """The row of a summary's table: its figure and its value as text. areas : in cm²; None gives no row."""
    if areas is None:
        return []
    reasons = [f"{area:.1f} {_BY_NAME[name].sentence}" for name, area in areas["by_reason"].items() if area >= 0.05]
    value = f"{areas['total_cm2']:.1f} cm²" + (f": {', '.join(reasons)}" if reasons else "")
    return [("texture that two cameras see and that was not measured", value)]


def unmeasured_findings(areas: dict[str, Any] | None) -> list[Finding]:
    """A finding where more than 3 % of the textured area is missing for other reasons than the view.

    What all cameras but one see too obliquely follows from where the cameras stand; it is listed, but no fault.

    areas : in cm², or None.
    """
    if areas is None:
        return []
    measured = areas["measured_cm2"]
    reasons = {name: area for name, area in areas["by_reason"].items() if name != LostPoint.OBLIQUE.name.lower()}
    missing = sum(reasons.values())
    if not missing or missing <= _WORTH_A_FINDING * (missing + measured):
        return []
    name, largest = next(iter(reasons.items()))
    reason = _BY_NAME[name]
    sentence = (
        f"{missing:.1f} of {missing + measured:.1f} cm² of texture that two cameras see were not measured, "
        f"{largest:.1f} cm² of it because: {reason.sentence}; {reason.remedy}"
    )
    share = missing / (missing + measured)
    return [Finding("area-unmeasured", sentence, value=100 * share, limit=100 * _WORTH_A_FINDING, unit="%")]
