"""``python -m ringdic.jobs.compiling`` compiles all kernels once, by several processes side by side.

Each process runs a part of what a job does on a small example, so that the kernels of that part are compiled, or loaded
from the cache that all processes share. Other packages add parts through the entry-point group ``ringdic.kernels``:
each entry names a function that is called without arguments. A file in the cache's folder says that all are compiled
for this processor; then the command ends at once.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path

import llvmlite.binding
import numba

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Tell = Callable[[int, int, float], None]

PARTS = "ringdic.kernels"
_NICE = 10  # compiling must not slow a capture down
_LOOK_S = 0.1


def compile_once(tell: Tell) -> None:
    """Compile all kernels, unless that has been done with these sources on this processor.

    Parts that fail are left to the first job, which compiles what it misses.

    tell : called with the number of parts that are compiled, the number of all, and the seconds since the begin: once
        before anything is compiled, and after each part; not at all if nothing is to be compiled.
    """
    mark, count = _mark(), len(_parts())
    if mark is None or mark.is_file():
        return
    tell(0, count, 0.0)
    with _alone(mark.parent):
        if mark.is_file():  # another process has compiled them meanwhile
            tell(count, count, 0.0)
        elif _compile_parts(tell):
            mark.touch()


def _compile_parts(tell: Tell) -> bool:
    """Compile all parts, as many at a time as there are cores; returns whether none has failed."""
    began, waiting, failed = time.monotonic(), list(_parts()), False
    running: list[subprocess.Popen[bytes]] = []
    count, lowered = len(waiting), getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
    while waiting or running:
        while waiting and len(running) < (os.cpu_count() or 1):
            command = [sys.executable, "-P", "-m", "ringdic.jobs.compiling", waiting.pop(0)]
            running.append(subprocess.Popen(command, stdin=subprocess.DEVNULL, creationflags=lowered))
        time.sleep(_LOOK_S)
        for child in [child for child in running if child.poll() is not None]:
            running.remove(child)
            failed |= child.returncode != 0
            tell(count - len(waiting) - len(running), count, time.monotonic() - began)
    return not failed


@cache
def _parts() -> dict[str, Callable[[], object]]:
    """What is run to compile the kernels, by name; those that take longest come first."""
    parts: dict[str, Callable[[], object]] = {
        "surfaces": _surfaces,
        "refinement": partial(_refinement, 1),
        "second order": partial(_refinement, 2),
        "matches": _matches,
    }
    for entry in entry_points(group=PARTS):
        parts[entry.name] = lambda entry=entry: entry.load()()  # type: ignore[misc]
    return parts


def _surfaces() -> None:
    from ringdic.jobs.warm_up import run_small_plate

    run_small_plate()


def _refinement(order: int) -> None:
    from ringdic.correlation.correlate import load_refinement

    load_refinement(order)


def _matches() -> None:
    from ringdic.correlation.correlate import load_search

    load_search()


def _mark() -> Path | None:
    """The file that says that all kernels are compiled with these sources, for this processor and numba.

    None where no folder for a cache can be written.
    """
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if folder is None:
        return None
    config, processor = numba.config, llvmlite.binding.get_host_cpu_name()
    target = (numba.__version__, processor, config.CPU_NAME, config.CPU_FEATURES, sorted(_parts()))  # type: ignore[attr-defined]
    name = hashlib.sha256(repr(target).encode()).hexdigest()[:16]
    return Path(folder) / f"compiled-{name}"


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Context that one process at a time enters; where the system has no locks, all do."""
    if fcntl is None:
        yield
        return
    with (folder / "compiling").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _tell_on_terminal(done: int, count: int, seconds: float) -> None:
    time_taken = f", {seconds:.0f} s" if done else ""
    sys.stderr.write(f"compiling the kernels, once: {done} of {count} parts{time_taken}\n")


def main(arguments: list[str]) -> int:
    """Compile the part that is named in the arguments, or all parts with progress on standard error."""
    if not arguments:
        compile_once(_tell_on_terminal)
        return 0
    if hasattr(os, "nice"):
        os.nice(_NICE)
    _parts()[arguments[0]]()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
