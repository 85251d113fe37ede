"""One figure of the comparison: the paper's, what is aimed at, and what each way reached."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

PAPER, BETTER = "paper's way", "better way"


@dataclass(frozen=True)
class Figure:
    """A quantity of an experiment.

    paper : the paper's figure as text, with its unit. limit : the largest magnitude aimed at for the better way, in
    ``unit``, or the least value where ``least``; None where nothing is aimed at. values : by way.
    """

    experiment: str
    quantity: str
    unit: str
    values: Mapping[str, float]
    paper: str = ""
    limit: float | None = None
    least: bool = False
    digits: int = 4
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the better way is where it should be; None where nothing is aimed at or nothing was measured."""
        value = self.values.get(BETTER)
        if self.limit is None or value is None:
            return None
        return value >= self.limit if self.least else abs(value) <= self.limit

    def text(self, value: float | None) -> str:
        """A value as text, with its unit's number of digits."""
        if value is None:
            return ""
        return "–" if value != value else f"{value:.{self.digits}f}"

    @property
    def aim(self) -> str:
        """What is aimed at, as text."""
        if self.limit is None:
            return ""
        return f"{'≥' if self.least else '≤'} {self.text(self.limit)}"

    def row(self, ways: Sequence[str]) -> dict[str, str]:
        """The figure as a row of a table."""
        verdict = {None: "", True: "yes", False: "NO"}[self.reached]
        return {
            "experiment": self.experiment,
            "figure": f"{self.quantity}{f', {self.unit}' if self.unit else ''}",
            "paper": self.paper,
            **{way: self.text(self.values.get(way)) for way in ways},
            "aim": self.aim,
            "reached": verdict,
        }

    def to_dict(self) -> dict[str, Any]:
        """The figure as JSON values."""
        return {
            "experiment": self.experiment,
            "quantity": self.quantity,
            "unit": self.unit,
            "paper": self.paper,
            "values": {way: None if value != value else float(value) for way, value in self.values.items()},
            "limit": self.limit,
            "least": self.least,
            "reached": self.reached,
            "note": self.note,
        }


@dataclass(frozen=True)
class Findings:
    """The figures of an experiment and what its plots are drawn from."""

    figures: tuple[Figure, ...]
    curves: Mapping[str, Any] = field(default_factory=dict)
