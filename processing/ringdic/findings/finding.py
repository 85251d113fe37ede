"""Findings of a run about its own images and cameras, and the verdict that follows from them.

A finding is something that may make results wrong or incomplete: a camera that moved, a target that contradicts its
measures, a repeating pattern. Each has a stable code, which programs can rely on, and the verdict that it leads to. The
verdict of a run is the worst of those of its findings.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ringdic.findings.codes import CODES, Verdict

_NAMED = 3  # cameras at most that a headline names


@dataclass(frozen=True)
class Finding:
    """Something that may make results wrong or incomplete, with the number that shows it.

    code : one of `CODES`. sentence : what was measured where, and what to do. cameras : ids of the cameras concerned.
    step : the capture concerned, None for all. value, limit : the number that shows it and where a finding begins, in
    `unit`; None where it is no matter of a number. accepted : whether the operator has accepted this code beforehand.
    """

    code: str
    sentence: str
    cameras: tuple[str, ...] = ()
    step: str | None = None
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    accepted: bool = False

    def __post_init__(self) -> None:
        if self.code not in CODES:
            raise ValueError(f"'{self.code}' is no code of a finding")

    @property
    def verdict(self) -> Verdict:
        """The verdict that this finding leads to; one that was accepted is still to be looked at."""
        return Verdict.LOOK if self.accepted else CODES[self.code][0]

    def to_json(self) -> dict[str, Any]:
        """The finding as a JSON object, with its verdict."""
        return {**asdict(self), "cameras": list(self.cameras), "verdict": str(self.verdict)}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Finding:
        """The finding from the JSON object of :meth:`to_json`."""
        known = {name: value for name, value in values.items() if name != "verdict"}
        return cls(**{**known, "cameras": tuple(known["cameras"])})


def overall_verdict(findings: Iterable[Finding]) -> Verdict:
    """The worst of the verdicts of some findings; sound where there are none."""
    return max((finding.verdict for finding in findings), key=lambda each: each.severity, default=Verdict.SOUND)


def verdict_headline(findings: Sequence[Finding]) -> str:
    """The verdict of some findings and what it is about, in one line, such as "do not use: camera cam_02".

    It is about the cameras that the gravest findings name, up to three, or else about what the first of these means.
    """
    verdict = overall_verdict(findings)
    gravest = [finding for finding in findings if finding.verdict == verdict]
    if not gravest:
        return str(verdict)
    cameras = list(dict.fromkeys(camera for finding in gravest for camera in finding.cameras))
    if 0 < len(cameras) <= _NAMED:
        return f"{verdict}: camera {', '.join(cameras)}"
    return f"{verdict}: {CODES[gravest[0].code][1]}"


def verdict_figures(findings: Sequence[Finding], accepted: Sequence[str] = ()) -> dict[str, Any]:
    """The verdict and its headline, the findings of a run, the gravest first, and their sentences, as JSON values.

    accepted : codes of findings that the operator has accepted; they are marked, and no longer forbid the use.
    """
    marked = [Finding(**{**vars(each), "accepted": each.code in accepted}) for each in findings]
    marked.sort(key=lambda each: -each.verdict.severity)
    return {
        "verdict": str(overall_verdict(marked)),
        "headline": verdict_headline(marked),
        "findings": [each.to_json() for each in marked],
        "warnings": [each.sentence for each in marked],
    }
