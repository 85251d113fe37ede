"""Columns of the load at the steps, beside what was measured on the surface."""

from __future__ import annotations

import math
from pathlib import Path

from ringdic.measure.table import Column, Table
from ringdic.session.load import load_series


def with_load(table: Table, session: Path) -> Table:
    """The table with a column ``load_NAME`` for each load channel of its captures, NaN where a capture has none.

    A table without a column ``capture`` is returned as it is. session : the folder. Raises InputError for a damaged
    ``load.json``.
    """
    if "capture" not in [column.name for column in table.columns]:
        return table
    captures = list(dict.fromkeys(table["capture"]))
    columns, notes = [], list(table.notes)
    for series in load_series([Path(session) / "captures" / str(name) for name in captures]):
        by_capture = dict(zip(captures, series.values, strict=True))
        columns.append(Column(f"load_{series.name}", series.unit, tuple(by_capture[name] for name in table["capture"])))
        unknown = [str(name) for name, value in by_capture.items() if math.isnan(value)]
        if unknown:
            notes.append(f"load channel '{series.name}' is not known at {', '.join(unknown)}")
    return Table((*table.columns, *columns), tuple(notes))
