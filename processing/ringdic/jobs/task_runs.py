"""Tasks of a job, run by an executor with reports of their progress."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from ringdic.progress import Stages
from ringdic.tasks import Executor, Task, TaskReport, tidy


def run_tasks(tasks: Sequence[Task], whole: Sequence[Task], folder: Path, stages: Stages, executor: Executor) -> None:
    """Run tasks and report their progress, then remove old outputs beyond the size limit of the work folder.

    whole : all tasks of the job, of which these may be a part.
    """
    total_cost, first = sum(task.cost for task in whole), [task.key for task in whole].index(tasks[0].key)
    began, cost, points = time.monotonic(), sum(task.cost for task in whole[:first]), 0

    def report(task: Task, outcome: TaskReport, count: int, total: int) -> None:
        nonlocal cost, points
        cost += task.cost
        points += outcome.points
        rate = f"{points / max(time.monotonic() - began, 1e-3):,.0f} points/s" if points else ""
        stages.at("correlate", cost / total_cost, f"{task.name} ({first + count} of {len(whole)})", rate)

    stages.at("correlate", cost / total_cost)
    executor.run(tasks, report)
    tidy(folder, whole)
