"""MishapJudgement of a run with a mishap: how wrong its results are, and whether the program said what is wrong."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from ringdic_controller.studies.mishaps.errors import RunErrors
from ringdic_controller.studies.mishaps.rows import Expectation, MishapRow

FOLLOWED = 3.0  # times the errors of the calm row
WRONG_SHARE, BEYOND_SHARE = 1e-3, 1e-3  # of the values: wrong by more than 1 mm, beyond 5 σ
#: Codes of findings that say what is missing and list all that may help: they name no mishap by a word.
LOSSES = ("area-unmeasured", "step-unmeasured")
#: Codes of findings on what is not measured, which are no alarms in a calm row where the truth bears them out.
NOT_MEASURED, UNCOVERED = ("area-unmeasured", "camera-unmatched"), 0.03
COVERED = 0.9  # of the points that the calm row measures


class Outcome(StrEnum):
    """How the program fared with a mishap; capitals stand for what must not happen."""

    CALM = "calm"
    FOLLOWED = "followed"
    STATED = "within σ"
    NAMED = "named"
    REFUSED = "refused"
    LESS = "measured less"
    SILENT = "SILENT"
    MISNAMED = "MISNAMED"
    WRONG_REASON = "REFUSED, WRONG REASON"
    ALARM = "FALSE ALARM"
    FAULT = "FAULT"

    @property
    def is_good(self) -> bool:
        """Whether the operator is served: results are right, or he knows what to mend."""
        return not self.value.isupper()


@dataclass(frozen=True)
class RunRecord:
    """What a run of a row gave.

    errors : against the truth, None where nothing was measured. findings : as JSON objects. steps : names of the
    captures of the specimen. refusal : the sentence by which it was refused. fault : whether the program failed.
    uncovered : shares of the true surface that are not covered, by camera, and by "" of all, where they were asked for.
    """

    steps: tuple[str, ...]
    errors: RunErrors | None = None
    findings: tuple[dict[str, Any], ...] = ()
    refusal: str = ""
    fault: bool = False
    verdict: str = ""
    uncovered: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class MishapJudgement:
    """The outcome of a row and why. naming : codes of the findings that name the mishap; others : of the other ones."""

    outcome: Outcome
    reason: str
    naming: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


def judged_mishap(row: MishapRow, run: RunRecord, calm: RunRecord | None) -> MishapJudgement:
    """Judge a run. calm : of the same rig without a mishap; None where that could not be measured."""
    if run.fault:
        return MishapJudgement(Outcome.FAULT, run.refusal)
    if run.errors is None:
        return _judged_refusal(row, run)
    faults = wrong_figures(run.errors, None if calm is None else calm.errors)
    usual = () if calm is None or row.name == row.calm.name else calm.findings
    news = [each for each in run.findings if not _among(each, usual)]
    if row.expected is None:
        return _judged_calm(row, run, news, faults)
    naming = naming_findings(row.expected, news, run.steps)
    others = [each for each in news if each not in naming]
    codes = _codes(naming), _codes(others)
    reason = "; ".join(faults)
    if naming:
        return MishapJudgement(Outcome.FOLLOWED if not faults else Outcome.NAMED, reason, *codes)
    blaming = [each for each in others if each["cameras"]]
    if not faults:
        outcome = Outcome.MISNAMED if blaming else Outcome.FOLLOWED
        return MishapJudgement(outcome, "another is blamed" if blaming else "", *codes)
    if run.errors.holds_in_sigma and not any(fault.startswith("lost") for fault in faults):
        return MishapJudgement(Outcome.MISNAMED if blaming else Outcome.STATED, reason, *codes)
    if others and all(fault.startswith("lost") for fault in faults):
        return MishapJudgement(Outcome.MISNAMED if blaming else Outcome.LESS, reason, *codes)
    return MishapJudgement(Outcome.MISNAMED if blaming else Outcome.SILENT, reason, *codes)


def wrong_figures(errors: RunErrors, calm: RunErrors | None) -> list[str]:
    """What is wrong in a run: errors larger than three times those of the calm row, and points lost, each in words."""
    if calm is None:
        return ["there is no calm run to compare with"]
    faults = []
    if errors.wrong > calm.wrong + WRONG_SHARE:
        faults.append(f"{100 * errors.wrong:.1f} % of the points are off by more than 1 mm")
    for name, value, usual, unit in (
        ("shape", errors.shape_mm, calm.shape_mm, "mm"),
        ("displacement", errors.displacement_mm, calm.displacement_mm, "mm"),
        ("stretch", errors.stretch, calm.stretch, ""),
    ):
        if value > FOLLOWED * usual:
            faults.append(f"{name} is off by {value:.4f} {unit}".rstrip() + f", calm {usual:.4f}")
    for step, (count, usual_count) in enumerate(zip(errors.measured, calm.measured, strict=False)):
        if count < COVERED * usual_count:
            faults.append(f"lost {100 * (1 - count / usual_count):.0f} % of the points at step {step}")
    return faults


def naming_findings(
    expected: Expectation, findings: Sequence[dict[str, Any]], steps: Sequence[str]
) -> list[dict[str, Any]]:
    """The findings that name what is to be mended: together all cameras, and each the step and the thing.

    A code by which other cameras are blamed too names nothing.

    findings : as JSON objects. steps : names of the captures of the specimen.
    """
    meant = set(expected.cameras)
    allowed = [None if number is None else steps[number] for number in expected.steps if (number or 0) < len(steps)]

    def fits(finding: dict[str, Any]) -> bool:
        named = set(finding["cameras"])
        cameras = not meant or (bool(named) and (named <= meant or (expected.in_doubt and named >= meant)))
        step = not allowed or finding["step"] in allowed
        vague = bool(expected.words) and finding["code"] in LOSSES
        return cameras and step and not vague and _has_word(expected.words, (finding["code"], finding["sentence"]))

    astray = {
        each["code"] for each in findings if meant and not expected.in_doubt and not set(each["cameras"]) <= meant
    }
    fitting = [each for each in findings if fits(each) and each["code"] not in astray]
    complete = meant <= {camera for each in fitting for camera in each["cameras"]}
    return fitting if complete else []


def _judged_refusal(row: MishapRow, run: RunRecord) -> MishapJudgement:
    """A refusal is right where its sentence names cameras and thing; a calm row is never to be refused."""
    if row.expected is None:
        return MishapJudgement(Outcome.ALARM, f"refused: {run.refusal}")
    named = all(camera in run.refusal for camera in row.expected.cameras)
    blamed = named and _has_word(row.expected.words, (run.refusal,))
    return MishapJudgement(Outcome.REFUSED if blamed else Outcome.WRONG_REASON, run.refusal)


def _judged_calm(
    row: MishapRow, run: RunRecord, findings: Sequence[dict[str, Any]], faults: Sequence[str]
) -> MishapJudgement:
    """A calm row is measured without a word but true ones, as well as the calmest or within the stated σ."""
    assert run.errors is not None
    wrong = [
        each for each in findings if not (row.tolerated and _has_word(row.tolerated, (each["code"], each["sentence"])))
    ]
    alarms = [each for each in wrong if not _is_true(each, run)]
    if alarms:
        return MishapJudgement(Outcome.ALARM, "; ".join(each["sentence"] for each in alarms), others=_codes(alarms))
    if row.calm.name == row.name and run.errors.wrong > WRONG_SHARE:
        share = 100 * run.errors.wrong
        return MishapJudgement(Outcome.SILENT, f"{share:.1f} % of the points are off by more than 1 mm")
    lost = any(fault.startswith("lost") for fault in faults)
    if faults and (lost or not run.errors.holds_in_sigma):
        return MishapJudgement(Outcome.SILENT, "; ".join(faults))
    if wrong:
        reason = f"{100 * run.uncovered['']:.0f} % of what two cameras see are not covered"
        return MishapJudgement(Outcome.LESS, reason, others=_codes(wrong))
    return MishapJudgement(Outcome.CALM, "; ".join(faults))


def _is_true(finding: dict[str, Any], run: RunRecord) -> bool:
    """Whether something was not measured, as a finding says, of what these cameras, or any two, see of the surface."""
    concerned = finding["cameras"] or [""]
    return finding["code"] in NOT_MEASURED and all(run.uncovered.get(id_, 0.0) > UNCOVERED for id_ in concerned)


def _has_word(words: Sequence[str], texts: Iterable[str]) -> bool:
    joined = " ".join(texts).lower()
    return not words or any(word in joined for word in words)


def _among(finding: dict[str, Any], usual: Sequence[dict[str, Any]]) -> bool:
    """Whether the calm run has a finding of this code about these cameras too."""
    return any(each["code"] == finding["code"] and each["cameras"] == finding["cameras"] for each in usual)


def _codes(findings: Iterable[dict[str, Any]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(f"{each['code']}({' '.join(each['cameras'])})" for each in findings))
