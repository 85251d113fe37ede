"""Progress reports of long computations, and a progress bar that shows them.

A computation calls a function with a :class:`Progress` from time to time; the caller decides what to do with it: show a
bar, print a line of JSON, or nothing.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """Progress of a computation at one moment.

    done : share of the whole job, 0 … 1. rate : speed, in words. left_s : estimate of the time left, s, or None.
    """

    stage: str
    done: float
    message: str = ""
    rate: str = ""
    left_s: float | None = None

    @property
    def time_left(self) -> str:
        """The time left in words, such as "12 s left"; empty where it is not known."""
        return "" if self.left_s is None else f"{self.left_s:.0f} s left"


Report = Callable[[Progress], None]


def silent(_: Progress) -> None:
    """Report nothing."""


@dataclass
class Stages:
    """Reports of a job in several stages: share of the whole job done, and time left, from the share of a stage done.

    weights : the expected duration of each stage, in any unit, in order; they need not sum to one.
    clock : seconds, monotonic.
    """

    weights: dict[str, float]
    report: Report
    clock: Callable[[], float] = time.monotonic
    _started: float = field(init=False)

    def __post_init__(self) -> None:
        self._started = self.clock()

    def at(self, stage: str, fraction: float, message: str = "", rate: str = "") -> None:
        """Report that ``fraction`` of ``stage`` is done."""
        total = sum(self.weights.values())
        before = 0.0
        for name, weight in self.weights.items():
            if name == stage:
                break
            before += weight
        done = (before + fraction * self.weights[stage]) / total
        elapsed = self.clock() - self._started
        left = elapsed * (1 - done) / done if done > 0.02 else None
        self.report(Progress(stage, min(done, 1.0), message, rate, left))


@contextmanager
def progress_bar() -> Iterator[Report]:
    """A bar with the stage, the rate and the time left, on a terminal's standard error or in a notebook.

    Where there is neither, a line is written to standard error whenever a new stage or another tenth begins. Yields
    the function to report to; the bar vanishes at the end.
    """
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if not (console.is_terminal or (console.is_jupyter and _has_widgets())):
        yield _lines()
        return
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}  {task.fields[rate]}  {task.fields[message]}"),
    )
    with Bars(*columns, console=console, transient=True) as bars:
        task = bars.add_task("", total=1.0, left="", rate="", message="")

        def report(progress: Progress) -> None:
            bars.update(
                task,
                description=progress.stage,
                completed=progress.done,
                left=progress.time_left,
                rate=progress.rate,
                message=progress.message,
            )

        yield report


def _has_widgets() -> bool:
    """Whether a notebook can show a bar that changes."""
    from importlib.util import find_spec

    return find_spec("ipywidgets") is not None


def _lines() -> Report:
    last: tuple[str, int, bool] | None = None

    def report(progress: Progress) -> None:
        nonlocal last
        new = (progress.stage, int(progress.done * 10), progress.message.startswith(COMPILING))
        if new != last:
            last = new
            parts = (progress.stage, progress.message, progress.rate, progress.time_left)
            sys.stderr.write(f"{progress.done:4.0%}  {'  '.join(part for part in parts if part)}\n")

    return report


#: The message of a report while kernels are compiled, which happens once after each installation or update.
COMPILING = "compiling the kernels, once: about a minute"
