"""Whether stated uncertainties are true: the spread of repeated measurements beside what they say of themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Spread:
    """Spread of one quantity over repeated noise, and what was stated.

    observed, stated : (k,) of each component, root mean squares over the places. ratio : (k,) of the two.
    whole : the ratio over all components. places, repeats : how many of each.
    """

    observed: Array
    stated: Array
    places: int
    repeats: int

    @property
    def ratio(self) -> Array:
        """Observed over stated, of each component. (k,)."""
        return np.asarray(self.observed / self.stated)

    @property
    def whole(self) -> float:
        """Observed over stated of all components together."""
        return float(np.sqrt(np.sum(self.observed**2) / np.sum(self.stated**2)))


def spread(values: Array, sigma: Array) -> Spread:
    """Compare R ≥ 2 repeats of n places.

    values, sigma : (R, n, k), what was measured and its stated standard deviation. A place that any repeat lost is
    left out. ValueError where none is left.
    """
    values, sigma = np.asarray(values, dtype=float), np.asarray(sigma, dtype=float)
    if values.shape != sigma.shape or values.ndim != 3 or len(values) < 2:
        raise ValueError(
            f"values {values.shape} and deviations {sigma.shape} must both be (repeats, places, components)"
        )
    kept = (np.isfinite(values) & np.isfinite(sigma)).all(axis=(0, 2))
    if not kept.any():
        raise ValueError("no place was measured in every repeat")
    observed = np.sqrt(np.mean(values[:, kept].var(axis=0, ddof=1), axis=0))
    return Spread(observed, np.sqrt(np.mean(sigma[:, kept] ** 2, axis=(0, 1))), int(kept.sum()), len(values))


def shared_places(labels: list[NDArray[np.int64]]) -> list[NDArray[np.int64]]:
    """Where each of several runs has the places that all of them have.

    labels : for each run (n, m), whole numbers that name a place, such as its lattice node and its reference camera's
    pixel. Returns for each run the indices (k,) of the common places, in one order.
    """
    named = [{tuple(row): k for k, row in enumerate(run.tolist())} for run in labels]
    common = sorted(set(named[0]).intersection(*named[1:]))
    return [np.array([names[place] for place in common], dtype=np.int64) for names in named]
