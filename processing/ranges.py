"""Ranges of the fields over the steps of a result, for colour scales."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.fields import FIELDS, StepFields, pick


class Ranges:
    """Gathers, step by step, the extremes and the 2nd and 98th percentiles of every field."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, bool], list[NDArray[np.float64] | None]] = {}

    def add(self, fields: StepFields) -> None:
        """Take one more step in; the reference comes first."""
        for entry in FIELDS:
            arrays = fields.point if entry.location == "point" else fields.face
            self._add((entry.name, False), pick(entry, arrays[entry.stored]))
            if entry.rigid:
                self._add((entry.name, True), pick(entry, arrays[f"{entry.stored}_without_rigid_motion"]))

    def table(self) -> list[dict[str, Any]]:
        """The catalogue of fields with their ranges, as JSON values."""
        rows: list[dict[str, Any]] = []
        for entry in FIELDS:
            row = {k: v for k, v in asdict(entry).items() if k not in ("stored", "part")}
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
