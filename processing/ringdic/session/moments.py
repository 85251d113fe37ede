"""Whether the images of a capture show one moment, as far as its record tells: measured times and file numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath
from statistics import median

from ringdic.findings import Finding
from ringdic.session.folder import Capture
from ringdic.session.numbering import number_conflict, shifted_numbers

_TOLERANCE_NS = 1_000_000  # skew that is not flagged where the record states none


def moment_findings(captures: Sequence[Capture]) -> list[Finding]:
    """Findings about captures whose images do not show one moment: skew beyond its tolerance, shifted file numbers.

    captures : of the specimen, in order of their number.
    """
    findings = [finding for capture in captures for finding in _skew(capture)]
    names: dict[str, list[str]] = {}
    for capture in captures:
        for camera, entry in capture.record.cameras.items():
            if entry.original is not None:
                names.setdefault(camera, []).append(PurePath(entry.original).name)
    complete = {camera: each for camera, each in names.items() if len(each) == len(captures)}
    conflict = number_conflict(complete)
    if conflict is not None:
        findings.append(
            Finding(
                "file-numbers-shifted", shifted_numbers(conflict), conflict.cameras,
                value=abs(conflict.shift), limit=0, unit="frames",
            )
        )  # fmt: skip
    return findings


def _skew(capture: Capture) -> list[Finding]:
    """The finding of a capture whose exposures lie further apart than is tolerated, with the cameras that are off."""
    times = {id_: entry.time_ns for id_, entry in capture.record.cameras.items() if entry.time_ns is not None}
    limit = capture.record.tolerance_ns or _TOLERANCE_NS
    if len(times) < 2 or max(times.values()) - min(times.values()) <= limit:
        return []
    middle = median(times.values())
    off = {id_: (time - middle) / 1e6 for id_, time in times.items() if abs(time - middle) > limit / 2}
    listed = ", ".join(f"camera {id_} by {ms:+.1f} ms" for id_, ms in off.items())
    skew = (max(times.values()) - min(times.values())) / 1e6
    sentence = (
        f"{capture.id}: the exposures lie {skew:.1f} ms apart (limit {limit / 1e6:g} ms), {listed} from the median; "
        "a body that moves meanwhile is measured wrongly: check the clock of these nodes, and capture again"
    )
    return [Finding("skew-exceeded", sentence, tuple(off), capture.id, round(skew, 3), limit / 1e6, "ms")]
