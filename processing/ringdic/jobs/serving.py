"""A waiting worker process that keeps its kernels loaded and processes sessions on order, one after the other.

Orders are lines of JSON on standard input, ``{"order": 1, "session": PATH, "step": null | CAPTURE, "settings": null |
FILE}``; with a ``step``, only that capture is processed. ``{"stop": 1}`` asks order 1 to stop at its next
report of progress.

Reports are lines of JSON too. At the start come ``{"worker": "warming", "compiling": true}``, where kernels have to be
compiled, and ``{"worker": "ready", "seconds": 1.2}``. An order is answered by the lines that
`ringdic.jobs.__main__` describes, with ``{"state": "stopped"}`` as a third outcome. The process ends when its standard
input does.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any

from ringdic.errors import RingdicError
from ringdic.jobs.compiling import compile_once
from ringdic.jobs.live_step import process_step
from ringdic.jobs.pipeline import process_session
from ringdic.progress import Progress, Report
from ringdic.settings import Settings, load_settings
from ringdic.tasks import process_memory

Say = Callable[[dict[str, Any]], None]
_MOST_KEPT = 4 << 30  # bytes of prepared images that stay in memory between orders
_TYPICAL_MEMORY = 8 << 30  # bytes, where the system does not say how much there is


def _memory() -> int:
    """Bytes of prepared images to keep between orders; the reference images of a ring of twelve take 1.5 GB."""
    try:
        whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # this system does not say
        whole = _TYPICAL_MEMORY
    return int(min(_MOST_KEPT, max(process_memory.limit, whole // 4)))


class StoppedError(Exception):
    """Raised in a computation to stop it, when its order is cancelled."""


def serve(lines: Iterable[str], say: Say) -> None:
    """Load all kernels, then carry out the orders in ``lines`` until these end; ``say`` is called with each report."""
    orders = _Orders(lines)
    began = time.monotonic()
    process_memory.limit = _memory()
    say({"worker": "warming"})
    compile_and_load(say)
    say({"worker": "ready", "seconds": round(time.monotonic() - began, 1)})
    while (order := orders.next()) is not None:
        say(_carried_out(order, say, orders))


def compile_and_load(say: Say) -> None:
    """Load all kernels; those that are not in the cache are compiled first, by processes of low priority.

    say : called if there are any.
    """
    from ringdic.correlation.correlate import load_kernels
    from ringdic.jobs.warm_up import run_small_plate

    compile_once(lambda done, count, _: say({"worker": "warming", "compiling": done < count}))
    load_kernels()
    run_small_plate()


def carry_out(session: Path, settings: Settings, report: Report, step: str | None = None) -> dict[str, Any]:
    """Process a session, or one step of it, and return the outcome as JSON values.

    session : its folder. settings : of the run. report : called with the progress. step : the only capture to
    process; None processes all.
    Raises RingdicError for faults that the operator can correct.
    """
    if step is not None:
        process_step(session, step, settings, report)
        return {"state": "done", "step": step}
    run = process_session(session, settings, report)
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    return {"state": "done", "run": run.name, "summary": summary}


def _carried_out(order: dict[str, Any], say: Say, orders: _Orders) -> dict[str, Any]:
    def report(progress: Progress) -> None:
        if orders.stopped(order["order"]):
            raise StoppedError
        say(asdict(progress))

    settings = order.get("settings")
    try:
        chosen = load_settings(None if settings is None else Path(settings))
        return carry_out(Path(order["session"]), chosen, report, order.get("step"))
    except StoppedError:
        return {"state": "stopped"}
    except RingdicError as error:
        return {"state": "failed", "error": str(error)}


class _Orders:
    """Orders as they arrive. A thread reads them, so that an order can be stopped while it is carried out."""

    def __init__(self, lines: Iterable[str]) -> None:
        self._waiting: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        self._stop: int | None = None
        self._over = False
        Thread(target=self._read, args=(lines,), name="orders", daemon=True).start()

    def next(self) -> dict[str, Any] | None:
        """The next order; waits for it. None when no more can arrive."""
        return self._waiting.get()

    def stopped(self, number: int) -> bool:
        """Whether an order is to stop: it was asked to, or nobody is left who could read its outcome."""
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
