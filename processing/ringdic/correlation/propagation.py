"""Reliability-guided propagation (Pan 2009) in waves: from the best matched points to their neighbours.

A wave refines, in parallel, all unmatched points that have a reliable neighbour. Each starts from its neighbour with
the highest ZNCC, whose displacement and derivatives are extrapolated to it. Neighbours below a level of ZNCC are used
only when no unmatched point has a better neighbour, so that matches do not propagate through poor ones unless they
must. The result depends on the input alone, not on the number of threads or on timing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.correlation import kernels
from ringdic.correlation.neighbours import COUNT, extrapolate, inconsistent_points, local_affine_fit, point_neighbours
from ringdic.correlation.prepared import Current, Reference
from ringdic.correlation.refinement import SubsetCache, refine, steep_along_rows, subset_cache
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status

Progress = Callable[[int, int], None]

_LEVELS = (0.9, 0.8, 0.6)  # levels of reliability, ZNCC; the last one is settings.zncc_min
_RETRIES = 3  # neighbours from which a point is started at most
_DRIFT_ZNCC = 0.9  # a point above it that twice did not converge is not started a third time
_REPEATED_ITERATIONS = 15  # at most, of points that have failed before
_FEWEST = 8  # start values from which an affine fit extrapolates where the region of interest lies
_MANY = 500  # points from which on it is judged anew whether the images are transposed
_STRETCH = 4.0  # largest stretch and compression of a subset between two images


@dataclass
class Propagation:
    """State of the points of a correlation while they are matched; arrays over n points.

    Parameters
    ----------
    reference, current : the images.
    xy : (n, 2) float64, px, points of the reference image.
    settings : of the correlation. progress : called with the numbers of matched and of all points after every wave.
    region : part of the current image in use; by default chosen from the first start values, and the whole image once a
        point lies outside it.
    filtering : seconds spent so far on filtering the current image.
    textureless : (n,) bool, points with too little texture; determined from the image by default.
    independent : each point is refined from its own start value only; no point has neighbours.
    repeated : these points are matched in other images too, so that their normal matrices are worth keeping.
    kept : cache of the reference's subsets to be used instead of one of these points alone, and the row (n,) of each.

    Attributes
    ----------
    near : (n, 8) int64, indices of neighbours, -1 for none.
    parameters : (n, 12) float64, px and derivatives, the warps in the order of ``kernels``.
    status, zncc, iterations : (n,), results of the last refinement. sigma : (n, 2) float64, px.
    used_sources : (n, 8) bool, neighbours that have already given a start value.
    fit_sources : (n,) int64, the good neighbours at the time of the last affine fit, one bit each.
    non_convergent : (n,) bool, points with a high ZNCC that did not converge from two start values. At the edge of what
        both images show, they would drift to the same place from any.
    deviation : (n,) float64, px, and stale : (n,) bool, cache of ``inconsistent_points``.
    subsets : cache of what depends on the reference alone.
    steep : whether points are refined in transposed images; a few do not pay for filtering these as well.
    """

    reference: Reference
    current: Current
    xy: Pixels
    settings: CorrelationSettings
    progress: Progress | None = None
    region: Current | None = None
    filtering: float = 0.0
    textureless: Mask | None = None
    independent: bool = False
    repeated: bool = True
    kept: tuple[SubsetCache, Indices] | None = None
    near: Indices = field(init=False)
    parameters: Floats = field(init=False)
    status: Indices = field(init=False)
    zncc: Floats = field(init=False)
    iterations: Indices = field(init=False)
    sigma: Floats = field(init=False)
    used_sources: Mask = field(init=False)
    fit_sources: Indices = field(init=False)
    non_convergent: Mask = field(init=False)
    deviation: Floats = field(init=False)
    stale: Mask = field(init=False)
    subsets: SubsetCache | None = field(init=False, default=None)
    steep: bool | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        n = len(self.xy)
        if self.repeated and self.kept is None:
            self.subsets = subset_cache(self.reference, self.xy, self.settings)
        self.near = np.full((n, COUNT), -1) if self.independent else self._neighbours()
        self.parameters = np.full((n, kernels.N_PARAMETERS), np.nan)
        self.status = np.full(n, Status.NOT_REACHED, np.int64)
        self.zncc = np.full(n, np.nan)
        self.iterations = np.zeros(n, np.int64)
        self.sigma = np.full((n, 2), np.nan)
        self.used_sources, self.fit_sources = np.zeros((n, COUNT), bool), np.zeros(n, np.int64)
        self.non_convergent = np.zeros(n, bool)
        self.deviation, self.stale = np.full(n, np.nan), np.ones(n, bool)
        if self.textureless is None:
            self.textureless = textureless_points(self.reference, self.xy, self.settings)
        self.status[self.textureless] = Status.NO_TEXTURE

    def _neighbours(self) -> Indices:
        """Indices (n, 8) of the neighbours of all points, -1 for none."""
        if self.subsets is None:
            return point_neighbours(self.xy, self.settings.step)
        if self.subsets.near is None:
            self.subsets.near = point_neighbours(self.xy, self.settings.step)
        return self.subsets.near

    @property
    def good(self) -> Mask:
        """Whether a point is matched. (n,) bool."""
        return self.status == Status.GOOD

    def refine_from(
        self,
        index: Indices,
        start: Floats,
        zncc_min: float | None = None,
        prefer_neighbour: bool = False,
        fixed_curvature: bool = False,
    ) -> Mask:
        """Refine points from start values and store the good matches.

        A match is good if it converged, its ZNCC reaches the limit, it lies within a step of its start value and its
        warp is not degenerate.

        Parameters
        ----------
        index : (k,) int64, of the points.
        start : (k, 12) float64, parameters in px and derivatives.
        zncc_min : limit of the ZNCC; that of the settings by default.
        prefer_neighbour : a point next to one just matched starts from that match where it agrees with the given start
            value.
        fixed_curvature : keep the second derivatives as given and refine the affine parameters alone.

        Returns
        -------
        good : (k,) bool.
        """
        settings = replace(self._settings_for(index), order=1) if fixed_curvature else self._settings_for(index)
        part = self.region if self.region is not None else self._initial_region(start, index)
        if len(index) >= _MANY or self.steep is None:
            self.steep = steep_along_rows(start)
        steep = self.steep
        self._filter_part(part, steep)
        cache = None if fixed_curvature else self._cache_rows(index)
        status, zncc, iterations, sigma, parameters = refine(
            self.reference, part, self.xy[index], start, settings, prefer_neighbour, cache, steep
        )
        outside = np.flatnonzero(status == Status.OUTSIDE)
        if part is not self.current and len(outside):  # outside the region, but perhaps inside the image
            part = self.current
            self._filter_part(part, steep)
            second = refine(self.reference, part, self.xy[index[outside]], start[outside], settings, steep=steep)
            status[outside], zncc[outside], iterations[outside], sigma[outside], parameters[outside] = second
        self.region = part
        limit = self.settings.zncc_min if zncc_min is None else zncc_min
        status = np.where((status == Status.GOOD) & ~(zncc >= limit), Status.LOW_ZNCC, status)
        false = (status == Status.GOOD) & (self._far_from_start(parameters, start) | _degenerate(parameters))
        status = np.where(false, Status.INCONSISTENT, status)
        good = status == Status.GOOD
        repeated = self.iterations[index] > 0
        self.non_convergent[index] = repeated & (status == Status.NO_CONVERGENCE) & (zncc > _DRIFT_ZNCC)
        self.status[index], self.iterations[index] = status, iterations
        self.parameters[index] = np.where(good[:, None], parameters, np.nan)
        self.zncc[index] = np.where(good, zncc, np.nan)
        self.sigma[index] = np.where(good[:, None], sigma, np.nan)
        self.stale[index] = True
        if self.progress is not None:
            self.progress(int(self.good.sum()), len(self.xy))
        return good

    def _far_from_start(self, parameters: Floats, start: Floats) -> Mask:
        """Matches (k, 12) that lie farther than a grid step, or 5 px, from their start values (k, 12). (k,) bool."""
        distance = np.hypot(parameters[:, 0] - start[:, 0], parameters[:, 6] - start[:, 6])
        return np.asarray(distance > max(self.settings.step, 5))

    def _cache_rows(self, index: Indices) -> tuple[SubsetCache, Indices] | None:
        """The cache of the reference's subsets with the rows of points (k,) in it; None if there is no cache."""
        if self.kept is not None:
            return self.kept[0], self.kept[1][index]
        return None if self.subsets is None else (self.subsets, index)

    def _settings_for(self, index: Indices) -> CorrelationSettings:
        """The settings for refining points (k,), with fewer iterations if all of them have failed before.

        From another start value Gauss-Newton converges within a few steps or, at the edge of what both images show,
        never.
        """
        if (self.iterations[index] > 0).all() and self.settings.max_iterations > _REPEATED_ITERATIONS:
            return replace(self.settings, max_iterations=_REPEATED_ITERATIONS)
        return self.settings

    def _filter_part(self, part: Current, steep: bool) -> None:
        """Compute the coefficients of a part of the current image, and add the time to ``filtering``.

        They are computed when first asked for. steep : whether those of the transposed image are needed.
        """
        began = time.perf_counter()
        assert (part.transpose if steep else part).coef.size  # computed on first use
        self.filtering += time.perf_counter() - began

    def _initial_region(self, start: Floats, index: Indices) -> Current:
        """The part of the current image where all points will lie, by an affine fit of start values (k, 12) of points
        (k,).
        """
        known = np.isfinite(start).all(axis=1)
        if known.sum() < _FEWEST:
            return self.current
        at = self.xy[index[known]]
        return self.current.crop_by_affine_fit(at, at + start[known][:, [0, 6]], self.xy, self.settings.radius)

    def adopt(self, index: Indices, other: Propagation) -> None:
        """Copy the good matches of another propagation for points that are not matched here.

        index : (k,) int64, the points here that are the other's points.
        """
        source = other.good & ~self.good[index]
        to = index[source]
        self.parameters[to], self.status[to], self.zncc[to] = (
            other.parameters[source],
            other.status[source],
            other.zncc[source],
        )
        self.iterations[to], self.sigma[to] = other.iterations[source], other.sigma[source]
        self.stale[to] = True

    def propagate(self) -> None:
        """Refine unmatched points in waves from their good neighbours, until all such start values have been tried."""
        levels = [level for level in _LEVELS if level > self.settings.zncc_min] + [-1.0]
        while True:
            index = np.flatnonzero(self._unmatched())
            index = index[self.used_sources[index].sum(axis=1) < _RETRIES]
            near = self.near[index]
            worth = np.where((near >= 0) & self.good[near] & ~self.used_sources[index], self.zncc[near], -np.inf)
            best = worth.max(axis=1)
            level = next((level for level in levels if (best >= level).any()), None)
            if level is None:
                return
            ready = best >= level
            self._wave(index[ready], np.argmax(worth[ready], axis=1))

    def _wave(self, index: Indices, slot: Indices) -> None:
        """Refine unmatched points (k,), each from the match of its neighbour number ``slot`` (k,)."""
        self.used_sources[index, slot] = True
        start = extrapolate(self.xy, self.parameters, self.near[index, slot], index)
        failed = self.iterations[index] > 0
        for part in (~failed, failed):
            if part.any():
                self.refine_from(index[part], start[part])

    def retry_from_fit(self) -> None:
        """Refine unmatched points from an affine fit of the good matches around each, and propagate from them.

        Points that failed in this way before are left out unless their good neighbours have changed.
        """
        for _ in range(2):
            index = np.flatnonzero(self._unmatched())
            sources = self._good_neighbours(index)
            new = (sources > 0) & (sources != self.fit_sources[index])
            index, sources = index[new], sources[new]
            if not len(index):
                return
            self.fit_sources[index] = sources
            start = local_affine_fit(self.xy, self.parameters, self.good, self.near, index)
            usable = np.isfinite(start).all(axis=1)
            if not usable.any() or not self.refine_from(index[usable], start[usable]).any():
                return
            self.propagate()

    def retry_with_neighbour_curvature(self) -> None:
        """Refine unmatched points of second order again with the second derivatives of their best neighbour held fixed.

        A subset that the mask cuts in half determines its own second derivatives too poorly.
        """
        index = np.flatnonzero(self._unmatched())
        index = index[self._good_neighbours(index) > 0]
        if self.settings.order == 1 or not len(index):
            return
        near = self.near[index]
        best = np.argmax(np.where((near >= 0) & self.good[near], self.zncc[near], -np.inf), axis=1)
        source = near[np.arange(len(index)), best]
        if self.refine_from(index, extrapolate(self.xy, self.parameters, source, index), fixed_curvature=True).any():
            self.reject_outliers()

    def reject_outliers(self) -> bool:
        """Reject matches that contradict their neighbours, repeatedly until none does. True if any was dropped."""
        for k in range(5):
            bad = inconsistent_points(self.xy, self.parameters, self.good, self.near, self.deviation, self.stale)
            if not bad.any():
                return k > 0
            self.status[bad] = Status.INCONSISTENT
            self.parameters[bad], self.zncc[bad], self.sigma[bad] = np.nan, np.nan, np.nan
            self.used_sources[bad] = False  # a neighbour used before may now have another match
            self.stale[bad] = True
        return True

    def _unmatched(self) -> Mask:
        """Points not matched that another start value may help. (n,) bool."""
        return ~self.good & (self.status != Status.NO_TEXTURE) & ~self.non_convergent

    def _good_neighbours(self, index: Indices) -> Indices:
        """Which of the neighbours of points (k,) are good, one bit each. (k,) int64."""
        near = self.near[index]
        return np.asarray(((near >= 0) & self.good[near]) @ (1 << np.arange(COUNT)))


def textureless_points(reference: Reference, xy: Pixels, settings: CorrelationSettings) -> Mask:
    """Points whose surroundings clearly have too little texture to be matched.

    A quick test of all points at once, so that no start value is sought for them; the kernel tests the subset itself.
    xy : (n, 2) float64, px, points of the reference image. Returns (n,) bool.
    """
    weakest, thin = reference.get_or_compute(("texture", settings.radius), lambda: _texture(reference, settings.radius))
    at = np.rint((xy - reference.origin) / thin).astype(np.int64)
    h, w = weakest.shape
    column, row = np.clip(at[:, 0], 0, w - 1), np.clip(at[:, 1], 0, h - 1)
    limit = 0.7 * settings.texture_min * reference.grey_range / 255.0
    return np.asarray(weakest[row, column] < limit**2)


def _texture(reference: Reference, radius: int) -> tuple[NDArray[np.float32], int]:
    """Smaller eigenvalue of the structure tensor over a square of the subset's size, at pixels of the reference's box.

    It is computed from every ``thin``-th pixel each way, and for those. Returns the eigenvalues (rows, columns), in
    squared grey levels per px², and ``thin``.
    """
    thin = max(radius // 8, 1)
    size = (2 * (radius // thin) + 1,) * 2
    sampled = np.s_[::thin, ::thin]
    inside = reference.mask[sampled].astype(np.float32)
    gx, gy = (slope[sampled].astype(np.float32) * inside for slope in reference.gradient)

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.boxFilter(values, -1, size, borderType=cv2.BORDER_CONSTANT))

    share = np.maximum(mean(inside), np.float32(1e-6))
    half_trace, half = mean(gx * gx), mean(gy * gy)
    half_trace, half = 0.5 * (half_trace + half), 0.5 * (half_trace - half)
    return (half_trace - np.sqrt(half * half + mean(gx * gy) ** 2)) / share, thin


def _degenerate(parameters: Floats) -> Mask:
    """Warps that fold a subset over, or stretch or compress it more than a view of a surface does.

    parameters : (n, 12). Returns (n,) bool.
    """
    a, b, c, d = 1.0 + parameters[:, 1], parameters[:, 2], parameters[:, 7], 1.0 + parameters[:, 8]
    half, det = 0.5 * (a * a + b * b + c * c + d * d), a * d - b * c
    largest = np.sqrt(half + np.sqrt(np.maximum(half * half - det * det, 0.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(~((det > 0) & (largest < _STRETCH) & (det / largest > 1.0 / _STRETCH)))
