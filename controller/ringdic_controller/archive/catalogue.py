"""Catalogue of the session folders: tables in memory (SQLite), quick to list.

The folders are the truth; the tables are rebuilt from them and never written to disk.
"""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from threading import RLock
from typing import Any

from ringdic.session.files import leads_out
from ringdic.session.folder import live_results
from ringdic.session.records import CaptureRecord

from ringdic_controller.archive.reading import FolderReader

_SCHEMA = """
create table sessions (name text primary key, rig text, created text, source text, damaged text, signature text);
create table captures (session text, id text, number integer, kind text, record text, primary key (session, id));
create table runs (session text, run text, finished_at text, summary text, primary key (session, run));
"""


class Catalogue:
    """Sessions, captures and processing runs of one archive folder; safe to use from several threads.

    Methods raise KeyError for a name that the catalogue does not hold, unless they say otherwise.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        self._folders = FolderReader(self.root)
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
        folders = [path.name for path in self._folders.folders()]
        with self._lock:
            rows = self._db.execute("select name, damaged, signature from sessions")
            known = {row["name"]: (row["signature"], json.loads(row["damaged"])) for row in rows}
            obsolete = known.keys() - set(folders)
            outdated = [name for name in folders if name not in known or self._is_outdated(name, *known[name])]
            for name in obsolete:
                with self._db:
                    self._delete(name)
            for name in outdated:
                self.refresh(name)
        return bool(obsolete or outdated)

    def refresh(self, name: str) -> None:
        """Read one session folder again, whether it seems changed or not; a folder that is no session is dropped."""
        with self._lock, self._db:
            self._delete(name)
            if not (self.root / name / "session.json").is_file():
                return
            found = self._folders.session(name)
            header = (found.header.rig, found.header.created, found.header.source) if found.header else (None,) * 3
            signature = self._folders.signature(name, found.damaged)
            row = (name, *header, json.dumps(found.damaged), signature)
            self._db.execute("insert into sessions values (?, ?, ?, ?, ?, ?)", row)
            for record in found.captures:
                self._insert(name, record)
            for run, finished_at, summary in found.runs:
                self._db.execute("insert into runs values (?, ?, ?, ?)", (name, run, finished_at, json.dumps(summary)))

    def refresh_capture(self, name: str, capture_id: str) -> dict[str, Any] | None:
        """Read one capture's record again and return it, None where there is none; other captures are not read."""
        with self._lock, self._db:
            if self._db.execute("select 1 from sessions where name = ?", (name,)).fetchone() is None:
                self.refresh(name)
            record = self._folders.capture(name, capture_id)
            if record is not None:
                self._insert(name, record)
            return None if record is None else record.to_json()

    def sessions(self) -> list[dict[str, Any]]:
        """One dictionary for each session, newest first; those whose ``session.json`` is damaged last.

        Its keys are name, rig, created, source, captures (the number of each kind), runs (their number) and damaged (a
        sentence for each file that is not readable).
        """
        columns = "name, rig, created, source, damaged"
        with self._lock:
            rows = self._db.execute(f"select {columns} from sessions order by created desc, name desc")
            return [
                dict(row) | self._counts(row["name"]) | {"damaged": list(json.loads(row["damaged"]).values())}
                for row in rows.fetchall()
            ]

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

    def file(self, name: str, *parts: str) -> Path | None:
        """The path of a file in a session's folder; None where there is none, or a link that leads out of the archive.

        parts : names of the folders in it, and of the file.
        """
        path = self.path(name).joinpath(*parts)
        return path if path.is_file() and not leads_out(self.root, path) else None

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

    def open_captures(self) -> list[tuple[str, str]]:
        """Session and id of every capture whose record has not been closed."""
        query = 'select session, id, record from captures where record like \'%"state": "open"%\''
        with self._lock:
            rows = self._db.execute(query).fetchall()
        return [(row["session"], row["id"]) for row in rows if json.loads(row["record"])["state"] == "open"]

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

    def _is_outdated(self, name: str, signature: str, damaged: dict[str, str]) -> bool:
        return signature != self._folders.signature(name, damaged)

    def _insert(self, name: str, record: CaptureRecord) -> None:
        row = (name, record.capture_id, record.number, record.kind, json.dumps(record.to_json()))
        self._db.execute("insert or replace into captures values (?, ?, ?, ?, ?)", row)

    def _delete(self, name: str) -> None:
        self._db.execute("delete from sessions where name = ?", (name,))
        self._db.execute("delete from captures where session = ?", (name,))
        self._db.execute("delete from runs where session = ?", (name,))
