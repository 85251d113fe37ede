"""Tables of measurements: named columns of equal length, each with its unit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Column:
    """A column of a table. unit : "" for text and for numbers without a unit."""

    name: str
    unit: str
    values: tuple[Any, ...]

    @property
    def heading(self) -> str:
        """Name with unit, as in ``displacement [mm]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class Table:
    """Columns of equal length, and notes about them."""

    columns: tuple[Column, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len({len(column.values) for column in self.columns}) > 1:
            raise ValueError("columns of different lengths")

    @classmethod
    def of_rows(cls, rows: Sequence[dict[str, Any]], units: dict[str, str], notes: Sequence[str] = ()) -> Table:
        """A table from rows that all have the same keys. units : of the columns that have one."""
        names = list(rows[0]) if rows else []
        columns = (Column(name, units.get(name, ""), tuple(row[name] for row in rows)) for name in names)
        return cls(tuple(columns), tuple(notes))

    def __getitem__(self, name: str) -> tuple[Any, ...]:
        """The values of a column; KeyError if there is none."""
        for column in self.columns:
            if column.name == name:
                return column.values
        raise KeyError(name)

    def rows(self) -> list[dict[str, Any]]:
        """The rows as dictionaries by column name; numbers that are not finite are None."""
        names = [column.name for column in self.columns]
        return [
            dict(zip(names, map(_plain, values), strict=True))
            for values in zip(*(column.values for column in self.columns), strict=True)
        ]

    def to_json(self) -> dict[str, Any]:
        """The table as JSON values: ``rows``, the ``units`` of the columns that have one, and ``notes``."""
        units = {column.name: column.unit for column in self.columns if column.unit}
        return {"rows": self.rows(), "units": units, "notes": list(self.notes)}

    def to_csv(self) -> str:
        """The table as comma-separated values: a line of headings with units; numbers that are not finite are empty."""
        lines = [",".join(_quoted(column.heading) for column in self.columns)]
        for values in zip(*(column.values for column in self.columns), strict=True):
            lines.append(",".join(_cell(value) for value in values))
        return "\n".join(lines) + "\n"


def _plain(value: Any) -> Any:
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _cell(value: Any) -> str:
    value = _plain(value)
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else _quoted(str(value))


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if any(mark in text for mark in ',"\n') else text
