"""Wall and monotonic time as an object, in whose place a test can put a clock of its own."""

from __future__ import annotations

import shutil
import subprocess
import time
from dataclasses import dataclass
from typing import Protocol

READINGS = 5  # pairs of readings of the two clocks, of which the closest is taken
CLOSE_NS = 5_000  # two readings so close that no further pair is needed
STEP_NS = 1_000_000  # a larger change of the wall clock against the monotonic one is a step: the clock was set


@dataclass(frozen=True)
class Instant:
    """One moment on both clocks, ns. Wall time is compared between machines, monotonic time measures waits."""

    wall_ns: int
    monotonic_ns: int


class Clock(Protocol):
    """A clock that gives the present moment and waits."""

    def now(self) -> Instant:
        """The present moment on both clocks."""

    def sleep(self, seconds: float) -> None:
        """Wait; a negative time is no wait."""


class SystemClock:
    """The clocks of this machine."""

    def now(self) -> Instant:
        """The present moment on the machine's clocks, from the closest of a few pairs of readings."""
        best: tuple[int, Instant] | None = None
        for _ in range(READINGS):
            before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            if best is None or after - before < best[0]:
                best = after - before, Instant(wall, (before + after) // 2)
            if after - before < CLOSE_NS:
                break
        assert best is not None
        return best[1]

    def sleep(self, seconds: float) -> None:
        """Wait; a negative time is no wait."""
        time.sleep(max(seconds, 0.0))


@dataclass(frozen=True)
class RigClock:
    """The controller's wall clock, by which the rig's cameras fire, told from this node's monotonic clock.

    zero_ns : the controller's time at which this node's monotonic clock was zero, ns since the Unix epoch; None where
    the controller has not measured it: then this node's wall clock stands for it.
    """

    zero_ns: int | None = None

    def time_ns(self, now: Instant) -> int:
        """The controller's time at a moment of this node, ns since the Unix epoch."""
        return now.wall_ns if self.zero_ns is None else now.monotonic_ns + self.zero_ns

    def offset_ns(self, now: Instant) -> int:
        """Offset of this node's wall clock from the controller's at a moment of this node, ns; positive: ahead."""
        return now.wall_ns - self.time_ns(now)


def sleep_until(clock: Clock, wall_ns: int) -> None:
    """Wait for the moment that is `wall_ns` by the wall clock as it stands at the call.

    A wall clock that is set meanwhile changes neither the moment nor the length of the wait.
    """
    start = clock.now()
    end_ns = start.monotonic_ns + wall_ns - start.wall_ns
    while (remaining := end_ns - clock.now().monotonic_ns) > 0:
        clock.sleep(min(remaining / 1e9, 0.05))


def clock_offset() -> tuple[float, float] | None:
    """Offset of this machine's clock from its time server and the bound of its error, ms, from chrony; else None."""
    command = shutil.which("chronyc")
    if command is None:
        return None
    try:
        answer = subprocess.run([command, "-c", "tracking"], capture_output=True, text=True, timeout=2.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return parse_tracking(answer.stdout)


def parse_tracking(line: str) -> tuple[float, float] | None:
    """Offset and error bound, ms, from the line of ``chronyc -c tracking``; None if unsynchronised.

    Fields counted from 0: 4 offset of the system clock, 10 root delay, 11 root dispersion, all in seconds.
    chrony bounds the error by |offset| + dispersion + delay / 2.
    """
    columns = line.strip().split(",")
    try:
        stratum = int(columns[2])
        offset, delay, dispersion = (float(columns[i]) for i in (4, 10, 11))
    except (IndexError, ValueError):
        return None
    if stratum == 0:
        return None
    return 1e3 * offset, 1e3 * (abs(offset) + dispersion + delay / 2)
