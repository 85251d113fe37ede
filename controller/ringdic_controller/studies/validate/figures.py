"""Figures of the comparison: a quantity by each way of processing, beside the paper's value and the aim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

PAPER, BETTER = "paper's way", "better way"


@dataclass(frozen=True)
class Figure:
    """One quantity of one experiment: its value by each way, the paper's value and the aim.

    values : by way of processing. paper : the paper's value as text. limit : the largest magnitude aimed at for the
    better way, in ``unit``, or the least value if ``least``; None where nothing is aimed at.
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
        """Whether the better way meets the aim; None where there is no aim or no value."""
        value = self.values.get(BETTER)
        if self.limit is None or value is None:
            return None
        return value >= self.limit if self.least else abs(value) <= self.limit

    def text(self, value: float | None) -> str:
        """A value as text with the figure's number of digits; empty for None."""
        if value is None:
            return ""
        return "–" if value != value else f"{value:.{self.digits}f}"

    @property
    def aim(self) -> str:
        """The aim as text, such as "≤ 0.0030"; empty without one."""
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
    """Figures of an experiment, and the arrays (curves) that its plots are drawn from."""

    figures: tuple[Figure, ...]
    curves: Mapping[str, Any] = field(default_factory=dict)
