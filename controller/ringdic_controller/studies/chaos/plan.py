"""Plan of what goes wrong in which capture, drawn from a seed: the same seed gives the same plan."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

#: What may go wrong, and with whom. Each kind comes once before any comes twice.
KINDS = {
    "kill a node": "node",
    "kill the controller": "controller",
    "freeze a node": "node",
    "freeze the controller": "controller",
    "full disk of a node": "node",
    "full disk of the controller": "controller",
    "cut link of a node": "node",
    "slow link of a node": "node",
    "two nodes of one id": "node",
    "manifests of another release": "node",
    "forged acknowledgements and broken messages": "network",
}
#: Moments that are aimed at, s from the planned moment of the exposure: as soon as the record exists, just before the
#: exposure, while the sensor is read out, while the image is stored, while it is delivered.
MOMENTS = (-9.0, -0.02, 0.05, 0.32, 0.5)
READOUT = 0.3  # s, of the simulated sensors


@dataclass(frozen=True)
class PlannedMishap:
    """One thing that goes wrong.

    capture : number of the capture in which it does, from 1. kind : one of `KINDS`. victim : camera id; empty for the
    controller and the network. after : s from the planned moment of the exposure. rest : s until it is undone.
    """

    capture: int
    kind: str
    victim: str
    after: float
    rest: float


def plan_mishaps(seed: int, cameras: Sequence[str], captures: int) -> list[PlannedMishap]:
    """Draw what goes wrong: one thing in each capture but the first, two in every third.

    seed : any number. cameras : ids. captures : number of captures.
    """
    draw = random.Random(seed)
    kinds: list[str] = []
    planned = []
    for capture in range(2, captures + 1):
        for _ in range(2 if capture % 3 == 0 else 1):
            if not kinds:
                kinds = draw.sample(list(KINDS), len(KINDS))
            kind = kinds.pop()
            victim = draw.choice(cameras) if KINDS[kind] == "node" else ""
            moment = draw.choice(MOMENTS) if draw.random() < 0.7 else draw.uniform(-0.5, 2.0)
            planned.append(PlannedMishap(capture, kind, victim, moment, draw.uniform(0.5, 3.0)))
    return planned
