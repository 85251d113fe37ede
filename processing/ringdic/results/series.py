"""Series of results that are read or computed one step at a time, so that not all need fit into memory.

A step is given as results of two steps, the reference and the step itself.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any, Protocol
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from ringdic.results.fields import OPTIONAL_ARRAYS
from ringdic.results.results import MATCH_ARRAYS, Results


class Series(Protocol):
    """Results at F steps, the reference first, read or computed one step at a time."""

    @property
    def names(self) -> tuple[str, ...]:
        """Capture ids (F,) of the steps."""
        ...

    @property
    def reference(self) -> Results:
        """The results of the reference alone."""
        ...

    def at(self, step: int) -> Results:
        """The results of the reference and of a later step; for step 0 those of the reference alone."""
        ...

    def without_matches(self) -> Series:
        """The series without the matches in the images."""
        ...


@dataclass(frozen=True)
class InMemorySeries:
    """Series of results that are all in memory."""

    results: Results

    @property
    def names(self) -> tuple[str, ...]:
        """Capture ids (F,) of the steps."""
        return self.results.steps

    @property
    def reference(self) -> Results:
        """The results of the reference alone."""
        return self.at(0)

    def at(self, step: int) -> Results:
        """The results of the reference and of a later step; for step 0 those of the reference alone."""
        return select_steps(self.results, [0, step] if step else [0])

    def without_matches(self) -> InMemorySeries:
        """The series without the matches in the images."""
        return InMemorySeries(replace(self.results, matches=()))


def select_steps(results: Results, steps: Sequence[int]) -> Results:
    """Results of some of the steps, in the order given.

    Raises ValueError where the first is not step 0, the reference.
    """
    index = list(steps)
    if not index or index[0] != 0:
        raise ValueError("results keep their reference, step 0, as the first")
    return _with_steps(results, [(results, index)])


def join_steps(parts: Sequence[Results]) -> Results:
    """Join the results of single steps to the results of all steps of a series.

    parts : from `Series.at`, for steps 0, 1, 2, … or for 1, 2, …
    """
    first, *others = parts
    return _with_steps(first, [(first, range(len(first.steps))), *((other, [1]) for other in others)])


def _with_steps(like: Results, chosen: Sequence[tuple[Results, Sequence[int]]]) -> Results:
    """Results with chosen steps of several results that differ in their steps only.

    like : gives what does not depend on the step. chosen : results and the indices of the steps to take from them.
    """

    def join(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([array[list(index)] for array, (_, index) in zip(arrays, chosen, strict=True)])

    def of(name: str) -> NDArray[Any]:
        return join([getattr(one, name) for one, _ in chosen])

    optional: dict[str, Any] = {name: of(name) for name in OPTIONAL_ARRAYS if getattr(like, name) is not None}
    matches = []
    for m, own in enumerate(like.matches):
        arrays: dict[str, Any] = {
            name: join([getattr(one.matches[m], name) for one, _ in chosen]) for name in MATCH_ARRAYS
        }
        matches.append(replace(own, **arrays))
    return replace(
        like,
        steps=tuple(one.steps[k] for one, index in chosen for k in index),
        vertices=of("vertices"),
        correlation=of("correlation"),
        sigma_xyz=of("sigma_xyz"),
        status=of("status"),
        matches=tuple(matches),
        **optional,
    )


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
