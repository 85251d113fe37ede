"""How a long computation tells where it is. The caller decides what to show: a bar, a line of JSON, nothing."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """One report. ``done`` is the share of the whole job, 0 … 1; ``left_s`` an estimate in seconds, or None."""

    stage: str
    done: float
    message: str = ""
    rate: str = ""
    left_s: float | None = None


Report = Callable[[Progress], None]


def silent(_: Progress) -> None:
    """Report nothing."""


@dataclass
class Stages:
    """Turns "k of n in this stage" into the share of the whole job and the time left.

    weights : the expected share of each stage, in order; they need not sum to one.
    clock : seconds, monotonic.
    """

    weights: dict[str, float]
    report: Report
    clock: Callable[[], float] = time.monotonic
    _started: float = field(init=False)

    def __post_init__(self) -> None:
        self._started = self.clock()

    def at(self, stage: str, fraction: float, message: str = "", rate: str = "") -> None:
        """Say that ``fraction`` of ``stage`` is done."""
        total = sum(self.weights.values())
        before = 0.0
        for name, weight in self.weights.items():
            if name == stage:
                break
            before += weight
        done = (before + fraction * self.weights[stage]) / total
        elapsed = self.clock() - self._started
        left = elapsed * (1 - done) / done if done > 0.02 else None
        self.report(Progress(stage, min(done, 1.0), message, rate, left))
