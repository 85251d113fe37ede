"""Notice of the kernels being compiled, which happens once on a machine: afterwards they are loaded from a cache."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event


class _Listener(event.Listener):
    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell = tell
        self._told = False

    def on_start(self, _: event.Event) -> None:
        if not self._told:
            self._told = True
            self._tell()

    def on_end(self, _: event.Event) -> None:
        return


@contextmanager
def on_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Call ``tell`` once if a kernel is compiled inside; not if all are loaded."""
    with event.install_listener("numba:compile", _Listener(tell)):
        yield
