"""Which tasks of a job may start, and which have ended: the part that all executors share."""

from __future__ import annotations

from collections.abc import Sequence

from ringdic.tasks.task import Ran, Task, Told


class Agenda:
    """The tasks of a job that are not done, in order; those that are done are told of at once.

    tasks : a task comes after those it needs. told : see ``Executor.run``.
    """

    def __init__(self, tasks: Sequence[Task], told: Told) -> None:
        self._told = told
        self._total = len(tasks)
        self._count = 0
        self._waiting: list[Task] = []
        self._left: set[str] = set()
        for task in tasks:
            if task.done:
                self._tell(task, task.run())
            elif task.key not in self._left:
                self._waiting.append(task)
                self._left.add(task.key)
            else:  # twice in the list: the same output
                self._total -= 1

    def __len__(self) -> int:
        """How many have not ended."""
        return len(self._left)

    @property
    def ready(self) -> int:
        """How many may start now."""
        return sum(self._may_start(task) for task in self._waiting)

    def start(self) -> Task | None:
        """The first task whose needs are all met, as one that has started; None if there is none now."""
        for task in self._waiting:
            if self._may_start(task):
                self._waiting.remove(task)
                return task
        return None

    def _may_start(self, task: Task) -> bool:
        return not self._left.intersection(task.needs)

    def ended(self, task: Task, ran: Ran) -> None:
        """A started task has its output."""
        self._left.discard(task.key)
        self._tell(task, ran)

    def _tell(self, task: Task, ran: Ran) -> None:
        self._count += 1
        self._told(task, ran, self._count, self._total)
