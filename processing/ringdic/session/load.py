"""Load channels of captures: what a testing machine or another sensor measured meanwhile, in ``load.json``.

A channel has a single value, or a line of values with their times from which the value at the capture's moment is
interpolated. The file stands beside the capture's record::

    {"schema": 1, "channels": [{"name": "force", "unit": "N", "values": 12.5},
                               {"name": "travel", "unit": "mm", "values": [[1700000000000000000, 0.1], …]}]}
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ringdic.session.files import leads_out
from ringdic.session.json_text import read_json
from ringdic.session.names import checked_name
from ringdic.session.records import SCHEMA, CaptureRecord, SessionError, read_capture_record

LOAD_FILE = "load.json"
_LONGEST_UNIT = 16  # characters
_MOST_CHANNELS = 64
_LATEST_NS = 1 << 63


class LoadConflictError(SessionError):
    """Other values of a load channel are archived already."""


@dataclass(frozen=True)
class LoadChannel:
    """One channel of the load at a capture.

    name : letters, digits, dots, dashes, underscores. unit : "" for none. values : a single value, or a line of
    (time, value) in order of time, ns since the Unix epoch.
    """

    name: str
    unit: str
    values: float | tuple[tuple[int, float], ...]

    def __post_init__(self) -> None:
        checked_name("the load channel", self.name)
        if not isinstance(self.unit, str) or len(self.unit) > _LONGEST_UNIT or not _is_unit(self.unit):
            raise SessionError(
                f"the unit {self.unit!r} of load channel '{self.name}' is not of 0 to {_LONGEST_UNIT} characters "
                "without brackets, commas and quotes"
            )
        if not isinstance(self.values, tuple):
            if not _is_number(self.values):
                raise SessionError(f"load channel '{self.name}' has the value {self.values!r}, which is no number")
            return
        if not self.values:
            raise SessionError(f"load channel '{self.name}' has no values")
        before = -1
        for entry in self.values:
            if not _is_reading(entry):
                raise SessionError(
                    f"load channel '{self.name}' has the entry {entry!r}; give each as [time in ns, value]"
                )
            if entry[0] <= before:
                raise SessionError(
                    f"load channel '{self.name}' is not in order of time: {entry[0]} comes after {before} ns"
                )
            before = entry[0]

    @classmethod
    def from_json(cls, document: Any) -> LoadChannel:
        """Parse the channel from its JSON object. Raises InputError."""
        if not isinstance(document, Mapping) or not {"name", "unit", "values"} <= set(document):
            raise SessionError("a load channel is a table with 'name', 'unit' and 'values'")
        values = document["values"]
        if isinstance(values, list):
            values = tuple(tuple(entry) if isinstance(entry, list) else entry for entry in values)
        return cls(document["name"], document["unit"], values)

    def to_json(self) -> dict[str, Any]:
        """The channel as a JSON object."""
        values = [list(entry) for entry in self.values] if isinstance(self.values, tuple) else self.values
        return {"name": self.name, "unit": self.unit, "values": values}

    def at(self, time_ns: int | None) -> float:
        """The value at a moment, ns since the Unix epoch: interpolated in a line, a single value at any moment.

        NaN before the first and after the last entry of a line, and where the moment is not known.
        """
        if not isinstance(self.values, tuple):
            return float(self.values)
        if time_ns is None or not self.values[0][0] <= time_ns <= self.values[-1][0]:
            return math.nan
        after = bisect_left(self.values, time_ns, key=lambda entry: entry[0])
        time, value = self.values[after]
        if time == time_ns:
            return float(value)
        earlier, start = self.values[after - 1]
        return start + (value - start) * ((time_ns - earlier) / (time - earlier))


@dataclass(frozen=True)
class LoadSeries:
    """One channel at the steps of a session. values : one a step, NaN where it is not known."""

    name: str
    unit: str
    values: tuple[float, ...]

    @property
    def heading(self) -> str:
        """Name with unit, as in ``force [N]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def read_load(folder: Path) -> tuple[LoadChannel, ...]:
    """The load channels of a capture's folder; none where it has no ``load.json``. SessionError names a damaged one."""
    path = Path(folder) / LOAD_FILE
    if not path.is_file():
        return ()
    if leads_out(folder, path):
        raise SessionError(f"{path}: a link that leads out of the capture; copy the file itself there")
    try:
        document = read_json(path)
        if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
            raise SessionError(f"no load channels of schema {SCHEMA}")
        channels = document.get("channels")
        if not isinstance(channels, list):
            raise SessionError("the list 'channels' is missing")
        return _unique(tuple(LoadChannel.from_json(each) for each in channels))
    except OSError as error:
        raise SessionError(f"{path}: cannot be read ({error.strerror}); copy it back from a backup") from error
    except ValueError as error:
        raise SessionError(f"{path}: {error}; send the load again, or copy the file back from a backup") from error


def load_document(channels: Sequence[LoadChannel]) -> dict[str, Any]:
    """The contents of a ``load.json`` with these channels."""
    return {"schema": SCHEMA, "channels": [channel.to_json() for channel in channels]}


def with_channel(
    channels: Sequence[LoadChannel], new: LoadChannel, *, replace: bool = False
) -> tuple[LoadChannel, ...]:
    """These channels and a new one. LoadConflictError where another of its name has other values, unless `replace`."""
    present = {channel.name: channel for channel in channels}
    before = present.get(new.name)
    if before is not None and before != new and not replace:
        raise LoadConflictError(f"the load channel '{new.name}' is archived with other values, which were kept")
    return _unique(tuple({**present, new.name: new}.values()))


def load_series(folders: Sequence[Path]) -> tuple[LoadSeries, ...]:
    """The load channels at the moments of captures, one value a capture; NaN where a capture has no such channel.

    The moment of a capture is the median of the cameras' measured times, else the planned one.

    folders : of the captures, in order. Raises SessionError for a damaged file, and where a channel has two units.
    """
    found: dict[str, tuple[str, dict[int, float]]] = {}
    for k, folder in enumerate(folders):
        channels = read_load(folder)
        moment = None
        if any(isinstance(channel.values, tuple) for channel in channels):
            moment = capture_moment(read_capture_record(Path(folder) / "capture.json"))
        for channel in channels:
            unit, values = found.setdefault(channel.name, (channel.unit, {}))
            if unit != channel.unit:
                raise SessionError(
                    f"{Path(folder) / LOAD_FILE}: the load channel '{channel.name}' is in '{channel.unit}', in an "
                    f"earlier capture in '{unit}'; give it in one unit"
                )
            values[k] = channel.at(moment)
    steps = range(len(folders))
    return tuple(
        LoadSeries(name, unit, tuple(by.get(k, math.nan) for k in steps)) for name, (unit, by) in found.items()
    )


def capture_moment(record: CaptureRecord) -> int | None:
    """Moment of a capture, ns since the Unix epoch: the median of its cameras' times, else the planned one, or None."""
    times = sorted(entry.time_ns for entry in record.cameras.values() if entry.time_ns is not None)
    if not times:
        return record.fire_at_ns
    return (times[(len(times) - 1) // 2] + times[len(times) // 2]) // 2


def _unique(channels: tuple[LoadChannel, ...]) -> tuple[LoadChannel, ...]:
    if len({channel.name for channel in channels}) < len(channels):
        raise SessionError("two load channels have the same name")
    if len(channels) > _MOST_CHANNELS:
        raise SessionError(f"{len(channels)} load channels, more than the {_MOST_CHANNELS} that a capture may have")
    return channels


def _is_unit(text: str) -> bool:
    return all(mark.isprintable() and mark not in '[]",;' for mark in text)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _is_reading(entry: Any) -> bool:
    return (
        isinstance(entry, tuple)
        and len(entry) == 2
        and isinstance(entry[0], int)
        and not isinstance(entry[0], bool)
        and 0 <= entry[0] < _LATEST_NS
        and _is_number(entry[1])
    )
