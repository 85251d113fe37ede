"""How the process asks the system for memory."""

from __future__ import annotations

import ctypes
import os
import sys

# Of glibc's mallopt(3).
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_KEPT = 1 << 30  # bytes of freed memory that stay with the process
_OWN_PAGES = 32 << 20  # bytes from which on an array has pages of its own; glibc takes no more


def keep_freed_memory() -> None:
    """Have freed memory used again in place of new pages, which the system would have to clear: images and fields of
    some megabytes come and go all the time. Where the C library is not glibc nothing changes.

    To be called before there are threads.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_ARENA_MAX, os.cpu_count() or 1)
        mallopt(_MMAP_THRESHOLD, _OWN_PAGES)
        mallopt(_TRIM_THRESHOLD, _KEPT)
