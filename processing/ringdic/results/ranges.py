"""Ranges of the fields over the steps of some results, for colour scales."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.results.fields import Field, StepFields

#: Percentiles 0, 2, 98 and 100 of fields at one step, by name and whether the rigid motion is removed.
Extent = dict[tuple[str, bool], Floats | None]

_PERCENTILES = np.array([0.0, 2.0, 98.0, 100.0])
_FEW = 4096  # so many numbers or fewer are sorted faster by comparing than by counting


class Ranges:
    """The extremes and the 2nd and 98th percentiles of some fields, collected step by step."""

    def __init__(self, fields: Sequence[Field]) -> None:
        self._fields = tuple(fields)
        self._extents: dict[tuple[str, bool], list[Floats | None]] = {}

    def add(self, fields: StepFields) -> None:
        """Add the fields of the next step; the reference comes first."""
        self.take(self.extent(fields))

    def extent(self, fields: StepFields) -> Extent:
        """Percentiles of the fields at one step, for :meth:`take`; several threads may call it at a time."""
        return {
            (entry.name, removed): percentiles(fields.scalar(entry, removed).astype(np.float32))
            for entry in self._fields
            for removed in ((False, True) if entry.rigid else (False,))
        }

    def take(self, extent: Extent) -> None:
        """Add the percentiles of the next step, from :meth:`extent`; the reference comes first."""
        for key, values in extent.items():
            self._extents.setdefault(key, []).append(values)

    def table(self) -> list[dict[str, Any]]:
        """The table of fields with their ranges, as JSON values: a dictionary for each field."""
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
        """The range over all steps, and [least, greatest] of each step; None where nothing was measured.

        The reference, in which nothing moves, counts only where it is the only step.
        """
        extents = self._extents.get(key, [])
        spans = [None if step is None else [float(step[0]), float(step[3])] for step in extents]
        moving = [step for step in (extents[1:] or extents) if step is not None]
        if not moving:
            return None, spans
        return [float(min(step[1] for step in moving)), float(max(step[2] for step in moving))], spans


def even_limits(span: Sequence[float] | None, centre: float | None) -> tuple[float, float]:
    """Limits (low, high) of a colour scale that cover a range of values, symmetric about a centre if one is given.

    span : [low, high], None for an unknown range. centre : the limits are symmetric about it; None for none.
    Limits that would be equal are set 1 apart.
    """
    low, high = (0.0, 1.0) if span is None else (float(span[0]), float(span[1]))
    if centre is not None:
        reach = max(abs(low - centre), abs(high - centre), 1e-6)
        low, high = centre - reach, centre + reach
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def percentiles(values: NDArray[np.float32]) -> Floats | None:
    """Percentiles 0, 2, 98 and 100 of the finite values, with linear interpolation between ranks.

    values : (...) in any unit, of any shape. Returns (4,) in the unit of the values; None where no value is finite.
    """
    keys = np.empty(values.size, np.uint32)
    count = _ordered_keys(np.ascontiguousarray(values).reshape(-1).view(np.uint32), keys)
    if not count:
        return None
    place = _PERCENTILES / 100.0 * (count - 1)
    below = np.floor(place).astype(np.int64)
    above = np.minimum(below + 1, count - 1)
    neighbours = _bits_at_ranks(keys[:count], np.stack([below, above], axis=1).ravel()).view(np.float32)
    first, second = neighbours.reshape(-1, 2).T.astype(float)
    return np.asarray(first + (second - first) * (place - below))


@nb.njit(cache=True, nogil=True)
def _ordered_keys(bits, keys):  # type: ignore[no-untyped-def]
    """Keys whose order as whole numbers is that of the finite single-precision numbers with these bits; their count.

    bits : (n,) uint32. keys : (n,) uint32, filled from the start. Numbers that are not finite get no key.
    """
    count = 0
    for one in bits:
        if one & np.uint32(0x7F800000) != np.uint32(0x7F800000):
            keys[count] = ~one if one >> np.uint32(31) else one | np.uint32(0x80000000)
            count += 1
    return count


@nb.njit(cache=True, nogil=True)
def _bits_at_ranks(keys, ranks):  # type: ignore[no-untyped-def]
    """Bits (k,) uint32 of the numbers whose keys have these ascending ranks (k,), by a radix selection.

    Keys (n,) are counted by their upper 16 bits; only those in the slots that hold a wanted rank are sorted.
    """
    upper = np.zeros(1 << 16, np.int32)
    for key in keys:
        upper[key >> np.uint32(16)] += 1
    slot, begin = np.full(1 << 16, -1, np.int8), np.zeros(len(ranks) + 1, np.int64)
    own, rest = np.empty(len(ranks), np.int8), np.empty(len(ranks), np.int64)
    slots, high, before = 0, 0, 0
    for k in range(len(ranks)):
        while ranks[k] - before >= upper[high]:
            before += upper[high]
            high += 1
        if slot[high] < 0:
            slot[high] = slots
            begin[slots + 1] = begin[slots] + upper[high]
            slots += 1
        own[k], rest[k] = slot[high], ranks[k] - before
    alike, free = np.empty(begin[slots], np.uint32), begin.copy()
    for key in keys:
        s = slot[key >> np.uint32(16)]
        if s >= 0:
            alike[free[s]] = key
            free[s] += 1
    for s in range(slots):
        _sort(alike[begin[s] : begin[s + 1]])
    out = np.empty(len(ranks), np.uint32)
    for k in range(len(ranks)):
        key = alike[begin[own[k]] + rest[k]]
        out[k] = key & np.uint32(0x7FFFFFFF) if key >> np.uint32(31) else ~key
    return out


@nb.njit(cache=True, nogil=True)
def _sort(keys):  # type: ignore[no-untyped-def]
    """Sort keys (n,) with equal upper 16 bits in place: few by comparison, many by counting their lower 16 bits."""
    if len(keys) < _FEW:
        keys.sort()
        return
    lower, high = np.zeros(1 << 16, np.int32), keys[0] & np.uint32(0xFFFF0000)
    for key in keys:
        lower[key & np.uint32(0xFFFF)] += 1
    at = 0
    for low in range(1 << 16):
        for _ in range(lower[low]):
            keys[at] = high | np.uint32(low)
            at += 1
