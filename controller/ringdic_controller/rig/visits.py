"""Visits to the nodes: each is visited when it appears and at an interval, one after the other."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable

log = logging.getLogger(__name__)


class NodeVisits:
    """A thread that visits nodes.

    Parameters
    ----------
    visit : callable (camera)
        Visits the node of a camera.
    alive : callable ()
        Ids of the cameras whose nodes are connected.
    before_round : callable ()
        Called at each interval, before the nodes are visited.
    interval : float
        Seconds between two visits of all nodes.
    """

    def __init__(
        self,
        visit: Callable[[str], None],
        alive: Callable[[], list[str]],
        before_round: Callable[[], None],
        interval: float,
    ) -> None:
        self._visit = visit
        self._alive = alive
        self._before_round = before_round
        self._interval = interval
        self._wanted: queue.Queue[str | None] = queue.Queue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reconciler", daemon=True)

    @property
    def stopped(self) -> bool:
        """Whether the visits are to end."""
        return self._stop.is_set()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def ask_for(self, camera: str) -> None:
        """Visit a node soon; returns at once."""
        self._wanted.put(camera)

    def end(self) -> None:
        """Visit no further node."""
        self._stop.set()
        self._wanted.put(None)

    def join(self, timeout: float) -> None:
        """Wait until the thread has ended, at most ``timeout`` seconds."""
        self._thread.join(timeout)

    def _run(self) -> None:
        due = time.monotonic() + self._interval
        while not self._stop.is_set():
            try:
                camera = self._wanted.get(timeout=max(due - time.monotonic(), 0.0))
            except queue.Empty:
                due = time.monotonic() + self._interval
                self._guarded(self._before_round)
                for name in self._alive():
                    if self._stop.is_set():
                        return
                    self._guarded(self._visit, name)
            else:
                if camera is not None:
                    self._guarded(self._visit, camera)

    def _guarded(self, act: Callable[..., None], *arguments: str) -> None:
        try:
            act(*arguments)
        except Exception:
            if not self.stopped:
                log.exception("a visit to the nodes failed: %s", arguments)
