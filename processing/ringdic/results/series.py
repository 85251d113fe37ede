"""The results of many steps without all of them in memory: the reference, and any step as results of the two alone."""

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

from ringdic.arrays import Floats
from ringdic.results.results import WHERE_KNOWN, Results


class Series(Protocol):
    """F steps of a surface, the reference first.

    names : (F,) captures. reference : the results of the reference alone. noise : of each matches, (F, C) px, the usual
    standard deviation that a step's matches state of each camera.
    """

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def reference(self) -> Results: ...
    @property
    def noise(self) -> Sequence[Floats]: ...

    def at(self, step: int) -> Results:
        """The results of the reference and a later step; of step 0 those of the reference alone."""

    def without_matches(self) -> Series:
        """The same without the matches in the images."""


@dataclass(frozen=True)
class InMemory:
    """Results that are all there, as a series."""

    results: Results

    @property
    def names(self) -> tuple[str, ...]:
        """The captures."""
        return self.results.steps

    @property
    def reference(self) -> Results:
        """The results of the reference alone."""
        return self.at(0)

    @property
    def noise(self) -> list[Floats]:
        """See `Series`."""
        return [
            np.array([median_deviations(*step) for step in zip(matches.sigma, matches.status, strict=True)])
            for matches in self.results.matches
        ]

    def at(self, step: int) -> Results:
        """See `Series`."""
        return select_steps(self.results, [0, step] if step else [0])

    def without_matches(self) -> InMemory:
        """See `Series`."""
        return InMemory(replace(self.results, matches=()))


def median_deviations(sigma: NDArray[Any], status: NDArray[np.int8]) -> Floats:
    """The medians (C,) of the standard deviations (C, n, 2) px of good matches (n,); NaN where there are none."""
    good = [each[np.isfinite(each)] for each in sigma[:, status == 0]]
    return np.array([np.median(each) if len(each) else np.nan for each in good], dtype=float)


def select_steps(results: Results, steps: Sequence[int]) -> Results:
    """The same results with some of their steps only, in the order given; the reference, 0, must be the first."""
    index = list(steps)
    if not index or index[0] != 0:
        raise ValueError("results keep their reference, step 0, as the first")
    return _with_steps(results, [(results, index)])


def join_steps(parts: Sequence[Results]) -> Results:
    """The results of the steps of all parts, each with the reference and a step of its own, the first perhaps alone."""
    first, *others = parts
    return _with_steps(first, [(first, range(len(first.steps))), *((other, [1]) for other in others)])


def _with_steps(like: Results, chosen: Sequence[tuple[Results, Sequence[int]]]) -> Results:
    """Results like others, with chosen steps of some that differ in their steps only."""

    def gathered(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([array[list(index)] for array, (_, index) in zip(arrays, chosen, strict=True)])

    def of(name: str) -> NDArray[Any]:
        return gathered([getattr(one, name) for one, _ in chosen])

    known: dict[str, Any] = {name: of(name) for name in WHERE_KNOWN if getattr(like, name) is not None}
    matches = []
    for m, own in enumerate(like.matches):
        arrays: dict[str, Any] = {
            name: gathered([getattr(one.matches[m], name) for one, _ in chosen])
            for name in ("px", "c_ls", "sigma", "status")
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
        **known,
    )


class StepCache:
    """Values laid aside in a file that nobody else sees and that goes with the process. Safe to be used from threads.

    folder : where the file lies.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115, closed with the shelf
        self._at: dict[Hashable, int] = {}
        self._lock = Lock()
        finalize(self, self._file.close)

    def put(self, key: Hashable, value: object) -> None:
        """Lay a value aside under a key."""
        with self._lock:
            self._at[key] = self._file.seek(0, 2)
            pickle.dump(value, self._file, protocol=5)

    def get(self, key: Hashable) -> Any:
        """The value of a key; KeyError where there is none."""
        with self._lock:
            self._file.seek(self._at[key])
            return pickle.load(self._file)

    def close(self) -> None:
        """Forget everything; what is not closed goes with the shelf."""
        self._file.close()
