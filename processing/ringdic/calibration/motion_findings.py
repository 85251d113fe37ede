"""Findings on cameras that moved: which camera, by how much, at which steps, and whether its motion is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ringdic.calibration.moved_cameras import MOVED_PX, UNEXPLAINED, CameraMotions
from ringdic.findings import Finding


def motion_figures(motions: Mapping[int, CameraMotions], steps: Sequence[str]) -> list[dict[str, Any]]:
    """Residuals (px), rotations and translations at the steps at which cameras had moved, as JSON values.

    motions, steps : as of `motion_findings`.
    """
    rows = []
    for step, one in sorted(motions.items()):
        if one.moved.any():
            turn, shift = (np.linalg.norm(part, axis=1) for part in np.split(one.motion, 2, axis=1))
            rows.append(
                {
                    "step": steps[step],
                    "before_px": float(np.nanmax(one.before)),
                    "after_px": float(np.nanmax(one.after)),
                    "scale": one.scale,
                    "cameras": {
                        camera.id: {
                            "image_px": float(one.effect[c]),
                            "turn_deg": float(np.degrees(turn[c])),
                            "shift_mm": float(shift[c]),
                        }
                        for c, camera in enumerate(one.cameras)
                        if np.isfinite(one.effect[c])
                    },
                }
            )
    return rows


def motion_findings(motions: Mapping[int, CameraMotions], steps: Sequence[str]) -> list[Finding]:
    """Findings on cameras that moved after the calibration or since the reference; empty where none moved.

    motions : by step, 0 those between the calibration and the reference, the others since the reference. steps : names.
    """
    findings = [] if 0 not in motions else _since_calibration(motions[0], steps[0])
    later = {step: one for step, one in motions.items() if step and one.moved.any()}
    unknown = [step for step, one in later.items() if one.unexplained]
    findings += [_unknown(later[step], steps[step], "since the reference") for step in unknown]
    count = max((len(one.cameras) for one in later.values()), default=0)
    for c in range(count):
        at = [step for step, one in sorted(later.items()) if one.moved[c] and step not in unknown]
        if at:
            worst = max(at, key=lambda step: later[step].effect[c])
            where = steps[worst] if len(at) == 1 else f"{steps[worst]} and less in {len(at) - 1} other steps"
            findings.append(_followed(later[worst], c, steps[worst], f"since the reference in {where}"))
    return findings


def left_out_finding(motions: CameraMotions, step: str) -> Finding:
    """The finding on the camera that contradicts all others at a step, and was left out there.

    motions : whose `contradicting` is the camera. step : name of the step.
    """
    camera, missed = motions.cameras[motions.contradicting].id, float(np.nanmax(motions.before))
    sentence = (
        f"camera {camera} contradicts all others in {step}: lines of sight miss one another by {missed:.2f} px, no "
        "motion of the camera explains that, and without it the others agree. It was left out there; check that its "
        "image is of this instant and of this camera"
    )
    return Finding("camera-contradicts", sentence, (camera,), step, float(np.nanmax(motions.misfit)), UNEXPLAINED, "σ")


def _since_calibration(motions: CameraMotions, reference: str) -> list[Finding]:
    """Findings on cameras that moved between the calibration and the reference."""
    if not motions.moved.any():
        return []
    if motions.unexplained:
        return [_unknown(motions, reference, "between the calibration and the reference")]
    when = "between the calibration and the reference"
    return [_followed(motions, int(c), reference, when) for c in np.flatnonzero(motions.moved)]


def _followed(motions: CameraMotions, c: int, step: str, when: str) -> Finding:
    """A finding on camera number c, whose motion is known."""
    camera, (x, y) = motions.cameras[c].id, motions.shift[c]
    others = "; which of two cameras moved cannot be known" if len(motions.cameras) == 2 else ""
    result = f"ines of sight missed one another by {motions.before[c]:.2f} px"
    result = f"It was followed: l{result}, and by {motions.after[c]:.3f} px now" if motions.followed else f"L{result}"
    sentence = (
        f"camera {camera} moved {when}, by {motions.effect[c]:.2f} px in its image ({x:+.2f} along rows, {y:+.2f} "
        f"along columns){others}. {result}. Fix the camera, and calibrate again"
    )
    return Finding("camera-moved", sentence, (camera,), step, float(motions.effect[c]), MOVED_PX, "px")


def _unknown(motions: CameraMotions, step: str, when: str) -> Finding:
    """A finding on cameras that seem to have moved, but whose matches no motion explains."""
    c = motions.contradicting
    ids = tuple(motions.cameras[k].id for k in (np.flatnonzero(motions.moved) if c < 0 else [c]))
    sentence = (
        f"camera {', '.join(ids)}: lines of sight miss those of the other cameras by {np.nanmax(motions.before):.2f} "
        f"px and no motion of a camera {when} brings them nearer than {np.nanmax(motions.after):.2f} px, "
        f"{np.nanmax(motions.misfit):.0f} times what the matches are good to. Check that all images of {step} are of "
        "the same instant and each of its own camera, then calibrate again"
    )
    return Finding("camera-moved-unknown", sentence, ids, step, float(np.nanmax(motions.misfit)), UNEXPLAINED, "σ")
