"""Steps taken out of results, and a cache on disk of what was computed for each step."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any
from weakref import finalize

from ringdic.results.fields import OPTIONAL_ARRAYS
from ringdic.results.results import MATCH_ARRAYS, Results


def select_steps(results: Results, steps: Sequence[int]) -> Results:
    """Results of some of the steps, in the order given.

    Raises ValueError where the first is not step 0, the reference.
    """
    index = list(steps)
    if not index or index[0] != 0:
        raise ValueError("results keep their reference, step 0, as the first")

    def chosen(source: object, names: Iterable[str]) -> dict[str, Any]:
        return {name: getattr(source, name)[index] for name in names if getattr(source, name) is not None}

    arrays = chosen(results, ("vertices", "correlation", "sigma_xyz", "status", *OPTIONAL_ARRAYS))
    matches = tuple(replace(each, **chosen(each, MATCH_ARRAYS)) for each in results.matches)
    return replace(results, steps=tuple(results.steps[k] for k in index), matches=matches, **arrays)


class StepCache:
    """A cache of values on disk, in a temporary file that is removed at the latest when the process ends.

    Several threads may use it at a time. folder : of the file; created where it is missing.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115, closed with the cache
        self._at: dict[Hashable, int] = {}
        self._lock = Lock()
        finalize(self, self._file.close)

    def put(self, key: Hashable, value: object) -> None:
        """Store a value under a key."""
        with self._lock:
            self._at[key] = self._file.seek(0, 2)
            pickle.dump(value, self._file, protocol=5)

    def get(self, key: Hashable) -> Any:
        """The value stored under a key; raises KeyError where there is none."""
        with self._lock:
            self._file.seek(self._at[key])
            return pickle.load(self._file)

    def close(self) -> None:
        """Remove the file. It is also removed when the cache is garbage-collected."""
        self._file.close()
