"""Refinement of many points by the kernels, along the rows of the images or along their columns, whichever is faster.

The kernels work on vectors of neighbouring pixels of a row of the reference, and are fastest if these also lie in
nearly a row of the current image. Between cameras side by side, displacements change along rows by up to 0.65 px a
pixel and hardly along columns: then both images are transposed, so that a vector is a piece of a column.
"""

from __future__ import annotations

from hashlib import sha256
from typing import NamedTuple

import numpy as np

from ringdic.arrays import Floats, Indices, Pixels
from ringdic.correlation import kernels
from ringdic.correlation.parallel import in_ranges
from ringdic.correlation.prepared import Current, Reference
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status
from ringdic.correlation.subset import width_of_subset

_MIN_CACHED = 500  # points of a set that is worth a cache
_CACHED_SETS = 2  # sets of points per reference: those of a coarse lattice and all
_STEEP_GRADIENT = 0.1  # change of the displacement along rows, px per px, from which on columns may be faster
_SAMPLE = 500  # points by which the steepness is judged
_TRANSPOSED = [6, 8, 7, 11, 10, 9, 0, 2, 1, 5, 4, 3]  # order of the parameters with x and y, u and v exchanged


class SubsetMatches(NamedTuple):
    """Results of the inverse-compositional Gauss-Newton refinement of n points.

    status : (n,) int64. zncc : (n,) float64. iterations : (n,) int64.
    sigma : (n, 2) float64, px, standard uncertainty of u and v. parameters : (n, 12) float64, px and derivatives.
    """

    status: Indices
    zncc: Floats
    iterations: Indices
    sigma: Floats
    parameters: Floats


class SubsetCache:
    """Cached normal matrices and neighbours of n subsets of a reference image, which every later current image reuses.

    values : (n, width_of_subset) float64, in the layout of ``kernels``. known : (n,) bool, rows that are filled.
    transpose : the cache of the subsets with x and y exchanged; None where these are not kept. near : (n, 8) int64,
    indices of the neighbours of each point; None before they are known.
    """

    def __init__(self, n: int, order: int, *, transposed: bool = False) -> None:
        self.values = np.empty((n, width_of_subset(order)))
        self.known = np.zeros(n, bool)
        self.near: Indices | None = None
        self.transpose = SubsetCache(n, order) if transposed else None


def subset_cache(reference: Reference, xy: Pixels, settings: CorrelationSettings) -> SubsetCache | None:
    """The cache of the subsets about given points, stored with their reference image; None for few points.

    The caches of the last ``_CACHED_SETS`` sets of points remain in memory. xy : (n, 2) float64, px.
    """
    if len(xy) < _MIN_CACHED:
        return None
    sets: dict[tuple[object, ...], SubsetCache] = reference.get_or_compute("subsets", dict)
    kind = (settings.radius, settings.step, settings.order, settings.subset, settings.texture_min)
    key = (sha256(xy.tobytes()).digest(), *kind)
    cache = sets.pop(key, None) or SubsetCache(len(xy), settings.order)
    while len(sets) >= _CACHED_SETS:
        sets.pop(next(iter(sets)))
    sets[key] = cache
    return cache


def reference_bytes(reference: Reference, n: int, settings: CorrelationSettings) -> int:
    """Upper bound of the memory, in bytes, that a reference image takes once n points of it have been matched."""
    filtered = reference.mask.size * (3 * np.dtype(reference.precision).itemsize + 1)
    return int(reference.image.nbytes + filtered + _CACHED_SETS * n * (8 * width_of_subset(settings.order) + 1))


def refine(
    reference: Reference,
    current: Current,
    xy: Pixels,
    start: Floats,
    settings: CorrelationSettings,
    prefer_neighbour: bool = False,
    cache: tuple[SubsetCache, Indices] | None = None,
    steep: bool | None = None,
) -> SubsetMatches:
    """Refine points by inverse-compositional Gauss-Newton (IC-GN) from start values.

    Parameters
    ----------
    reference, current : the images.
    xy : (n, 2) float64, px, points of the reference image.
    start : (n, 12) float64, parameters in px and derivatives; points with NaN are left out.
    prefer_neighbour : a point next to one just matched starts from that match where it agrees with the given start
        value.
    cache : the reference's subset cache and the row (n,) of each point in it, if there is one.
    steep : whether the images are transposed; by default where displacements are steep along rows.

    Returns
    -------
    refinement : status (n,), ZNCC (n,), iterations (n,), sigma (n, 2) px and parameters (n, 12), unfiltered: the ZNCC
        is not yet compared with its limit.
    """
    if not (steep_along_rows(start) if steep is None else steep):
        return _refine(reference, current, xy, start, settings, prefer_neighbour, cache)
    if cache is not None:
        cache = None if cache[0].transpose is None else (cache[0].transpose, cache[1])
    exchanged = _refine(
        reference.transpose, current.transpose, xy[:, ::-1], start[:, _TRANSPOSED], settings, prefer_neighbour, cache
    )
    return exchanged._replace(sigma=exchanged.sigma[:, ::-1], parameters=exchanged.parameters[:, _TRANSPOSED])


def steep_along_rows(start: Floats) -> bool:
    """Whether displacements change strongly along the rows of the image, and less than half as much along its columns.

    start : (n, 12) float64, parameters in px and derivatives; judged by the median over a sample of the points.
    """
    some = start[:: max(1, len(start) // _SAMPLE)]
    change = np.abs(some[:, [1, 2]]) + np.abs(some[:, [7, 8]])
    change = change[np.isfinite(change).all(axis=1)]
    if not len(change):
        return False
    along_row, along_column = np.median(change, axis=0)
    return bool(along_row > _STEEP_GRADIENT and along_column < 0.5 * along_row)


def _refine(
    reference: Reference,
    current: Current,
    xy: Pixels,
    start: Floats,
    settings: CorrelationSettings,
    prefer_neighbour: bool,
    cache: tuple[SubsetCache, Indices] | None,
) -> SubsetMatches:
    """Refinement of ``refine`` on the images as they are, without transposing them."""
    n, xy = len(xy), np.ascontiguousarray(xy, dtype=np.float64)
    parameters = np.array(start, dtype=np.float64, order="C")  # the kernel is compiled for this order alone
    known = np.isfinite(parameters).all(axis=1)
    status = np.full(n, Status.NOT_REACHED, np.int64)
    zncc, sigma = np.full(n, np.nan), np.full((n, 2), np.nan)
    iterations = np.zeros(n, np.int64)
    between = bool(np.any(xy != np.rint(xy)))
    subsets, row = cache or (SubsetCache(0, settings.order), np.full(n, -1))
    in_ranges(
        kernels.refine_points,
        -(-n // kernels.CHUNK),
        reference.grey,
        *reference.gradient,
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
        True if settings.order == 2 else None,
        True if settings.degree == 3 else None,
        settings.tolerance,
        settings.max_iterations,
        settings.texture_min * reference.grey_range / 255.0,
        settings.noise or 0.0,
        1.6 * settings.step if prefer_neighbour else 0.0,
        subsets.values,
        subsets.known,
        row,
        status,
        zncc,
        iterations,
        sigma,
    )
    return SubsetMatches(status, zncc, iterations, sigma, parameters)


def _tiles(xy: Pixels, settings: CorrelationSettings) -> Indices:
    """Order in which points that share pixels follow one another, tile by tile, so that the pixels stay in the cache.

    xy : (n, 2) px. Returns indices (n,).
    """
    side = max(8.0 * settings.step, 2.0 * settings.radius)
    column, row = np.floor(xy / side).T.astype(np.int64)
    return np.argsort(column * (1 << 32) + row, kind="stable")
