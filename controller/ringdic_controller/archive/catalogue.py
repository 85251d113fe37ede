"""Catalogue of the session folders: tables in memory (SQLite), quick to list.

The folders are the truth; the tables are rebuilt from them and never written to disk.
"""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar

from ringdic.session.folder import live_results
from ringdic.session.records import CaptureRecord, read_capture_record, read_session_record

T = TypeVar("T")

logger = logging.getLogger(__name__)

_SCHEMA = """
create table sessions (name text primary key, rig text, created text, source text, signature text);
create table captures (session text, id text, number integer, kind text, record text, primary key (session, id));
create table runs (session text, run text, finished_at text, summary text, primary key (session, run));
"""


class Catalogue:
    """Sessions, captures and processing runs of one archive folder; safe to use from several threads.

    Methods raise KeyError for a name that the catalogue does not hold, unless they say otherwise.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        self._lock = RLock()  # guards the tables; reading the folders with it held keeps them consistent
        self._db = sqlite3.connect(":memory:", check_same_thread=False)
        self._db.row_factory = sqlite3.Row
        self._db.executescript(_SCHEMA)
        self.sync()

    def close(self) -> None:
        """Free the tables; nothing else may be called afterwards."""
        with self._lock:
            self._db.close()

    def sync(self) -> bool:
        """Read the session folders that are new or changed, and drop those that no longer exist.

        Returns whether there were any of either.
        """
        folders = {path.name: path for path in self._folders()}
        with self._lock:
            rows = self._db.execute("select name, signature from sessions")
            signatures = {row["name"]: row["signature"] for row in rows}
            obsolete = signatures.keys() - folders.keys()
            outdated = [name for name, path in folders.items() if signatures.get(name) != _signature(path)]
            for name in obsolete:
                with self._db:
                    self._delete(name)
            for name in outdated:
                self.refresh(name)
        return bool(obsolete or outdated)

    def refresh(self, name: str) -> None:
        """Read one session folder again, whether it seems changed or not; a folder that is no session is dropped."""
        path = self.root / name
        with self._lock, self._db:
            self._delete(name)
            header = _read(path / "session.json", read_session_record)
            if header is None:
                return
            self._db.execute(
                "insert into sessions values (?, ?, ?, ?, ?)",
                (name, header.rig, header.created, header.source, _signature(path)),
            )
            for record in _captures(path):
                self._insert(name, record)
            for run, finished_at, summary in _runs(path):
                self._db.execute("insert into runs values (?, ?, ?, ?)", (name, run, finished_at, json.dumps(summary)))

    def refresh_capture(self, name: str, capture_id: str) -> dict[str, Any] | None:
        """Read one capture's record again and return it, None where there is none; other captures are not read."""
        with self._lock, self._db:
            if self._db.execute("select 1 from sessions where name = ?", (name,)).fetchone() is None:
                self.refresh(name)
            record = _record(self.root / name / "captures" / capture_id / "capture.json")
            if record is not None:
                self._insert(name, record)
            return None if record is None else record.to_json()

    def sessions(self) -> list[dict[str, Any]]:
        """One dictionary for each session, newest first.

        Its keys are name, rig, created, source, captures (the number of each kind) and runs (their number).
        """
        with self._lock:
            rows = self._db.execute("select name, rig, created, source from sessions order by created desc, name desc")
            return [dict(row) | self._counts(row["name"]) for row in rows.fetchall()]

    def session(self, name: str) -> dict[str, Any]:
        """One session as a dictionary, with the keys that `sessions` lists."""
        for session in self.sessions():
            if session["name"] == name:
                return session
        raise KeyError(name)

    def path(self, name: str) -> Path:
        """The folder of a session."""
        with self._lock:
            row = self._db.execute("select 1 from sessions where name = ?", (name,)).fetchone()
        if row is None:
            raise KeyError(name)
        return self.root / name

    def captures(self, name: str) -> list[dict[str, Any]]:
        """The capture records of a session in order of their number; none for an unknown session."""
        query = "select record from captures where session = ? order by number"
        with self._lock:
            return [json.loads(row["record"]) for row in self._db.execute(query, (name,))]

    def capture(self, name: str, capture_id: str) -> dict[str, Any]:
        """The record of one capture."""
        query = "select record from captures where session = ? and id = ?"
        with self._lock:
            row = self._db.execute(query, (name, capture_id)).fetchone()
        if row is None:
            raise KeyError(capture_id)
        return dict(json.loads(row["record"]))

    def runs(self, name: str) -> list[dict[str, Any]]:
        """The processing runs of a session, oldest first: run, finished_at, summary; none for an unknown session."""
        query = "select run, finished_at, summary from runs where session = ? order by run"
        with self._lock:
            return [
                {"run": row["run"], "finished_at": row["finished_at"], "summary": json.loads(row["summary"])}
                for row in self._db.execute(query, (name,))
            ]

    def live_steps(self, name: str) -> tuple[Path, ...]:
        """Result folders of a session's newest live steps, oldest first; none for an unknown session.

        A live step is a specimen capture that was processed alone as soon as it was archived.
        """
        try:
            return live_results(self.path(name))
        except KeyError:
            return ()

    def _counts(self, name: str) -> dict[str, Any]:
        kinds = self._db.execute("select kind, count(*) from captures where session = ? group by kind", (name,))
        counts = {row[0]: row[1] for row in kinds}
        (runs,) = self._db.execute("select count(*) from runs where session = ?", (name,)).fetchone()
        return {"captures": counts, "runs": runs}

    def _insert(self, name: str, record: CaptureRecord) -> None:
        row = (name, record.capture_id, record.number, record.kind, json.dumps(record.to_json()))
        self._db.execute("insert or replace into captures values (?, ?, ?, ?, ?)", row)

    def _delete(self, name: str) -> None:
        self._db.execute("delete from sessions where name = ?", (name,))
        self._db.execute("delete from captures where session = ?", (name,))
        self._db.execute("delete from runs where session = ?", (name,))

    def _folders(self) -> Iterator[Path]:
        if self.root.is_dir():
            for path in self.root.iterdir():
                if not path.name.startswith(".") and (path / "session.json").is_file():
                    yield path


def _captures(path: Path) -> Iterator[CaptureRecord]:
    for file in (path / "captures").glob("*/capture.json"):
        record = _record(file)
        if record is not None:
            yield record


def _record(file: Path) -> CaptureRecord | None:
    """The record of a capture; None if it is not readable or names another capture than its folder does."""
    record = _read(file, read_capture_record)
    return record if record is not None and record.capture_id == file.parent.name else None


def _runs(path: Path) -> Iterator[tuple[str, str, dict[str, Any]]]:
    results = path / "results"
    for folder in sorted(results.iterdir()) if results.is_dir() else ():
        if folder.name.isdigit() and (folder / "results.h5").is_file():
            finished = datetime.fromtimestamp((folder / "results.h5").stat().st_mtime, UTC)
            yield (
                folder.name,
                finished.isoformat(timespec="seconds"),
                _read(folder / "summary.json", _read_summary) or {},
            )


def _read(file: Path, read: Callable[[Path], T]) -> T | None:
    """What a file holds, or None, with a warning where it is damaged: it must not hide the other sessions."""
    if not file.is_file():
        return None
    try:
        return read(file)
    except (ValueError, OSError) as error:
        logger.warning("%s is not readable and is left out of the catalogue: %s", file, error)
        return None


def _read_summary(file: Path) -> dict[str, Any]:
    summary = json.loads(file.read_text(encoding="utf-8"))
    return summary if isinstance(summary, dict) else {}


def _signature(path: Path) -> str:
    """Text that changes when a capture or a run is added to a session folder, or its header is replaced."""
    parts = []
    for name in ("session.json", "captures", "results"):
        try:
            parts.append(str((path / name).stat().st_mtime_ns))
        except FileNotFoundError:
            parts.append("-")
    return " ".join(parts)
