"""Where the cameras stand, all of them together: a target turned on its stand, and cameras taken for one another.

One camera's image tells its azimuth but for the number of its columns. Cameras that see the seam know that too, and the
printed numbers carry it from camera to camera. What is then found for most cameras alike is a turn of the target; what
is found for one camera alone is that camera in another place than the rig says.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ringdic.calibration.dots import Dots
from ringdic.calibration.labels import Labels, common_part, has_labels, read_labels, same_numbers
from ringdic.calibration.target import identify, possible_azimuths
from ringdic.errors import InputError
from ringdic.session.rig import RigCamera, Target

log = logging.getLogger(__name__)

#: Degrees: a camera further off than this from where the rig and the turn put it is not that camera; a target turned
#: by more is worth a sentence.
_ELSEWHERE, _TURNED = 8.0, 5.0


@dataclass(frozen=True)
class Sight:
    """What one camera's image of the target says by itself.

    azimuths : degrees at which the camera may stand, the nearest to the nominal one first; empty where no target is
    recognised. labels : numbers printed above its columns, numbered as at azimuths[0].
    """

    camera: RigCamera
    azimuths: tuple[float, ...]
    labels: Labels


@dataclass(frozen=True)
class Survey:
    """Azimuths of the cameras by id, degrees, and sentences for the operator.

    turn_deg : by how much the target is turned from where the azimuths in rig.toml have it.
    """

    azimuths: dict[str, float]
    turn_deg: float
    warnings: tuple[str, ...]


def sight(image: NDArray[np.generic], dots: Dots, camera: RigCamera, target: Target) -> Sight:
    """What an image, grey, and the spots found in it say.

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
    azimuths = tuple(sorted((float(a) for a in possible), key=lambda a: abs(_wrapped(a - camera.azimuth_deg))))
    if not azimuths:
        return Sight(camera, (), {})
    try:
        observed = identify(
            dots, target, azimuths[0], camera=camera.id, rotation_deg=camera.rotation_deg, height_mm=camera.height_mm
        )
    except InputError:
        return Sight(camera, (), {})  # whoever calibrates this camera says why
    labels = read_labels(image, observed, target) if observed.rows.max() == target.rows else {}
    if not has_labels(labels):
        upside_down = observed.rows.min() == 1 and has_labels(read_labels(image, observed, target, below=True))
        if upside_down:
            other = (camera.rotation_deg + 180.0) % 360.0
            raise InputError(
                f"camera {camera.id}: the numbers of the target's columns stand below the lowest row; the image is "
                f"upside down: give rotation_deg = {other:.0f} in rig.toml, or turn the camera"
            )
        labels = {}
    return Sight(camera, azimuths, labels)


def survey(sights: Mapping[str, Sight], target: Target) -> Survey:
    """The cameras' azimuths from all sights together.

    Raises InputError that names cameras standing where the rig does not have them.
    """
    seen = {id_: each for id_, each in sights.items() if each.azimuths}
    raised = _raised(seen, target)
    off = {
        id_: _wrapped(_numbered(seen[id_], columns, target) - seen[id_].camera.azimuth_deg)
        for id_, columns in raised.items()
    }
    turn = _middle(list(off.values())) if off else 0.0
    for id_, each in off.items():
        if abs(_wrapped(each - turn)) > _ELSEWHERE:
            raise InputError(_elsewhere(id_, seen, off, turn))
    shared = turn if abs(turn) > _TURNED else 0.0
    azimuths = {id_: (each.camera.azimuth_deg + off.get(id_, shared)) % 360.0 for id_, each in seen.items()}
    warnings: tuple[str, ...] = ()
    if abs(turn) > _TURNED:
        warnings = (
            f"the calibration target is turned by {turn:+.1f}° from where the azimuths in rig.toml have it; the world "
            "turns with it. Turn it back, or change azimuth_deg of all cameras",
        )
    log.info("target turned by %+.1f°, %d of %d cameras numbered for certain", turn, len(off), len(sights))
    return Survey(azimuths, turn, warnings)


def _numbered(each: Sight, columns: int, target: Target) -> float:
    """Azimuth after its first one is raised by so many columns: the seam is narrower than a column."""
    about = each.azimuths[0] + columns * math.degrees(target.column_angle)
    return min(each.azimuths, key=lambda a: abs(_wrapped(a - about)))


def _raised(seen: dict[str, Sight], target: Target) -> dict[str, int]:
    """By how many columns each camera's first azimuth must be raised, for those that can be certain."""
    sure = {id_: 0 for id_, each in seen.items() if len(each.azimuths) == 1}
    labelled = [id_ for id_, each in seen.items() if each.labels]
    if not sure or not labelled:
        return sure
    common = common_part(seen[id_].labels for id_ in labelled)
    queue = [id_ for id_ in sure if id_ in labelled]
    while queue:
        known = queue.pop(0)
        for other in labelled:
            if other not in sure:
                shift = same_numbers(seen[known].labels, seen[other].labels, common, target.columns)
                if shift is not None:
                    sure[other] = sure[known] + shift
                    queue.append(other)
    return sure


def _elsewhere(id_: str, seen: dict[str, Sight], off: dict[str, float], turn: float) -> str:
    nominal = seen[id_].camera.azimuth_deg
    stands = (nominal + off[id_] - turn) % 360.0
    there = [
        other
        for other, each in seen.items()
        if other != id_ and abs(_wrapped(each.camera.azimuth_deg - stands)) <= _ELSEWHERE
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
    """The angle from which the others are nearest, degrees."""
    return min(angles, key=lambda a: sum(abs(_wrapped(a - b)) for b in angles))


def _wrapped(angle: float) -> float:
    return (angle + 180.0) % 360.0 - 180.0
