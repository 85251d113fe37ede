"""The same points in two images of one camera: whole-pixel subsets, twice, and what the neighbours know.

A first-order subset in a curved displacement field is biased; one of second order is not, but nearly twice as noisy.
So there are two passes. The first is of second order. A quadratic of its displacement over the neighbours gives every
point its second derivatives, far less noisy than the subset's own; the second pass is of first order and holds them.
What bias is left (the field is no quadratic where the surface turns away) is the smooth part of the difference of the
two passes, and is taken off as far as it stands out of the noise.

A subset of the reference lies on a whole pixel, where nothing is interpolated; gradient and curvature carry the result
to the point, less than a pixel away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.correlation import Correlation, CorrelationSettings, Current, Reference, Status, correlate
from processing.correlation.quadratic import Neighbourhoods, QuadraticFit

Array = NDArray[np.float64]

_REACH = 2.5  # subset radii about a point in which its neighbours tell its curvature and its bias
_LOOSE = 1e-4  # px, tolerance of the first of two passes
_PATIENCE = 20  # iterations of the first of two passes
_ENOUGH = 0.5  # share of the start values that must hold before the images are searched for others
_LEAST_EXCESS = 0.1  # of a second-order subset's variance, beyond that of the same subset of first order
_OVERLAP = 1.2  # subsets share pixels: a mean of several is this much less certain than of independent ones
_BIASED = 4.0  # Σ(b/σ)² of a bias below which it may be noise, of 2 numbers
_CURVED = 20.0  # the same of second derivatives, of 6 numbers of overlapping subsets
_LEFT = 0.25  # share of the bias that may be left: the neighbourhood is wider than the subset
_SCATTERS = 8.0  # a point this many times off its neighbours' quadratic contradicts it
_LEAST_OFF = 0.1  # px, and never less than this
_UNLIKE = 3.0  # a mean square difference this many times the usual one is not noise, which stays below 2


@dataclass(frozen=True)
class Followed:
    """n points of one image in another; NaN where status is not 0.

    warp : (n, 12) at the points: u v ux uy vx vy and uxx uxy uyy vxx vxy vyy. sigma : (n, 2) px of u v.
    c_ls : (n,). rest : (n,), mean square difference of the two subsets, grey levels². status : (n,), see ``Status``.
    """

    warp: Array
    sigma: Array
    c_ls: Array
    rest: Array
    status: NDArray[np.int64]

    @property
    def good(self) -> NDArray[np.bool_]:
        """Matched points. (n,) bool."""
        return self.status == Status.GOOD

    def part(self, index: NDArray) -> Followed:
        """Some of the points, by indices or a mask."""
        return Followed(self.warp[index], self.sigma[index], self.c_ls[index], self.rest[index], self.status[index])


def follow(
    reference: Reference,
    current: Current,
    at: Array,
    start: Array | None,
    settings: CorrelationSettings,
    *,
    around: Neighbourhoods | None = None,
    two_pass: bool = True,
    search: bool = True,
) -> Followed:
    """Follow points ``at`` (n, 2) px of the reference image, whole or fractional, into the current image.

    start : (n, 12) warps at the points, NaN rows where unknown; None: found in the images. around : see
    ``neighbourhoods``. search : look for start values in the images where too few of those given hold. settings.order
    2 with two_pass False leaves the second derivatives to each subset.
    """
    around = around or neighbourhoods(at, settings)
    pixel = around.xy
    shift = pixel - at
    given = None if start is None else shifted(start, shift)
    first = _matched(reference, current, pixel, given, _first_settings(settings) if two_pass else settings, search)
    if not two_pass or not first.good.any():
        return _judged(first, reference, shift, around, settings.radius)
    warp = _warp(first)
    warp[:, 6:] = _held(_fitted(first, around), first, settings.radius)
    second = correlate(reference, current, pixel, settings, start=warp)
    return _judged(_unbiased(first, second, around), reference, shift, around, settings.radius)


def neighbourhoods(at: Array, settings: CorrelationSettings, window: float | None = None) -> Neighbourhoods:
    """Of the whole pixels next to points ``at`` (n, 2) px; window : px, by default 2.5 subset radii."""
    return Neighbourhoods(np.rint(at), window or _REACH * settings.radius)


def shifted(warp: Array, shift: Array) -> Array:
    """Warps (n, 12) at points moved by shift (n, 2) px: displacement and gradient by their Taylor series."""
    out = warp.copy()
    dx, dy = shift[:, 0], shift[:, 1]
    for value, slope, curve in ((0, 2, 6), (1, 4, 9)):
        xx, xy, yy = warp[:, curve], warp[:, curve + 1], warp[:, curve + 2]
        out[:, value] += warp[:, slope] * dx + warp[:, slope + 1] * dy
        out[:, value] += 0.5 * xx * dx**2 + xy * dx * dy + 0.5 * yy * dy**2
        out[:, slope] += xx * dx + xy * dy
        out[:, slope + 1] += xy * dx + yy * dy
    return out


def _first_settings(settings: CorrelationSettings) -> CorrelationSettings:
    """Of the first of two passes: second order, and no more iterations than a point takes that will be found."""
    iterations = min(settings.max_iterations, _PATIENCE)
    return replace(settings, order=2, tolerance=max(settings.tolerance, _LOOSE), max_iterations=iterations)


def _matched(
    reference: Reference,
    current: Current,
    pixel: Array,
    start: Array | None,
    settings: CorrelationSettings,
    search: bool,
) -> Correlation:
    """From the start values, or from the images where too few of them hold."""
    if start is None or not np.isfinite(start).all(axis=1).any():
        return correlate(reference, current, pixel, settings)
    found = correlate(reference, current, pixel, settings, start=start)
    known = np.isfinite(start).all(axis=1)
    if not search or found.good[known].mean() >= _ENOUGH:
        return found
    searched = correlate(reference, current, pixel, settings)
    return searched if searched.good.sum() > found.good.sum() else found


def _warp(found: Correlation) -> Array:
    n = len(found.xy)
    return np.concatenate([found.uv, found.gradient.reshape(n, 4), found.curvature.reshape(n, 6)], axis=1)


def _fitted(found: Correlation, around: Neighbourhoods) -> QuadraticFit:
    """The quadratics of the displacement, points that contradict it left out."""
    uv, sigma = found.uv, np.hypot(*found.sigma.T)
    fit = around.fit(uv, sigma)
    odd = contradicts(fit)
    return around.fit(np.where(odd[:, None], np.nan, uv), sigma) if odd.any() else fit


def _held(fit: QuadraticFit, found: Correlation, radius: int) -> Array:
    """Second derivatives (n, 6) to hold: at the rim, where a point's own are too uncertain, those of the nearest point.

    A wrong second derivative δ moves a round first-order subset of radius r by δ r²/8, the mean of δ x²/2 over it.
    """
    size = np.hypot(*found.sigma.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = (found.sigma / size[:, None])[:, :, None] * fit.curvature_sigma[:, None, :]
        harm = fit.curvature_sigma.max(axis=1) * radius**2 / 8.0
        known = np.isfinite(fit.curvature).all(axis=(1, 2)) & (harm < size)
    if not known.any():
        return np.zeros((len(size), 6))
    curvature = fit.curvature[known].reshape(-1, 6)
    curvature *= _clear(curvature, sigma[known].reshape(-1, 6), _CURVED)
    _, nearest = cKDTree(found.xy[known]).query(found.xy)
    return np.asarray(curvature[nearest])


def _unbiased(first: Correlation, second: Correlation, around: Neighbourhoods) -> Correlation:
    """The second pass less the smooth part of its difference from the first, as far as that is more than noise."""
    difference = second.uv - first.uv
    with np.errstate(invalid="ignore"):
        each = np.sqrt(np.maximum(first.sigma**2 - second.sigma**2, _LEAST_EXCESS * first.sigma**2))
    size = np.hypot(*each.T)
    fit = around.fit(difference, size)
    with np.errstate(invalid="ignore", divide="ignore"):
        s = _OVERLAP * fit.value_sigma[:, None] * each / size[:, None]
    share = _clear(fit.value, s, _BIASED)
    known = np.isfinite(fit.value).all(axis=1) & np.isfinite(s).all(axis=1) & second.good
    uv = np.where(known[:, None], second.uv - share * fit.value, second.uv)
    doubt = share * np.hypot(s, _LEFT * fit.value)
    sigma = np.where(known[:, None], np.hypot(second.sigma, doubt), second.sigma)
    return replace(second, uv=uv, sigma=sigma)


def _clear(values: Array, sigma: Array, limit: float) -> Array:
    """How much (n, 1) of vectors (n, k) stands clear of their uncertainty: 1 - limit / Σ(v/σ)², or nothing.

    The estimator of James & Stein (1961), its positive part: noise alone gives 0, so it costs nothing.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = np.sum((values / sigma) ** 2, axis=1, keepdims=True)
        return np.nan_to_num(np.maximum(0.0, 1.0 - limit / squares))


def contradicts(fit: QuadraticFit) -> NDArray[np.bool_]:
    """Points (n,) far off the quadratic of their neighbours, measured by the scatter of all."""
    off = np.hypot(*fit.leave_out.T)
    known = np.isfinite(off)
    scatter = 1.4826 * float(np.median(off[known])) if known.any() else 0.0
    with np.errstate(invalid="ignore"):
        return np.asarray(known & (off > max(_LEAST_OFF, _SCATTERS * scatter)))


def most_unlike(rest: Array, around: Neighbourhoods) -> Array:
    """The largest mean square difference (n,) of a good match, from those of all, (n,); NaN where nothing is known.

    A point whose subsets differ by far more than those about it is partly covered, or worn. Noise leaves the same
    in weak and in strong texture, so weak texture is not taken for a difference.
    """
    known = np.isfinite(rest)
    return _UNLIKE * np.fmax(around.median(rest), np.median(rest[known])) if known.any() else np.full(len(rest), np.nan)


def _rest(found: Correlation, reference: Reference, radius: int) -> Array:
    """C_LS times the variance of the reference's subset, and no less than rounding to whole grey levels makes. (n,)."""
    good = found.good
    rest = np.full(len(found.xy), np.nan)
    least = (reference.grey_range / 255.0) ** 2
    rest[good] = np.maximum(found.c_ls[good] * _variance(reference, found.xy[good], radius), least)
    return rest


def _variance(reference: Reference, xy: Array, radius: int) -> Array:
    """Variance (n,) of the grey levels in the squares about points xy (n, 2), what the mask cuts left out."""
    size = (2 * radius + 1,) * 2
    inside = reference.mask.astype(np.float64)
    at = np.rint(xy - reference.origin).astype(np.int64)
    level = reference.grey * inside

    def total(values: Array) -> Array:
        summed = cv2.boxFilter(values, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed, dtype=np.float64)[at[:, 1], at[:, 0]]

    count = np.maximum(total(inside), 1.0)
    return np.maximum(total(level * level) / count - (total(level) / count) ** 2, 0.0)


def _judged(found: Correlation, reference: Reference, shift: Array, around: Neighbourhoods, radius: int) -> Followed:
    """The matches at the points themselves; those unlike the reference or against their neighbours lost."""
    status = found.status.copy()
    rest = _rest(found, reference, radius)
    status[rest > most_unlike(rest, around)] = Status.LOW_ZNCC
    kept = status == Status.GOOD
    fit = around.fit(np.where(kept[:, None], found.uv, np.nan), np.hypot(*found.sigma.T))
    status[kept & contradicts(fit)] = Status.INCONSISTENT
    good = status == Status.GOOD
    warp = shifted(_warp(found), -shift)
    return Followed(
        np.where(good[:, None], warp, np.nan),
        np.where(good[:, None], found.sigma, np.nan),
        np.where(good, found.c_ls, np.nan),
        np.where(good, rest, np.nan),
        status,
    )
