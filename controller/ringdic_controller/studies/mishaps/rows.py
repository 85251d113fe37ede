"""The rows of the study: which mishap befalls which camera of which rig, and what the program should name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from ringdic.errors import InputError
from ringdic_node.virtual_rig.bodies import solid_bodies
from ringdic_node.virtual_rig.scenes import SolidMotion, SolidSpecimen

from ringdic_controller.studies.gallery.rows import MODERATE, RIGID
from ringdic_controller.studies.mishaps.changes import Change, unchanged
from ringdic_controller.studies.mishaps.measurement import PlannedMeasurement, moving_specimens

RANDOM = "random"  # group of the calm rows that are drawn, which are measured only where they are asked for
_RANDOM_RIGS = ("arc2", "arc3", "arc4", "arc5", "ring6", "ring8", "ring12")


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
    at the last step. body : its name in the gallery. seed : of cameras, board and speckles; 0 but in random calm rows.
    """

    group: str
    mishap: str
    rig: str
    change: Change
    expected: Expectation | None
    tolerated: tuple[str, ...] = ()
    motion: SolidMotion = MODERATE
    body: str = "limb"
    seed: int = 0

    @property
    def name(self) -> str:
        """Name of the row, such as ``bumped-after-calibration-3px-turned-rows-arc4``."""
        return "-".join([self.mishap, *([] if self.body == "limb" else [self.body]), self.rig])

    @property
    def calm(self) -> MishapRow:
        """The row in which nothing goes wrong with the same body in the same rig; of a random row, itself."""
        return calm_row(self.rig, self.body) if self.seed == 0 else self

    @property
    def specimens(self) -> tuple[SolidSpecimen, ...]:
        """The body at the reference and at every step: the truth."""
        return moving_specimens(self.motion, self.body, self.seed)

    def planned(self, scale: float) -> PlannedMeasurement:
        """The measurement with the mishap. scale : of the images."""
        return self.change(PlannedMeasurement.calm(self.rig, scale, self.specimens, self.seed))


def random_rows(count: int) -> list[MishapRow]:
    """Rows in which nothing goes wrong: rigs, bodies, places of the cameras, speckles and motions at random."""
    return [_random_row(seed) for seed in range(1, count + 1)]


def _random_row(seed: int) -> MishapRow:
    rng = np.random.default_rng([seed, 100])
    body, rig = str(rng.choice(sorted(solid_bodies()))), str(rng.choice(_RANDOM_RIGS))
    strain = 0.0 if body.startswith("plate") else 1.0
    x, y, z = (float(each) for each in rng.uniform(-1.5, 1.5, 3))
    turns = tuple(float(each) for each in rng.uniform(-2.0, 2.0, 3))
    motion = SolidMotion(
        stretch=strain * float(rng.uniform(-0.04, 0.05)), swell=strain * float(rng.uniform(-0.04, 0.05)),
        swell_z=float(rng.uniform(-60.0, 60.0)), swell_width=float(rng.uniform(50.0, 90.0)),
        twist=strain * float(rng.uniform(-4e-4, 4e-4)), turn_deg=(turns[0], turns[1], turns[2]), shift=(x, y, z),
    )  # fmt: skip
    return MishapRow(RANDOM, f"random-{seed}", rig, unchanged, None, motion=motion, body=body, seed=seed)


def calm_row(rig: str, body: str = "limb") -> MishapRow:
    """The row of a body in a rig in which nothing goes wrong, with which the others are compared."""
    return MishapRow("calm", "calm", rig, unchanged, None, motion=usual_motion(body), body=body)


def usual_motion(body: str) -> SolidMotion:
    """The motion of a body of a name: plates keep their form, others deform."""
    return RIGID if body.startswith("plate") else MODERATE


def selected_rows(rows: Sequence[MishapRow], only: Sequence[str]) -> list[MishapRow]:
    """The rows with these names, groups or rigs, or whose name begins so; where none is given, all but the random ones.

    Raises InputError for a name that selects no row.
    """

    def meant(row: MishapRow, name: str) -> bool:
        return name in (row.name, row.group) or row.name.startswith(name) or (name == row.rig and row.group != RANDOM)

    for name in only:
        if not any(meant(row, name) for row in rows):
            known = ", ".join(row.name for row in rows if row.group != RANDOM)
            raise InputError(
                f"--only: there is no mishap '{name}'; groups are {', '.join(_groups(rows))}, rows {known}"
            )
    if not only:
        return [row for row in rows if row.group != RANDOM]
    return [row for row in rows if any(meant(row, name) for name in only)]


def _groups(rows: Sequence[MishapRow]) -> Iterator[str]:
    yield from dict.fromkeys(row.group for row in rows)
