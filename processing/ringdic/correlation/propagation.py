"""Reliability-guided propagation (Pan 2009) in waves: from the best matched points to their neighbours.

Every wave refines, in parallel, all points that border on a reliable one, each from the best of its neighbours,
displacement and derivatives carried across. Waves start at the most reliable level and sink to lower ones only when
nothing else is left, so bad points are never a bridge while a better way exists. The result depends on nothing but
the input: not on threads, not on timing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask
from ringdic.correlation import kernels
from ringdic.correlation.neighbours import COUNT, inconsistent, local_fit, point_neighbours, predicted
from ringdic.correlation.prepared import Current, Reference
from ringdic.correlation.refinement import Subsets, refine, steep_along_rows, subsets_of
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status

Progress = Callable[[int, int], None]

_LEVELS = (0.9, 0.8, 0.6)  # reliability in steps, ZNCC; the last one is settings.zncc_min
_RETRIES = 3
_DRIFTING = 0.9  # ZNCC of a point that twice did not converge from which on it is not started elsewhere
_PATIENCE = 15  # iterations of a point that failed before
_FEWEST = 8  # start values that tell where the region of interest goes
_STRETCH = 4.0  # largest stretch and compression of a subset between two images


@dataclass
class Propagation:
    """The state of all points while they are being matched; arrays over n points.

    parameters (n, 12) as in ``kernels``; tried : (n, 8) bool, neighbours a start value was taken from;
    fitted : (n,), which neighbours were good when a start value was fitted to the points around, as bits.
    region : the part of the current image in use, chosen by the first start values, grown when a point lies beyond.
    filtering : seconds spent on filtering it. bare : (n,) bool, points without texture; None to look for them.
    alone : points are refined from start values of their own; none has neighbours.
    drifting : (n,) bool, points that look alike but whose steps do not end, from two start values: at the rim of what
    both images show they drift to the same place from any.
    jump, stale : (n,), what the neighbours' judgement keeps, see ``inconsistent``.
    """

    reference: Reference
    current: Current
    xy: Floats
    settings: CorrelationSettings
    progress: Progress | None = None
    region: Current | None = None
    filtering: float = 0.0
    bare: Mask | None = None
    alone: bool = False
    near: Indices = field(init=False)
    parameters: Floats = field(init=False)
    status: Indices = field(init=False)
    zncc: Floats = field(init=False)
    iterations: Indices = field(init=False)
    sigma: Floats = field(init=False)
    tried: Mask = field(init=False)
    fitted: Indices = field(init=False)
    drifting: Mask = field(init=False)
    jump: Floats = field(init=False)
    stale: Mask = field(init=False)
    subsets: Subsets | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        n = len(self.xy)
        self.near = np.full((n, COUNT), -1) if self.alone else point_neighbours(self.xy, self.settings.step)
        self.parameters = np.full((n, kernels.N_PARAMETERS), np.nan)
        self.status = np.full(n, Status.NOT_REACHED, np.int64)
        self.zncc = np.full(n, np.nan)
        self.iterations = np.zeros(n, np.int64)
        self.sigma = np.full((n, 2), np.nan)
        self.tried, self.fitted = np.zeros((n, COUNT), bool), np.zeros(n, np.int64)
        self.drifting = np.zeros(n, bool)
        self.jump, self.stale = np.full(n, np.nan), np.ones(n, bool)
        if self.bare is None:
            self.bare = bare_points(self.reference, self.xy, self.settings)
        self.status[self.bare] = Status.NO_TEXTURE
        if not self.alone:
            self.subsets = subsets_of(self.reference, self.xy, self.settings)

    @property
    def good(self) -> Mask:
        """Points matched so far. (n,) bool."""
        return self.status == Status.GOOD

    def attempt(
        self,
        index: Indices,
        start: Floats,
        zncc_min: float | None = None,
        follow: bool = False,
        held: bool = False,
    ) -> Mask:
        """Refine points (k,) from start values (k, 12) and keep what is good; true where it was. (k,) bool.

        follow : a point beside one just matched starts from it, if it agrees with the start value. held : the second
        derivatives stay as they are given.
        A result must look alike (ZNCC) and lie within a step of its start value.
        """
        settings = replace(self._patient(index), order=1) if held else self._patient(index)
        part = self.region if self.region is not None else self._reached(start, index)
        self._filter(part, start)
        status, zncc, iterations, sigma, found = refine(
            self.reference, part, self.xy[index], start, settings, follow, None if held else self._kept(index)
        )
        beyond = np.flatnonzero(status == Status.OUTSIDE)
        if part is not self.current and len(beyond):  # of the region, but perhaps not of the image
            part = self.current
            self._filter(part, start[beyond])
            again = refine(self.reference, part, self.xy[index[beyond]], start[beyond], settings)
            status[beyond], zncc[beyond], iterations[beyond], sigma[beyond], found[beyond] = again
        self.region = part
        limit = self.settings.zncc_min if zncc_min is None else zncc_min
        jump = np.hypot(found[:, 0] - start[:, 0], found[:, 6] - start[:, 6])
        settled = status == Status.GOOD
        status = np.where(settled & ~(zncc >= limit), Status.LOW_ZNCC, status)
        far = (status == Status.GOOD) & (jump > max(self.settings.step, 5))
        status = np.where(far | ((status == Status.GOOD) & _degenerate(found)), Status.INCONSISTENT, status)
        keep = status == Status.GOOD
        repeated = self.iterations[index] > 0
        self.drifting[index] = repeated & (status == Status.NO_CONVERGENCE) & (zncc > _DRIFTING)
        self.status[index], self.iterations[index] = status, iterations
        self.parameters[index] = np.where(keep[:, None], found, np.nan)
        self.zncc[index] = np.where(keep, zncc, np.nan)
        self.sigma[index] = np.where(keep[:, None], sigma, np.nan)
        self.stale[index] = True
        if self.progress is not None:
            self.progress(int(self.good.sum()), len(self.xy))
        return keep

    def _kept(self, index: Indices) -> tuple[Subsets, Indices] | None:
        return None if self.subsets is None else (self.subsets, index)

    def _patient(self, index: Indices) -> CorrelationSettings:
        """The settings for points (k,): where none has been matched from elsewhere before, fewer iterations will tell.

        Gauss-Newton from another start value converges in a few steps or, at the rim of what both images show, never.
        """
        if (self.iterations[index] > 0).all() and self.settings.max_iterations > _PATIENCE:
            return replace(self.settings, max_iterations=_PATIENCE)
        return self.settings

    def _filter(self, part: Current, start: Floats) -> None:
        began = time.perf_counter()
        assert (part.turned if steep_along_rows(start) else part).coef.size  # computed when first asked for
        self.filtering += time.perf_counter() - began

    def _reached(self, start: Floats, index: Indices) -> Current:
        """The part of the current image where the points will lie, judged by the first start values (k, 12)."""
        known = np.isfinite(start).all(axis=1)
        if known.sum() < _FEWEST:
            return self.current
        at = self.xy[index[known]]
        return self.current.about_all(at, at + start[known][:, [0, 6]], self.xy, self.settings.radius)

    def adopt(self, index: Indices, other: Propagation) -> None:
        """Take over the good points of another field, whose points are ``index`` (k,) here, where still open."""
        take = other.good & ~self.good[index]
        to = index[take]
        self.parameters[to], self.status[to], self.zncc[to] = (
            other.parameters[take],
            other.status[take],
            other.zncc[take],
        )
        self.iterations[to], self.sigma[to] = other.iterations[take], other.sigma[take]
        self.stale[to] = True

    def propagate(self) -> None:
        """Waves from the good points until no point has an untried good neighbour."""
        levels = [level for level in _LEVELS if level > self.settings.zncc_min] + [-1.0]
        while True:
            index = np.flatnonzero(self._open())
            index = index[self.tried[index].sum(axis=1) < _RETRIES]
            near = self.near[index]
            worth = np.where((near >= 0) & self.good[near] & ~self.tried[index], self.zncc[near], -np.inf)
            best = worth.max(axis=1)
            level = next((level for level in levels if (best >= level).any()), None)
            if level is None:
                return
            ready = best >= level
            self._wave(index[ready], np.argmax(worth[ready], axis=1))

    def _wave(self, index: Indices, slot: Indices) -> None:
        """Open points (k,) refined from one of their neighbours each (k,)."""
        self.tried[index, slot] = True
        start = predicted(self.xy, self.parameters, self.near[index, slot], index)
        failed = self.iterations[index] > 0
        for part in (~failed, failed):
            if part.any():
                self.attempt(index[part], start[part])

    def retry_from_fit(self) -> None:
        """Lost points once more, from an affine fit of the good points around them; then from their new neighbours.

        Not those that failed so before and whose neighbours are good or lost as they were then.
        """
        for _ in range(2):
            index = np.flatnonzero(self._open())
            beside = self._good_neighbours(index)
            new = (beside > 0) & (beside != self.fitted[index])
            index, beside = index[new], beside[new]
            if not len(index):
                return
            self.fitted[index] = beside
            start = local_fit(self.xy, self.parameters, self.good, self.near, index)
            usable = np.isfinite(start).all(axis=1)
            if not usable.any() or not self.attempt(index[usable], start[usable]).any():
                return
            self.propagate()

    def hold_curvature(self) -> None:
        """Lost points of second order once more as of first, with the second derivatives of their best neighbour.

        A subset that the region cuts in half knows its own too poorly.
        """
        index = np.flatnonzero(self._open())
        index = index[self._good_neighbours(index) > 0]
        if self.settings.order == 1 or not len(index):
            return
        near = self.near[index]
        best = np.argmax(np.where((near >= 0) & self.good[near], self.zncc[near], -np.inf), axis=1)
        source = near[np.arange(len(index)), best]
        if self.attempt(index, predicted(self.xy, self.parameters, source, index), held=True).any():
            self.reject_outliers()

    def reject_outliers(self) -> bool:
        """Points that contradict their neighbours become lost, until none does. True if any did."""
        for k in range(5):
            bad = inconsistent(self.xy, self.parameters, self.good, self.near, self.jump, self.stale)
            if not bad.any():
                return k > 0
            self.status[bad] = Status.INCONSISTENT
            self.parameters[bad], self.zncc[bad], self.sigma[bad] = np.nan, np.nan, np.nan
            self.tried[bad] = False  # another neighbour may lead elsewhere
            self.stale[bad] = True
        return True

    def _open(self) -> Mask:
        """Points not matched that another start value may help. (n,)."""
        return ~self.good & (self.status != Status.NO_TEXTURE) & ~self.drifting

    def _good_neighbours(self, index: Indices) -> Indices:
        """Which of the neighbours of points (k,) are good, as bits of a number. (k,)."""
        near = self.near[index]
        return np.asarray(((near >= 0) & self.good[near]) @ (1 << np.arange(COUNT)))


def bare_points(reference: Reference, xy: Floats, settings: CorrelationSettings) -> Mask:
    """Points (n,) with clearly too little texture about them, seen at once for all: no start value is sought there.

    The kernel judges the subset itself.
    """
    weakest, thin = reference.once(("texture", settings.radius), lambda: _texture(reference, settings.radius))
    at = np.rint((xy - reference.origin) / thin).astype(np.int64)
    h, w = weakest.shape
    column, row = np.clip(at[:, 0], 0, w - 1), np.clip(at[:, 1], 0, h - 1)
    limit = 0.7 * settings.texture_min * reference.grey_range / 255.0
    return np.asarray(weakest[row, column] < limit**2)


def _texture(reference: Reference, radius: int) -> tuple[NDArray[np.float32], int]:
    """The weaker eigenvalue of the structure tensor over the square about every so many pixels of the box, from a
    sample of its pixels; and how many pixels."""
    thin = max(radius // 8, 1)
    size = (2 * (radius // thin) + 1,) * 2
    sampled = np.s_[::thin, ::thin]
    inside = reference.mask[sampled].astype(np.float32)
    gx, gy = (slope[sampled].astype(np.float32) * inside for slope in reference.slopes)

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.boxFilter(values, -1, size, borderType=cv2.BORDER_CONSTANT))

    share = np.maximum(mean(inside), np.float32(1e-6))
    half_trace, half = mean(gx * gx), mean(gy * gy)
    half_trace, half = 0.5 * (half_trace + half), 0.5 * (half_trace - half)
    return (half_trace - np.sqrt(half * half + mean(gx * gy) ** 2)) / share, thin


def _degenerate(parameters: Floats) -> Mask:
    """Warps (n, 12) that fold, or stretch an axis beyond what a view of a surface does: never a true match. (n,)."""
    a, b, c, d = 1.0 + parameters[:, 1], parameters[:, 2], parameters[:, 7], 1.0 + parameters[:, 8]
    half, det = 0.5 * (a * a + b * b + c * c + d * d), a * d - b * c
    largest = np.sqrt(half + np.sqrt(np.maximum(half * half - det * det, 0.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(~((det > 0) & (largest < _STRETCH) & (det / largest > 1.0 / _STRETCH)))
