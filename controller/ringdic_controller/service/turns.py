"""Turns at work that costs memory or time: few at once, a few more wait, and whoever comes then is refused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import BoundedSemaphore

from ringdic_controller.service.refusals import BusyError


class Turns:
    """Turns at one sort of work. Without a bound on who waits, requests for it would take all threads of the server.

    Parameters
    ----------
    what
        The work in words, for the refusal, such as "pictures are asked for".
    at_once, waiting
        How many work, and how many more may wait.
    """

    def __init__(self, what: str, at_once: int, waiting: int) -> None:
        self._what = what
        self._inside = BoundedSemaphore(at_once + waiting)
        self._working = BoundedSemaphore(at_once)

    @contextmanager
    def take(self) -> Iterator[None]:
        """Context of one turn; waits for it. Raises BusyError if too many wait already."""
        if not self._inside.acquire(blocking=False):
            raise BusyError(f"More {self._what} at this moment than the controller can; ask again in a few seconds.")
        try:
            with self._working:
                yield
        finally:
            self._inside.release()
