"""Measurement of a node's clock over the link, as NTP does it: question, answer, four readings. Standard library only.

A question leaves at the controller's time t1, reaches the node at its time t2, the answer leaves the node at t3 and
arrives at t4. Each way takes half of the delay (t4 - t1) - (t3 - t2), give or take that half: an asymmetric or a slow
link makes the stated error larger, never the offset wrong by more than it. Both clocks of the exchange are monotonic
ones, so a wall clock that is set disturbs no measurement; each answer has the node's wall clock beside it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ringdic_controller.rig.frame_grid import FrameTiming

EXCHANGES = 32  # that are remembered
DRIFT = 50e-6  # largest difference of the rates of two machines' clocks that are left alone
SLEWED = 0.2  # largest difference while one of them is driven to another time, as chrony does
QUIET_NS = 10_000_000_000  # without a contradiction, until a clock counts as left alone again
READINGS = 3  # pairs of readings of the wall clock and the monotonic clock
STEP_NS = 1_000_000  # a larger change of a node's wall clock against its monotonic one: the clock was set


def wall_start_ns(
    wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
) -> int:
    """Time by this machine's wall clock at which its monotonic clock was zero, ns since the Unix epoch.

    From the closest of a few pairs of readings, since a busy machine may stop between the two of a pair.
    """
    pairs = []
    for _ in range(READINGS):
        before, wall, after = monotonic_ns(), wall_ns(), monotonic_ns()
        pairs.append((after - before, wall - (before + after) // 2))
    return min(pairs)[1]


@dataclass(frozen=True)
class ClockExchange:
    """One question to a node's clock and its answer, ns.

    asked_ns, answered_ns : the controller's monotonic clock when the question left and when the answer was there.
    received_ns, sent_ns : the node's monotonic clock when the question was there and when the answer left. wall_ns :
    the node's wall clock at `sent_ns`.
    """

    asked_ns: int
    received_ns: int
    sent_ns: int
    answered_ns: int
    wall_ns: int

    @property
    def delay_ns(self) -> int:
        """Time that question and answer were on their way, ns."""
        return (self.answered_ns - self.asked_ns) - (self.sent_ns - self.received_ns)

    @property
    def lead_ns(self) -> int:
        """Lead of the node's monotonic clock over the controller's, ns, if both ways took equally long."""
        return ((self.received_ns - self.asked_ns) + (self.sent_ns - self.answered_ns)) // 2


@dataclass(frozen=True)
class ClockEstimate:
    """What is known of a node's clocks at a moment.

    lead_ns : lead of the node's monotonic clock over the controller's, ns. error_ns : bound of its error. start_ns :
    time by the node's wall clock at which its monotonic clock was zero, ns since the Unix epoch. steps : how often the
    clock was set since it is observed.
    """

    lead_ns: int
    error_ns: int
    start_ns: int
    steps: int = 0

    def zero_ns(self, controller_start_ns: int) -> int:
        """Time by the controller's wall clock at which the node's monotonic clock was zero, ns since the Unix epoch.

        controller_start_ns : time by the controller's wall clock at which the controller's monotonic clock was zero.
        """
        return controller_start_ns - self.lead_ns

    def offset_ns(self, controller_start_ns: int) -> int:
        """Offset of the node's wall clock from the controller's, ns; positive: ahead."""
        return self.start_ns - self.zero_ns(controller_start_ns)


class NodeClock:
    """A node's clock as measured by repeated exchanges, of which the one with the least delay counts.

    An exchange that contradicts the earlier ones beyond their errors and the clocks' drift tells that one of the two
    machines was started anew or that its clock is being driven to another time: the earlier ones are dropped, and for a
    while the error that is stated grows as fast as a clock can be driven.
    """

    def __init__(self) -> None:
        self._exchanges: deque[ClockExchange] = deque(maxlen=EXCHANGES)
        self._start_ns: int | None = None
        self._steps = 0
        self._contradicted_ns: int | None = None  # the last time, by the controller's monotonic clock
        self.last_step_ns = 0  # by how much the node's wall clock was set the last time, ns

    def note(self, exchange: ClockExchange) -> bool:
        """Take an exchange into account; True if it tells that the node's clock was set, or runs anew."""
        if exchange.delay_ns < 0:
            return False  # an answer from before its question: no measurement
        changed = False
        best = self._best(exchange.answered_ns)
        if best is not None:
            allowed = self._bound(best, exchange.answered_ns) + exchange.delay_ns / 2
            if abs(exchange.lead_ns - best.lead_ns) > allowed:
                self._exchanges.clear()
                self._contradicted_ns = exchange.answered_ns
                self._steps += 1
                changed = True
        self._exchanges.append(exchange)
        start_ns = exchange.wall_ns - exchange.sent_ns
        if self._start_ns is not None and abs(start_ns - self._start_ns) > STEP_NS:
            self.last_step_ns = start_ns - self._start_ns
            self._steps += not changed
            changed = True
        self._start_ns = start_ns
        return changed

    def estimate(self, now_ns: int) -> ClockEstimate | None:
        """What is known at a moment of the controller's monotonic clock, ns; None before the first exchange."""
        best = self._best(now_ns)
        if best is None or self._start_ns is None:
            return None
        return ClockEstimate(best.lead_ns, round(self._bound(best, now_ns)), self._start_ns, self._steps)

    def _best(self, now_ns: int) -> ClockExchange | None:
        return min(self._exchanges, key=lambda exchange: self._bound(exchange, now_ns), default=None)

    def _bound(self, exchange: ClockExchange, now_ns: int) -> float:
        """Largest error of the lead that an exchange measured, at a moment, ns."""
        driven = self._contradicted_ns is not None and exchange.answered_ns - self._contradicted_ns < QUIET_NS
        return exchange.delay_ns / 2 + (SLEWED if driven else DRIFT) * abs(now_ns - exchange.answered_ns)


@dataclass(frozen=True)
class NodeTiming:
    """What is known of a node's clock and frames by the controller's wall clock, ns.

    zero_ns : time at which the node's monotonic clock was zero. offset_ns : offset of the node's wall clock. error_ns :
    bound of the error of both. frames : times of the camera's frames, where it takes frames continuously.
    """

    zero_ns: int
    offset_ns: int
    error_ns: int
    frames: FrameTiming | None = None


def clock_fault(timing: NodeTiming | None, tolerance_ns: int) -> str | None:
    """Why a node's clock is not known well enough to capture with; None if it is.

    An offset of any size is corrected; what counts is that it is known to within the tolerance, ns.
    """
    if timing is None:
        return "its clock could not be measured: the node does not answer that question; update its software"
    if timing.error_ns <= tolerance_ns:
        return None
    return (
        f"its clock is known to ±{timing.error_ns / 1e6:.1f} ms only (offset {timing.offset_ns / 1e6:+.1f} ms, "
        f"tolerance {tolerance_ns / 1e6:g} ms), because the link to it is slow: wait until its images are delivered, "
        "use a cable, or raise tolerance_us in rig.toml"
    )
