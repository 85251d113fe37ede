"""The worker's side of a cluster: checks the worker and runs a task with its share of the threads."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numba

from ringdic.compiled import source_digest
from ringdic.correlation.correlate import load_kernels
from ringdic.errors import InputError
from ringdic.tasks import Task, TaskReport

VISIBLE_S = 60.0  # a shared folder may show a file of another machine with this delay
_LOOK_S = 0.2

_ready = threading.Lock()
_accepted: set[Handshake] = set()  # checked by this process, without a refusal


@dataclass(frozen=True)
class Handshake:
    """Values that a worker is checked against: the driver's version, and a random text in the session's folder.

    stamp : digest of the driver's source. file, text : the file and its contents.
    """

    stamp: str
    file: Path
    text: str


@dataclass(frozen=True)
class TaskOutcome:
    """Outcome of a task on a worker: a report, the reason why this worker cannot run tasks, or an error of the input.

    worker : its address. Exactly one of report, refusal and input_error is not None; the last two are sentences.
    """

    worker: str
    report: TaskReport | None = None
    refusal: str | None = None
    input_error: str | None = None


def inspect(handshake: Handshake) -> str | None:
    """Check this process and load its kernels, once. Why it cannot run the driver's tasks, None if it can."""
    with _ready:
        if handshake in _accepted:
            return None
        if source_digest() != handshake.stamp:
            return "it runs another version of ringdic; install the same one there"
        if (
            not visible(handshake.file.is_file, handshake.file.parent, limit=10 * _LOOK_S)
            or _text(handshake.file) != handshake.text
        ):
            return (
                f"it does not see the folder {handshake.file.parent}; "
                "every machine must see the session's folder under the same path"
            )
        if not os.access(handshake.file.parent, os.W_OK):
            return f"it may not write to {handshake.file.parent}; give it the permission"
        cv2.setNumThreads(1)
        load_kernels()
        _accepted.add(handshake)
        return None


def run_task(task: Task, handshake: Handshake, share: int) -> TaskOutcome:
    """Run a task in this process after checking it against the driver.

    handshake : to check the worker against. share : threads for the task's kernels, so that the tasks running at a time
    use no more than the worker's threads.
    """
    address, threads = _worker()
    refusal = inspect(handshake)
    if refusal is not None:
        return TaskOutcome(address, refusal=refusal)
    absent = [path for path in task.inputs if not visible(path.is_file, task.folder)]
    if absent:
        return TaskOutcome(address, refusal=f"it does not see {absent[0]}, which another worker has written")
    try:
        return TaskOutcome(address, report=_run(task, min(share, threads)))
    except InputError as error:
        return TaskOutcome(address, input_error=str(error))


def visible(there: Callable[[], bool], folder: Path, limit: float = VISIBLE_S) -> bool:
    """Wait until a file written by another machine is visible here; returns whether it was within ``limit`` seconds.

    there : function that says whether the file is visible now. folder : of the file.
    """
    deadline = time.monotonic() + limit
    while not there():
        if time.monotonic() > deadline:
            return False
        time.sleep(_LOOK_S)
        if folder.is_dir():
            os.listdir(folder)  # has a network file system ask its server again
    return True


def _run(task: Task, threads: int) -> TaskReport:
    numba.set_num_threads(max(1, min(threads, int(numba.config.NUMBA_NUM_THREADS))))  # type: ignore[attr-defined]
    return task.run()


def _worker() -> tuple[str, int]:
    """Address and number of threads of the worker that runs this function."""
    from distributed import get_worker

    worker: Any = get_worker()
    return str(worker.address), int(worker.state.nthreads)


def _text(file: Path) -> str | None:
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return None
