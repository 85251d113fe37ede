"""Output of the commands: tables and sentences on standard error, JSON on standard output."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

_console = Console(stderr=True)


def show_table(title: str, rows: Sequence[Mapping[str, str]]) -> None:
    """Print a table of figures on standard error; the columns are the keys of the first row."""
    if not rows:
        return
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(rows[0]):
        table.add_column(name, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*(escape(str(row[name])) for name in rows[0]))
    (_console if _console.is_terminal else Console(stderr=True, width=120)).print(table)


def say(sentence: str) -> None:
    """Print one sentence on standard error."""
    _console.print(sentence, highlight=False, soft_wrap=True, markup=False)


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on a line of standard output; numbers of NumPy become JSON numbers."""
    sys.stdout.write(json.dumps(value, ensure_ascii=False, default=float) + "\n")
