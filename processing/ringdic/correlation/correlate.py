"""Correlation of one pair of images: displacement, its derivatives and its standard uncertainty at every point."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cache

import numba
import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.correlation import kernels
from ringdic.correlation.features import feature_start_values
from ringdic.correlation.hypotheses import search_warps
from ringdic.correlation.lattice_field import interpolate_lattice
from ringdic.correlation.neighbours import local_affine_fit
from ringdic.correlation.prepared import Current, Reference, prepare_current, prepare_reference
from ringdic.correlation.propagation import Progress, Propagation
from ringdic.correlation.quadratic import Neighbourhoods
from ringdic.correlation.refinement import SubsetCache, refine
from ringdic.correlation.seeds import even_sample, flow_start_values, template_start_values
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status
from ringdic.errors import InputError

StartMethod = Callable[[Reference, Current, Pixels, int], Floats]

log = logging.getLogger(__name__)

# Name, method, and whether start values of all points cost hardly more than those of a few.
_METHODS: tuple[tuple[str, StartMethod, bool], ...] = (
    ("optical flow", flow_start_values, True),
    ("template search", template_start_values, False),
    ("features", feature_start_values, False),
)
_ENOUGH = 0.99  # share of the points that are matched before no further method is tried
_START_ZNCC = 0.4  # least ZNCC of a start value that is refined
_SEED_ZNCC = 0.75  # least ZNCC of a seed's match
_DENSE_ZNCC = 0.9  # least ZNCC of a point's match from its own start value; below it is left to propagation
_TRUSTED = 0.6  # share of a method's seeds that must be matched for it to suit the pair
# Columns of a kernel's 12 parameters in the order of start values: u v ux uy vx vy, then uxx uxy uyy vxx vxy vyy.
_COLUMNS = [0, 6, 1, 2, 7, 8, 3, 4, 5, 9, 10, 11]


@dataclass(frozen=True)
class PointMatches:
    """Matches of n points of a reference image in a current image; NaN where the status is not GOOD.

    xy : (n, 2) float64, px, positions in the reference image.
    uv : (n, 2) float64, px, displacement: current minus reference position.
    gradient : (n, 2, 2) float64, no unit, derivatives d u_i / d x_j of the displacement.
    curvature : (n, 2, 3) float64, 1/px, second derivatives of the displacement with respect to xx, xy, yy.
    zncc, c_ls : (n,) float64, no unit, zero-mean normalised cross-correlation and c_ls = 2 (1 - zncc).
    iterations : (n,) int64. status : (n,) int64, values of ``Status``.
    sigma : (n, 2) float64, px, standard uncertainty of uv: √2 σ √(H⁻¹), σ the noise of an image and H⁻¹ the inverse of
        the whole normal matrix.
    seconds : time by stage: prepare (filtering), start (start values), refine.
    """

    xy: Pixels
    uv: Pixels
    gradient: Floats
    curvature: Floats
    zncc: Floats
    c_ls: Floats
    iterations: Indices
    status: Indices
    sigma: Floats
    seconds: dict[str, float]

    @property
    def good(self) -> Mask:
        """Whether a point is matched. (n,) bool."""
        return self.status == Status.GOOD

    def part(self, index: Indices | Mask) -> PointMatches:
        """Matches of some of the points. index : (k,) int, or (n,) bool."""
        arrays = {each.name: getattr(self, each.name)[index] for each in fields(self) if each.name != "seconds"}
        return PointMatches(**arrays, seconds=dict(self.seconds))

    def without(self, lost: Mask, status: Status) -> PointMatches:
        """The matches with some of the good ones lost. lost : (n,) bool. status : that they get."""
        gone = lost & self.good
        matches = self.part(np.arange(len(self.xy)))  # a copy
        for values in (matches.uv, matches.gradient, matches.curvature, matches.zncc, matches.c_ls, matches.sigma):
            values[gone] = np.nan
        matches.status[gone] = status
        return matches


def correlate_points(
    reference: Reference,
    current: Current,
    xy: Pixels,
    settings: CorrelationSettings,
    *,
    start: Floats | None = None,
    prefer_neighbour: bool = False,
    threads: int | None = None,
    progress: Progress | None = None,
    kept: tuple[SubsetCache, Indices] | None = None,
) -> PointMatches:
    """Match points of a reference image in a current image.

    Points with a start value are refined from it, the others are reached by reliability-guided propagation from their
    neighbours. Then matches that contradict their neighbours are rejected. Call it from one thread at a time: it runs
    in parallel inside.

    Parameters
    ----------
    reference, current : the images, prepared with the same settings.
    xy : (n, 2) float64, px, whole or fractional, inside the reference's mask.
    start : (n, 6) float64, start values u v ux uy vx vy (u, v in px), or (n, 12) with the second derivatives uxx uxy
        uyy vxx vxy vyy (1/px) after them, which are fixed at first order; NaN where unknown. None to search for
        start values in the images.
    prefer_neighbour : a point next to one just matched starts from that match instead, where the two agree: for start
        values that are less certain than a neighbour's match.
    threads : number of threads; all cores by default. The results do not depend on it.
    progress : called with the numbers of matched and of all points after every wave.
    kept : cache of the reference's subsets for more points than these, and the row (n,) of each of these in it. The
        current image is then used in its box as it is, since more points will be matched there.

    Returns
    -------
    matches : of the n points.

    Raises InputError if there is no point or no start value, or if the images were prepared for other settings.
    """
    xy = _check_points(reference, current, xy, settings)
    with on_threads(threads):
        load_kernels()
        began = time.perf_counter()
        assert reference.gradient  # computed on first use
        seconds = {"prepare": time.perf_counter() - began, "start": 0.0, "refine": 0.0}
        # Where start values are given, the kernel's own test of each subset is enough.
        textureless = None if start is None else np.zeros(len(xy), bool)
        region = None if kept is None else current
        points = Propagation(reference, current, xy, settings, progress, region, textureless=textureless, kept=kept)
        if start is None:
            _match_automatically(points, seconds)
        else:
            _match_from_start_values(points, _kernel_parameters(start, len(xy)), seconds, prefer_neighbour)
    seconds["prepare"] += points.filtering
    seconds["refine"] -= points.filtering
    return _result(points, seconds)


def correlate_independently(
    reference: Reference,
    current: Current,
    xy: Pixels,
    settings: CorrelationSettings,
    start: Floats,
    repeated: bool = False,
    kept: tuple[SubsetCache, Indices] | None = None,
) -> PointMatches:
    """Match points of a reference image each from its own start value, without propagation and test of outliers.

    Parameters
    ----------
    reference, current : the images, prepared with the same settings. The current image is used in its box as it is:
        where a subset leaves that, the point is lost.
    xy : (n, 2) float64, px, points of the reference image.
    start : (n, 6) or (n, 12) float64, px and derivatives, as for :func:`correlate_points`; NaN leaves a point out.
    repeated : whether these points of the reference are matched in other images too, and what all share is kept.
    kept : cache of the reference's subsets for more points than these, and the row (n,) of each of these in it.

    Raises InputError if there is no point, or if the images were prepared for other settings.
    """
    xy = _check_points(reference, current, xy, settings)
    load_kernels()
    textureless = np.zeros(len(xy), bool)  # the kernel tests each subset
    points = Propagation(
        reference, current, xy, settings, region=current, textureless=textureless, independent=True, repeated=repeated,
        kept=kept,
    )  # fmt: skip
    given = np.flatnonzero(np.isfinite(start).all(axis=1))
    began = time.perf_counter()
    if len(given):
        points.refine_from(given, _kernel_parameters(start, len(xy))[given])
    seconds = {"prepare": points.filtering, "start": 0.0, "refine": time.perf_counter() - began - points.filtering}
    return _result(points, seconds)


def _check_points(reference: Reference, current: Current, xy: Pixels, settings: CorrelationSettings) -> Pixels:
    """The points as a contiguous array (n, 2) px, after a check of points, images and settings.

    Raises InputError where they or the images do not fit the settings.
    """
    xy = np.ascontiguousarray(xy, dtype=np.float64)
    if current.degree != settings.degree:
        raise InputError(f"the current image was prepared for degree {current.degree}, not {settings.interpolation}")
    if {reference.precision, current.precision} != {settings.precision} or reference.degree != settings.degree:
        raise InputError("the images were prepared for another tolerance or interpolation; prepare them again")
    if xy.ndim != 2 or xy.shape[1] != 2 or not len(xy):
        raise InputError("there is no point to correlate; check the mask and the step")
    return xy


@cache
def load_kernels() -> None:
    """Compile all kernels that a correlation runs, or load them from numba's cache, once per process.

    Called before anything is timed.
    """
    points = _small_example()
    _match_automatically(points, {"prepare": 0.0, "start": 0.0, "refine": 0.0})


def load_refinement(order: int = 1) -> None:
    """Compile the kernels of the refinement by subsets of order 1 or 2, or load them from numba's cache."""
    points = _small_example()
    settings = replace(points.settings, order=order)
    refine(points.reference, points.current, points.xy, np.zeros((len(points.xy), 12)), settings)


def load_search() -> None:
    """Compile the kernels of a correlation other than the refinement's, or load them from numba's cache."""
    points = _small_example()
    n = len(points.xy)
    search_warps(points.reference, points.current, points.xy, np.zeros((n, 1, 6)), points.settings.radius)
    points.status[:], points.parameters[:] = Status.GOOD, 0.0
    points.reject_outliers()
    local_affine_fit(points.xy, points.parameters, points.good, points.near, np.arange(n))
    interpolate_lattice(6.0 * np.rint(points.xy / 6.0), np.zeros((n, 12)), 6.0, points.xy)
    neighbourhoods = Neighbourhoods(points.xy, 20.0)
    neighbourhoods.fit(np.zeros((n, 2)), np.ones(n))
    neighbourhoods.lower_quartile(np.zeros(n))


def _small_example() -> Propagation:
    """An image that is to be matched with itself, so small that compiling takes nearly all of the time."""
    image = np.random.default_rng(0).integers(0, 256, (64, 64), np.uint8)  # of the type of a camera's images
    settings = CorrelationSettings(radius=6, step=6)
    xy = np.stack(np.meshgrid(np.arange(16.0, 48.0, 6.0), np.arange(16.0, 48.0, 6.0)), axis=-1).reshape(-1, 2)
    return Propagation(prepare_reference(image, None, settings), prepare_current(image, None, settings), xy, settings)


def _match_automatically(points: Propagation, seconds: dict[str, float]) -> None:
    """Match the points, with start values from one method after the other until enough points are matched.

    Each method gives start values at a sample of the points still unmatched. Where most of them lead to matches, the
    method suits the pair: its matches are adopted and propagated at once. The few matches of an unsuitable method may
    be false: they wait until the other methods have been tried and then serve only points that none of these reached.
    """
    doubtful = []
    for name, method, dense in _METHODS:
        open_points = _unmatched_points(points)
        if len(open_points) <= (1.0 - _ENOUGH) * _textured_count(points):
            break
        began = time.perf_counter()
        sample = even_sample(points.xy[open_points])
        seeds = open_points[sample]
        index = open_points if dense else seeds
        start = method(points.reference, points.current, points.xy[index], points.settings.radius)
        trial = _try_seeds(points, seeds, start[sample] if dense else start)
        share = float(trial.good.sum() / max((trial.status != Status.NO_TEXTURE).sum(), 1))
        log.debug("%s: %d of %d seeds matched", name, int(trial.good.sum()), len(seeds))
        seconds["start"] += time.perf_counter() - began - trial.filtering
        seconds["prepare"] += trial.filtering
        if share < _TRUSTED:
            doubtful.append((share, seeds, trial))
            continue
        points.adopt(seeds, trial)
        points.region = points.region or trial.region
        _propagate(points, seconds, index[~points.good[index]], start[~points.good[index]])
    for _, seeds, trial in sorted(doubtful, key=lambda entry: -entry[0]):
        if len(_unmatched_points(points)) > (1.0 - _ENOUGH) * _textured_count(points):
            points.adopt(seeds, trial)
            _propagate(points, seconds)


def _unmatched_points(points: Propagation) -> Indices:
    """Indices of the points that have texture and no match."""
    return np.flatnonzero(~points.good & (points.status != Status.NO_TEXTURE))


def _textured_count(points: Propagation) -> int:
    """Number of points with enough texture to be matched."""
    return int((points.status != Status.NO_TEXTURE).sum())


def _try_seeds(points: Propagation, seeds: Indices, start: Floats) -> Propagation:
    """Refinement of the seeds (k,) from start values (k, 12), in a propagation of their own.

    Start values at which the images are too dissimilar are left out.
    """
    textureless = np.asarray(points.status[seeds] == Status.NO_TEXTURE)
    trial = Propagation(points.reference, points.current, points.xy[seeds], points.settings, textureless=textureless)
    known = np.asarray(np.isfinite(start).all(axis=1))
    warps = np.where(known[:, None], start, np.nan)[:, None, _COLUMNS[:6]]
    _, zncc, _ = search_warps(points.reference, points.current, trial.xy, warps, points.settings.radius)
    similar = np.flatnonzero(known & (zncc > _START_ZNCC))
    if len(similar):
        trial.refine_from(similar, start[similar], max(_SEED_ZNCC, points.settings.zncc_min))
    return trial


def _match_from_start_values(
    points: Propagation, start: Floats, seconds: dict[str, float], prefer_neighbour: bool
) -> None:
    """Refine the points that have a start value (n, 12), then propagate to all others."""
    began = time.perf_counter()
    given = np.flatnonzero(np.isfinite(start).all(axis=1))
    if not len(given):
        raise InputError("no point has a start value; leave them out to have them found")
    points.refine_from(given, start[given], prefer_neighbour=prefer_neighbour)
    seconds["refine"] += time.perf_counter() - began
    _propagate(points, seconds)


def _propagate(
    points: Propagation, seconds: dict[str, float], index: Indices | None = None, start: Floats | None = None
) -> None:
    """Refine points (k,) from start values (k, 12), if given, propagate to all others and reject outliers."""
    began = time.perf_counter()
    if index is not None and start is not None:
        known = np.isfinite(start).all(axis=1) & (points.status[index] != Status.NO_TEXTURE)
        points.refine_from(
            index[known], start[known], max(_DENSE_ZNCC, points.settings.zncc_min), prefer_neighbour=True
        )
    points.propagate()
    points.retry_from_fit()
    if points.reject_outliers():
        points.propagate()
        points.retry_from_fit()
        points.reject_outliers()
    points.retry_with_neighbour_curvature()
    seconds["refine"] += time.perf_counter() - began


def _kernel_parameters(start: Floats, n: int) -> Floats:
    """Start values (n, 6) or (n, 12) in the order of the kernels' parameters. (n, 12)."""
    start = np.asarray(start, dtype=np.float64)
    if start.shape not in ((n, 6), (n, 12)):
        raise ValueError(f"start values must be ({n}, 6) or ({n}, 12), not {start.shape}")
    out = np.zeros((n, kernels.N_PARAMETERS))
    out[:, _COLUMNS[: start.shape[1]]] = start
    return out


def as_start_values(parameters: Floats) -> Floats:
    """Reorder the kernels' warp parameters to the layout of start values.

    parameters : (n, 12) float64, px and derivatives, u ux uy uxx uxy uyy v vx vy vxx vxy vyy.
    Returns (n, 12), u v ux uy vx vy uxx uxy uyy vxx vxy vyy.
    """
    return np.asarray(parameters[:, _COLUMNS])


def _result(points: Propagation, seconds: dict[str, float]) -> PointMatches:
    """The matches of a propagation, NaN where a point is not good."""
    p = points.parameters.copy()
    p[~points.good] = np.nan
    return PointMatches(
        xy=points.xy,
        uv=p[:, [0, 6]],
        gradient=p[:, [1, 2, 7, 8]].reshape(-1, 2, 2),
        curvature=p[:, [3, 4, 5, 9, 10, 11]].reshape(-1, 2, 3),
        zncc=points.zncc,
        c_ls=2.0 * (1.0 - points.zncc),
        iterations=points.iterations,
        status=points.status,
        sigma=points.sigma,
        seconds=seconds,
    )


def usable_threads(count: int | None) -> int:
    """Number of threads that a correlation uses for a requested ``count``, at most the cores; all cores for None."""
    cores = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    return min(count, cores) if count else cores


@contextmanager
def on_threads(count: int | None) -> Iterator[None]:
    """Context in which the kernels run on a number of threads; on all cores for None. Raises InputError below 1."""
    before = numba.get_num_threads()
    if count is not None and count < 1:
        raise InputError(f"the number of threads must be at least 1, not {count}")
    numba.set_num_threads(usable_threads(count))
    try:
        yield
    finally:
        numba.set_num_threads(before)
