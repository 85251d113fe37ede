"""Reading of JSON files that may be damaged or foreign: what is read can be shown, stored and written again.

JSON of another program may hold what no other part of this one can pass on: numbers that are not finite, halves of
characters, tables within tables without end.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
from pathlib import Path
from typing import Any

LARGEST = 64 << 20  # bytes; the record of a capture with a hundred cameras has 0.1 MB
DEEPEST = 40  # tables within tables; each costs the encoders of the HTTP interface several frames of the stack

_HALF_CHARACTER = re.compile(r"\\u[dD][89abABcdefCDEF]")


def read_json(path: Path) -> Any:
    """Read the value in a JSON file.

    Numbers that are not finite become None, and halves of characters (lone surrogates) U+FFFD.

    Raises
    ------
    ValueError
        The file is no JSON in UTF-8, is nested too deeply, is too large or is no regular file.
    OSError
        It cannot be read.
    """
    state = os.stat(path)
    if not stat.S_ISREG(state.st_mode):
        raise ValueError("no regular file")
    if state.st_size > LARGEST:
        raise ValueError(f"{state.st_size} bytes, more than the {LARGEST} of the largest record")
    return parse_json(Path(path).read_text(encoding="utf-8"))


def parse_json(text: str) -> Any:
    """Parse JSON text; numbers that are not finite become None, and halves of characters U+FFFD.

    Raises ValueError for text that is no JSON or is nested too deeply.
    """
    try:
        value = json.loads(text, parse_constant=lambda _: None, parse_float=_finite)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if _is_deeper(value, DEEPEST):
        raise ValueError(f"nested deeper than {DEEPEST} levels")
    return _with_whole_characters(value) if _HALF_CHARACTER.search(text) else value


def _finite(digits: str) -> float | None:
    number = float(digits)
    return number if math.isfinite(number) else None


def _is_deeper(value: Any, levels: int) -> bool:
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list):
        return False
    return levels == 0 or any(_is_deeper(inner, levels - 1) for inner in value)


def _with_whole_characters(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    if isinstance(value, dict):
        return {_with_whole_characters(key): _with_whole_characters(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_with_whole_characters(inner) for inner in value]
    return value
