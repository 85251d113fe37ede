"""Many points refined at once, along the rows of the images or along their columns, whichever the kernels do faster.

A vector of the kernels is a piece of a row of the reference. Between cameras side by side displacements change along
the rows by up to 0.65 px a pixel and hardly along the columns: then both images are turned about their diagonal, so
that a vector is a piece of a column, whose pixels lie in the current image as they do in the reference.
"""

from __future__ import annotations

from hashlib import sha256

import numpy as np

from ringdic.arrays import Floats, Indices
from ringdic.correlation import kernels
from ringdic.correlation.prepared import Current, Reference
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status

#: Status (n,), ZNCC (n,), iterations (n,), sigma (n, 2) px and parameters (n, 12) of points.
Refined = tuple[Indices, Floats, Indices, Floats, Floats]

_WORTH_KEEPING = 500  # points
_SETS = 2  # of points of one reference: a lattice and all
_STEEP = 0.1  # change of the displacement from pixel to pixel of a row from which on columns may be faster
_SOME = 500  # points tell how steep the displacements are
_TURNED = [6, 8, 7, 11, 10, 9, 0, 2, 1, 5, 4, 3]  # parameters with x and y, u and v exchanged


class Subsets:
    """What a correlation finds of n subsets of the reference alone: found (n, ...), as ``kernels`` leave it, where
    known (n,) bool."""

    def __init__(self, n: int, order: int) -> None:
        self.found = np.empty((n, kernels.width_of_subset(order)))
        self.known = np.zeros(n, bool)


def subsets_of(reference: Reference, xy: Floats, settings: CorrelationSettings) -> Subsets | None:
    """What is known of the subsets about these points, kept with the reference for the next image; None for a few.

    The last sets of points that were asked for are kept.
    """
    if len(xy) < _WORTH_KEEPING:
        return None
    sets: dict[tuple[object, ...], Subsets] = reference.once("subsets", dict)
    key = (sha256(xy.tobytes()).digest(), settings.radius, settings.order, settings.subset, settings.texture_min)
    found = sets.pop(key, None) or Subsets(len(xy), settings.order)
    while len(sets) >= _SETS:
        sets.pop(next(iter(sets)))
    sets[key] = found
    return found


def reference_bytes(reference: Reference, n: int, settings: CorrelationSettings) -> int:
    """The most that a reference takes in memory once n points of it have been followed into other images."""
    filtered = reference.mask.size * (3 * np.dtype(reference.precision).itemsize + 1)
    return int(reference.image.nbytes + filtered + _SETS * n * (8 * kernels.width_of_subset(settings.order) + 1))


def refine(
    reference: Reference,
    current: Current,
    xy: Floats,
    start: Floats,
    settings: CorrelationSettings,
    follow: bool = False,
    kept: tuple[Subsets, Indices] | None = None,
) -> Refined:
    """IC-GN of points xy (n, 2) from start values (n, 12), NaN rows left out.

    Returns status (n,), ZNCC (n,), iterations (n,), sigma (n, 2) px and parameters (n, 12), all as the kernel left
    them: nothing is judged here. follow : a point beside one just matched starts from it, if it agrees.
    kept : what is known of subsets of the reference, and which of them each point's (n,) is.
    """
    if not steep_along_rows(start):
        return _refine(reference, current, xy, start, settings, follow, kept)
    found = _refine(reference.turned, current.turned, xy[:, ::-1], start[:, _TURNED], settings, follow, None)
    status, zncc, iterations, sigma, parameters = found
    return status, zncc, iterations, sigma[:, ::-1], parameters[:, _TURNED]


def steep_along_rows(start: Floats) -> bool:
    """Whether displacements (n, 12) change along rows of the image, and less than half as much along its columns."""
    some = start[:: max(1, len(start) // _SOME)]
    change = np.abs(some[:, [1, 2]]) + np.abs(some[:, [7, 8]])
    change = change[np.isfinite(change).all(axis=1)]
    if not len(change):
        return False
    along_row, along_column = np.median(change, axis=0)
    return bool(along_row > _STEEP and along_column < 0.5 * along_row)


def _refine(
    reference: Reference,
    current: Current,
    xy: Floats,
    start: Floats,
    settings: CorrelationSettings,
    follow: bool,
    kept: tuple[Subsets, Indices] | None,
) -> Refined:
    """The same along the rows of the images as they are."""
    n, xy, parameters = len(xy), np.ascontiguousarray(xy, dtype=np.float64), np.array(start, dtype=np.float64)
    known = np.isfinite(parameters).all(axis=1)
    status = np.full(n, Status.NOT_REACHED, np.int64)
    zncc, sigma = np.full(n, np.nan), np.full((n, 2), np.nan)
    iterations = np.zeros(n, np.int64)
    between = bool(np.any(xy != np.rint(xy)))
    subsets, row = kept or (Subsets(0, settings.order), np.full(n, -1))
    kernels.refine_points(
        reference.grey,
        *reference.slopes,
        reference.coef if between else np.zeros((1, 1), settings.precision),
        reference.mask.view(np.uint8),
        reference.origin,
        current.coef,
        current.origin,
        xy,
        _tiles(xy, settings),
        parameters,
        known,
        settings.radius,
        settings.subset == "circle",
        3 if settings.order == 1 else 6,
        settings.degree == 5,
        settings.tolerance,
        settings.max_iterations,
        settings.texture_min * reference.grey_range / 255.0,
        settings.noise or 0.0,
        1.6 * settings.step if follow else 0.0,
        subsets.found,
        subsets.known,
        row,
        status,
        zncc,
        iterations,
        sigma,
    )
    return status, zncc, iterations, sigma, parameters


def _tiles(xy: Floats, settings: CorrelationSettings) -> Indices:
    """An order of points xy (n, 2) in which points that share pixels follow one another. (n,)."""
    side = max(8.0 * settings.step, 2.0 * settings.radius)
    column, row = np.floor(xy / side).T.astype(np.int64)
    return np.argsort(column * (1 << 32) + row, kind="stable")
