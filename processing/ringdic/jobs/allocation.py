"""Settings of the C library's memory allocation for this process."""

from __future__ import annotations

import ctypes
import os
import sys

# Parameters of mallopt(3) in glibc.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_FREED = 1 << 30  # bytes of freed memory that the process does not give back
_OWN_PAGES = 32 << 20  # bytes from which on an array gets pages of its own; the largest value that glibc accepts


def keep_freed_memory() -> None:
    """Set the C library to reuse freed memory instead of requesting new pages, which the system has to clear first.

    Arrays of several megabytes are allocated and freed all the time, so this saves much of the system's time. Nothing
    changes where the C library is not glibc. To be called before threads are started.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_ARENA_MAX, os.cpu_count() or 1)
        mallopt(_MMAP_THRESHOLD, _OWN_PAGES)
        mallopt(_TRIM_THRESHOLD, _FREED)
