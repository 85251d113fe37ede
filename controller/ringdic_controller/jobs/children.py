"""The processing's child processes: one for every job, or a warm one that carries out order after order.

A child prints lines: objects of JSON that tell of progress or of the outcome (see `ringdic.jobs.__main__`), and log.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import Any, Protocol

logger = logging.getLogger(__name__)

Command = Callable[[Path], list[str]]
_KILL_AFTER = 5.0  # seconds that a child has to end by itself


@dataclass(frozen=True)
class Order:
    """What to process: a whole session, or with ``step`` (a capture's id) that step alone, at once."""

    session: Path
    step: str | None = None


@dataclass(frozen=True)
class Warmth:
    """How ready the processing is: ``cold`` (starts with its job), ``warming``, ``ready`` or ``ended``.

    compiling : the kernels are being compiled, which happens once. seconds : what warming took, None before.
    """

    state: str
    compiling: bool = False
    seconds: float | None = None


class Work(Protocol):
    """An order being carried out."""

    def lines(self) -> Iterator[str]:
        """What is printed about it, to its end."""

    def wait(self) -> int:
        """0, or the exit code of a child that ended; after the last line."""

    def end(self) -> None:
        """Stop it with everything it started."""

    def give_way(self) -> None:
        """Ask it to stop as soon as it can without losing what it has found; it may be done before."""


class Processing(Protocol):
    """Carries out one order at a time. ``on_change`` is told, from any thread, that its warmth has changed."""

    on_change: Callable[[], None]

    @property
    def live(self) -> bool:
        """Whether single steps can be ordered."""

    @property
    def warmth(self) -> Warmth:
        """How ready it is."""

    def warm(self) -> None:
        """Get ready, if that can be done before there is an order."""

    def begin(self, order: Order) -> Work:
        """Have an order carried out. OSError if no child can be started."""

    def close(self) -> None:
        """End the children."""


class ChildPerJob:
    """A child of its own for every order; ``command`` makes its command line of the session's folder."""

    live = False
    warmth = Warmth("cold")

    def __init__(self, command: Command) -> None:
        self._command = command
        self.on_change: Callable[[], None] = lambda: None

    def warm(self) -> None:
        """Nothing can be kept warm."""

    def begin(self, order: Order) -> Work:
        """Start the child."""
        return _OwnChild(_start(self._command(order.session)))

    def close(self) -> None:
        """Nothing runs between jobs."""


class WarmChild:
    """One child that loads kernels and keeps what it has read between the orders of a session.

    Parameters
    ----------
    command
        Its command line; it reads orders as lines of JSON and tells when it is ready.
    settings
        A file of settings for all orders.

    A child that ends, by itself or by being cancelled, is replaced; a new one that ends before it was ready is not,
    until the next order.
    """

    live = True

    def __init__(self, command: Sequence[str], settings: Path | None = None) -> None:
        self._command = list(command)
        self._settings = settings
        self.on_change: Callable[[], None] = lambda: None
        self._lock = Lock()
        self._child: _ServingChild | None = None
        self._closing = False

    @property
    def warmth(self) -> Warmth:
        """How ready the child is."""
        child = self._child
        return Warmth("cold") if child is None else child.warmth

    def warm(self) -> None:
        """Start the child, if there is none."""
        with self._lock:
            self._ready_child()

    def begin(self, order: Order) -> Work:
        """Hand the order to the child; a new one if it has ended."""
        with self._lock:
            child = self._ready_child()
        settings = None if self._settings is None else str(self._settings)
        return child.take({**asdict(order), "session": str(order.session), "settings": settings})

    def close(self) -> None:
        """End the child."""
        with self._lock:
            self._closing = True
            child = self._child
        if child is not None:
            child.end()

    def _ready_child(self) -> _ServingChild:
        if self._child is None or self._child.ended:
            self._child = _ServingChild(self._command, self._changed)
        return self._child

    def _changed(self, child: _ServingChild) -> None:
        if child.ended and child.has_been_ready:
            with self._lock, suppress(OSError):
                if not self._closing and self._child is child:
                    self._ready_child()
        self.on_change()


class _OwnChild:
    """A child whose life is one order."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def lines(self) -> Iterator[str]:
        return _lines(self._process)

    def wait(self) -> int:
        return self._process.wait()

    def end(self) -> None:
        _end(self._process)

    def give_way(self) -> None:
        """It would lose everything; let it finish."""


class _ServingChild:
    """A warm child: its process, what it says, and the order it carries out."""

    def __init__(self, command: list[str], on_change: Callable[[_ServingChild], None]) -> None:
        self._process = _start(command, orders=True)
        self._on_change = on_change
        self._lock = Lock()
        self._work: _Served | None = None
        self._number = 0
        self.warmth = Warmth("warming")
        self.has_been_ready = False
        Thread(target=self._follow, name="processing", daemon=True).start()

    @property
    def ended(self) -> bool:
        return self.warmth.state == "ended" or self._process.poll() is not None

    def take(self, order: dict[str, Any]) -> _Served:
        with self._lock:
            self._number += 1
            work = self._work = _Served(self, self._number)
        self.tell({**order, "order": work.number})
        return work

    def tell(self, message: dict[str, Any]) -> None:
        """Write a line to the child; one that has ended will be noticed by whoever follows it."""
        assert self._process.stdin is not None
        with self._lock, suppress(OSError, ValueError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def end(self) -> None:
        _end(self._process)

    def wait(self) -> int:
        return self._process.wait()

    def _follow(self) -> None:
        """Pass its lines on to the order that they belong to."""
        for line in _lines(self._process):
            said = message_of(line)
            if said is not None and "worker" in said:
                self._tell_warmth(said)
                continue
            with self._lock:
                work = self._work
                if work is not None and said is not None and "state" in said:
                    self._work = None
            if work is not None:
                work.say(line)
            elif line.strip():
                logger.info("processing: %s", line.rstrip())
        self._process.wait()
        with self._lock:
            self.warmth, work = Warmth("ended"), self._work
            self._work = None
        if work is not None:
            work.say(None)
        self._on_change(self)

    def _tell_warmth(self, said: dict[str, Any]) -> None:
        took = said.get("seconds", self.warmth.seconds)
        self.warmth = Warmth(str(said["worker"]), bool(said.get("compiling", False)), took)
        self.has_been_ready = self.has_been_ready or self.warmth.state == "ready"
        self._on_change(self)


class _Served:
    """One order of a warm child."""

    def __init__(self, child: _ServingChild, number: int) -> None:
        self.number = number
        self._child = child
        self._lines: SimpleQueue[str | None] = SimpleQueue()
        self._done = False

    def say(self, line: str | None) -> None:
        self._lines.put(line)

    def lines(self) -> Iterator[str]:
        while (line := self._lines.get()) is not None:
            yield line
            said = message_of(line)
            if said is not None and "state" in said:
                self._done = True
                return

    def wait(self) -> int:
        return 0 if self._done else self._child.wait()

    def end(self) -> None:
        self._child.end()

    def give_way(self) -> None:
        self._child.tell({"stop": self.number})


def message_of(line: str) -> dict[str, Any] | None:
    """The JSON object of a line about progress, outcome or warmth; None for a line of log."""
    if not line.startswith("{"):
        return None
    try:
        message = json.loads(line)
    except json.JSONDecodeError:
        return None
    known = isinstance(message, dict) and any(name in message for name in ("stage", "state", "worker"))
    return message if known else None


def serving_command() -> list[str]:
    """The command of a warm child of this interpreter."""
    return [sys.executable, "-P", "-m", "ringdic.jobs", "--serve"]


def _start(command: list[str], orders: bool = False) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE if orders else subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"},
        start_new_session=os.name == "posix",
    )


def _lines(child: subprocess.Popen[str]) -> Iterator[str]:
    """The child's lines until it has ended, even if a grandchild keeps the pipe open."""
    lines: SimpleQueue[str | None] = SimpleQueue()

    def read() -> None:
        assert child.stdout is not None
        with child.stdout:
            for line in child.stdout:
                lines.put(line)
        lines.put(None)

    Thread(target=read, name="job-output", daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=1.0)
        except Empty:
            if child.poll() is not None:
                return
            continue
        if line is None:
            return
        yield line


def _end(child: subprocess.Popen[str]) -> None:
    """Ask the child and everything it started to end; insist after a while."""
    _signal(child, signal.SIGTERM)
    try:
        child.wait(_KILL_AFTER)
    except subprocess.TimeoutExpired:
        _signal(child, getattr(signal, "SIGKILL", signal.SIGTERM))


def _signal(child: subprocess.Popen[str], number: int) -> None:
    try:
        if os.name == "posix":
            os.killpg(child.pid, number)
        else:
            child.terminate()
    except ProcessLookupError:  # it has ended meanwhile
        return
