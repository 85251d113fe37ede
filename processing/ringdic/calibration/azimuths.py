"""Azimuths of all cameras from their images of the target, with detection of a rotated target and of exchanged cameras.

The image of one camera determines its azimuth up to a multiple of the columns' angle. The seam of the columns, where
the image shows it, determines the multiple too, and the printed numbers transfer it to other cameras. A deviation from
the rig that is common to most cameras is a rotation of the target; a deviation of a single camera means that it stands
elsewhere.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ringdic.calibration.dots import Dots
from ringdic.calibration.labels import Labels, column_labels, column_shift, has_labels, mean_label, mirrored_labels
from ringdic.calibration.target import identify_dots, possible_azimuths
from ringdic.errors import InputError
from ringdic.findings import Finding
from ringdic.geometry.camera import signed_degrees
from ringdic.session.rig import RigCamera, Target

log = logging.getLogger(__name__)

#: Least deviation of a camera's azimuth, after the target's rotation, that is an error; least rotation of the target
#: that is reported to the operator. Degrees.
_ELSEWHERE, _TURNED = 8.0, 5.0


@dataclass(frozen=True)
class AzimuthCandidates:
    """Possible azimuths of one camera, from its own image of the target alone.

    camera : its entry in the rig.
    azimuths : possible azimuths, degrees, the nearest to the nominal one first; empty where no target is seen.
    labels : rectified images of the prints above its columns, by column number, for azimuths[0]; empty for none.
    """

    camera: RigCamera
    azimuths: tuple[float, ...]
    labels: Labels


@dataclass(frozen=True)
class CameraAzimuths:
    """Azimuths of all cameras, and the rotation of the target against the rig file.

    azimuths : by camera id, degrees. turn_deg : rotation of the target about its axis from where the azimuths in
    rig.toml have it. findings : that it is turned, where it is.
    """

    azimuths: dict[str, float]
    turn_deg: float
    findings: tuple[Finding, ...]


def azimuth_candidates(image: NDArray[np.generic], dots: Dots, camera: RigCamera, target: Target) -> AzimuthCandidates:
    """Possible azimuths of a camera, in degrees, from its image of the target.

    image : (height, width) grey levels. dots : the spots of this image. camera : its entry in the rig.

    Raises InputError where the image is upside down or lies on its side.
    """
    possible = possible_azimuths(dots, target, camera.rotation_deg)
    if not len(possible):
        for turn in (90.0, 270.0):
            other = (camera.rotation_deg + turn) % 360.0
            if len(possible_azimuths(dots, target, other)):
                raise InputError(
                    f"camera {camera.id}: the target lies on its side in the image; give rotation_deg = {other:.0f} or "
                    f"{(other + 180) % 360:.0f} in rig.toml, or turn the camera"
                )
    azimuths = tuple(sorted((float(a) for a in possible), key=lambda a: abs(signed_degrees(a - camera.azimuth_deg))))
    if not azimuths:
        return AzimuthCandidates(camera, (), {})
    try:
        observed = identify_dots(
            dots, target, azimuths[0], camera=camera.id, rotation_deg=camera.rotation_deg, height_mm=camera.height_mm
        )
    except InputError:
        return AzimuthCandidates(camera, (), {})  # the calibration of this camera reports the error
    labels = column_labels(image, observed, target) if observed.rows.max() == target.rows else {}
    if not has_labels(labels):
        upside_down = observed.rows.min() == 1 and has_labels(column_labels(image, observed, target, below=True))
        if upside_down:
            other = (camera.rotation_deg + 180.0) % 360.0
            raise InputError(
                f"camera {camera.id}: the numbers of the target's columns stand below the lowest row; the image is "
                f"upside down: give rotation_deg = {other:.0f} in rig.toml, or turn the camera"
            )
        labels = {}
    return AzimuthCandidates(camera, azimuths, labels)


def camera_azimuths(candidates: Mapping[str, AzimuthCandidates], target: Target) -> CameraAzimuths:
    """Azimuths of all cameras from the possible azimuths of each.

    candidates : by camera id. Raises InputError, naming the camera, where one stands elsewhere than the rig says.
    """
    with_target = {id_: each for id_, each in candidates.items() if each.azimuths}
    sure = _column_shifts(with_target, target)
    off = {
        id_: signed_degrees(
            _azimuth_after_shift(with_target[id_], columns, target) - with_target[id_].camera.azimuth_deg
        )
        for id_, columns in sure.items()
    }
    turn = _middle([*off.values(), 0.0])  # where cameras disagree, the target was likely not turned
    for id_, each in off.items():
        if abs(signed_degrees(each - turn)) > _ELSEWHERE:
            mirrored = _mirrored(off, with_target, target)
            raise InputError(mirrored or _elsewhere(id_, with_target, off, turn))
    _require_unmirrored(with_target, set(sure), target)
    shared = turn if abs(turn) > _TURNED else 0.0
    azimuths = {id_: (each.camera.azimuth_deg + off.get(id_, shared)) % 360.0 for id_, each in with_target.items()}
    findings: tuple[Finding, ...] = ()
    if abs(turn) > _TURNED:
        sentence = (
            f"the calibration target is turned by {turn:+.1f}° from where the azimuths in rig.toml have it; the world "
            "turns with it. Turn it back, or change azimuth_deg of all cameras"
        )
        findings = (Finding("target-turned", sentence, value=turn, limit=_TURNED, unit="°"),)
    log.info("target turned by %+.1f°, %d of %d cameras numbered for certain", turn, len(off), len(candidates))
    return CameraAzimuths(azimuths, turn, findings)


def _azimuth_after_shift(each: AzimuthCandidates, columns: int, target: Target) -> float:
    """The candidate azimuth nearest to the first one plus a number of columns, since the seam differs from a column."""
    about = each.azimuths[0] + columns * math.degrees(target.column_angle)
    return min(each.azimuths, key=lambda a: abs(signed_degrees(a - about)))


def _column_shifts(with_target: dict[str, AzimuthCandidates], target: Target) -> dict[str, int]:
    """Columns by which the first candidate of a camera is off, for those cameras whose azimuth is determined."""
    sure = {id_: 0 for id_, each in with_target.items() if len(each.azimuths) == 1}
    labelled = [id_ for id_, each in with_target.items() if each.labels]
    if not sure or not labelled:
        return sure
    mean = mean_label(with_target[id_].labels for id_ in labelled)
    queue = [id_ for id_ in sure if id_ in labelled]
    while queue:
        known = queue.pop(0)
        for other in labelled:
            if other not in sure:
                shift = column_shift(with_target[known].labels, with_target[other].labels, mean, target.columns)
                if shift is not None:
                    sure[other] = sure[known] + shift
                    queue.append(other)
    return sure


def _require_unmirrored(with_target: dict[str, AzimuthCandidates], sure: set[str], target: Target) -> None:
    """Raise InputError where the printed numbers in an image agree with those in another only if it is mirrored.

    sure : cameras whose azimuth is determined.
    """
    labelled = {id_: each for id_, each in with_target.items() if each.labels}
    known = sure & labelled.keys()
    mean = mean_label(each.labels for each in labelled.values()) if known else np.zeros(0)
    for id_ in labelled.keys() - sure if known else ():
        mirrored = mirrored_labels(labelled[id_].labels, target.columns)
        if any(column_shift(labelled[other].labels, mirrored, mean, target.columns) is not None for other in known):
            raise InputError(_is_mirrored([id_], "its printed numbers are"))


def _mirrored(off: dict[str, float], with_target: dict[str, AzimuthCandidates], target: Target) -> str:
    """Message that images are mirrored left to right, "" where that does not explain where cameras seem to stand.

    Mirrored, a column appears as that as far from the other end of the columns, and a camera at the azimuth of that.
    off : deviations of cameras from rig.toml, degrees.
    """
    last = (target.columns - 1) * math.degrees(target.column_angle)
    ids = []
    for id_, each in off.items():
        nominal = with_target[id_].camera.azimuth_deg
        if abs(signed_degrees(each)) > _TURNED and abs(signed_degrees(last - 2 * nominal - each)) < _TURNED:
            ids.append(id_)
    right = [id_ for id_, each in off.items() if id_ not in ids and abs(signed_degrees(each)) > _TURNED]
    if not ids or right:
        return ""
    return _is_mirrored(ids, "its columns are counted from the other end")


def _is_mirrored(ids: list[str], why: str) -> str:
    """Message that the images of the target of some cameras are mirrored, and what shows it."""
    return (
        f"camera {', '.join(ids)}: the image of the target is mirrored left to right ({why}); switch the flip of the "
        "camera off, for all of its images"
    )


def _elsewhere(id_: str, with_target: dict[str, AzimuthCandidates], off: dict[str, float], turn: float) -> str:
    """Message that a camera stands elsewhere than the rig says; off : deviations of all cameras, degrees."""
    nominal = with_target[id_].camera.azimuth_deg
    stands = (nominal + off[id_] - turn) % 360.0
    there = [
        other
        for other, each in with_target.items()
        if other != id_ and abs(signed_degrees(each.camera.azimuth_deg - stands)) <= _ELSEWHERE
    ]
    if there:
        return (
            f"camera {id_} stands at azimuth {stands:.0f}°, where rig.toml has camera {there[0]}, and not at "
            f"{nominal:.0f}°: their images or their ids are exchanged; put the images, or azimuth_deg and the order of "
            "[[cameras]], right"
        )
    return (
        f"camera {id_} stands at azimuth {stands:.0f}°, rig.toml says {nominal:.0f}° and the other cameras agree with "
        "it; correct azimuth_deg of this camera"
    )


def _middle(angles: list[float]) -> float:
    """Median of angles, degrees: the one with the least sum of distances to the others."""
    return min(angles, key=lambda a: sum(abs(signed_degrees(a - b)) for b in angles))
