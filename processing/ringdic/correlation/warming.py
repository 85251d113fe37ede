"""Notification of callers when numba kernels have to be compiled.

That happens once on a machine; afterwards they are loaded from a cache on disk.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from numba.core import event

from ringdic.progress import COMPILING, Progress, Report


class _Listener(event.Listener):
    def __init__(self, notify: Callable[[], None]) -> None:
        self._notify = notify
        self._notified = False

    def on_start(self, _: event.Event) -> None:
        if not self._notified:
            self._notified = True
            self._notify()

    def on_end(self, _: event.Event) -> None:
        return


@contextmanager
def on_compiling(notify: Callable[[], None]) -> Iterator[None]:
    """Context that calls ``notify`` once when a kernel is compiled in it; not if all are loaded from the cache."""
    with event.install_listener("numba:compile", _Listener(notify)):
        yield


@contextmanager
def compiling_reported(report: Report) -> Iterator[Report]:
    """Context that forwards progress reports, and adds a message when kernels are compiled in it.

    report : receives everything. Yields the function for the computation to report to.
    """
    last = Progress("prepare", 0.0)

    def passed_on(progress: Progress) -> None:
        nonlocal last
        last = progress
        report(progress)

    with on_compiling(lambda: report(replace(last, message=COMPILING))):
        yield passed_on
