"""The rows of the study: which mishap befalls which camera of which rig, and what the program should name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ringdic.errors import InputError
from ringdic_node.virtual_rig.scenes import SolidMotion, SolidSpecimen

from ringdic_controller.studies.gallery.rows import MODERATE, RIGID
from ringdic_controller.studies.mishaps.changes import Change, unchanged
from ringdic_controller.studies.mishaps.measurement import PlannedMeasurement, moving_specimens


@dataclass(frozen=True)
class Expectation:
    """What a finding must name, so that the operator knows what to mend.

    cameras : exactly these, or none where the mishap is no single camera's. steps : numbers of the steps that it may
    name, of which None stands for the whole run; empty where any will do. words : of which one must occur in code or
    sentence; empty where any will do. in_doubt : whether further cameras may be named with these, as where two
    contradict each other and no third can tell which is wrong.
    """

    cameras: tuple[str, ...] = ()
    steps: tuple[int | None, ...] = ()
    words: tuple[str, ...] = ()
    in_doubt: bool = False


@dataclass(frozen=True)
class MishapRow:
    """One mishap in one rig.

    group : of the mishaps that are alike, such as "moved". expected : what is to be named; None for a calm row, which
    must be measured without a word. tolerated : words of findings that a calm row may have. motion : of the body, whole
    at the last step. body : its name in the gallery.
    """

    group: str
    mishap: str
    rig: str
    change: Change
    expected: Expectation | None
    tolerated: tuple[str, ...] = ()
    motion: SolidMotion = MODERATE
    body: str = "limb"

    @property
    def name(self) -> str:
        """Name of the row, such as ``bumped-after-calibration-3px-turned-rows-arc4``."""
        return "-".join([self.mishap, *([] if self.body == "limb" else [self.body]), self.rig])

    @property
    def calm(self) -> MishapRow:
        """The row in which nothing goes wrong with the same body in the same rig."""
        return calm_row(self.rig, self.body)

    @property
    def specimens(self) -> tuple[SolidSpecimen, ...]:
        """The body at the reference and at every step: the truth."""
        return moving_specimens(self.motion, self.body)

    def planned(self, scale: float) -> PlannedMeasurement:
        """The measurement with the mishap. scale : of the images."""
        return self.change(PlannedMeasurement.calm(self.rig, scale, self.specimens))


def calm_row(rig: str, body: str = "limb") -> MishapRow:
    """The row of a body in a rig in which nothing goes wrong, with which the others are compared."""
    return MishapRow("calm", "calm", rig, unchanged, None, motion=usual_motion(body), body=body)


def usual_motion(body: str) -> SolidMotion:
    """The motion of a body of a name: plates keep their form, others deform."""
    return RIGID if body.startswith("plate") else MODERATE


def selected_rows(rows: Sequence[MishapRow], only: Sequence[str]) -> list[MishapRow]:
    """The rows with these names, groups, mishaps or rigs, or whose name begins with one; all where none is given.

    Raises InputError for a name that selects no row.
    """

    def meant(row: MishapRow, name: str) -> bool:
        return name in (row.name, row.group, row.rig) or row.name.startswith(name)

    for name in only:
        if not any(meant(row, name) for row in rows):
            known = ", ".join(row.name for row in rows)
            raise InputError(
                f"--only: there is no mishap '{name}'; groups are {', '.join(_groups(rows))}, rows {known}"
            )
    return [row for row in rows if not only or any(meant(row, name) for name in only)]


def _groups(rows: Sequence[MishapRow]) -> Iterator[str]:
    yield from dict.fromkeys(row.group for row in rows)
