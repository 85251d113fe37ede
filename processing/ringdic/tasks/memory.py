"""What a process keeps between tasks: decoded images, prepared references. Bounded by bytes, whatever the job."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from numpy.typing import NDArray

from ringdic.session.images import read_gray

T = TypeVar("T")

# Bytes. A run takes camera after camera and asks for none again; memory not used before is dear, the system clears it.
_LIMIT = 256 << 20


@dataclass
class _Entry:
    """One value, made by the first who asks while the others wait."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    value: Any = None
    bytes: int = -1  # until it is made


class Memory:
    """Values under keys, those not used for longest dropped when they take more than ``limit`` bytes together.

    Safe to be asked from several threads; a value is made once. ``made`` counts how many were.
    """

    def __init__(self, limit: int = _LIMIT) -> None:
        self.limit = limit
        self.made = 0
        self._entries: OrderedDict[Hashable, _Entry] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """What is kept now."""
        with self._lock:
            return sum(max(entry.bytes, 0) for entry in self._entries.values())

    def get(self, key: Hashable, make: Callable[[], T], size: Callable[[T], int]) -> T:
        """The value of a key, made if it is not there; size : its bytes. What ``make`` raises is raised, not kept."""
        with self._lock:
            entry = self._entries.setdefault(key, _Entry())
            self._entries.move_to_end(key)
        with entry.lock:
            if entry.bytes < 0:
                try:
                    entry.value = make()
                    entry.bytes = size(entry.value)
                except BaseException:
                    with self._lock:
                        self._entries.pop(key, None)
                    raise
                self.made += 1
                self._drop()
            value: T = entry.value
        return value

    def image(self, path: Path) -> NDArray:
        """The grey image of a file as it is now."""
        stat = path.stat()
        key = (str(path), stat.st_size, stat.st_mtime_ns)
        return self.get(key, lambda: read_gray(path), lambda image: int(image.nbytes))

    def clear(self) -> None:
        """Keep nothing."""
        with self._lock:
            self._entries.clear()

    def _drop(self) -> None:
        with self._lock:
            total = sum(max(entry.bytes, 0) for entry in self._entries.values())
            for key in [key for key, entry in self._entries.items() if entry.bytes >= 0]:
                if total <= self.limit:
                    return
                total -= self._entries.pop(key).bytes


#: Of this process.
kept = Memory()
