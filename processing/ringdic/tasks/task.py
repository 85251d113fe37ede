"""A task, the key of what it depends on, and its output file."""

from __future__ import annotations

import hashlib
import os
import time
import uuid
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from ringdic.errors import ComputationError, InputError
from ringdic.session.records import CameraRecord

Arrays = Mapping[str, NDArray[Any]]
#: Told of a task that has ended, what came of it, and how many of how many have.
Told = Callable[["Task", "Ran", int, int], None]

_ERROR = "error"  # the name under which an output keeps why there is nothing else in it


@dataclass(frozen=True)
class Ran:
    """What came of a task. made : computed now, not found. points : matches made. seconds : time it took."""

    made: bool
    points: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Task:
    """A function of paths and small values whose result is kept in ``folder`` under ``key``.

    key : of everything that the output depends on, see ``digest``. name : for people. function : of a module, called
    with ``arguments`` and with ``inputs``, the output files of ``needs``; gives arrays by name, of which "points", if
    there, counts matches. needs : keys of tasks whose outputs lie in the same folder. cost : how long it takes beside
    others. All of it can be pickled; the function runs wherever the session folder is seen under the same path.
    """

    key: str
    name: str
    function: Callable[..., Arrays]
    arguments: tuple[Any, ...]
    folder: Path
    needs: tuple[str, ...] = ()
    cost: float = 1.0

    @property
    def output(self) -> Path:
        """The file of the result."""
        return self.folder / f"{self.key}.npz"

    @property
    def done(self) -> bool:
        """Whether the output is there, and whole: its end is written last."""
        return self.output.is_file() and zipfile.is_zipfile(self.output)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The output files of the tasks it needs."""
        return tuple(self.folder / f"{key}.npz" for key in self.needs)

    def run(self) -> Ran:
        """Make the output unless it is there. A ComputationError is an outcome: it is kept as such."""
        if self.done:
            os.utime(self.output)
            return Ran(made=False)
        began = time.monotonic()
        try:
            arrays = dict(self.function(*self.arguments, inputs=self.inputs))
        except ComputationError as error:
            arrays = {_ERROR: np.array(str(error))}
        _write(self.output, arrays)
        return Ran(True, int(arrays.get("points", 0)), time.monotonic() - began)


class Executor(Protocol):
    """Whatever runs tasks."""

    def run(self, tasks: Sequence[Task], told: Told) -> None:
        """Run every task whose output is not there; a task comes after those it needs.

        ``told`` is called in the calling thread, once a task. An InputError of a task, or a bug, ends the run and is
        raised; what was made until then stays.
        """


def read_output(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an output file. Raises the ComputationError that its task ended with."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not readable ({error}); remove it and process again") from error
    if _ERROR in arrays:
        raise ComputationError(str(arrays[_ERROR]))
    return arrays


def digest(*parts: Any) -> str:
    """A key of values: numbers, text, arrays, sequences, mappings, dataclasses and groups of settings. 32 digits."""
    sha = hashlib.sha256()
    for piece in _pieces(parts):
        sha.update(piece)
    return sha.hexdigest()[:32]


@cache
def code_stamp() -> str:
    """A key of this program's own source: another version makes its outputs anew."""
    root = Path(__file__).resolve().parents[1]
    sources = sorted(root.rglob("*.py"))
    return digest([(str(path.relative_to(root).as_posix()), path.read_bytes()) for path in sources])


def file_digest(path: Path, record: CameraRecord | None = None) -> str:
    """The SHA-256 of a file, hexadecimal. record : its capture's entry, believed where the size in bytes agrees."""
    if record is not None and record.sha256 and record.bytes == path.stat().st_size:
        return record.sha256
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write(path: Path, arrays: Arrays) -> None:
    """Written aside and renamed: a file under its own name is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.stem}-{uuid.uuid4().hex}.partial")  # its own on every machine that sees the folder
    try:
        with aside.open("wb") as file:
            np.savez(file, **dict(arrays))  # type: ignore[arg-type]
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def _pieces(value: Any) -> list[bytes]:
    """A value as bytes that tell it from every other."""
    if isinstance(value, BaseModel):
        return [type(value).__name__.encode(), *_pieces(value.model_dump())]
    if is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__.encode(), *_pieces([(f.name, getattr(value, f.name)) for f in fields(value)])]
    if isinstance(value, np.ndarray):
        return [f"array {value.dtype.str} {value.shape} ".encode(), np.ascontiguousarray(value).tobytes()]
    if isinstance(value, Mapping):
        return [b"{", *(piece for item in sorted(value.items()) for piece in _pieces(item)), b"}"]
    if isinstance(value, list | tuple):
        return [b"(", *(piece for each in value for piece in _pieces(each)), b")"]
    if isinstance(value, bytes):
        return [f"bytes {len(value)} ".encode(), value]
    if value is None or isinstance(value, bool | int | float | str | np.generic):
        text = repr(value.item() if isinstance(value, np.generic) else value).encode()
        return [f"{len(text)} ".encode(), text]
    raise TypeError(f"a key cannot be made of {type(value).__name__}")
