"""Image files as bytes: their checksum, and whether a binary PGM is whole."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

_HEADER = re.compile(rb"P5\n(\d{1,9}) (\d{1,9})\n(\d{1,5})\n")


def image_digest(parts: Sequence[bytes | memoryview]) -> tuple[str, int]:
    """SHA-256 in hexadecimal, and length in bytes, of parts joined in order."""
    sha, length = hashlib.sha256(), 0
    for part in parts:
        sha.update(part)
        length += len(part)
    return sha.hexdigest(), length


def digest_of_file(path: Path) -> str:
    """SHA-256 of a file in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def image_is_whole(path: Path) -> bool:
    """Whether a file is a binary PGM with as many pixels as its header promises."""
    with open(path, "rb") as file:
        header = _HEADER.match(file.read(64))
    if header is None:
        return False
    width, height, deepest = (int(number) for number in header.groups())
    return path.stat().st_size == header.end() + width * height * (1 if deepest < 256 else 2)
