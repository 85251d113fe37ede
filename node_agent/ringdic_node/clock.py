"""Wall and monotonic time as an object, in whose place a test can put a clock of its own."""

from __future__ import annotations

import shutil
import subprocess
import time
from dataclasses import dataclass
from typing import Protocol


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
        """The present moment on the machine's clocks."""
        return Instant(wall_ns=time.time_ns(), monotonic_ns=time.monotonic_ns())

    def sleep(self, seconds: float) -> None:
        """Wait; a negative time is no wait."""
        time.sleep(max(seconds, 0.0))


def sleep_until(clock: Clock, wall_ns: int) -> None:
    """Wait until the wall clock has reached `wall_ns`; in short waits, so that a clock that is set meanwhile counts."""
    while (remaining := wall_ns - clock.now().wall_ns) > 0:
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
