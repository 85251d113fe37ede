"""Matching of a camera's points in a later image, in two passes that account for the displacement field's curvature.

A first-order subset in a curved displacement field is biased; one of second order is not, but is nearly twice as noisy.
So there are two passes. The first is of second order, at the knots, a part of the points. A quadratic fitted to its
displacements over the neighbours gives every point its start value, and second derivatives far less noisy than a
subset's own; the second pass is of first order and holds these fixed. What bias remains (where the surface turns away,
the field is not quadratic) is the smooth part of the difference of the two passes. It is subtracted as far as it
exceeds the noise.

A subset of the reference lies on a whole pixel, where nothing is interpolated; gradient and curvature carry the result
to the point, less than a pixel away.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.charts.tracked_points import TrackedPoints, robust_quadratics
from ringdic.correlation import (
    CorrelationSettings,
    Current,
    PointMatches,
    Reference,
    Status,
    as_start_values,
    correlate_independently,
    correlate_points,
)
from ringdic.correlation.quadratic import QuadraticFit
from ringdic.correlation.seeds import flow_start_values

_LOOSE = 5e-3  # px, tolerance of the first of two passes
_PATIENCE = 10  # iterations of the first of two passes
_MARGIN = 32.0  # px about the subsets in which a current image is filtered
_ENOUGH = 0.5  # least share of valid start values; with fewer, the images are searched for others
_SPARE = 0.05  # share of the knots that may be lost before they are searched for again
_LEAST_EXCESS = 0.1  # of a second-order subset's variance, beyond that of the same subset of first order
_OVERLAP = 1.2  # subsets share pixels: a mean of several is this much less certain than of independent ones
_BIASED = 4.0  # Σ(b/σ)² of a bias below which it may be noise, of 2 numbers
_CURVED = 20.0  # Σ(c/σ)² of second derivatives below which they may be noise, of 6 numbers of overlapping subsets
_LEFT = 0.25  # share of the bias that may be left: the neighbourhood is wider than the subset


@dataclass(frozen=True)
class ImageMatches:
    """Matches of n points of one image in another; NaN where status is not 0.

    warp : (n, 12) at the points, u v ux uy vx vy uxx uxy uyy vxx vxy vyy, in px and its powers. sigma : (n, 2) px,
    of u and v. c_ls : (n,). mean_square : (n,), mean square difference of the two subsets, grey levels². status :
    (n,) int.
    """

    warp: Floats
    sigma: Floats
    c_ls: Floats
    mean_square: Floats
    status: Indices

    @property
    def good(self) -> Mask:
        """Matched points, (n,) bool."""
        return self.status == Status.GOOD

    def part(self, index: NDArray) -> ImageMatches:
        """Matches of some of the points.

        index : (k,) int, or (n,) bool.
        """
        return ImageMatches(
            self.warp[index], self.sigma[index], self.c_ls[index], self.mean_square[index], self.status[index]
        )


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
    """Match points of the reference image in the current image.

    Parameters
    ----------
    reference, current : the two images, filtered.
    points : n points of the reference image.
    start : (n, 12) float64, warps at the points in px and its powers, NaN rows where unknown; None: start values are
        sought in the images.
    settings : of the correlation; order 2 with ``two_pass`` False leaves the second derivatives to each subset.
    two_pass : whether second derivatives of the neighbours' displacement are held fixed in a second, first-order pass.
    search : whether start values are sought in the images where too few of those given are valid.
    """
    pixel_start = None if start is None else shift_warps(start, points.shift)
    if not two_pass:
        matches = _match_pixels(reference, current, points.pixels, pixel_start, settings, search)
        return _reject_outliers(matches, points)
    part = current
    if pixel_start is not None:
        part = _about(points.pixels + pixel_start[:, :2], settings.radius, current, current)
    first = _at_knots(reference, (part, current), points, pixel_start, _of_knots(settings), search)
    if not first.good.any():
        return _lost(points, first.status[points.knot])
    warp = _predicted_warps(first, points, settings.radius)
    part = _about(points.pixels + warp[:, :2], settings.radius, part, current)
    second = correlate_independently(reference, part, points.pixels, settings, warp)
    return _reject_outliers(_subtract_bias(first, second, points), points)


def shift_warps(warp: Floats, shift: Pixels) -> Floats:
    """Warps at points displaced by a shift within their subsets: displacement and gradient by Taylor series.

    warp : (n, 12). shift : (n, 2) px. Returns (n, 12).
    """
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
    """Settings of the first of two passes: second order, with as many iterations as a converging point needs."""
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
) -> PointMatches:
    """Match the knots from start values, from optical flow, or by a search over the images.

    current : the part of the current image about the start values, and the whole. start : (n, 12), of all points.
    """
    part, whole = current
    xy = points.neighbourhoods.xy
    if start is None:
        part, start_at_knots = whole, as_start_values(flow_start_values(reference, whole, xy, settings.radius))
    else:
        start_at_knots = start[points.knots]
    matches = correlate_independently(reference, part, xy, settings, start_at_knots)
    if search and matches.good.sum() < _ENOUGH * max(1, np.isfinite(start_at_knots).all(axis=1).sum()):
        searched = correlate_points(reference, whole, xy, settings)
        return searched if searched.good.sum() > matches.good.sum() else matches
    lost = np.flatnonzero(~matches.good)
    if len(lost) <= _SPARE * len(xy) or not matches.good.any():
        return matches
    smooth_start = _smooth(matches, points)[lost]
    if not np.isfinite(smooth_start).all(axis=1).any():
        return matches
    return with_matches(matches, lost, correlate_independently(reference, part, xy[lost], settings, smooth_start))


def with_matches(matches: PointMatches, index: Indices, other: PointMatches) -> PointMatches:
    """Replace the matches of the points ``index`` (k,) by those of other matches where these are good."""
    good = other.good
    arrays = {}
    for each in fields(matches):
        values = getattr(matches, each.name)
        if isinstance(values, np.ndarray):
            values = values.copy()
            values[index[good]] = getattr(other, each.name)[good]
        arrays[each.name] = values
    return PointMatches(**arrays)


def _about(positions: Pixels, radius: int, part: Current, whole: Current) -> Current:
    """Current image with a box about positions (n, 2) px, NaN where unknown; unchanged if its box covers them."""
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


def _match_pixels(
    reference: Reference,
    current: Current,
    pixels: Pixels,
    start: Floats | None,
    settings: CorrelationSettings,
    search: bool,
) -> PointMatches:
    """Match pixels (n, 2) px in one pass, from start values (n, 12) or, where too few of these hold, by a search."""
    known: Mask = np.zeros(len(pixels), bool)
    if start is not None:
        known = np.asarray(np.isfinite(start).all(axis=1))
    if start is None or not known.any():
        return correlate_points(reference, current, pixels, settings)
    matches = correlate_points(reference, current, pixels, settings, start=start)
    if not search or matches.good[known].mean() >= _ENOUGH:
        return matches
    searched = correlate_points(reference, current, pixels, settings)
    return searched if searched.good.sum() > matches.good.sum() else matches


def _warp(matches: PointMatches) -> Floats:
    """Warps (n, 12) of matches."""
    n = len(matches.xy)
    return np.concatenate([matches.uv, matches.gradient.reshape(n, 4), matches.curvature.reshape(n, 6)], axis=1)


def _smooth(first: PointMatches, points: TrackedPoints) -> Floats:
    """Warps (m, 12) of the knots by the quadratics of their neighbours' displacement; NaN where these are too few."""
    return _warp_of(robust_quadratics(points.neighbourhoods, first.uv, np.hypot(*first.sigma.T)))


def _warp_of(fit: QuadraticFit) -> Floats:
    """Warps (m, 12) of local quadratics."""
    return np.concatenate([fit.value, fit.gradient.reshape(-1, 4), fit.curvature.reshape(-1, 6)], axis=1)


def _predicted_warps(first: PointMatches, points: TrackedPoints, radius: int) -> Floats:
    """Predict the warps (n, 12) of all points from the knots' matches, with the second derivatives to be held fixed."""
    fit = robust_quadratics(points.neighbourhoods, first.uv, np.hypot(*first.sigma.T))
    warp = _warp_of(fit)
    warp = np.where(np.isfinite(warp).all(axis=1, keepdims=True), warp, _warp(first))
    knot = points.nearest(np.asarray(np.isfinite(warp).all(axis=1)), points.neighbourhoods.window)
    out = shift_warps(warp[knot], points.pixels - points.neighbourhoods.xy[knot])
    out[knot < 0] = np.nan
    out[:, 6:] = _fixed_curvature(fit, first, points, radius)
    return out


def _fixed_curvature(fit: QuadraticFit, first: PointMatches, points: TrackedPoints, radius: int) -> Floats:
    """Second derivatives (n, 6) that the second pass holds fixed, from the quadratics of the first pass.

    Where a knot's own are too uncertain, as at the rim, those of the nearest knot are taken. A wrong second
    derivative δ moves a round first-order subset of radius r by δ r²/8, the mean of δ x²/2 over it.
    """
    size = np.hypot(*first.sigma.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = (first.sigma / size[:, None])[:, :, None] * fit.curvature_sigma[:, None, :]
        harm = fit.curvature_sigma.max(axis=1) * radius**2 / 8.0
        known = np.isfinite(fit.curvature).all(axis=(1, 2)) & (harm < size)
        curvature = fit.curvature.reshape(-1, 6)
        curvature = curvature * _shrinkage(curvature, sigma.reshape(-1, 6), _CURVED)
    if not known.any():
        return np.zeros((len(points.positions), 6))
    return np.asarray(curvature[points.nearest(known)])


def _subtract_bias(first: PointMatches, second: PointMatches, points: TrackedPoints) -> PointMatches:
    """Subtract from the second pass the smooth part of its difference from the first that exceeds noise.

    This is the bias of first-order subsets where the field is not quadratic; its uncertainty is added to that of the
    match.
    """
    second_sigma = second.sigma[points.knots]
    with np.errstate(invalid="ignore"):
        excess = np.sqrt(np.maximum(first.sigma**2 - second_sigma**2, _LEAST_EXCESS * first.sigma**2))
    size = np.hypot(*excess.T)
    fit = points.neighbourhoods.fit(second.uv[points.knots] - first.uv, size)
    with np.errstate(invalid="ignore", divide="ignore"):
        bias_sigma = _OVERLAP * fit.value_sigma[:, None] * excess / size[:, None]
    share = _shrinkage(fit.value, bias_sigma, _BIASED)
    known = np.isfinite(fit.value).all(axis=1) & np.isfinite(bias_sigma).all(axis=1)
    knot = points.nearest(known, points.neighbourhoods.window)
    bias = fit.extrapolate(knot, points.pixels - points.neighbourhoods.xy[knot])
    known_bias: Mask = np.asarray((knot >= 0) & second.good)
    uv = np.where(known_bias[:, None], second.uv - share[knot] * bias, second.uv)
    left_over = share[knot] * np.hypot(bias_sigma[knot], _LEFT * bias)
    sigma = np.where(known_bias[:, None], np.hypot(second.sigma, left_over), second.sigma)
    return replace(second, uv=uv, sigma=sigma)


def _shrinkage(values: Floats, sigma: Floats, limit: float) -> Floats:
    """Factor (n, 1) by which uncertain vectors (n, k) are shrunk towards zero: 1 - limit / Σ(v/σ)², at least 0.

    The positive part of the estimator of James & Stein (1961): where there is only noise it gives 0.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = np.sum((values / sigma) ** 2, axis=1, keepdims=True)
        return np.nan_to_num(np.maximum(0.0, 1.0 - limit / squares))


def _mean_square(matches: PointMatches, points: TrackedPoints) -> Floats:
    """Mean square difference (n,) of the subsets, grey levels², at least that of rounding to whole grey levels.

    It is C_LS times the variance of the reference's subset.
    """
    return np.where(matches.good, np.maximum(matches.c_ls * points.variance, points.least), np.nan)


def _lost(points: TrackedPoints, status: Indices) -> ImageMatches:
    """Matches without a good point, for the reasons (n,) given."""
    n = len(points.positions)
    lost = np.full(n, np.nan)
    return ImageMatches(np.full((n, 12), np.nan), np.full((n, 2), np.nan), lost, lost.copy(), status)


def _reject_outliers(matches: PointMatches, points: TrackedPoints) -> ImageMatches:
    """Matches at the points themselves; those unlike the reference or contradicting their neighbours are lost."""
    status = matches.status.copy()
    mean_square = _mean_square(matches, points)
    with np.errstate(invalid="ignore"):
        status[mean_square > points.largest_difference(mean_square)] = Status.LOW_ZNCC
    plausible = status == Status.GOOD
    uv = np.where(plausible[:, None], matches.uv, np.nan)
    status[points.contradict(uv, np.hypot(*matches.sigma.T))] = Status.INCONSISTENT
    good = status == Status.GOOD
    warp = shift_warps(_warp(matches), -points.shift)
    return ImageMatches(
        np.where(good[:, None], warp, np.nan),
        np.where(good[:, None], matches.sigma, np.nan),
        np.where(good, matches.c_ls, np.nan),
        np.where(good, mean_square, np.nan),
        status,
    )
