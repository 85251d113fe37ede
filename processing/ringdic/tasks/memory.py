"""A cache in memory that the tasks of a process share: decoded images, prepared references. Its size is bounded."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from ringdic.arrays import Image
from ringdic.session.mosaic import read_level_gray

T = TypeVar("T")

# Bytes. A run processes one camera after the other and needs none again, so more would be of no use; and memory that
# the process has not used before is slow, because the system clears it first.
_LIMIT = 256 << 20


@dataclass
class _Entry:
    """One value, computed by the first thread that asks for it while the others wait."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    value: Any = None
    bytes: int = -1  # until the value is computed


class Memory:
    """A cache of values by key, which drops the least recently used ones beyond a limit of bytes.

    Several threads may use it at a time; each value is computed once. limit : of all values together, bytes.
    ``computations`` counts the values that were computed.
    """

    def __init__(self, limit: int = _LIMIT) -> None:
        self.limit = limit
        self.computations = 0
        self._entries: OrderedDict[Hashable, _Entry] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """Size of all values now."""
        with self._lock:
            return sum(max(entry.bytes, 0) for entry in self._entries.values())

    def get(self, key: Hashable, compute: Callable[[], T], size: Callable[[T], int]) -> T:
        """The value stored under a key, computed where it is not in the cache.

        compute : function that returns the value; an exception that it raises is raised and not cached. size : bytes of
        a value.
        """
        with self._lock:
            entry = self._entries.setdefault(key, _Entry())
            self._entries.move_to_end(key)
        with entry.lock:
            if entry.bytes < 0:
                try:
                    entry.value = compute()
                    entry.bytes = size(entry.value)
                except BaseException:
                    with self._lock:
                        self._entries.pop(key, None)
                    raise
                self.computations += 1
                self._drop()
            value: T = entry.value
        return value

    def image(self, path: Path) -> Image:
        """The grey levels, (height, width), of an image file; read again if the file has changed since."""
        stat = path.stat()
        key = (str(path), stat.st_size, stat.st_mtime_ns)
        return self.get(key, lambda: read_level_gray(path), lambda image: int(image.nbytes))

    def clear(self) -> None:
        """Drop all values."""
        with self._lock:
            self._entries.clear()

    def _drop(self) -> None:
        with self._lock:
            total = sum(max(entry.bytes, 0) for entry in self._entries.values())
            for key in [key for key, entry in self._entries.items() if entry.bytes >= 0]:
                if total <= self.limit:
                    return
                total -= self._entries.pop(key).bytes


#: The cache of this process.
process_memory = Memory()
