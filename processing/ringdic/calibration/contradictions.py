"""Findings about a calibration that contradicts itself: target against rig.toml, lens by board against by target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.target_evidence import CameraEvidence, SheetChange
from ringdic.calibration.target_measures import CONTRADICTION, TargetMeasures, target_measures
from ringdic.findings import Finding
from ringdic.session.rig import Target

#: Least deviation of a measure of the target that is a finding, as a part of it, and in units of what is expected; its
#: least ratio to the standard error; and least error that the model itself may have, as a part.
_MEASURE, _USUAL, _SURE, _MODEL = 0.002, 4.0, 5.0, 1e-4
#: Least bend of a checkerboard that is a finding, mm, and least stretch of its squares, as a part of them.
_BEND, _STRETCH = 0.1, 0.001
#: Ratios of distances that are a finding: of a camera to that in rig.toml, and of the boards to the target.
_FARTHER, _OTHER_UNITS = 1.25, 6.0
#: Least rotation of the printed sheet on its cylinder that is a finding, rad.
_TILT = 0.005
#: Least deviation of a focal length that is a finding, as a part of it.
_FOCUS = 0.001
#: Print errors that are a finding, in units of those that are expected; expected ones at least, mm; and dots' errors in
#: the image that noise may cause, px.
_MANY, _TOO_MANY, _LEAST_PRINT, _NOISE = 3.0, 10.0, 0.03, 0.15


@dataclass(frozen=True)
class ExpectedErrors:
    """How far a target may be from its measures in rig.toml, as standard deviations.

    dots : of the dots' places, mm in each direction. radius, pitch : of the radius and of the spacing of the columns,
    mm, where that is more than the dots' alone.
    """

    dots: float = 0.03
    radius: float = 0.0
    pitch: float = 0.0

    @property
    def print_error(self) -> float:
        """Standard deviation of the dots' places, mm; an ordinary print's where the dots are held fixed."""
        return max(self.dots, _LEAST_PRINT)

    def tolerance(self, target: Target) -> tuple[float, float]:
        """Deviations of radius and column spacing that say nothing, as parts of them."""
        least = max(_MEASURE, _USUAL * self.print_error / target.radius_mm)
        return (
            max(least, _USUAL * self.radius / target.radius_mm),
            max(least, _USUAL * self.pitch / target.column_spacing_mm),
        )


def contradictions(
    calibrations: Mapping[str, CameraCalibration],
    target: Target,
    expected: ExpectedErrors | None = None,
    distances: Mapping[str, float] | None = None,
) -> tuple[Finding, ...]:
    """Findings that name what contradicts: measures of the target, cameras whose lens is not that of the boards, dots.

    calibrations : by camera id, of each camera alone. expected : how far the target may be from rig.toml, None for an
    ordinary print. distances : of cameras from the target's axis as rig.toml has them, by camera id, mm.
    """
    expected = expected or ExpectedErrors()
    bent = (*_of_boards(calibrations), *_of_scale(calibrations, target, distances or {}))
    measures = target_measures(calibrations, target, expected.tolerance(target))
    if measures is None:
        return bent
    return (
        *bent,
        *_of_target(measures, target, expected),
        *_of_lenses(measures, calibrations),
        *_of_dots(measures.evidence, expected.print_error),
    )


def _of_boards(calibrations: Mapping[str, CameraCalibration]) -> list[Finding]:
    """Findings that name the cameras whose board was bent, or had squares that are longer than wide."""
    findings = []
    fits = {id_: each.fit for id_, each in calibrations.items() if each.fit is not None}
    bent = {id_: fit.bend for id_, fit in fits.items() if fit.bend > _BEND}
    if bent:
        sentence = (
            f"camera {', '.join(bent)}: the checkerboard was bent, its surface rises and falls by up to "
            f"{max(bent.values()):.2f} mm; the lens was fitted to the bent board, but use a stiff flat one, as another "
            "bend in each view cannot be seen"
        )
        findings.append(
            Finding("board-not-flat", sentence, tuple(bent), value=max(bent.values()), limit=_BEND, unit="mm")
        )
    stretched = {id_: 100 * fit.stretch for id_, fit in fits.items() if abs(fit.stretch) > _STRETCH}
    if stretched:
        worst = max(stretched.values(), key=abs)
        sentence = (
            f"camera {', '.join(stretched)}: the squares of the checkerboard are {abs(worst):.2f} % "
            f"{'longer' if worst > 0 else 'shorter'} than wide, along the second number of [board] squares; the lens "
            "was fitted to them, but print the board without scaling, and measure it"
        )
        findings.append(
            Finding("board-not-square", sentence, tuple(stretched), value=worst, limit=100 * _STRETCH, unit="%")
        )
    return findings


def _of_scale(
    calibrations: Mapping[str, CameraCalibration], target: Target, distances: Mapping[str, float]
) -> list[Finding]:
    """A finding where the target's measures are likely in other units, which its images cannot show.

    The distance from the camera follows from them. It is held against that in rig.toml, by camera id in mm, and that of
    the boards, which were held where the lens is in focus as well.
    """
    findings = []
    stands = {id_: float(np.hypot(*each.camera.centre[:2])) for id_, each in calibrations.items()}
    measured = {id_: stands[id_] / distance for id_, distance in distances.items() if id_ in stands and distance > 0}
    if measured:
        id_, ratio = max(measured.items(), key=lambda item: abs(np.log(item[1])))
        if abs(np.log(ratio)) > np.log(_FARTHER):
            sentence = (
                f"camera {id_} stands {stands[id_]:.0f} mm from the target's axis by the measures of the target, "
                f"rig.toml says distance_mm {distances[id_]:g}; check the units of [target], and distance_mm"
            )
            findings.append(Finding("world-scale", sentence, (id_,), value=ratio, limit=_FARTHER))
    held = {id_: each.fit.distance for id_, each in calibrations.items() if each.fit is not None}
    ratios = {id_: held[id_] / (stands[id_] - target.radius_mm) for id_ in held if stands[id_] > target.radius_mm}
    ratio = float(np.median(list(ratios.values()))) if ratios else float("nan")
    if abs(np.log(ratio)) > np.log(_OTHER_UNITS):
        sentence = (
            f"the boards were held {ratio:.2g} times as far from the cameras as the target stands, by square_mm of the "
            "board and the measures of the target; one of both is likely in centimetres or inches: correct it"
        )
        findings.append(Finding("world-scale", sentence, tuple(ratios), value=ratio, limit=_OTHER_UNITS))
    return findings


def _of_target(measures: TargetMeasures, target: Target, expected: ExpectedErrors) -> list[Finding]:
    """A finding for a measure of the target that rig.toml does not have right, and one for a turned sheet."""
    findings = []
    sigma = float(np.hypot(measures.sigma, _MODEL))
    radius, columns = expected.tolerance(target)
    tolerance = {"radius": radius, "columns": columns}.get(measures.wrong, min(radius, columns))
    limit = max(tolerance, _SURE * sigma)
    if abs(measures.off) > limit:
        sentence = f"{_what_fits(measures, target, sigma)}; measure the target and correct [target] in rig.toml"
        ids = tuple(each.camera for each in measures.evidence)
        findings.append(
            Finding("target-measures", sentence, ids, value=100 * measures.off, limit=100 * limit, unit="%")
        )
    tilt = abs(measures.sheet.tilt)
    if tilt > _TILT:
        turned, least = (float(np.degrees(each)) for each in (tilt, _TILT))
        sentence = (
            f"the printed sheet is turned by {turned:.2f}° on the target's cylinder, so that its columns are not "
            "parallel to the axis; glue it on straight, or let calibration.tilt_error_deg be 1"
        )
        findings.append(Finding("target-measures", sentence, value=turned, limit=least, unit="°"))
    return findings


def _what_fits(measures: TargetMeasures, target: Target, sigma: float) -> str:
    """The sentence on the measure that is wrong: which fits the images, and what rig.toml says."""
    off, sheet = measures.off, measures.sheet
    amount = f"{100 * off:+.2f} % ± {100 * sigma:.2f} %"
    said = f"{{}} fits the images, rig.toml says {{:g}} ({amount})"
    if measures.wrong == "rows":
        spacing = target.row_spacing_mm * (1 + off)
        apart = "far apart" if off > 0 else "close together"
        return (
            f"the target's rows are {abs(100 * off):.2f} % too {apart} for its radius and columns: row_spacing_mm "
            + (said.format(f"{spacing:.3f}", target.row_spacing_mm))
        )
    if measures.wrong == "columns":
        return "the target's columns do not have their spacing: column_spacing_mm " + said.format(
            f"{sheet.pitch:.3f}", target.column_spacing_mm
        )
    radius = said.format(f"{sheet.radius:.3f}", target.radius_mm)
    if measures.wrong == "radius":
        scale = target.radius_mm / sheet.radius
        rows, columns = target.row_spacing_mm * scale, target.column_spacing_mm * scale
        larger = "large" if scale > 1 else "small"
        return (
            f"radius and print of the target do not belong together: radius_mm {radius}, or else the sheet is printed "
            f"{100 * abs(scale - 1):.2f} % too {larger} (row_spacing_mm {rows:.3f}, column_spacing_mm {columns:.3f})"
        )
    return (
        f"radius and columns of the target do not belong to its rows: with row_spacing_mm {target.row_spacing_mm:g}, "
        f"radius_mm {sheet.radius:.3f} and column_spacing_mm {sheet.pitch:.3f} fit the images, rig.toml says "
        f"{target.radius_mm:g} and {target.column_spacing_mm:g} (up to {amount})"
    )


def _of_lenses(measures: TargetMeasures, calibrations: Mapping[str, CameraCalibration]) -> list[Finding]:
    """Findings that name the cameras whose lens by the target is not that by the boards, by the likely cause."""
    causes: dict[str, list[tuple[CameraEvidence, str]]] = {}
    for each in measures.evidence:
        T, (off, sigma) = each.distance(measures.change), each.focal_gap(measures.change)
        focus = abs(off) > max(_FOCUS, _SURE * sigma)
        if T <= CONTRADICTION and not focus:
            continue
        other = _other_lens(each, measures)
        amount = f"{each.camera}: focal length {100 * off:+.2f} % ± {100 * sigma:.2f} %"
        if other is not None:
            code, amount = other
        elif focus and each.distance_if_refocused(measures.change) < max(0.3 * T, 0.4 * CONTRADICTION):
            code = "camera-refocused"
        else:
            code = "lens-contradicts-target"
            centre = (each.lens - each.board.values)[3:5]
            amount += f", centre ({centre[0]:+.1f}, {centre[1]:+.1f}) px"
        causes.setdefault(code, []).append((each, amount))
    return [_lens_finding(code, of, measures, calibrations) for code, of in causes.items()]


def _lens_finding(
    code: str,
    of: Sequence[tuple[CameraEvidence, str]],
    measures: TargetMeasures,
    calibrations: Mapping[str, CameraCalibration],
) -> Finding:
    """The finding on some cameras whose lenses contradict their boards for one cause. of : evidence and amounts."""
    ids = tuple(each.camera for each, _ in of)
    amounts = "; ".join(amount for _, amount in of)
    worst = float(np.sqrt(max(each.distance(measures.change) for each, _ in of)))
    boards = "boards" if all(calibrations[id_].fit is not None for id_ in ids) else "intrinsics"
    who = f"camera {', '.join(ids)}: "
    sentence = {
        "camera-refocused": f"the target shows another focal length than the {boards} ({amounts}); the lens was turned "
        f"in between, or the {boards} are of another session: fix the focus and take the boards again",
        "wrong-board": f"the target is seen through another lens than the board ({amounts}); put the images of the "
        "board right, or take them again",
        "images-mirrored": f"the lens that fits the target is that of the {boards} with its images turned over "
        f"({amounts}); switch flips and turns of this camera off, or the same on in board, target and specimen",
        "lens-contradicts-target": f"the lens that fits the target is {worst:.0f} standard errors from that of the "
        f"{boards} ({amounts}); check that the board is flat and its squares true, that all images are of this camera, "
        "that [target] in rig.toml describes the target, and that no lens was touched in between",
    }[code]
    if code == "camera-refocused":
        off = max((each.focal_gap(measures.change)[0] for each, _ in of), key=abs)
        return Finding(code, who + sentence, ids, value=100 * off, limit=100 * _FOCUS, unit="%")
    return Finding(code, who + sentence, ids, value=worst, limit=float(np.sqrt(CONTRADICTION)), unit="σ")


def _other_lens(each: CameraEvidence, measures: TargetMeasures) -> tuple[str, str] | None:
    """The lens that explains what the target shows far better than that of the boards, as a code and in words.

    None where there is none.
    """
    board = each.board
    ways = [
        ("images-mirrored", "mirrored left to right", board.mirrored(across=True, along=False)),
        ("images-mirrored", "mirrored top to bottom", board.mirrored(across=False, along=True)),
        ("images-mirrored", "turned by 180°", board.mirrored(across=True, along=True)),
        *(
            ("wrong-board", f"that of the boards of camera {other.camera} fits {each.camera}", other.board)
            for other in measures.evidence
            if other.camera != each.camera and other.board.size == board.size
        ),
    ]
    # Where hardly a camera agrees with its boards, the sheet is known no better than rig.toml has it.
    stated = SheetChange(measures.stated_change)
    distances = [min(each.distance(sheet, lens) for sheet in (measures.change, stated)) for _, _, lens in ways]
    best = int(np.argmin(distances))
    if distances[best] > min(CONTRADICTION, 0.1 * each.distance(measures.change)):
        return None
    return ways[best][:2]


def _of_dots(evidence: Sequence[CameraEvidence], print_error: float) -> list[Finding]:
    """Findings that name the cameras in which dots are farther from their places than a print has them."""
    limits = {"print-errors": _MANY * print_error, "print-errors-large": _TOO_MANY * print_error}
    off: dict[str, list[CameraEvidence]] = {}
    for each in evidence:
        beyond = [code for code, limit in limits.items() if each.dot_sigma > limit and each.px_sigma > _NOISE]
        if beyond:
            off.setdefault(beyond[-1], []).append(each)
    findings = []
    for code, those in off.items():
        ids, worst = tuple(each.camera for each in those), max(each.dot_sigma for each in those)
        sentence = (
            f"camera {', '.join(ids)}: dots of the target are up to {worst:.3f} mm RMS off the places that any lens "
            f"would give them, {print_error:g} mm are expected; check the print and its seam, that the target is a "
            "true cylinder, clean and sharp in the image"
        )
        findings.append(Finding(code, sentence, ids, value=worst, limit=limits[code], unit="mm"))
    return findings
