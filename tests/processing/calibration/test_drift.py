"""Cameras that moved are named, with the step and by how much; steady ones are not."""

import numpy as np
from ringdic.calibration.drift import drift_findings

STEPS = ("0001-specimen", "0002-specimen", "0003-specimen")


def test_steady_cameras_are_not_spoken_of() -> None:
    still = {"1-2": np.array([0.01, -0.02, 0.03]), "2-3": np.array([np.nan, np.nan, np.nan])}
    assert drift_findings(still, STEPS) == ()
    assert drift_findings({}, STEPS) == ()


def test_a_camera_that_moved_after_the_calibration_and_one_that_moves_are_told_apart() -> None:
    drift = {
        "201-202": np.array([-0.15, -0.15, -0.14]),
        "202-203": np.array([0.01, 0.02, -0.23]),
        "203": np.array([np.nan, -0.11, 0.12]),  # followed alone: nothing is measured at the reference
        "204": np.array([0.0, 0.0, 0.0]),
    }
    before, later = drift_findings(drift, STEPS)
    assert before.sentence.startswith("cameras 201-202: at the reference")
    assert "-0.15 px" in before.sentence
    assert later.sentence.startswith("cameras 202-203, 203: matches drift")
    assert "-0.24 px in the mean in 0003-specimen (202-203)" in later.sentence
    assert (before.step, later.step) == ("0001-specimen", "0003-specimen")
    assert later.cameras == ("202-203", "203")


def test_the_limit_is_the_user_s() -> None:
    drift = {"a": np.array([0.0, 0.04])}
    assert drift_findings(drift, STEPS, limit=0.03) != ()
    assert drift_findings(drift, STEPS, limit=0.05) == ()
