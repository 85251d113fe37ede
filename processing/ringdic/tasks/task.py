"""Tasks: functions with an output file, named by a hash of everything that the output depends on."""

from __future__ import annotations

import hashlib
import os
import time
import uuid
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from ringdic.errors import ComputationError, InputError
from ringdic.session.files import checksum
from ringdic.session.records import CameraRecord

Arrays = Mapping[str, NDArray[Any]]
#: Called when a task has ended, with the task, its report, and how many tasks of how many have ended.
OnTaskEnd = Callable[["Task", "TaskReport", int, int], None]

_ERROR = "error"  # name of the only array in the output of a task that ended with a ComputationError: its sentence


@dataclass(frozen=True)
class TaskReport:
    """Outcome of a task.

    computed : whether its output was computed now; False where the file existed already. points : number of matches.
    seconds : time spent.
    """

    computed: bool
    points: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Task:
    """A function of paths and small values, whose result is stored in a folder under a key.

    key : digest of everything that the output depends on. name : for messages to the operator.
    function : a function of a module, called with ``arguments`` and with ``inputs``, the output files of the tasks in
        ``needs``; returns arrays by name. The array "points", where there is one, is the number of matches.
    folder : of the output file. needs : keys of tasks whose outputs lie in the same folder.
    cost : expected time relative to the other tasks.

    A task can be pickled and runs on every machine that sees the session folder under the same path.
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
        """Path of the output file."""
        return self.folder / f"{self.key}.npz"

    @property
    def done(self) -> bool:
        """Whether the output file exists and is complete; the end of a zip file is written last."""
        return self.output.is_file() and zipfile.is_zipfile(self.output)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Output files of the tasks that it needs."""
        return tuple(self.folder / f"{key}.npz" for key in self.needs)

    def run(self) -> TaskReport:
        """Compute the output unless its file exists. A ComputationError of the function is stored as the output."""
        if self.done:
            os.utime(self.output)
            return TaskReport(computed=False)
        began = time.monotonic()
        try:
            arrays = dict(self.function(*self.arguments, inputs=self.inputs))
        except ComputationError as error:
            arrays = {_ERROR: np.array(str(error))}
        _write(self.output, arrays)
        return TaskReport(True, int(arrays.get("points", 0)), time.monotonic() - began)


class Executor(Protocol):
    """Runs tasks: in this process or on other machines."""

    def run(self, tasks: Sequence[Task], on_end: OnTaskEnd) -> None:
        """Run every task that is not done.

        tasks : in an order in which each follows the tasks that it needs. on_end : called in the calling thread, once
        for each task.
        Raises the InputError, or the unexpected exception, of the first task that has one; outputs computed until then
        remain.
        """


def read_output(path: Path, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read the arrays of a task's output file, by name; each (n, ...) has the shape and unit of the task's result.

    names : of the arrays that are read; None reads all.
    Raises the ComputationError that the task ended with, InputError where the file is not readable.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            failed = _ERROR in file.files
            arrays = {name: file[name] for name in (file.files if failed or names is None else names)}
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not readable ({error}); remove it and process again") from error
    if failed:
        raise ComputationError(str(arrays[_ERROR]))
    return arrays


def digest(*parts: Any) -> str:
    """Digest (32 hexadecimal digits) that identifies a set of values, for the key of a task.

    parts : numbers, text, arrays, sequences, mappings, dataclasses and groups of settings; TypeError for others.
    """
    sha = hashlib.sha256()
    for piece in _pieces(parts):
        sha.update(piece)
    return sha.hexdigest()[:32]


def file_digest(path: Path, record: CameraRecord | None = None) -> str:
    """SHA-256 of a file. record : its entry in the capture's record; that digest is used where the size agrees."""
    if record is not None and record.sha256 and record.bytes == path.stat().st_size:
        return record.sha256
    return checksum(path)


def _write(path: Path, arrays: Arrays) -> None:
    """Write arrays to a temporary file and rename it, so that a file under its own name is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.stem}-{uuid.uuid4().hex}.partial")  # unique among all machines that see the folder
    try:
        with aside.open("wb") as file:
            np.savez(file, **dict(arrays))  # type: ignore[arg-type]
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def _pieces(value: Any) -> list[bytes]:
    """Bytes that identify a value: different values have different bytes."""
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
