"""Codes of findings, which programs can rely on: for each the verdict that it leads to, and what it means."""

from __future__ import annotations

from enum import StrEnum


class Verdict(StrEnum):
    """What can be done with the results: use them, look at the findings first, or not use them at all."""

    SOUND = "sound"
    LOOK = "look at this"
    DO_NOT_USE = "do not use"

    @property
    def severity(self) -> int:
        """0 for sound, 1 for look at this, 2 for do not use."""
        return list(Verdict).index(self)


#: The exit code of a command whose results are not to be used.
DO_NOT_USE_EXIT = 4

_LOOK, _STOP = Verdict.LOOK, Verdict.DO_NOT_USE
#: For each code of a finding the verdict that it leads to, and what it means.
CODES: dict[str, tuple[Verdict, str]] = {
    # calibration
    "camera-not-calibrated": (_LOOK, "a camera has no image of the target, and takes no part"),
    "target-turned": (_LOOK, "the target is turned against the azimuths in rig.toml"),
    "target-measures": (_STOP, "the target does not have the measures of rig.toml"),
    "world-scale": (_STOP, "the target's measures are likely in other units"),
    "print-errors": (_LOOK, "dots of the target are printed off their places"),
    "print-errors-large": (_STOP, "dots of the target are far from where the target should have them"),
    "lens-contradicts-target": (_STOP, "the lenses that fit the target are not those that fit the board"),
    "board-not-flat": (_LOOK, "the checkerboard was bent"),
    "board-not-square": (_LOOK, "the squares of the checkerboard are longer than wide"),
    "camera-refocused": (_STOP, "a camera's focal length changed between board and target"),
    "wrong-board": (_STOP, "the board images of a camera are those of another camera"),
    "images-mirrored": (_STOP, "board and target images of a camera are not turned over alike"),
    # cameras
    "pair-left-out": (_LOOK, "two neighbouring cameras cannot be used together"),
    "camera-unmatched": (_LOOK, "a camera shares hardly a point with another"),
    "camera-moved": (_LOOK, "a camera moved after the calibration or between steps, and was followed"),
    "lens-refocused": (_LOOK, "a lens was refocused after the calibration or between steps, and was followed"),
    "images-exchanged": (_STOP, "the images of two cameras at the reference are exchanged"),
    "image-turned": (_STOP, "the specimen's reference image of a camera is mirrored or upside down"),
    "camera-contradicts": (_LOOK, "a camera contradicts all others at a step, and was left out there"),
    "camera-drift": (_LOOK, "by the method paper: matches lie off the epipolar lines in the mean; a camera moved"),
    "camera-moved-unknown": (_STOP, "a camera moved, and how is not known well enough"),
    # captures
    "instants-differ": (
        _STOP,
        "a rigid body changes its size with its distance from two cameras: they show different instants",
    ),
    "skew-exceeded": (_LOOK, "the cameras of a capture were exposed at different times"),
    "file-numbers-shifted": (_LOOK, "the file numbers of a camera differ from those that they are paired with"),
    # images
    "repeating-pattern": (_STOP, "the pattern repeats itself, so matches can be wrong by its period"),
    "coarse-speckle": (_LOOK, "speckles are as large as a subset"),
    "fine-speckle": (_LOOK, "speckles are as small as a pixel"),
    "image-repeated": (_STOP, "an image is that of another camera or step, pixel for pixel"),
    "image-missing": (_LOOK, "a camera has no image of a step"),
    "image-blurred": (_LOOK, "an image is more blurred than its reference"),
    "image-clipped": (_LOOK, "a good part of the pattern is white or black without any grey level"),
    "image-faint": (_LOOK, "an image has far less contrast than its reference"),
    "camera-lost-points": (_LOOK, "a camera lost far more points at a step than the others"),
    # surface
    "area-unmeasured": (_LOOK, "textured area that two cameras see was not measured"),
    "step-unmeasured": (_LOOK, "hardly a point was measured at a step, and its images do not show why"),
}
