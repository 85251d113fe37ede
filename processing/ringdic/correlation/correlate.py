"""Correlation of one pair of images: displacement, derivatives and their uncertainty at every point."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

import numba
import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.correlation import kernels
from ringdic.correlation.features import feature_starts
from ringdic.correlation.hypotheses import search_hypotheses
from ringdic.correlation.prepared import Current, Reference, prepare_current, prepare_reference
from ringdic.correlation.propagation import Progress, Propagation
from ringdic.correlation.seeds import flow_starts, search_starts, spread
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status
from ringdic.errors import InputError

StartValues = Callable[[Reference, Current, Floats, int], Floats]

log = logging.getLogger(__name__)

# Name, method, and whether it tells of all points at once as cheaply as of a few.
_METHODS: tuple[tuple[str, StartValues, bool], ...] = (
    ("optical flow", flow_starts, True),
    ("template search", search_starts, False),
    ("features", feature_starts, False),
)
_ENOUGH = 0.99  # share of the points that have a match before the next method is asked
_ALIKE = 0.4  # ZNCC before the refinement below which none is worth while
_SEED_ZNCC = 0.75
_DENSE_ZNCC = 0.9  # what a point started by itself must reach; others wait for what their neighbours say
_TRUSTED = 0.6  # share of a method's seeds that must hold
# Columns of the 12 parameters of a kernel, in the order u v ux uy vx vy, then uxx uxy uyy vxx vxy vyy.
_COLUMNS = [0, 6, 1, 2, 7, 8, 3, 4, 5, 9, 10, 11]


@dataclass(frozen=True)
class Correlation:
    """Matches of n points; NaN where status is not 0.

    xy : (n, 2) px on the reference. uv : (n, 2) px, current minus reference position.
    gradient : (n, 2, 2), d u_i / d x_j. curvature : (n, 2, 3), second derivatives by xx, xy, yy, 1/px.
    zncc, c_ls : (n,), c_ls = 2 (1 - zncc). iterations : (n,). status : (n,), see ``Status``.
    sigma : (n, 2) px, standard uncertainty of uv, √2 σ √(H⁻¹) with the whole inverse.
    seconds : by stage: prepare, start, refine.
    """

    xy: Floats
    uv: Floats
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
        """Matched points. (n,) bool."""
        return self.status == Status.GOOD


def correlate_points(
    reference: Reference,
    current: Current,
    xy: Floats,
    settings: CorrelationSettings,
    *,
    start: Floats | None = None,
    follow: bool = False,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Correlation:
    """Match points of the reference image in the current image.

    xy : (n, 2) px, whole or fractional, inside the reference's mask. start : (n, 6) u v ux uy vx vy, or (n, 12) with
    the second derivatives uxx uxy uyy vxx vxy vyy after them; NaN where unknown: the other points are reached by
    propagation. Without start values they are found in the images. First order holds second derivatives as given.
    follow : start values are less sure than what a match tells of the point beside it, and give way where they agree.
    threads : cores to use, all by default; the result does not depend on it. progress(done, total) is called after
    every wave. Call it from one thread at a time: it is parallel inside.
    """
    xy = _checked(reference, current, xy, settings)
    with on_threads(threads):
        load_kernels()
        began = time.perf_counter()
        assert reference.slopes  # computed when first asked for
        seconds = {"prepare": time.perf_counter() - began, "start": 0.0, "refine": 0.0}
        points = Propagation(reference, current, xy, settings, progress)
        if start is None:
            _match_automatically(points, seconds)
        else:
            _match_from(points, _parameters(start, len(xy)), seconds, follow)
    seconds["prepare"] += points.filtering
    seconds["refine"] -= points.filtering
    return _result(points, seconds)


def refine_alone(
    reference: Reference, current: Current, xy: Floats, settings: CorrelationSettings, start: Floats
) -> Correlation:
    """Match points of the reference image each from its own start value alone: no neighbour leads to it or judges it.

    xy, start : as for :func:`correlate`. current is filtered as it is: where a subset leaves its box, a point is lost.
    """
    xy = _checked(reference, current, xy, settings)
    load_kernels()
    points = Propagation(reference, current, xy, settings, region=current, bare=np.zeros(len(xy), bool), alone=True)
    given = np.flatnonzero(np.isfinite(start).all(axis=1))
    began = time.perf_counter()
    if len(given):
        points.attempt(given, _parameters(start, len(xy))[given])
    seconds = {"prepare": points.filtering, "start": 0.0, "refine": time.perf_counter() - began - points.filtering}
    return _result(points, seconds)


def _checked(reference: Reference, current: Current, xy: Floats, settings: CorrelationSettings) -> Floats:
    """The points (n, 2) as the kernels take them. InputError where they or the images do not fit the settings."""
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
    """Compile or load all that a correlation runs, once a process, so that no timing contains it."""
    image = np.random.default_rng(0).normal(128.0, 30.0, (64, 64))
    settings = CorrelationSettings(radius=6, step=6)
    xy = np.stack(np.meshgrid(np.arange(16.0, 48.0, 6.0), np.arange(16.0, 48.0, 6.0)), axis=-1).reshape(-1, 2)
    reference, current = prepare_reference(image, None, settings), prepare_current(image, None, settings)
    _match_automatically(Propagation(reference, current, xy, settings), {"prepare": 0.0, "start": 0.0, "refine": 0.0})


def _match_automatically(points: Propagation, seconds: dict[str, float]) -> None:
    """Seeds by one method after the other until nearly every point is matched, each carried on by propagation.

    A method most of whose seeds hold suits the pair and is used at once. The few seeds that an unsuitable one gets
    through may be false: they wait until the others have had their turn, and only serve points nobody reached.
    """
    doubtful = []
    for name, method, dense in _METHODS:
        open_points = _open(points)
        if len(open_points) <= (1.0 - _ENOUGH) * _worth(points):
            break
        began = time.perf_counter()
        chosen = spread(points.xy[open_points])
        asked = open_points if dense else open_points[chosen]
        start = method(points.reference, points.current, points.xy[asked], points.settings.radius)
        seeds = open_points[chosen]
        trial = _try_seeds(points, seeds, start[chosen] if dense else start)
        share = float(trial.good.sum() / max((trial.status != Status.NO_TEXTURE).sum(), 1))
        log.debug("%s: %d of %d seeds hold", name, int(trial.good.sum()), len(seeds))
        seconds["start"] += time.perf_counter() - began - trial.filtering
        seconds["prepare"] += trial.filtering
        if share < _TRUSTED:
            doubtful.append((share, seeds, trial))
            continue
        points.adopt(seeds, trial)
        points.region = points.region or trial.region
        _carry_on(points, seconds, asked[~points.good[asked]], start[~points.good[asked]])
    for _, seeds, trial in sorted(doubtful, key=lambda entry: -entry[0]):
        if len(_open(points)) > (1.0 - _ENOUGH) * _worth(points):
            points.adopt(seeds, trial)
            _carry_on(points, seconds)


def _open(points: Propagation) -> Indices:
    return np.flatnonzero(~points.good & (points.status != Status.NO_TEXTURE))


def _worth(points: Propagation) -> int:
    """The number of points with texture enough to be matched."""
    return int((points.status != Status.NO_TEXTURE).sum())


def _try_seeds(points: Propagation, seeds: Indices, start: Floats) -> Propagation:
    """The seeds (k,) refined from start values (k, 12), apart from the other points, where they look alike at all."""
    bare = points.status[seeds] == Status.NO_TEXTURE
    trial = Propagation(points.reference, points.current, points.xy[seeds], points.settings, bare=np.asarray(bare))
    known = np.asarray(np.isfinite(start).all(axis=1))
    warps = np.where(known[:, None], start, np.nan)[:, None, _COLUMNS[:6]]
    _, alike, _ = search_hypotheses(points.reference, points.current, trial.xy, warps, points.settings.radius)
    found = np.flatnonzero(known & (alike > _ALIKE))
    if not len(found):
        return trial
    trial.attempt(found, start[found], max(_SEED_ZNCC, points.settings.zncc_min))
    return trial


def _match_from(points: Propagation, start: Floats, seconds: dict[str, float], follow: bool) -> None:
    began = time.perf_counter()
    given = np.flatnonzero(np.isfinite(start).all(axis=1))
    if not len(given):
        raise InputError("no point has a start value; leave them out to have them found")
    points.attempt(given, start[given], follow=follow)
    seconds["refine"] += time.perf_counter() - began
    _carry_on(points, seconds)


def _carry_on(
    points: Propagation, seconds: dict[str, float], index: Indices | None = None, start: Floats | None = None
) -> None:
    """All points from their own start values where given, then from neighbour to neighbour, and the judgement."""
    began = time.perf_counter()
    if index is not None and start is not None:
        known = np.isfinite(start).all(axis=1) & (points.status[index] != Status.NO_TEXTURE)
        points.attempt(index[known], start[known], max(_DENSE_ZNCC, points.settings.zncc_min), follow=True)
    points.propagate()
    points.retry_from_fit()
    if points.reject_outliers():
        points.propagate()
        points.retry_from_fit()
        points.reject_outliers()
    points.hold_curvature()
    seconds["refine"] += time.perf_counter() - began


def _parameters(start: Floats, n: int) -> Floats:
    start = np.asarray(start, dtype=np.float64)
    if start.shape not in ((n, 6), (n, 12)):
        raise ValueError(f"start values must be ({n}, 6) or ({n}, 12), not {start.shape}")
    out = np.zeros((n, kernels.N_PARAMETERS))
    out[:, _COLUMNS[: start.shape[1]]] = start
    return out


def start_order(parameters: Floats) -> Floats:
    """Parameters (n, 12) of the kernels in the order in which start values are given. (n, 12)."""
    return np.asarray(parameters[:, _COLUMNS])


def _result(points: Propagation, seconds: dict[str, float]) -> Correlation:
    p = points.parameters.copy()
    p[~points.good] = np.nan
    return Correlation(
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
    """The number of threads a correlation runs on when ``count`` are asked for; all cores for None."""
    cores = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    return min(count, cores) if count else cores


@contextmanager
def on_threads(count: int | None) -> Iterator[None]:
    """Inside, the kernels run on so many threads; all cores for None."""
    before = numba.get_num_threads()
    if count is not None and count < 1:
        raise InputError(f"the number of threads must be at least 1, not {count}")
    numba.set_num_threads(usable_threads(count))
    try:
        yield
    finally:
        numba.set_num_threads(before)
