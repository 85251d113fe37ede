"""Kinds of capture, and the names that sessions, captures and cameras may have in folders and in messages.

The messages between node and controller (`ringdic_node.wire`) follow the same kinds and the same rule. A node has no
package `ringdic`, so they are repeated there; a test checks that the two agree.
"""

from __future__ import annotations

import re
from typing import Literal, get_args

from ringdic.errors import InputError

CaptureKind = Literal["board", "target", "specimen", "static"]

#: board: views of the checkerboard. target: the calibration object. specimen: the reference, then the steps.
#: static: the specimen at rest, unchanged since the reference, from which the noise is measured.
CAPTURE_KINDS: tuple[CaptureKind, ...] = get_args(CaptureKind)

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_CAPTURE_ID = re.compile(r"([0-9]{4,9})-([a-z]+)")


def checked_name(what: str, name: object) -> str:
    """Return a name unchanged if it can be used in file names and in messages' keys, else raise InputError.

    Parameters
    ----------
    what : what the name is of, for the error message, such as "the session name".
    name : the candidate.

    Raises
    ------
    InputError
        It is not 1 to 64 letters, digits, dots, dashes or underscores, beginning with a letter or a digit.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(
            f"{what} {name!r} is not a name: use 1 to 64 letters, digits, dots, dashes or underscores, "
            "beginning with a letter or a digit"
        )
    return name


def is_file_name(name: str) -> bool:
    """Whether a name stays in its folder: it is not empty, has no separator and is neither ``.`` nor ``..``."""
    return bool(name) and "/" not in name and "\\" not in name and name not in (".", "..")


def capture_id(number: int, kind: str) -> str:
    """Name of a capture, which is also that of its folder: ``0003-specimen``."""
    return f"{number:04d}-{kind}"


def split_capture_id(name: str) -> tuple[int, str] | None:
    """Number and kind of a capture from its name; None where the name is not of this form.

    The kind may be one that this version does not know.
    """
    match = _CAPTURE_ID.fullmatch(name)
    return None if match is None else (int(match[1]), match[2])
