"""The executor of one machine: tasks side by side in threads of this process, as many as there are cores."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager

import cv2
import numba

from ringdic.tasks.agenda import Agenda
from ringdic.tasks.task import Ran, Task, Told

_TOGETHER = ("omp", "tbb")  # layers of numba whose kernels may be started from several threads at once


class LocalExecutor:
    """Runs tasks in threads of this process.

    workers : tasks at a time; None for one a core. A task's kernels share the cores with those it starts beside: one
    that all others wait for has all of them.
    """

    def __init__(self, workers: int | None = None) -> None:
        self._workers = workers

    def run(self, tasks: Sequence[Task], told: Told) -> None:
        """See ``Executor.run``. Tasks start in the order given as soon as what they need is there."""
        agenda = Agenda(tasks, told)
        if not agenda:
            return
        cores = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        workers = min(self._workers or (os.cpu_count() or 1), len(agenda)) if kernels_side_by_side() else 1
        running: dict[Future[Ran], Task] = {}
        with _single_threaded_filters(workers > 1), ThreadPoolExecutor(workers, "task") as pool:
            while agenda:
                while len(running) < workers and (task := agenda.start()) is not None:
                    together = min(workers, len(running) + 1 + agenda.ready)
                    running[pool.submit(_run, task, max(1, cores // together))] = task
                ended, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in ended:
                    agenda.ended(running.pop(future), future.result())


def _run(task: Task, threads: int) -> Ran:
    numba.set_num_threads(threads)  # of this thread
    return task.run()


def kernels_side_by_side() -> bool:
    """Whether kernels may run in several threads of this process at once; False before the first has run."""
    try:
        return numba.threading_layer() in _TOGETHER
    except ValueError:  # no kernel has run yet
        return False


@contextmanager
def _single_threaded_filters(alone: bool) -> Iterator[None]:
    """OpenCV without threads of its own while tasks fill the cores."""
    before = cv2.getNumThreads()
    if alone:
        cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
