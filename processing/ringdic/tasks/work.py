"""The folder of a session's task outputs, and the limit of its size."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ringdic.tasks.task import Task

_LIMIT = 8 << 30  # bytes


def work_folder(session: Path) -> Path:
    """The folder of a session's task outputs. It may be removed while no job runs; outputs are computed again."""
    return Path(session).resolve() / "work"


def tidy(folder: Path, job: Iterable[Task], limit: int = _LIMIT) -> None:
    """Remove the least recently used outputs until the folder takes no more than ``limit`` bytes.

    job : tasks whose outputs are not removed.
    """
    if not folder.is_dir():
        return
    own = {task.output for task in job}
    outputs = [(path.stat(), path) for path in folder.glob("*.npz")]
    total = sum(stat.st_size for stat, _ in outputs)
    for stat, path in sorted(outputs, key=lambda one: one[0].st_mtime):
        if total <= limit:
            return
        if path not in own:
            path.unlink(missing_ok=True)
            total -= stat.st_size
