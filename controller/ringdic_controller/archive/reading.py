"""Reading of one session folder for the catalogue: whatever is damaged in it is named, and hides nothing else."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from ringdic.session.files import leads_out
from ringdic.session.folder import is_run_name
from ringdic.session.json_text import read_json
from ringdic.session.names import split_capture_id
from ringdic.session.records import CaptureRecord, SessionError, SessionRecord, read_capture_record, read_session_record

T = TypeVar("T")

logger = logging.getLogger(__name__)


@dataclass
class SessionContents:
    """What a session folder holds, as far as it is readable.

    header : of its ``session.json``. captures : the records. runs : (number, time of its end in ISO 8601, summary) of
    each processing run. damaged : what is wrong with each file that is not readable, as a sentence, by its path in the
    folder.
    """

    header: SessionRecord | None = None
    captures: list[CaptureRecord] = field(default_factory=list)
    runs: list[tuple[str, str, dict[str, Any]]] = field(default_factory=list)
    damaged: dict[str, str] = field(default_factory=dict)


class FolderReader:
    """Reads the session folders of one archive. It follows no link that leads out of the archive.

    Parameters
    ----------
    root
        Folder of the archive.
    """

    def __init__(self, root: Path) -> None:
        self._root = Path(root)

    def folders(self) -> Iterator[Path]:
        """The session folders: those with a ``session.json``, readable or not."""
        if not self._root.is_dir():
            return
        for path in self._root.iterdir():
            if not path.name.startswith(".") and os.path.isfile(path / "session.json"):
                if _has_whole_name(path):
                    yield path
                else:
                    logger.warning("the session folder %r is left out: rename it in letters", path.name)

    def session(self, name: str) -> SessionContents:
        """What the folder of a session holds."""
        path, contents = self._root / name, SessionContents()
        contents.header = self._read(path, "session.json", read_session_record, contents.damaged)
        for file in sorted((path / "captures").glob("*/capture.json")):
            record = self._capture(path, file, contents.damaged)
            if record is not None:
                contents.captures.append(record)
        contents.runs.extend(self._runs(path, contents.damaged))
        for sentence in contents.damaged.values():
            logger.warning("session %s: %s", name, sentence)
        return contents

    def capture(self, name: str, capture_id: str) -> CaptureRecord | None:
        """The record of a capture; None if there is none that is readable."""
        path = self._root / name
        file = path / "captures" / capture_id / "capture.json"
        return self._capture(path, file, {}) if os.path.isfile(file) else None

    def signature(self, name: str, damaged: dict[str, str]) -> str:
        """Text that changes when a capture or a run is added to a session folder, or a file is replaced.

        damaged : by path in the folder, the files that are looked at beside ``session.json``.
        """
        parts = []
        for file in ("session.json", "captures", "results", *damaged):
            try:
                parts.append(str((self._root / name / file).stat().st_mtime_ns))
            except OSError:
                parts.append("-")
        return " ".join(parts)

    def _capture(self, path: Path, file: Path, damaged: dict[str, str]) -> CaptureRecord | None:
        """The record in a file, unless it is damaged or names another capture than its folder does."""
        if split_capture_id(file.parent.name) is None:
            return None

        def read(file: Path) -> CaptureRecord:
            record = read_capture_record(file)
            if record.capture_id != file.parent.name:
                raise SessionError(f"{file}: the record of {record.capture_id}; put it back into its own folder")
            return record

        return self._read(path, file.relative_to(path).as_posix(), read, damaged)

    def _runs(self, path: Path, damaged: dict[str, str]) -> Iterator[tuple[str, str, dict[str, Any]]]:
        results = path / "results"
        for folder in sorted(results.iterdir()) if results.is_dir() else ():
            name = f"results/{folder.name}/results.h5"
            if is_run_name(folder.name) and os.path.isfile(path / name):
                finished = self._read(path, name, _end_of, damaged)
                summary = f"results/{folder.name}/summary.json"
                known = self._read(path, summary, _read_summary, damaged) if os.path.isfile(path / summary) else None
                if finished is not None:
                    yield folder.name, finished, known or {}

    def _read(self, path: Path, name: str, read: Callable[[Path], T], damaged: dict[str, str]) -> T | None:
        """What a file of a session folder holds; None where it is damaged, which is then noted."""
        file = path / name
        try:
            if leads_out(self._root, file):
                raise SessionError(f"{file}: a link that leads out of the archive; put the file itself there")
            return read(file)
        except (ValueError, OSError) as error:
            damaged[name] = str(error)
            return None


def _end_of(results: Path) -> str:
    """When a results file was finished, ISO 8601."""
    return datetime.fromtimestamp(results.stat().st_mtime, UTC).isoformat(timespec="seconds")


def _read_summary(file: Path) -> dict[str, Any]:
    try:
        summary = read_json(file)
    except ValueError as error:
        raise ValueError(f"{file}: not readable as JSON ({error}); process the session again") from error
    return summary if isinstance(summary, dict) else {}


def _has_whole_name(path: Path) -> bool:
    """Whether the name of a folder is text; on some systems a name may be any bytes."""
    try:
        path.name.encode()
    except UnicodeEncodeError:
        return False
    return True
