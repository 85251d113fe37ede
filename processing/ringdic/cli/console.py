"""What the commands print: progress bars, tables and sentences on standard error, JSON on standard output."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars
from rich.table import Table

from ringdic.progress import Progress, Report

_console = Console(stderr=True)


@contextmanager
def narrated() -> Iterator[Report]:
    """A progress bar with the stage, the rate and the time left; a line a stage where there is no terminal."""
    if not _console.is_terminal:
        yield _lines()
        return
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}  {task.fields[rate]}  {task.fields[message]}"),
    )
    with Bars(*columns, console=_console, transient=True) as bars:
        task = bars.add_task("", total=1.0, left="", rate="", message="")

        def report(progress: Progress) -> None:
            left = "" if progress.left_s is None else f"{progress.left_s:.0f} s left"
            bars.update(
                task,
                description=progress.stage,
                completed=progress.done,
                left=left,
                rate=progress.rate,
                message=progress.message,
            )

        yield report


def show_table(title: str, rows: Sequence[Mapping[str, str]]) -> None:
    """A table of figures on standard error; the columns are the keys of the first row."""
    if not rows:
        return
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(rows[0]):
        table.add_column(name, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*(escape(str(row[name])) for name in rows[0]))
    (_console if _console.is_terminal else Console(stderr=True, width=120)).print(table)


def say(sentence: str) -> None:
    """One sentence on standard error."""
    _console.print(sentence, highlight=False, soft_wrap=True, markup=False)


def print_json(value: Mapping[str, Any]) -> None:
    """One JSON object on a line of standard output; numbers of NumPy become JSON numbers."""
    sys.stdout.write(json.dumps(value, ensure_ascii=False, default=float) + "\n")


def _lines() -> Report:
    last = {"tenth": -1, "stage": ""}

    def report(progress: Progress) -> None:
        tenth = int(progress.done * 10)
        if progress.stage != last["stage"] or tenth != last["tenth"]:
            last.update(stage=progress.stage, tenth=tenth)
            left = "" if progress.left_s is None else f"{progress.left_s:.0f} s left"
            told = (progress.stage, progress.message, progress.rate, left)
            say(f"{progress.done:4.0%}  {'  '.join(part for part in told if part)}")

    return report
