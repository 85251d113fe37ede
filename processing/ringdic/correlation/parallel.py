"""Kernels on several threads: each takes one range of the work after the other.

The threads are Python's, and the kernels release its lock. numba's own parallel loops would be compiled several times
over, and only some of its threading layers let two threads of a program start kernels at the same time.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numba

_RANGES = 4  # for each thread, so that all end at about the same time


def in_ranges(kernel: Callable[..., None], count: int, *arguments: object, least: int = 1) -> None:
    """Call a kernel on ranges that together make 0 … count, on the number of threads that numba is set to.

    Parameters
    ----------
    kernel : called with the first and the last index of a range, the last one exclusive, and the arguments; releases
        Python's lock, and works on any two ranges at the same time.
    count : of the pieces of work. least : smallest number of them that is worth a thread.
    """
    threads = min(numba.get_num_threads(), count // least)
    if threads <= 1:
        kernel(0, count, *arguments)
        return
    size = max(least, -(-count // (_RANGES * threads)))
    beginnings = iter(range(0, count, size))

    def take_ranges() -> None:
        for first in beginnings:
            kernel(first, min(first + size, count), *arguments)

    others = [_pool().submit(take_ranges) for _ in range(threads - 1)]
    try:
        take_ranges()
    finally:
        for other in others:
            other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(int(numba.config.NUMBA_NUM_THREADS), "kernel")  # type: ignore[attr-defined]
