"""Executor for one machine: runs tasks in threads of this process, one per core."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager

import cv2
import numba

from ringdic.tasks.agenda import Agenda
from ringdic.tasks.task import OnTaskEnd, Task, TaskReport


class LocalExecutor:
    """Runs tasks in threads of this process.

    workers : number of tasks at a time; None for one per core. The kernels of tasks that run at a time share the cores;
    those of a task that all others wait for use all cores.
    """

    def __init__(self, workers: int | None = None) -> None:
        self._workers = workers

    def run(self, tasks: Sequence[Task], on_end: OnTaskEnd) -> None:
        """Run every task that is not done, in the order given; each starts when the tasks that it needs have ended.

        on_end : called in the calling thread for each task that has ended. InputError of a task ends the run.
        """
        agenda = Agenda(tasks, on_end)
        if not agenda:
            return
        cores = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        workers = min(self._workers or (os.cpu_count() or 1), len(agenda))
        running: dict[Future[TaskReport], Task] = {}
        with _single_threaded_filters(workers > 1), ThreadPoolExecutor(workers, "task") as pool:
            while agenda:
                while len(running) < workers and (task := agenda.start()) is not None:
                    together = min(workers, len(running) + 1 + agenda.ready)
                    running[pool.submit(_run, task, max(1, cores // together))] = task
                ended, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in ended:
                    agenda.ended(running.pop(future), future.result())


def _run(task: Task, threads: int) -> TaskReport:
    numba.set_num_threads(threads)  # the setting holds for this thread alone
    return task.run()


@contextmanager
def _single_threaded_filters(alone: bool) -> Iterator[None]:
    """Have OpenCV use one thread for the time of the context, if ``alone``: the tasks already use all cores."""
    before = cv2.getNumThreads()
    if alone:
        cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
