"""Child processes that run the processing: one for every job, or a warm one that serves order after order.

A child prints messages, which are JSON objects about progress, outcome or readiness (`ringdic.jobs.__main__` lists
them), and lines of log. Each has a guardian (`ringdic_controller.jobs.guardian`), so that no child outlives the
controller, however that ends.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
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

from ringdic_controller.jobs import guardian

logger = logging.getLogger(__name__)

Command = Callable[[Path], list[str]]
_KILL_AFTER = 5.0  # seconds that a child has to end by itself


@dataclass(frozen=True)
class Order:
    """What to process: the session in a folder or, with ``step`` (a capture's id), that step alone."""

    session: Path
    step: str | None = None


@dataclass(frozen=True)
class Warmth:
    """How ready the processing is: ``state`` is cold (starts with its job), warming, ready or ended.

    ``compiling`` tells whether the kernels are being compiled, which happens once; ``seconds`` how long warming took,
    s, or None before it has ended.
    """

    state: str
    compiling: bool = False
    seconds: float | None = None


class Work(Protocol):
    """An order that a child process is working on."""

    def lines(self) -> Iterator[str]:
        """Lines that the child prints about the order, until the order ends."""

    def wait(self) -> int:
        """Exit code, known after the last line; 0 if the order has ended and its child goes on."""

    def end(self) -> None:
        """End the child and everything it started, at once."""

    def give_way(self) -> None:
        """Ask the child to stop as soon as its intermediate results are cached; the order may complete before."""


class Processing(Protocol):
    """Carries out processing orders in child processes, one order at a time.

    ``on_change`` is called, from any thread, when the warmth has changed.
    """

    on_change: Callable[[], None]

    @property
    def live(self) -> bool:
        """Whether single steps can be ordered."""

    @property
    def warmth(self) -> Warmth:
        """How ready the processing is."""

    def warm(self) -> None:
        """Prepare for orders, where that is possible before the first."""

    def begin(self, order: Order) -> Work:
        """Start an order. Raises OSError if no child can be started."""

    def close(self) -> None:
        """End the children."""


class ChildPerJob:
    """Processing with a new child process for every order.

    command : gives the child's command line from the session's folder.
    """

    live = False
    warmth = Warmth("cold")

    def __init__(self, command: Command) -> None:
        self._command = command
        self.on_change: Callable[[], None] = lambda: None

    def warm(self) -> None:
        """Do nothing: there is no child between orders."""

    def begin(self, order: Order) -> Work:
        """Start the order's child."""
        return _OneOrderChild(_start(self._command(order.session)))

    def close(self) -> None:
        """Do nothing: there is no child between orders."""


class WarmChild:
    """Processing by one child process that stays: it loads the kernels once and caches what it has read.

    A child that ends, by itself or because its order is cancelled, is replaced at once. One that ends before it was
    ready is replaced only for the next order.

    Parameters
    ----------
    command
        Command line of the child; it reads orders as lines of JSON and prints when it is ready.
    settings
        File of settings for all orders; None for the defaults.
    """

    live = True

    def __init__(self, command: Sequence[str], settings: Path | None = None) -> None:
        self._command = list(command)
        self._settings = settings
        self.on_change: Callable[[], None] = lambda: None
        self._lock = Lock()  # guards the two below: one child at a time, and none after close
        self._child: _ServingChild | None = None
        self._closing = False

    @property
    def warmth(self) -> Warmth:
        """How ready the child is; cold before there is one."""
        child = self._child
        return Warmth("cold") if child is None else child.warmth

    def warm(self) -> None:
        """Start the child, unless one is alive."""
        with self._lock:
            self._ready_child()

    def begin(self, order: Order) -> Work:
        """Send the order to the child, or to a new one if it has ended. Raises OSError if none can be started."""
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


class _OneOrderChild:
    """A child that ends with its order."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def lines(self) -> Iterator[str]:
        return _lines(self._process)

    def wait(self) -> int:
        assert self._process.stdin is not None
        code = self._process.wait()
        self._process.stdin.close()
        return code

    def end(self) -> None:
        _end(self._process)

    def give_way(self) -> None:
        """Do nothing: a child that ends with its order would lose all intermediate results."""


class _ServingChild:
    """A warm child process: its warmth, and the order that it serves."""

    def __init__(self, command: list[str], on_change: Callable[[_ServingChild], None]) -> None:
        self._process = _start(command, orders=True)
        self._on_change = on_change
        self._lock = Lock()  # guards the work, its number and the child's input; never held while on_change is called
        self._work: _ServedWork | None = None
        self._number = 0
        self.warmth = Warmth("warming")  # this and the next are written by the following thread alone
        self.has_been_ready = False
        Thread(target=self._follow, name="processing", daemon=True).start()

    @property
    def ended(self) -> bool:
        return self.warmth.state == "ended" or self._process.poll() is not None

    def take(self, order: dict[str, Any]) -> _ServedWork:
        with self._lock:
            self._number += 1
            work = _ServedWork(self, self._number)
            if self.warmth.state == "ended":  # nobody follows the child any more
                work.put(None)
            else:
                self._work = work
        self.send({**order, "order": work.number})
        return work

    def send(self, message: dict[str, Any]) -> None:
        """Write a line to the child; if it has ended, that is noticed by the thread that follows its output."""
        assert self._process.stdin is not None
        with self._lock, suppress(OSError, ValueError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def end(self) -> None:
        _end(self._process)

    def wait(self) -> int:
        return self._process.wait()

    def _follow(self) -> None:
        """Pass the child's lines on to the order that they belong to, until the child ends."""
        for line in _lines(self._process):
            message = message_of(line)
            if message is not None and "worker" in message:
                self._note_warmth(message)
                continue
            with self._lock:
                work = self._work
                if work is not None and message is not None and "state" in message:
                    self._work = None
            if work is not None:
                work.put(line)
            elif line.strip():
                logger.info("processing: %s", line.rstrip())
        self._process.wait()
        with self._lock:
            self.warmth, work = Warmth("ended"), self._work
            self._work = None
        if work is not None:
            work.put(None)
        self._on_change(self)

    def _note_warmth(self, message: dict[str, Any]) -> None:
        seconds = message.get("seconds", self.warmth.seconds)
        self.warmth = Warmth(str(message["worker"]), bool(message.get("compiling", False)), seconds)
        self.has_been_ready = self.has_been_ready or self.warmth.state == "ready"
        self._on_change(self)


class _ServedWork:
    """One order of a warm child."""

    def __init__(self, child: _ServingChild, number: int) -> None:
        self.number = number
        self._child = child
        self._lines: SimpleQueue[str | None] = SimpleQueue()
        self._complete = False

    def put(self, line: str | None) -> None:
        """Add a line about the order; None when the child has ended."""
        self._lines.put(line)

    def lines(self) -> Iterator[str]:
        while (line := self._lines.get()) is not None:
            yield line
            message = message_of(line)
            if message is not None and "state" in message:
                self._complete = True
                return

    def wait(self) -> int:
        return 0 if self._complete else self._child.wait()

    def end(self) -> None:
        self._child.end()

    def give_way(self) -> None:
        self._child.send({"stop": self.number})


def message_of(line: str) -> dict[str, Any] | None:
    """The message in a line, a JSON object about progress, outcome or warmth; None for a line of log."""
    if not line.startswith("{"):
        return None
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return None
    is_message = isinstance(message, dict) and any(name in message for name in ("stage", "state", "worker"))
    return message if is_message else None


def serving_command() -> list[str]:
    """Command line of a warm child that runs this interpreter."""
    return [sys.executable, "-P", "-m", "ringdic.jobs", "--serve"]


def _start(command: list[str], orders: bool = False) -> subprocess.Popen[str]:
    """Start a command with a guardian, which holds the pipe to its standard input. Raises OSError."""
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, "no such program", command[0])
    guarded = [sys.executable, "-I", "-S", guardian.__file__, *(["--orders"] if orders else []), *command]
    return subprocess.Popen(
        guarded,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"},
        start_new_session=os.name == "posix",
    )


def _lines(child: subprocess.Popen[str]) -> Iterator[str]:
    """Lines that the child prints until it has ended, even if a grandchild keeps the pipe open."""
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
    """Ask the child and everything it started to end; kill them if they have not after some seconds."""
    _signal(child, signal.SIGTERM)
    try:
        child.wait(_KILL_AFTER)
    except subprocess.TimeoutExpired:
        _signal(child, getattr(signal, "SIGKILL", signal.SIGTERM))


def _signal(child: subprocess.Popen[str], number: int) -> None:
    if os.name == "posix":
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.killpg(child.pid, number)
    elif child.stdin is not None and not child.stdin.closed:  # the guardian ends the child
        with suppress(OSError):
            child.stdin.close()
    else:
        child.terminate()
