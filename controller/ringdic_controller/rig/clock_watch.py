"""Repeated measurement of the clocks of a rig's nodes, over whatever asks a node for its clock."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable

from ringdic_node.wire import ClockReading

from ringdic_controller.rig.clocks import ClockExchange, NodeClock, NodeTiming
from ringdic_controller.rig.frame_grid import frame_timing

log = logging.getLogger(__name__)

TIMEOUT = 1.0  # s, longest wait for an answer
EVERY = 2.0  # s, between two measurements of all clocks
EXCHANGES = 4  # of one of these
ARM_EXCHANGES = 24  # before a camera is armed


class ClockWatch:
    """The measured clocks of a rig's nodes, and a thread that measures them again and again, as they drift.

    May be used from several threads.

    Parameters
    ----------
    cameras
        Ids of the cameras.
    ask : callable (camera, on_answer)
        Asks a node for its clock and returns at once; `on_answer` is called with its reading, or None for an answer
        that is none, as soon as the answer is there, or never.
    alive : callable ()
        Ids of the cameras whose nodes are connected.
    tolerance_ns
        Error of an offset, ns, far below which no further question is needed.
    monotonic_ns
        The controller's monotonic clock, ns.
    """

    def __init__(
        self,
        cameras: Iterable[str],
        ask: Callable[[str, Callable[[ClockReading | None], None]], None],
        alive: Callable[[], list[str]],
        tolerance_ns: int,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._ask = ask
        self._alive = alive
        self._enough_ns = tolerance_ns / 4
        self._monotonic_ns = monotonic_ns
        self._lock = threading.Lock()  # guards the two below
        self._clocks = {camera: NodeClock() for camera in cameras}
        self._readings: dict[str, ClockReading] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clocks", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self, timeout: float) -> None:
        """End the thread; wait for it at most ``timeout`` seconds."""
        self._stop.set()
        self._thread.join(timeout)

    def _run(self) -> None:
        while not self._stop.wait(EVERY):
            for camera in self._alive():
                if not self._stop.is_set():
                    self.measure(camera, EXCHANGES)

    def timing(self, camera: str, start_ns: int) -> NodeTiming | None:
        """What is known of a node's clock and frames, by the controller's wall clock; None if it was not measured.

        start_ns : time at which the controller's monotonic clock was zero, ns since the Unix epoch.
        """
        with self._lock:
            estimate = self._clocks[camera].estimate(self._monotonic_ns())
            reading = self._readings.get(camera)
        if estimate is None or reading is None:
            return None
        offset_ns = estimate.offset_ns(start_ns)
        frames = frame_timing(reading.frame_time_ns, reading.frame_period_ns, offset_ns)
        return NodeTiming(estimate.zero_ns(start_ns), offset_ns, estimate.error_ns, frames)

    def measure(self, camera: str, exchanges: int) -> None:
        """Ask a node for its clock until its offset is known well enough, at most so many times, or it is silent."""
        for _ in range(exchanges):
            if not self._exchange(camera):
                return
            timing = self.timing(camera, 0)
            if timing is not None and timing.error_ns < self._enough_ns:
                return

    def _exchange(self, camera: str) -> bool:
        """Ask a node for its clock once; False if it does not answer in time."""
        answers: queue.SimpleQueue[tuple[int, ClockReading | None]] = queue.SimpleQueue()
        asked_ns = self._monotonic_ns()
        self._ask(camera, lambda reading: answers.put((self._monotonic_ns(), reading)))
        try:
            answered_ns, reading = answers.get(timeout=TIMEOUT)
        except queue.Empty:
            return False
        if reading is None or reading.node != camera:
            return False
        exchange = ClockExchange(asked_ns, reading.received_ns, reading.sent_ns, answered_ns, reading.wall_ns)
        with self._lock:
            clock = self._clocks[camera]
            self._readings[camera] = reading
            changed = clock.note(exchange)
        if changed:
            step_ms = clock.last_step_ns / 1e6
            log.warning("the clock of node %s was set (by %+.1f ms), or the node was started anew", camera, step_ms)
        return True
