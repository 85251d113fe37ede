"""Ranges of the fields over the steps of a result, for colour scales."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from processing.fields import Field, StepFields

Extent = dict[tuple[str, bool], NDArray[np.float64] | None]

_PERCENTILES = np.array([0.0, 2.0, 98.0, 100.0])


class Ranges:
    """Gathers, step by step, the extremes and the 2nd and 98th percentiles of some fields."""

    def __init__(self, fields: Sequence[Field]) -> None:
        self._fields = tuple(fields)
        self._seen: dict[tuple[str, bool], list[NDArray[np.float64] | None]] = {}

    def add(self, fields: StepFields) -> None:
        """Take one more step in; the reference comes first."""
        self.take(self.extent(fields))

    def extent(self, fields: StepFields) -> Extent:
        """What :meth:`take` wants to know of a step; it can be found for several steps at a time."""
        return {
            (entry.name, removed): percentiles(fields.scalar(entry, removed).astype(np.float32))
            for entry in self._fields
            for removed in ((False, True) if entry.rigid else (False,))
        }

    def take(self, extent: Extent) -> None:
        """Take the extent of one more step in; that of the reference comes first."""
        for key, values in extent.items():
            self._seen.setdefault(key, []).append(values)

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


def percentiles(values: NDArray[np.float32]) -> NDArray[np.float64] | None:
    """The least, the 2nd and 98th percentile and the greatest of what is finite; None where nothing is."""
    keys = np.empty(values.size, np.uint32)
    count = _ordered_keys(np.ascontiguousarray(values).reshape(-1).view(np.uint32), keys)
    if not count:
        return None
    place = _PERCENTILES / 100.0 * (count - 1)
    below = np.floor(place).astype(np.int64)
    above = np.minimum(below + 1, count - 1)
    found = _of_ranks(keys[:count], np.stack([below, above], axis=1).ravel()).view(np.float32)
    first, second = found.reshape(-1, 2).T.astype(float)
    return np.asarray(first + (second - first) * (place - below))


@nb.njit(cache=True, nogil=True)
def _ordered_keys(bits, keys):  # type: ignore[no-untyped-def]
    """Whole numbers in the order of the finite ones of single-precision numbers, from their bits; their count."""
    count = 0
    for one in bits:
        if one & np.uint32(0x7F800000) != np.uint32(0x7F800000):
            keys[count] = ~one if one >> np.uint32(31) else one | np.uint32(0x80000000)
            count += 1
    return count


@nb.njit(cache=True, nogil=True)
def _of_ranks(keys, ranks):  # type: ignore[no-untyped-def]
    """The bits of the numbers that have these ranks, in order: counts of the upper, then of the lower halves."""
    upper = np.zeros(1 << 16, np.int32)
    for key in keys:
        upper[key >> np.uint32(16)] += 1
    out = np.empty(len(ranks), np.uint32)
    lower = np.empty(1 << 16, np.int32)
    counted = -1
    for k in range(len(ranks)):
        high, rank = 0, ranks[k]
        while rank >= upper[high]:
            rank -= upper[high]
            high += 1
        if high != counted:
            lower[:] = 0
            for key in keys:
                if key >> np.uint32(16) == high:
                    lower[key & np.uint32(0xFFFF)] += 1
            counted = high
        low = 0
        while rank >= lower[low]:
            rank -= lower[low]
            low += 1
        key = np.uint32((high << 16) | low)
        out[k] = key & np.uint32(0x7FFFFFFF) if key >> np.uint32(31) else ~key
    return out
