"""Load channels from a table of comma-separated values: a row for each capture, or several with their times."""

from __future__ import annotations

import csv
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ringdic.errors import InputError
from ringdic.session.folder import Capture, Session, open_session
from ringdic.session.load import LoadChannel, read_load, with_channel
from ringdic.session.writer import SessionWriter

_HEADING = re.compile(r"(?P<name>[^\[\]]*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?")
_LARGEST = 64 << 20  # bytes


@dataclass
class _Rows:
    """The rows of one capture: line numbers, times and the cells of each channel."""

    lines: list[int] = field(default_factory=list)
    cells: list[dict[str, str]] = field(default_factory=list)


def read_load_table(path: Path, session: Session) -> dict[str, tuple[LoadChannel, ...]]:
    """Load channels by capture id, from a CSV file with a line of headings.

    A column ``step`` (0 is the reference, the first specimen capture) or ``capture`` (its id) says where a row
    belongs. Every other column is a channel, headed by name and unit as in ``force [N]``; an empty cell gives
    nothing. With a column ``time_ns`` (ns since the Unix epoch) the rows of a capture are a line of values.

    Raises InputError with the file and the line at fault.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _LARGEST:
            raise InputError(f"{path}: larger than {_LARGEST >> 20} MB; cut it into several")
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = list(csv.reader(file))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not readable as a table of comma-separated values ({error})") from error
    headings = [cell.strip() for cell in lines[0]] if lines else []
    keys = [name for name in ("step", "capture") if name in headings]
    if len(keys) != 1:
        raise InputError(f"{path}: the first line must have one column 'step' or 'capture', and the channels")
    if len(set(headings)) < len(headings):
        raise InputError(f"{path}: two columns have the same heading")
    rows = _rows(path, lines, headings, keys[0], session)
    names = [name for name in headings if name not in (keys[0], "time_ns")]
    if not names:
        raise InputError(f"{path}: no column with a channel; head one as in 'force [N]'")
    timed = "time_ns" in headings
    return {
        id_: tuple(channel for name in names if (channel := _channel(path, name, each, timed)) is not None)
        for id_, each in rows.items()
    }


def archive_load_table(path: Path, session_path: Path, *, replace: bool = False) -> dict[str, tuple[LoadChannel, ...]]:
    """Archive the load channels of a CSV file beside the captures of a session, and return them by capture id.

    path : of the file, see `read_load_table`. session_path : the session folder. replace : whether values that are
    archived already may be replaced by others. Raises InputError before anything is written where they may not.
    """
    found = read_load_table(path, open_session(session_path))
    writer = SessionWriter(Path(session_path), time.time_ns)
    for id_, channels in found.items():
        before = read_load(Path(session_path) / "captures" / id_)
        for channel in channels:
            try:
                before = with_channel(before, channel, replace=replace)
            except InputError as error:
                raise InputError(f"{path}: {id_}: {error}; --replace replaces them") from error
    for id_, channels in found.items():
        for channel in channels:
            writer.capture(id_).store_load(channel, replace=replace)
    return found


def _rows(path: Path, lines: list[list[str]], headings: list[str], key: str, session: Session) -> dict[str, _Rows]:
    """The rows of each capture."""
    found: dict[str, _Rows] = {}
    for number, cells in enumerate(lines[1:], start=2):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(headings):
            raise InputError(f"{path}, line {number}: {len(cells)} cells under {len(headings)} headings")
        row = {name: cell.strip() for name, cell in zip(headings, cells, strict=True)}
        id_ = _capture(path, number, key, row[key], session.captures, session.of_kind("specimen"))
        rows = found.setdefault(id_, _Rows())
        if rows.lines and "time_ns" not in headings:
            raise InputError(f"{path}, line {number}: {id_} has a row already, in line {rows.lines[0]}")
        rows.lines.append(number)
        rows.cells.append(row)
    if not found:
        raise InputError(f"{path}: no row below the headings")
    return found


def _capture(
    path: Path, number: int, key: str, cell: str, captures: Sequence[Capture], steps: Sequence[Capture]
) -> str:
    """Id of the capture that a row names."""
    if key == "capture":
        if cell not in [capture.id for capture in captures]:
            raise InputError(f"{path}, line {number}: the session has no capture '{cell}'")
        return cell
    if not (cell.isascii() and cell.isdigit()) or len(cell) > 9 or int(cell) >= len(steps):
        raise InputError(f"{path}, line {number}: no step '{cell}'; the session has {len(steps)}, from 0 (reference)")
    return steps[int(cell)].id


def _channel(path: Path, heading: str, rows: _Rows, timed: bool) -> LoadChannel | None:
    """The channel of a column at one capture; None where its cells are empty."""
    match = _HEADING.fullmatch(heading)
    if match is None:
        raise InputError(f"{path}: the heading '{heading}' is not a name with a unit, as in 'force [N]'")
    values: list[tuple[int, float]] = []
    for number, row in zip(rows.lines, rows.cells, strict=True):
        if not row[heading]:
            continue
        try:
            values.append((int(row["time_ns"]) if timed else 0, float(row[heading])))
        except ValueError:
            raise InputError(f"{path}, line {number}: '{row[heading]}' or its time is no number") from None
    if not values:
        return None
    try:
        return LoadChannel(match["name"], match["unit"] or "", tuple(values) if timed else values[0][1])
    except InputError as error:
        raise InputError(f"{path}, lines {rows.lines[0]} to {rows.lines[-1]}: {error}") from error
