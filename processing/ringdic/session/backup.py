"""Backup of an archive of sessions, and removal of sessions that a backup holds.

A backup is an archive like the first: its sessions open where they are. What can be computed again, the folders
``calibration``, ``work`` and ``live``, is left out.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

from ringdic.errors import InputError
from ringdic.session.files import PARTIAL, copy_file, same_content
from ringdic.session.verification import session_folders, verify_session

_COMPUTED = ("calibration", "work", "live")
_DAY = 86_400.0


@dataclass(frozen=True)
class SessionBackup:
    """What was done for one session. copied : files; size : their bytes; held : files that were there already.

    faults : a sentence for each file that could not be copied or that contradicts the backup's.
    """

    session: str
    copied: int
    size: int
    held: int
    faults: tuple[str, ...]


def back_up(archive: Path, backup: Path) -> Iterator[SessionBackup]:
    """Copy what a backup lacks of the sessions of an archive; each file is read back and compared.

    A record that has changed since replaces the older one. An image or a result that differs from the backup's is a
    contradiction: it is named, and the backup keeps its own. A session with damaged images is copied as far as it is
    whole, and its faults are named, so that damage never spreads.

    Parameters
    ----------
    archive : folder of sessions.
    backup : folder of the backup, on another disk; it is created.

    Yields
    ------
    A SessionBackup for each session, as soon as it is done.

    Raises
    ------
    InputError : there is no such archive, or one of the folders lies in the other.
    """
    archive, backup = Path(archive).resolve(), Path(backup).resolve()
    sessions = session_folders(archive)
    if archive == backup or archive in backup.parents or backup in archive.parents:
        raise InputError(f"{backup}: a backup must not lie in the archive {archive}, nor the archive in it")
    for session in sessions:
        yield _back_up_session(session, backup / session.name)


def _back_up_session(session: Path, copy: Path) -> SessionBackup:
    damaged = verify_session(session).faults
    faults = list(damaged.values())
    copied = size = held = 0
    for path in _kept_files(session):
        target = copy / path.relative_to(session)
        if path in damaged:
            continue
        try:
            if target.is_file() and same_content(path, target):
                held += 1
            elif target.exists() and path.suffix != ".json" and path.name not in ("rig.toml", "settings.toml"):
                faults.append(f"{target}: the backup holds another file of this name; it is kept, compare the two")
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                copy_file(path, target)
                copied, size = copied + 1, size + target.stat().st_size
        except OSError as error:
            faults.append(f"{target}: cannot be written ({error.strerror or error})")
    return SessionBackup(session.name, copied, size, held, tuple(faults))


def _kept_files(session: Path) -> Iterator[Path]:
    """Files of a session that a backup holds: the images first, the records after them."""
    files = []
    for path in sorted(session.rglob("*")):
        parts = path.relative_to(session).parts
        if parts[0] in _COMPUTED or any(part.startswith((PARTIAL, ".")) for part in parts):
            continue
        if path.is_file() and not any((session / Path(*parts[: i + 1])).is_symlink() for i in range(len(parts))):
            files.append(path)
    yield from sorted(files, key=lambda path: (path.suffix == ".json", path))


def removable_sessions(archive: Path, backup: Path, older_than_days: float) -> tuple[tuple[Path, str], ...]:
    """Sessions that nobody has written to for a time, each with the reason why it must stay, empty where it may go.

    A session may go when the backup holds every one of its files, byte for byte.

    Parameters
    ----------
    archive, backup : folders of sessions.
    older_than_days : days since the last write to any of the session's files.
    """
    archive, backup = Path(archive).resolve(), Path(backup).resolve()
    limit = time.time() - older_than_days * _DAY
    found = []
    for session in session_folders(archive):
        files = list(_kept_files(session))
        if max((path.stat().st_mtime for path in files), default=0.0) > limit:
            continue
        found.append((session, _reason_to_stay(session, backup / session.name, files)))
    return tuple(found)


def _reason_to_stay(session: Path, copy: Path, files: list[Path]) -> str:
    for fault in verify_session(session).faults.values():
        return fault
    for path in files:
        target = copy / path.relative_to(session)
        if not target.is_file():
            return f"the backup lacks {path.relative_to(session)}; run 'ringdic archive backup' first"
        if not same_content(path, target):
            return f"the backup's {path.relative_to(session)} is another one; compare the two"
    return ""


def remove_session(session: Path) -> None:
    """Remove a session folder for good; it disappears from its archive at once, as a whole."""
    aside = session.with_name(f".removed-{session.name}-{uuid4().hex}")
    session.rename(aside)
    shutil.rmtree(aside)
