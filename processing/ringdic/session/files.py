"""Atomic and durable writing of files: a file under its name is complete, and survives a power cut.

A file is written under a temporary name, flushed to the disk, and then linked or renamed to its name; then its folder
is flushed too.
"""

from __future__ import annotations

import errno
import filecmp
import hashlib
import json
import os
import shutil
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

PARTIAL = ".partial-"  # how the names of files begin that are being written
_PIECE = 1 << 20  # bytes copied at a time


def place(path: Path, content: bytes) -> None:
    """Write a new file atomically; raises FileExistsError where the name is taken, and never replaces a file."""
    aside = _write_aside(path, content)
    try:
        os.link(aside, path)
    finally:
        aside.unlink()
    _flush_folder(path.parent)


def link(source: Path, path: Path) -> bool:
    """Hard-link a file to a second name; returns False where the file system cannot.

    Raises FileExistsError where the name is taken, and never replaces a file.
    """
    try:
        os.link(source, path)
    except FileExistsError:
        raise
    except OSError:
        return False
    return True


def checksum(path: Path) -> str:
    """SHA-256 of a file in hexadecimal digits, read a piece at a time."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def same_content(path: Path, other: Path) -> bool:
    """Whether two files hold the same bytes; both are read where their sizes agree."""
    filecmp.clear_cache()  # which goes by size and time of the files, and a damaged file may have both
    return filecmp.cmp(path, other, shallow=False)


def copy_file(source: Path, path: Path) -> None:
    """Copy a file with its times, durably, and read the copy back; a file of that name is replaced.

    Raises OSError where the copy is not what was read.
    """
    aside = _aside(path)
    try:
        with open(source, "rb") as original, open(aside, "wb") as copy:
            shutil.copyfileobj(original, copy, _PIECE)
            copy.flush()
            os.fsync(copy.fileno())
        shutil.copystat(source, aside)
        if not same_content(source, aside):
            raise OSError(errno.EIO, "what was read back is not what was written; check the disk")
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
    _flush_folder(path.parent)


def replace_json(path: Path, document: dict[str, Any]) -> None:
    """Replace a JSON file atomically: a reader sees either the old file or the new one."""
    aside = _write_aside(path, json.dumps(document, indent=1).encode() + b"\n")
    try:
        os.replace(aside, path)
    except OSError:
        aside.unlink(missing_ok=True)
        raise
    _flush_folder(path.parent)


def leads_out(folder: Path, path: Path) -> bool:
    """Whether a path leads, through symbolic links in it, to a place outside a folder.

    A session folder comes from elsewhere at times, and a link in it could name any file of this PC.
    """
    whole = os.path.realpath(folder)
    return os.path.commonpath([whole, os.path.realpath(path)]) != whole


def _aside(path: Path) -> Path:
    """The name under which this thread writes a file before it is renamed to its own."""
    return path.with_name(f"{PARTIAL}{path.name}-{os.getpid()}-{threading.get_ident()}")


def _write_aside(path: Path, content: bytes) -> Path:
    """Write a file under a temporary name; nothing is left of one that the disk does not take."""
    aside = _aside(path)
    try:
        with open(aside, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        with suppress(OSError):
            aside.unlink(missing_ok=True)
        raise
    return aside


def _flush_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
