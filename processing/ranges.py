"""Ranges of the fields over the steps of a result, for colour scales."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.fields import Field, StepFields


class Ranges:
    """Gathers, step by step, the extremes and the 2nd and 98th percentiles of some fields."""

    def __init__(self, fields: Sequence[Field]) -> None:
        self._fields = tuple(fields)
        self._seen: dict[tuple[str, bool], list[NDArray[np.float64] | None]] = {}

    def add(self, fields: StepFields) -> None:
        """Take one more step in; the reference comes first."""
        for entry in self._fields:
            for removed in (False, True) if entry.rigid else (False,):
                self._add((entry.name, removed), fields.scalar(entry, removed).astype(np.float32))

    def table(self) -> list[dict[str, Any]]:
        """The catalogue of fields with their ranges, as JSON values."""
        rows: list[dict[str, Any]] = []
        for entry in self._fields:
            row = entry.row()
            row["range"], row["steps"] = self._spans((entry.name, False))
            if entry.rigid:
                spans = self._spans((entry.name, True))
                row["range_without_rigid_motion"], row["steps_without_rigid_motion"] = spans
            rows.append(row)
        return rows

    def _add(self, key: tuple[str, bool], values: NDArray[np.float32]) -> None:
        finite = values[np.isfinite(values)]
        self._seen.setdefault(key, []).append(np.percentile(finite, [0, 2, 98, 100]) if finite.size else None)

    def _spans(self, key: tuple[str, bool]) -> tuple[list[float] | None, list[list[float] | None]]:
        """The range over all steps (without the reference, where nothing moves, if there are more) and of each step."""
        seen = self._seen.get(key, [])
        spans = [None if step is None else [float(step[0]), float(step[3])] for step in seen]
        moving = [step for step in (seen[1:] or seen) if step is not None]
        if not moving:
            return None, spans
        return [float(min(step[1] for step in moving)), float(max(step[2] for step in moving))], spans


def even_limits(span: Sequence[float] | None, centre: float | None) -> tuple[float, float]:
    """Limits of a colour scale that shows a span: even about the centre where there is one, and never of no width."""
    low, high = (0.0, 1.0) if span is None else (float(span[0]), float(span[1]))
    if centre is not None:
        reach = max(abs(low - centre), abs(high - centre), 1e-6)
        low, high = centre - reach, centre + reach
    return (low, high) if high > low else (low - 0.5, low + 0.5)
