"""What runs on a worker of a cluster: one task, with its share of the worker's threads, if the worker is fit for it."""

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

from ringdic.correlation.correlate import load_kernels
from ringdic.errors import InputError
from ringdic.tasks import Ran, Task, code_stamp, kernels_side_by_side

VISIBLE_S = 60.0  # a shared folder may show another machine's file so much later
_LOOK_S = 0.2

_alone = threading.Lock()  # of a task whose kernels use all threads of the worker
_ready = threading.Lock()
_seen: set[Sign] = set()  # found good by this process


@dataclass(frozen=True)
class Sign:
    """By what a worker is known to be fit: this program's source, and a file that the driver has made."""

    stamp: str
    file: Path
    text: str


@dataclass(frozen=True)
class TaskOutcome:
    """What a worker tells of a task: how it ran, or why this worker runs none, or what is wrong with the input."""

    worker: str
    ran: Ran | None = None
    unfit: str | None = None
    wrong: str | None = None


def inspect(sign: Sign) -> str | None:
    """Why this process cannot run the driver's tasks, None if it can; then its kernels are loaded, once."""
    with _ready:
        if sign in _seen:
            return None
        if code_stamp() != sign.stamp:
            return "it runs another version of ringdic; install the same one there"
        if not visible(sign.file.is_file, sign.file.parent, limit=10 * _LOOK_S) or _text(sign.file) != sign.text:
            return (
                f"it does not see the folder {sign.file.parent}; "
                "every machine must see the session's folder under the same path"
            )
        if not os.access(sign.file.parent, os.W_OK):
            return f"it may not write to {sign.file.parent}; give it the permission"
        cv2.setNumThreads(1)
        load_kernels()
        _seen.add(sign)
        return None


def run_task(task: Task, sign: Sign, share: int) -> TaskOutcome:
    """Run a task here.

    share : threads for its kernels, so that the tasks at a time do not take more than the worker's threads; where
    kernels cannot run side by side, one task at a time takes all of them.
    """
    address, threads = _worker()
    unfit = inspect(sign)
    if unfit is not None:
        return TaskOutcome(address, unfit=unfit)
    absent = [path for path in task.inputs if not visible(path.is_file, task.folder)]
    if absent:
        return TaskOutcome(address, unfit=f"it does not see {absent[0]}, which another worker has written")
    try:
        if kernels_side_by_side():
            return TaskOutcome(address, ran=_run(task, min(share, threads)))
        with _alone:
            return TaskOutcome(address, ran=_run(task, threads))
    except InputError as error:
        return TaskOutcome(address, wrong=str(error))


def visible(there: Callable[[], bool], folder: Path, limit: float = VISIBLE_S) -> bool:
    """Wait until a file that another machine has made in a folder is seen here; whether it was within the time (s)."""
    deadline = time.monotonic() + limit
    while not there():
        if time.monotonic() > deadline:
            return False
        time.sleep(_LOOK_S)
        if folder.is_dir():
            os.listdir(folder)  # makes a network file system ask its server anew
    return True


def _run(task: Task, threads: int) -> Ran:
    numba.set_num_threads(max(1, min(threads, int(numba.config.NUMBA_NUM_THREADS))))  # type: ignore[attr-defined]
    return task.run()


def _worker() -> tuple[str, int]:
    """Address and threads of the worker that runs this."""
    from distributed import get_worker

    worker: Any = get_worker()
    return str(worker.address), int(worker.state.nthreads)


def _text(file: Path) -> str | None:
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return None
