"""The folder of the tasks' outputs in a session, kept within a size."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ringdic.tasks.task import Task

_LIMIT = 8 << 30  # bytes


def work_folder(session: Path) -> Path:
    """Where a session's tasks put their outputs. It may be removed at any time that no job runs: it is made anew."""
    return Path(session).resolve() / "work"


def tidy(folder: Path, job: Iterable[Task], limit: int = _LIMIT) -> None:
    """Remove the outputs not used for longest until the folder takes no more than ``limit`` bytes; never the job's."""
    if not folder.is_dir():
        return
    own = {task.output for task in job}
    found = [(path.stat(), path) for path in folder.glob("*.npz")]
    total = sum(stat.st_size for stat, _ in found)
    for stat, path in sorted(found, key=lambda one: one[0].st_mtime):
        if total <= limit:
            return
        if path not in own:
            path.unlink(missing_ok=True)
            total -= stat.st_size
