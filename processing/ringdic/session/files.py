"""Atomic and durable writing of files: a file under its name is complete, and survives a power cut.

A file is written under a temporary name, flushed to the disk, and then linked or renamed to its name; then its folder
is flushed too.
"""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path
from typing import Any

PARTIAL = ".partial-"  # how the names of files begin that are being written


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


def replace_json(path: Path, document: dict[str, Any]) -> None:
    """Replace a JSON file atomically: a reader sees either the old file or the new one."""
    aside = _write_aside(path, json.dumps(document, indent=1).encode() + b"\n")
    os.replace(aside, path)
    _flush_folder(path.parent)


def _write_aside(path: Path, content: bytes) -> Path:
    aside = path.with_name(f"{PARTIAL}{path.name}-{os.getpid()}-{threading.get_ident()}")
    with open(aside, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return aside


def _flush_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
