"""Advice to the operator on improving a calibration, in sentences that each name one action."""

from __future__ import annotations

import numpy as np

from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.quality import CameraQuality, PairQuality

#: Part of the image that the board should cover, and views that a lens should be fitted to.
_COVERAGE, _VIEWS = 0.5, 8
#: A view whose error is this many times the median of all views is named.
_BAD_VIEW = 3.0
#: Limits of the residual distortion, of the lens's error where the target is seen, and of the dots' residuals, px.
_COMMON, _LENS, _DOTS = 0.2, 0.1, 1.0
#: Limits of the azimuth's deviation from rig.toml and of the angle between cameras, degrees; of control points, mm.
_AZIMUTH, _ANGLES, _CONTROL = 3.0, (8.0, 60.0), 0.15
_FEWEST_COMMON = 20


def camera_advice(calibration: CameraCalibration, quality: CameraQuality) -> tuple[str, ...]:
    """Advice on one camera, most helpful sentence first; empty where its calibration is good."""
    who = f"camera {quality.camera}: "
    return tuple(who + each for each in (*_lens(calibration, quality), *_target(quality)))


def pair_advice(quality: PairQuality) -> tuple[str, ...]:
    """Advice on a pair of cameras; empty where they agree well."""
    sentences = []
    if quality.points < _FEWEST_COMMON:
        sentences.append(
            f"only {quality.points} dots of the target are seen by both; bring the cameras nearer to each other, or "
            "turn them to the target"
        )
    if quality.rms > _CONTROL:
        sentences.append(
            f"control points come back {quality.rms:.2f} mm off; take sharper and more varied views of the board with "
            "both cameras, and check the measures of the target in rig.toml"
        )
    if not _ANGLES[0] <= quality.angle_deg <= _ANGLES[1]:
        sentences.append(
            f"the cameras stand {quality.angle_deg:.0f}° apart; 15° to 40° is best, nearer is unsure in depth and "
            "farther matches little"
        )
    who = f"pair {quality.pair[0]}-{quality.pair[1]}: "
    return tuple(who + each for each in sentences)


def _lens(calibration: CameraCalibration, quality: CameraQuality) -> list[str]:
    """Advice on the views of the board, from the figures of the lens."""
    fit = calibration.fit
    if fit is None or quality.board_coverage is None:
        return []
    sentences = []
    if quality.board_coverage < _COVERAGE:
        sentences.append(
            f"board views cover {100 * quality.board_coverage:.0f} % of the image; take views nearer the corners"
        )
    if quality.board_views_used < _VIEWS:
        sentences.append(f"the lens rests on {quality.board_views_used} board views; take 10 to 15, tilted 20° to 45°")
    if quality.lens_error is not None and quality.lens_error > _LENS:
        sentences.append(
            f"where the target is seen the lens is known to {quality.lens_error:.2f} px only; take more board views "
            "there, tilted in several directions"
        )
    bad = fit.view_errors > _BAD_VIEW * np.median(fit.view_errors)
    if bad.any() and len(calibration.views) == len(bad):
        names = ", ".join(name for name, each in zip(calibration.views, bad, strict=True) if each)
        sentences.append(
            f"board view {names} was left out, its corners are off by {fit.view_errors[bad].max():.1f} px and the "
            f"others' by {np.median(fit.view_errors):.2f}; such a view is blurred, or the board moved or bent"
        )
    if calibration.blank:
        sentences.append(
            f"no board was found in {', '.join(calibration.blank)}; show all of it, sharp and without glare"
        )
    if quality.residual_distortion is not None and quality.residual_distortion > _COMMON:
        sentences.append(
            f"corners are off by {quality.residual_distortion:.2f} px in common at places of the image; use a flat "
            "board with true squares, or let the lens have a third radial term"
        )
    return sentences


def _target(quality: CameraQuality) -> list[str]:
    """Advice on the image of the target, from the residuals of its dots."""
    sentences = []
    if abs(quality.azimuth_off_deg) > _AZIMUTH:
        sentences.append(
            f"it stands at azimuth {quality.azimuth_deg:.1f}°, {abs(quality.azimuth_off_deg):.1f}° from what rig.toml "
            "says; correct azimuth_deg there, or turn the target back"
        )
    if quality.residual_rms > _DOTS:
        sentences.append(
            f"dots of the target are {quality.residual_rms:.1f} px off their places; check the print, the focus and "
            "the board views"
        )
    if quality.left_out > 0.1 * quality.dots:
        sentences.append(
            f"{quality.left_out} of {quality.dots + quality.left_out} dots were left out as gross errors; clean the "
            "target, and keep glare and cables off it"
        )
    return sentences
