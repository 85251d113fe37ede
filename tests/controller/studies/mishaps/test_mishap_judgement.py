"""What a run says is held against what went wrong: right cameras, right step, right thing, or silence."""

from dataclasses import replace
from typing import Any

import pytest
from ringdic_controller.studies.mishaps.changes import unchanged
from ringdic_controller.studies.mishaps.errors import RunErrors
from ringdic_controller.studies.mishaps.judgement import Outcome, RunRecord, judged_mishap
from ringdic_controller.studies.mishaps.rows import Expectation, MishapRow, calm_row

STEPS = ("0010-specimen", "0011-specimen", "0012-specimen")
GOOD = RunErrors((1000, 1000, 990), 0.0, 0.010, 0.005, 0.001, 0.0, 1.0)
WRONG = replace(GOOD, wrong=0.3, shape_mm=1.2, displacement_mm=0.4, beyond=0.9, spread=50.0)
LOST = replace(GOOD, measured=(1000, 1000, 0))
LARGER = replace(GOOD, shape_mm=0.05, displacement_mm=0.02)  # and within the stated σ
CALM = RunRecord(STEPS, GOOD)
BUMP = MishapRow("moved", "bump", "arc4", unchanged, Expectation(("cam_02",), (2,)))
EXCHANGE = MishapRow("order", "exchange", "arc4", unchanged, Expectation(("cam_02", "cam_03"), (None, 0)))
RADIUS = MishapRow("target", "radius", "arc4", unchanged, Expectation(words=("radius",)))


def finding(
    code: str = "camera-moved", cameras: tuple[str, ...] = (), step: str | None = None, sentence: str = ""
) -> Any:
    return {"code": code, "sentence": sentence, "cameras": list(cameras), "step": step, "verdict": "look at this"}


RIGHT = finding(cameras=("cam_02",), step=STEPS[2])


@pytest.mark.parametrize(
    ("row", "errors", "findings", "outcome"),
    [
        (BUMP, GOOD, [], Outcome.FOLLOWED),
        (BUMP, GOOD, [RIGHT], Outcome.FOLLOWED),
        (BUMP, GOOD, [finding(cameras=("cam_03",), step=STEPS[2])], Outcome.MISNAMED),
        (BUMP, WRONG, [], Outcome.SILENT),
        (BUMP, WRONG, [RIGHT], Outcome.NAMED),
        (BUMP, WRONG, [RIGHT, finding("camera-unmatched", cameras=("cam_03",))], Outcome.NAMED),
        (BUMP, WRONG, [RIGHT, finding(cameras=("cam_03",))], Outcome.MISNAMED),
        (BUMP, WRONG, [finding(cameras=("cam_03",), step=STEPS[2])], Outcome.MISNAMED),
        (BUMP, WRONG, [finding(cameras=("cam_02", "cam_03"), step=STEPS[2])], Outcome.MISNAMED),
        (BUMP, WRONG, [finding(cameras=("cam_02",), step=STEPS[1])], Outcome.MISNAMED),
        (BUMP, WRONG, [finding(cameras=("cam_02",))], Outcome.MISNAMED),  # of no step
        (BUMP, WRONG, [finding("area-unmeasured")], Outcome.SILENT),
        (BUMP, LARGER, [], Outcome.STATED),
        (BUMP, LOST, [], Outcome.SILENT),
        (BUMP, LOST, [finding("step-unmeasured", step=STEPS[2])], Outcome.LESS),
        (BUMP, LOST, [RIGHT], Outcome.NAMED),
        (EXCHANGE, WRONG, [finding(cameras=("cam_03", "cam_02"))], Outcome.NAMED),
        (EXCHANGE, WRONG, [finding(cameras=("cam_03",)), finding(cameras=("cam_02",), step=STEPS[0])], Outcome.NAMED),
        (EXCHANGE, WRONG, [finding(cameras=(f"cam_0{k}",)) for k in (1, 2, 3, 4)], Outcome.MISNAMED),  # each of all
        (EXCHANGE, WRONG, [finding(cameras=("cam_03",))], Outcome.MISNAMED),  # half of it
        (EXCHANGE, WRONG, [finding(cameras=("cam_01", "cam_02", "cam_03"))], Outcome.MISNAMED),
        (RADIUS, WRONG, [finding(sentence="the Radius is 57 mm")], Outcome.NAMED),
        (RADIUS, WRONG, [finding("area-unmeasured", sentence="check the radius, or the light")], Outcome.SILENT),
        (RADIUS, WRONG, [finding(sentence="the speckles are faint")], Outcome.SILENT),
        (calm_row("arc4"), GOOD, [], Outcome.CALM),
        (calm_row("arc4"), GOOD, [finding(cameras=("cam_02",))], Outcome.ALARM),
        (calm_row("arc4"), LARGER, [], Outcome.CALM),
        (calm_row("arc4"), WRONG, [], Outcome.SILENT),
        (calm_row("arc4"), LOST, [], Outcome.SILENT),
    ],
)
def test_outcomes(row: MishapRow, errors: RunErrors, findings: list[Any], outcome: Outcome) -> None:
    assert judged_mishap(row, RunRecord(STEPS, errors, tuple(findings)), CALM).outcome is outcome


def test_what_a_calm_row_says_of_unmeasured_surface_is_no_alarm_where_it_is_true() -> None:
    said = (finding("area-unmeasured"), finding("camera-unmatched", cameras=("cam_02",)))
    for uncovered, outcome in (
        ({"": 0.1, "cam_02": 1.0}, Outcome.LESS),
        ({"": 0.1, "cam_02": 0.01}, Outcome.ALARM),  # the camera sees what is covered
        ({"": 0.01, "cam_02": 1.0}, Outcome.ALARM),
        ({}, Outcome.ALARM),
    ):
        run = RunRecord(STEPS, GOOD, said, uncovered=uncovered)
        assert judged_mishap(calm_row("arc4"), run, run).outcome is outcome
    moved = RunRecord(STEPS, GOOD, (*said, finding(cameras=("cam_02",))), uncovered={"": 0.1, "cam_02": 1.0})
    assert judged_mishap(calm_row("arc4"), moved, moved).outcome is Outcome.ALARM


def test_a_wrong_result_with_five_sigma_outliers_is_not_within_sigma() -> None:
    outliers = replace(LARGER, beyond=0.002)
    assert judged_mishap(BUMP, RunRecord(STEPS, outliers), CALM).outcome is Outcome.SILENT


def test_where_two_cameras_contradict_each_other_both_may_be_named_but_not_the_wrong_one() -> None:
    assert BUMP.expected is not None
    doubtful = replace(BUMP, expected=replace(BUMP.expected, in_doubt=True))
    for cameras, outcome in ((("cam_01", "cam_02"), Outcome.NAMED), (("cam_01",), Outcome.MISNAMED)):
        run = RunRecord(STEPS, WRONG, (finding(cameras=cameras, step=STEPS[2]),))
        assert judged_mishap(doubtful, run, CALM).outcome is outcome


def test_what_the_calm_rig_says_too_is_neither_a_name_nor_a_blame() -> None:
    calm = replace(CALM, findings=(RIGHT,))
    assert judged_mishap(BUMP, RunRecord(STEPS, WRONG, (RIGHT,)), calm).outcome is Outcome.SILENT
    noisy = replace(calm_row("arc4"), mishap="noise")
    assert judged_mishap(noisy, RunRecord(STEPS, GOOD, (RIGHT,)), calm).outcome is Outcome.CALM
    assert judged_mishap(calm_row("arc4"), calm, calm).outcome is Outcome.ALARM


@pytest.mark.parametrize(
    ("row", "sentence", "outcome"),
    [
        (BUMP, "camera cam_02 has moved since the calibration", Outcome.REFUSED),
        (BUMP, "the speckles do not look alike", Outcome.WRONG_REASON),
        (RADIUS, "the radius of the target contradicts the board", Outcome.REFUSED),
        (RADIUS, "no camera pair gave a surface", Outcome.WRONG_REASON),
        (calm_row("arc4"), "no camera pair gave a surface", Outcome.ALARM),
    ],
)
def test_a_refusal_is_right_where_it_names_the_reason(row: MishapRow, sentence: str, outcome: Outcome) -> None:
    assert judged_mishap(row, RunRecord(STEPS, refusal=sentence), CALM).outcome is outcome


def test_a_fault_of_the_program_is_never_a_refusal() -> None:
    run = RunRecord(STEPS, refusal="camera cam_02", fault=True)
    assert judged_mishap(BUMP, run, CALM).outcome is Outcome.FAULT


def test_bad_outcomes_are_written_in_capitals() -> None:
    assert {each for each in Outcome if not each.is_good} == {
        Outcome.SILENT, Outcome.MISNAMED, Outcome.WRONG_REASON, Outcome.ALARM, Outcome.FAULT,
    }  # fmt: skip
