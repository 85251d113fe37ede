"""The same points in two images of one camera: whole-pixel subsets, twice, and what the neighbours know.

A first-order subset in a curved displacement field is biased; one of second order is not, but nearly twice as noisy.
So there are two passes. The first is of second order, at the knots, a part of the points. A quadratic of its
displacement over the neighbours gives every point its start value, and second derivatives far less noisy than a
subset's own; the second pass is of first order and holds them.
What bias is left (the field is no quadratic where the surface turns away) is the smooth part of the difference of the
two passes, and is taken off as far as it stands out of the noise.

A subset of the reference lies on a whole pixel, where nothing is interpolated; gradient and curvature carry the result
to the point, less than a pixel away.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask
from ringdic.correlation import (
    Correlation,
    CorrelationSettings,
    Current,
    Reference,
    Status,
    as_start_values,
    correlate_independently,
    correlate_points,
)
from ringdic.correlation.quadratic import QuadraticFit
from ringdic.correlation.seeds import flow_start_values
from ringdic.multiview.tracked_points import TrackedPoints, robust

_LOOSE = 5e-3  # px, tolerance of the first of two passes
_PATIENCE = 10  # iterations of the first of two passes
_MARGIN = 32.0  # px about the subsets in which a current image is filtered
_ENOUGH = 0.5  # share of the start values that must hold before the images are searched for others
_SPARE = 0.05  # share of the knots whose neighbours tell enough without them
_LEAST_EXCESS = 0.1  # of a second-order subset's variance, beyond that of the same subset of first order
_OVERLAP = 1.2  # subsets share pixels: a mean of several is this much less certain than of independent ones
_BIASED = 4.0  # Σ(b/σ)² of a bias below which it may be noise, of 2 numbers
_CURVED = 20.0  # the same of second derivatives, of 6 numbers of overlapping subsets
_LEFT = 0.25  # share of the bias that may be left: the neighbourhood is wider than the subset


@dataclass(frozen=True)
class ImageMatches:
    """n points of one image in another; NaN where status is not 0.

    warp : (n, 12) at the points: u v ux uy vx vy and uxx uxy uyy vxx vxy vyy. sigma : (n, 2) px of u v.
    c_ls : (n,). rest : (n,), mean square difference of the two subsets, grey levels². status : (n,), see ``Status``.
    """

    warp: Floats
    sigma: Floats
    c_ls: Floats
    rest: Floats
    status: Indices

    @property
    def good(self) -> Mask:
        """Matched points. (n,) bool."""
        return self.status == Status.GOOD

    def part(self, index: NDArray) -> ImageMatches:
        """Some of the points, by indices or a mask."""
        return ImageMatches(self.warp[index], self.sigma[index], self.c_ls[index], self.rest[index], self.status[index])


def match_tracked_points(
    reference: Reference,
    current: Current,
    points: TrackedPoints,
    start: Floats | None,
    settings: CorrelationSettings,
    *,
    two_pass: bool = True,
    search: bool = True,
) -> ImageMatches:
    """Follow points of the reference image into the current image.

    start : (n, 12) warps at the points, NaN rows where unknown; None: found in the images. search : look for start
    values in the images where too few of those given hold. settings.order 2 with two_pass False leaves the second
    derivatives to each subset.
    """
    given = None if start is None else shifted(start, points.shift)
    if not two_pass:
        return _judged(_matched(reference, current, points.pixel, given, settings, search), points)
    part = current if given is None else _about(points.pixel + given[:, :2], settings.radius, current, current)
    first = _at_knots(reference, (part, current), points, given, _of_knots(settings), search)
    if not first.good.any():
        return _nowhere(points, first.status[points.knot])
    warp = _foretold(first, points, settings.radius)
    part = _about(points.pixel + warp[:, :2], settings.radius, part, current)
    second = correlate_independently(reference, part, points.pixel, settings, warp)
    return _judged(_unbiased(first, second, points), points)


def shifted(warp: Floats, shift: Floats) -> Floats:
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


def _of_knots(settings: CorrelationSettings) -> CorrelationSettings:
    """Of the first of two passes: second order, and no more iterations than a point takes that will be found."""
    return replace(
        settings,
        order=2,
        step=max(settings.step, settings.radius),
        tolerance=max(settings.tolerance, _LOOSE),
        max_iterations=min(settings.max_iterations, _PATIENCE),
    )


def _at_knots(
    reference: Reference,
    current: tuple[Current, Current],
    points: TrackedPoints,
    start: Floats | None,
    settings: CorrelationSettings,
    search: bool,
) -> Correlation:
    """The knots' matches: from start values (n, 12) of all points, from optical flow, or from whatever finds them.

    current : its part about the start values, and the whole.
    """
    part, whole = current
    xy = points.around.xy
    if start is None:
        part, given = whole, as_start_values(flow_start_values(reference, whole, xy, settings.radius))
    else:
        given = start[points.knots]
    found = correlate_independently(reference, part, xy, settings, given)
    if search and found.good.sum() < _ENOUGH * max(1, np.isfinite(given).all(axis=1).sum()):
        searched = correlate_points(reference, whole, xy, settings)
        return searched if searched.good.sum() > found.good.sum() else found
    lost = np.flatnonzero(~found.good)
    if len(lost) <= _SPARE * len(xy) or not found.good.any():
        return found
    again = _smooth(found, points)[lost]
    if not np.isfinite(again).all(axis=1).any():
        return found
    return placed(found, lost, correlate_independently(reference, part, xy[lost], settings, again))


def placed(found: Correlation, index: Indices, other: Correlation) -> Correlation:
    """``found`` with the points ``index`` (k,) as in ``other`` where that found them."""
    good = other.good
    changed = {}
    for each in fields(found):
        values = getattr(found, each.name)
        if isinstance(values, np.ndarray):
            values = values.copy()
            values[index[good]] = getattr(other, each.name)[good]
        changed[each.name] = values
    return Correlation(**changed)


def _about(positions: Floats, radius: int, part: Current, whole: Current) -> Current:
    """The part of the current image about positions (n, 2) px, NaN where unknown: the one at hand if it holds them."""
    known = positions[np.isfinite(positions).all(axis=1)]
    if not len(known):
        return whole
    if part is not whole:
        x0, y0, x1, y1 = part.box
        margin = 1.5 * radius
        low, high = np.maximum(known.min(axis=0) - margin, 0), known.max(axis=0) + margin
        last = whole.box[2:]
        if (low >= (x0, y0)).all() and (np.minimum(high, last) <= (x1, y1)).all():
            return part
    return whole.crop_around(known, 2.0 * radius + _MARGIN)


def _matched(
    reference: Reference,
    current: Current,
    pixel: Floats,
    start: Floats | None,
    settings: CorrelationSettings,
    search: bool,
) -> Correlation:
    """From the start values, or from the images where too few of them hold."""
    known: Mask = np.zeros(len(pixel), bool)
    if start is not None:
        known = np.asarray(np.isfinite(start).all(axis=1))
    if start is None or not known.any():
        return correlate_points(reference, current, pixel, settings)
    found = correlate_points(reference, current, pixel, settings, start=start)
    if not search or found.good[known].mean() >= _ENOUGH:
        return found
    searched = correlate_points(reference, current, pixel, settings)
    return searched if searched.good.sum() > found.good.sum() else found


def _warp(found: Correlation) -> Floats:
    n = len(found.xy)
    return np.concatenate([found.uv, found.gradient.reshape(n, 4), found.curvature.reshape(n, 6)], axis=1)


def _smooth(first: Correlation, points: TrackedPoints) -> Floats:
    """Warps (m, 12) of the knots by the quadratics of their neighbours' displacement; NaN where these are too few."""
    return _warp_of(robust(points.around, first.uv, np.hypot(*first.sigma.T)))


def _warp_of(fit: QuadraticFit) -> Floats:
    return np.concatenate([fit.value, fit.gradient.reshape(-1, 4), fit.curvature.reshape(-1, 6)], axis=1)


def _foretold(first: Correlation, points: TrackedPoints, radius: int) -> Floats:
    """Warps (n, 12) of the points as the knots' matches foretell them, with the second derivatives to hold."""
    fit = robust(points.around, first.uv, np.hypot(*first.sigma.T))
    warp = _warp_of(fit)
    warp = np.where(np.isfinite(warp).all(axis=1, keepdims=True), warp, _warp(first))
    knot = points.nearest(np.asarray(np.isfinite(warp).all(axis=1)), points.around.window)
    out = shifted(warp[knot], points.pixel - points.around.xy[knot])
    out[knot < 0] = np.nan
    out[:, 6:] = _held(fit, first, points, radius)
    return out


def _held(fit: QuadraticFit, first: Correlation, points: TrackedPoints, radius: int) -> Floats:
    """Second derivatives (n, 6) to hold: at the rim, where a knot's own are too uncertain, those of the nearest knot.

    A wrong second derivative δ moves a round first-order subset of radius r by δ r²/8, the mean of δ x²/2 over it.
    """
    size = np.hypot(*first.sigma.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = (first.sigma / size[:, None])[:, :, None] * fit.curvature_sigma[:, None, :]
        harm = fit.curvature_sigma.max(axis=1) * radius**2 / 8.0
        known = np.isfinite(fit.curvature).all(axis=(1, 2)) & (harm < size)
        curvature = fit.curvature.reshape(-1, 6)
        curvature = curvature * _clear(curvature, sigma.reshape(-1, 6), _CURVED)
    if not known.any():
        return np.zeros((len(points.at), 6))
    return np.asarray(curvature[points.nearest(known)])


def _unbiased(first: Correlation, second: Correlation, points: TrackedPoints) -> Correlation:
    """The second pass less the smooth part of its difference from the first, as far as that is more than noise."""
    own = second.sigma[points.knots]
    with np.errstate(invalid="ignore"):
        each = np.sqrt(np.maximum(first.sigma**2 - own**2, _LEAST_EXCESS * first.sigma**2))
    size = np.hypot(*each.T)
    fit = points.around.fit(second.uv[points.knots] - first.uv, size)
    with np.errstate(invalid="ignore", divide="ignore"):
        s = _OVERLAP * fit.value_sigma[:, None] * each / size[:, None]
    share = _clear(fit.value, s, _BIASED)
    known = np.isfinite(fit.value).all(axis=1) & np.isfinite(s).all(axis=1)
    knot = points.nearest(known, points.around.window)
    bias = fit.extrapolate(knot, points.pixel - points.around.xy[knot])
    there: Mask = np.asarray((knot >= 0) & second.good)
    uv = np.where(there[:, None], second.uv - share[knot] * bias, second.uv)
    doubt = share[knot] * np.hypot(s[knot], _LEFT * bias)
    sigma = np.where(there[:, None], np.hypot(second.sigma, doubt), second.sigma)
    return replace(second, uv=uv, sigma=sigma)


def _clear(values: Floats, sigma: Floats, limit: float) -> Floats:
    """How much (n, 1) of vectors (n, k) stands clear of their uncertainty: 1 - limit / Σ(v/σ)², or nothing.

    The estimator of James & Stein (1961), its positive part: noise alone gives 0, so it costs nothing.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = np.sum((values / sigma) ** 2, axis=1, keepdims=True)
        return np.nan_to_num(np.maximum(0.0, 1.0 - limit / squares))


def _rest(found: Correlation, points: TrackedPoints) -> Floats:
    """C_LS times the variance of the reference's subset, and no less than rounding to whole grey levels makes. (n,)."""
    return np.where(found.good, np.maximum(found.c_ls * points.variance, points.least), np.nan)


def _nowhere(points: TrackedPoints, status: Indices) -> ImageMatches:
    """None of the points found, for the reasons (n,) given."""
    n = len(points.at)
    lost = np.full(n, np.nan)
    return ImageMatches(np.full((n, 12), np.nan), np.full((n, 2), np.nan), lost, lost.copy(), status)


def _judged(found: Correlation, points: TrackedPoints) -> ImageMatches:
    """The matches at the points themselves; those unlike the reference or against their neighbours lost."""
    status = found.status.copy()
    rest = _rest(found, points)
    with np.errstate(invalid="ignore"):
        status[rest > points.most_unlike(rest)] = Status.LOW_ZNCC
    kept = status == Status.GOOD
    uv = np.where(kept[:, None], found.uv, np.nan)
    status[points.contradict(uv, np.hypot(*found.sigma.T))] = Status.INCONSISTENT
    good = status == Status.GOOD
    warp = shifted(_warp(found), -points.shift)
    return ImageMatches(
        np.where(good[:, None], warp, np.nan),
        np.where(good[:, None], found.sigma, np.nan),
        np.where(good, found.c_ls, np.nan),
        np.where(good, rest, np.nan),
        status,
    )
