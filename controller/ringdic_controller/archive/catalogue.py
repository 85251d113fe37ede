"""The catalogue of sessions: SQLite over the session folders. The folders are the truth; this is rebuilt from them."""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar

from ringdic.session.folder import live_results
from ringdic.session.records import CaptureRecord, read_capture_record, read_session_record

T = TypeVar("T")

logger = logging.getLogger(__name__)

_SCHEMA = """
create table sessions (name text primary key, rig text, created text, source text, path text, signature text);
create table captures (session text, id text, number integer, kind text, record text, primary key (session, id));
create table runs (session text, run text, finished_at text, summary text, primary key (session, run));
"""


class Catalogue:
    """Sessions, captures and processing runs under one archive folder, quick to list.

    Nothing is kept on disk. Safe to use from several threads. Unknown names raise KeyError.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        self._lock = RLock()
        self._db = sqlite3.connect(":memory:", check_same_thread=False)
        self._db.row_factory = sqlite3.Row
        self._db.executescript(_SCHEMA)
        self.sync()

    def close(self) -> None:
        """Let go of the memory; nothing else may be called afterwards."""
        with self._lock:
            self._db.close()

    def sync(self) -> bool:
        """Read the session folders that are new or changed, forget those that are gone; whether there were any."""
        found = {path.name: path for path in self._folders()}
        with self._lock:
            known = {row["name"]: row["signature"] for row in self._db.execute("select name, signature from sessions")}
            gone = known.keys() - found.keys()
            changed = [name for name, path in found.items() if known.get(name) != _signature(path)]
            for name in gone:
                with self._transaction():
                    self._forget(name)
            for name in changed:
                self.refresh(name)
        return bool(gone or changed)

    def refresh(self, name: str) -> None:
        """Read one session folder anew."""
        path = self.root / name
        with self._lock, self._transaction():
            self._forget(name)
            header = _read(path / "session.json", read_session_record)
            if header is None:
                return
            self._db.execute(
                "insert into sessions values (?, ?, ?, ?, ?, ?)",
                (name, header.rig, header.created, header.source, str(path), _signature(path)),
            )
            for record in _captures(path):
                self._keep(name, record)
            for run, finished_at, summary in _runs(path):
                self._db.execute("insert into runs values (?, ?, ?, ?)", (name, run, finished_at, json.dumps(summary)))

    def refresh_capture(self, name: str, capture_id: str) -> dict[str, Any] | None:
        """Read one capture's record anew and return it, None where there is none: however many captures there are."""
        with self._lock, self._transaction():
            if self._db.execute("select 1 from sessions where name = ?", (name,)).fetchone() is None:
                self.refresh(name)
            record = _record(self.root / name / "captures" / capture_id / "capture.json")
            if record is not None:
                self._keep(name, record)
            return None if record is None else record.to_json()

    def sessions(self) -> list[dict[str, Any]]:
        """All sessions, newest first, with the number of captures of each kind and of runs."""
        with self._lock:
            rows = self._db.execute("select name, rig, created, source from sessions order by created desc, name desc")
            return [dict(row) | self._counts(row["name"]) for row in rows.fetchall()]

    def session(self, name: str) -> dict[str, Any]:
        """One session of `sessions`."""
        for session in self.sessions():
            if session["name"] == name:
                return session
        raise KeyError(name)

    def path(self, name: str) -> Path:
        """The folder of a session."""
        with self._lock:
            row = self._db.execute("select path from sessions where name = ?", (name,)).fetchone()
        if row is None:
            raise KeyError(name)
        return Path(row["path"])

    def captures(self, name: str) -> list[dict[str, Any]]:
        """The capture records of a session, in order."""
        query = "select record from captures where session = ? order by number"
        with self._lock:
            return [json.loads(row["record"]) for row in self._db.execute(query, (name,))]

    def capture(self, name: str, capture_id: str) -> dict[str, Any]:
        """One capture record."""
        query = "select record from captures where session = ? and id = ?"
        with self._lock:
            row = self._db.execute(query, (name, capture_id)).fetchone()
        if row is None:
            raise KeyError(capture_id)
        return dict(json.loads(row["record"]))

    def runs(self, name: str) -> list[dict[str, Any]]:
        """The processing runs of a session, oldest first: run, finished_at, summary."""
        query = "select run, finished_at, summary from runs where session = ? order by run"
        with self._lock:
            return [
                {"run": row["run"], "finished_at": row["finished_at"], "summary": json.loads(row["summary"])}
                for row in self._db.execute(query, (name,))
            ]

    def live(self, name: str) -> tuple[Path, ...]:
        """Folders of the newest steps that were processed at once, oldest first; none for an unknown session."""
        try:
            return live_results(self.path(name))
        except KeyError:
            return ()

    def _counts(self, name: str) -> dict[str, Any]:
        kinds = self._db.execute("select kind, count(*) from captures where session = ? group by kind", (name,))
        counts = {row[0]: row[1] for row in kinds}
        (runs,) = self._db.execute("select count(*) from runs where session = ?", (name,)).fetchone()
        return {"captures": counts, "runs": runs}

    def _keep(self, name: str, record: CaptureRecord) -> None:
        row = (name, record.capture_id, record.number, record.kind, json.dumps(record.to_json()))
        self._db.execute("insert or replace into captures values (?, ?, ?, ?, ?)", row)

    def _forget(self, name: str) -> None:
        self._db.execute("delete from sessions where name = ?", (name,))
        self._db.execute("delete from captures where session = ?", (name,))
        self._db.execute("delete from runs where session = ?", (name,))

    def _folders(self) -> Iterator[Path]:
        if self.root.is_dir():
            for path in self.root.iterdir():
                if not path.name.startswith(".") and (path / "session.json").is_file():
                    yield path

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._db:
            yield


def _captures(path: Path) -> Iterator[CaptureRecord]:
    for file in (path / "captures").glob("*/capture.json"):
        record = _record(file)
        if record is not None:
            yield record


def _record(file: Path) -> CaptureRecord | None:
    """The record of a capture; None if it is not readable or another capture's."""
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
    """Changes when a capture or a run is added, or the session's header is replaced."""
    parts = []
    for name in ("session.json", "captures", "results"):
        try:
            parts.append(str((path / name).stat().st_mtime_ns))
        except FileNotFoundError:
            parts.append("-")
    return " ".join(parts)
