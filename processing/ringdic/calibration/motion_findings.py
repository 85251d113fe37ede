"""Findings on cameras that moved or were refocused: which, by how much, at which steps, and how well that is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ringdic.calibration.moved_cameras import ADRIFT_PX, MOTION, MOVED_PX, UNEXPLAINED, CameraMotions
from ringdic.calibration.parameters import POSE
from ringdic.findings import Finding


def motion_figures(motions: Mapping[int, CameraMotions], steps: Sequence[str]) -> list[dict[str, Any]]:
    """Residuals (px), turns, shifts and changed focal lengths at the steps at which cameras had moved, as JSON values.

    motions, steps : as of `motion_findings`.
    """
    rows = []
    for step, one in sorted(motions.items()):
        if one.moved.any():
            turn, shift = (np.linalg.norm(part, axis=1) for part in (one.motion[:, :3], one.motion[:, 3:POSE]))
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
                            "focal_length_percent": 100.0 * float(one.motion[c, POSE]),
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
    unknown = [step for step, one in later.items() if one.unexplained or one.adrift]
    for step in unknown:
        say = _unknown if later[step].unexplained else _adrift
        findings.append(say(later[step], steps[step], "since the reference"))
    known = {step: one for step, one in later.items() if step not in unknown}
    for step in [step for step, one in known.items() if _all_refocused(one)]:
        findings.append(_lenses(known.pop(step), steps[step], f"since the reference in {steps[step]}"))
    count = max((len(one.cameras) for one in known.values()), default=0)
    for c in range(count):
        at = [step for step, one in sorted(known.items()) if one.moved[c]]
        if at:
            worst = max(at, key=lambda step: known[step].effect[c])
            where = steps[worst] if len(at) == 1 else f"{steps[worst]} and less in {len(at) - 1} other steps"
            findings.append(_followed(known[worst], c, steps[worst], f"since the reference in {where}"))
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
    when = "between the calibration and the reference"
    if motions.unexplained:
        return [_unknown(motions, reference, when)]
    if motions.adrift:
        return [_adrift(motions, reference, when)]
    if _all_refocused(motions):
        return [_lenses(motions, reference, when)]
    return [_followed(motions, int(c), reference, when) for c in np.flatnonzero(motions.moved)]


def _followed(motions: CameraMotions, c: int, step: str, when: str) -> Finding:
    """A finding on camera number c, whose motion is known."""
    camera, (x, y) = motions.cameras[c].id, motions.shift[c]
    others = "; which of two cameras moved cannot be known" if len(motions.cameras) == 2 else ""
    result = f"ines of sight missed one another by {motions.before[c]:.2f} px"
    result = f"It was followed: l{result}, and by {motions.after[c]:.3f} px now" if motions.followed else f"L{result}"
    far = f"by {motions.effect[c]:.2f} px in its image ({x:+.2f} along rows, {y:+.2f} along columns)"
    if motions.refocused[c]:
        sentence = (
            f"the lens of camera {camera} was refocused {when}: its focal length changed by {_percent(motions, c)} %, "
            f"and points moved {far}. {result}. Lock the focus, and calibrate again"
        )
        return Finding("lens-refocused", sentence, (camera,), step, float(motions.effect[c]), MOVED_PX, "px")
    sentence = f"camera {camera} moved {when}, {far}{others}. {result}. Fix the camera, and calibrate again"
    return Finding("camera-moved", sentence, (camera,), step, float(motions.effect[c]), MOVED_PX, "px")


def _all_refocused(motions: CameraMotions) -> bool:
    """Whether the lenses of all cameras that see a point were refocused, and none is known to stand as it was."""
    return bool(motions.refocused[np.isfinite(motions.effect)].all())


def _lenses(motions: CameraMotions, step: str, when: str) -> Finding:
    """A finding on cameras that were all refocused, so that hardly anything tells the scale."""
    cameras = [c for c, moved in enumerate(motions.moved) if moved]
    ids = tuple(motions.cameras[c].id for c in cameras)
    changes = ", ".join(f"{motions.cameras[c].id} {_percent(motions, c)} %" for c in cameras)
    at = POSE + MOTION * np.array(cameras)
    doubt = 100.0 * float(np.sqrt(np.mean(motions.covariance[np.ix_(at, at)])))
    sentence = (
        f"the lenses of all cameras were refocused {when}: their focal lengths changed by {changes}. Images tell the "
        f"mean of these, and with it the size of the specimen, to {doubt:.2f} %, which is part of the stated "
        "standard deviations. Lock the focus, and calibrate again"
    )
    return Finding("lens-refocused", sentence, ids, step, float(np.nanmax(motions.effect)), MOVED_PX, "px")


def _percent(motions: CameraMotions, c: int) -> str:
    """Change of the focal length of camera number c, in percent."""
    return f"{100.0 * motions.motion[c, POSE]:+.2f}"


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


def _adrift(motions: CameraMotions, step: str, when: str) -> Finding:
    """A finding on cameras of which most moved, and far, so that none holds the world where it was."""
    ids = tuple(motions.cameras[c].id for c in np.flatnonzero(motions.moved))
    far = float(np.nanmax(motions.effect))
    sentence = (
        f"camera {', '.join(ids)} moved {when}, by up to {far:.1f} px in their images. So many moved that hardly any "
        "holds the world where it was: lines of sight meet again, but size and form of the specimen may be wrong by "
        f"more than is stated (limit {ADRIFT_PX:.0f} px). Fix the cameras, and calibrate again"
    )
    return Finding("camera-moved-unknown", sentence, ids, step, far, ADRIFT_PX, "px")
