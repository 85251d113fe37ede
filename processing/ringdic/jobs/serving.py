"""A warm processing: kernels loaded, what was read is kept, and one order after the other is carried out.

Orders come as lines of JSON, ``{"order": 1, "session": PATH, "step": null | CAPTURE, "settings": null | FILE}``;
``{"stop": 1}`` asks order 1 to stop at its next report of progress. Told, as lines of JSON too, are
``{"worker": "warming", "compiling": true}`` and ``{"worker": "ready", "seconds": 1.2}``, and of an order what
`ringdic.jobs.__main__` tells, with ``{"state": "stopped"}`` as a third outcome. It ends when no orders can come any
more.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any

from ringdic.errors import RingdicError
from ringdic.jobs.live_step import process_step
from ringdic.jobs.pipeline import process_session
from ringdic.progress import Progress, Report
from ringdic.settings import Settings, load_settings
from ringdic.tasks import kept

Say = Callable[[dict[str, Any]], None]
_MOST_KEPT, _USUAL_MEMORY = 4 << 30, 8 << 30  # bytes
_NICE = 10  # compiling must not slow a capture down


def _memory() -> int:
    """Bytes to keep between orders: all reference images of a ring of twelve, prepared, take 1.5 GB."""
    try:
        whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not told on this system
        whole = _USUAL_MEMORY
    return int(min(_MOST_KEPT, max(kept.limit, whole // 4)))


class StoppedError(Exception):
    """The order was asked to stop."""


def serve(lines: Iterable[str], say: Say) -> None:
    """Carry out the orders of ``lines``, warmed up before the first."""
    orders = _Orders(lines)
    began = time.monotonic()
    kept.limit = _memory()
    say({"worker": "warming"})
    compile_and_load()
    say({"worker": "ready", "seconds": round(time.monotonic() - began, 1)})
    while (order := orders.next()) is not None:
        say(_carried_out(order, say, orders))


def compile_and_load() -> None:
    """Have the kernels compiled at low priority, where they are not yet, and load them."""
    lowered = getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
    command = [sys.executable, "-P", "-m", "ringdic.jobs", "--compile"]
    subprocess.run(command, check=False, stdin=subprocess.DEVNULL, creationflags=lowered)
    _load_kernels()


def _load_kernels() -> None:
    from ringdic.correlation.correlate import load_kernels
    from ringdic.jobs.warm_up import run_small_plate

    load_kernels()
    run_small_plate()


def compile_kernels(say: Say) -> None:
    """Compile the kernels into their cache, where they are not there, at low priority; tells if it does compile."""
    if hasattr(os, "nice"):
        os.nice(_NICE)
    from ringdic.correlation.warming import on_compiling

    with on_compiling(lambda: say({"worker": "warming", "compiling": True})):
        _load_kernels()


def carry_out(session: Path, settings: Settings, report: Report, step: str | None = None) -> dict[str, Any]:
    """Process a session, or a step of it at once; the outcome as JSON values.

    Raises RingdicError for what an operator can mend.
    """
    if step is not None:
        process_step(session, step, settings, report)
        return {"state": "done", "step": step}
    run = process_session(session, settings, report)
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    return {"state": "done", "run": run.name, "summary": summary}


def told(progress: Progress) -> dict[str, Any]:
    """A report of progress as JSON values."""
    return {name: getattr(progress, name) for name in ("stage", "done", "message", "rate", "left_s")}


def _carried_out(order: dict[str, Any], say: Say, orders: _Orders) -> dict[str, Any]:
    def report(progress: Progress) -> None:
        if orders.stopped(order["order"]):
            raise StoppedError
        say(told(progress))

    settings = order.get("settings")
    try:
        chosen = load_settings(None if settings is None else Path(settings))
        return carry_out(Path(order["session"]), chosen, report, order.get("step"))
    except StoppedError:
        return {"state": "stopped"}
    except RingdicError as error:
        return {"state": "failed", "error": str(error)}


class _Orders:
    """Orders as they come, read by a thread, so that an order can be stopped while it is carried out."""

    def __init__(self, lines: Iterable[str]) -> None:
        self._waiting: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        self._stop: int | None = None
        self._over = False
        Thread(target=self._read, args=(lines,), name="orders", daemon=True).start()

    def next(self) -> dict[str, Any] | None:
        """The next order, waited for; None when there will be none."""
        return self._waiting.get()

    def stopped(self, number: int) -> bool:
        """Whether an order is not wanted any more."""
        return self._over or self._stop == number

    def _read(self, lines: Iterable[str]) -> None:
        for line in lines:
            message = json.loads(line)
            if "stop" in message:
                self._stop = message["stop"]
            else:
                self._waiting.put(message)
        self._over = True
        self._waiting.put(None)
