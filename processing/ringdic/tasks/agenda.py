"""Scheduling of a job's tasks by their dependencies: which may start, and which have ended."""

from __future__ import annotations

from collections.abc import Sequence

from ringdic.tasks.task import OnTaskEnd, Task, TaskReport


class Agenda:
    """The tasks of a job that have not ended, in order. Tasks that are done already are reported on construction.

    tasks : in an order in which each follows the tasks that it needs. on_end : called for each task that has ended,
    with its report.
    """

    def __init__(self, tasks: Sequence[Task], on_end: OnTaskEnd) -> None:
        self._on_end = on_end
        self._total = len(tasks)
        self._count = 0
        self._waiting: list[Task] = []
        self._left: set[str] = set()
        for task in tasks:
            if task.done:
                self._report(task, task.run())
            elif task.key not in self._left:
                self._waiting.append(task)
                self._left.add(task.key)
            else:  # a second task with the output of one before it
                self._total -= 1

    def __len__(self) -> int:
        """Number of tasks that have not ended."""
        return len(self._left)

    @property
    def ready(self) -> int:
        """Number of tasks that may start now."""
        return sum(self._may_start(task) for task in self._waiting)

    def start(self) -> Task | None:
        """Remove and return the first task whose needed tasks have all ended; None where no task may start now."""
        for task in self._waiting:
            if self._may_start(task):
                self._waiting.remove(task)
                return task
        return None

    def _may_start(self, task: Task) -> bool:
        return not self._left.intersection(task.needs)

    def ended(self, task: Task, report: TaskReport) -> None:
        """Record that a task which was started has ended, and report it."""
        self._left.discard(task.key)
        self._report(task, report)

    def _report(self, task: Task, report: TaskReport) -> None:
        self._count += 1
        self._on_end(task, report, self._count, self._total)
