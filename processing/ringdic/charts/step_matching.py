"""Matching of a camera's points in a later image, in two passes that account for the displacement field's curvature.

A first-order subset in a curved displacement field is biased; one of second order is not, but is nearly twice as noisy.
So there are two passes, both of first order. The first is at the knots, a small part of the points. Where the curvature
is nearly constant, so is the bias: a quadratic fitted to the knots' displacements has the second derivatives of the
field, far less noisy than a subset's own, and gives every point its start value. The second pass, of all points, holds
these second derivatives fixed. Its own displacements then give the curvature over smaller neighbourhoods, and what
this changes is corrected. At the rim, where the neighbours lie to one side, subsets of a strongly curved field are of
second order.

A subset of the reference lies on a whole pixel, where nothing is interpolated; gradient and curvature carry the result
to the point, less than a pixel away.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.charts.tracked_points import APART, TrackedPoints, contradiction_limit, robust_quadratics
from ringdic.correlation import (
    CorrelationSettings,
    Current,
    PointMatches,
    Reference,
    Status,
    as_start_values,
    correlate_independently,
    correlate_points,
    search_warps,
)
from ringdic.correlation.quadratic import QuadraticFit
from ringdic.correlation.seeds import flow_start_values
from ringdic.geometry.outliers import LostPoint

_LOOSE = 5e-3  # px, tolerance of the first of two passes
_MARGIN = 32.0  # px about the subsets in which a current image is filtered
_START_ZNCC = 0.6  # least ZNCC under the warp by optical flow that makes it a start value
_STRIDE = 3  # px between the pixels of a subset that this ZNCC is of
_SOME = 0.2  # least share of the knots with start values from which the others can be reached
_FEWEST = 8  # start values from which an affine fit extrapolates where all points lie
_BENT = 2.0  # standard deviations by which curvature moves a subset, from which on it matters at the rim
_LOOSER = 2.5  # times the tolerance of subsets of second order, which are as much noisier
_TURNED = np.radians(6.0)  # turn of the body from which on its motion predicts the warps
_HIDDEN = np.cos(np.radians(74.0))  # cosine of the incidence below which a surface that has turned away is not matched
_AGREEING = 0.5  # least share of the knots that a predicted motion lets match
_CURVED = 20.0  # Σ(c/σ)² of second derivatives below which they may be noise, of 6 numbers of overlapping subsets


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
    settings: CorrelationSettings,
    *,
    curved: bool = True,
) -> ImageMatches:
    """Match points of the reference image in the current image.

    Parameters
    ----------
    reference, current : the two images, filtered.
    points : n points of the reference image.
    settings : of the correlation; order 2 with ``curved`` False leaves the second derivatives to each subset.
    curved : whether second derivatives of the neighbours' displacement are held fixed in a second, first-order pass.
    """
    if not curved:
        return _reject_outliers(correlate_points(reference, current, points.pixels, settings), points)
    first, part, ground = _at_knots(reference, current, points, _of_knots(settings))
    if not first.good.any():
        return _lost(points, first.status[points.knots.of_points])
    warp = _predicted_warps(first, ground.warp, points, settings.radius)
    warp[ground.hidden] = np.nan
    part = _about(points.pixels + warp[:, :2], settings.radius, part, current)
    second = correlate_independently(reference, part, points.pixels, settings, warp, repeated=True)
    second = replace(
        second, uv=second.uv - ground.plane[:, 0], gradient=second.gradient - np.swapaxes(ground.plane[:, 1:], 1, 2)
    )
    mended, again = _mend_curvature(second, warp[:, :2], ground.warp, points, settings.radius)
    if len(again):
        settings = replace(settings, order=2, tolerance=_LOOSER * settings.tolerance)
        third = correlate_independently(reference, part, points.pixels[again], settings, _warp(mended)[again])
        mended = with_matches(mended, again, third)
    mended.status[ground.hidden] = LostPoint.OBLIQUE
    return _reject_outliers(mended, points, ground.warp[:, :2])


@dataclass(frozen=True)
class _Ground:
    """Warps that a motion of the body predicts, to which the rest is added.

    warp : (n, 12). hidden : (n,) bool, points that turn away from the camera. plane : (n, 3, 2), what first-order
    subsets measure of these warps beyond their quadratics: value, px, and slopes.
    """

    warp: Floats
    hidden: Mask
    plane: Floats

    @classmethod
    def level(cls, points: TrackedPoints) -> _Ground:
        """No motion."""
        n = len(points.positions)
        return cls(np.zeros((n, 12)), np.zeros(n, bool), np.zeros((n, 3, 2)))

    @classmethod
    def of_matches(cls, points: TrackedPoints, warp: Floats) -> _Ground | None:
        """The prediction from warps (m, 6) or more at the knots; None unless they tell of a large turn."""
        if points.body is None:
            return None
        motion = points.body.motion(points.next_to_knots, points.knots.neighbourhoods.xy, warp)
        if motion is None or motion.angle < _TURNED:
            return None
        predicted, cosine, plane = points.on_body.after(motion)
        known = np.isfinite(predicted).all(axis=1)
        if not known.any():
            return None
        lost, which = np.flatnonzero(~known), np.flatnonzero(known)
        near = which[cKDTree(points.pixels[which]).query(points.pixels[lost])[1]]
        predicted[lost] = shift_warps(predicted[near], points.pixels[lost] - points.pixels[near])
        cosine[lost] = cosine[near]
        return cls(predicted, ~(cosine > _HIDDEN), np.nan_to_num(plane))


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
    """Settings of the first of two passes: first order, as precise as start values and curvatures need."""
    return replace(
        settings,
        order=1,
        step=max(settings.step, round(APART * settings.radius)),
        tolerance=max(settings.tolerance, _LOOSE),
    )


def _at_knots(
    reference: Reference, current: Current, points: TrackedPoints, settings: CorrelationSettings
) -> tuple[PointMatches, Current, _Ground]:
    """Match the knots from optical flow, and those that it does not reach from their neighbours.

    Where these matches tell that the body has turned far, the knots are matched again from the warps that its motion
    predicts. Returns the matches, the part of the current image where all points will lie, and the prediction.
    """
    xy = points.knots.neighbourhoods.xy
    at_knots = as_start_values(flow_start_values(reference, current, xy, settings.radius))[:, :6]
    known = np.flatnonzero(np.isfinite(at_knots).all(axis=1))
    _, zncc, _ = search_warps(reference, current, xy[known], at_knots[known, None], settings.radius, stride=_STRIDE)
    at_knots[known[~(zncc > _START_ZNCC)]] = np.nan
    known = known[zncc > _START_ZNCC]
    if len(known) < max(_FEWEST, _SOME * len(xy)):
        part, matches = current, correlate_points(reference, current, xy, settings)
    else:
        at = xy[known]
        part = current.crop_by_affine_fit(at, at + at_knots[known, :2], points.pixels, settings.radius)
        matches = correlate_points(reference, part, xy, settings, start=at_knots, prefer_neighbour=True)
    turned = _at_turned_knots(reference, current, points, settings, _warp(matches))
    return turned or (matches, part, _Ground.level(points))


def _at_turned_knots(
    reference: Reference, current: Current, points: TrackedPoints, settings: CorrelationSettings, warp: Floats
) -> tuple[PointMatches, Current, _Ground] | None:
    """Match the knots from the motion that warps (m, 6) or more at them tell of.

    Returns what `_at_knots` does; None unless the body has turned far, or where the images contradict it.
    """
    ground = _Ground.of_matches(points, warp)
    if ground is None:
        return None
    knot, xy = points.knots.index, points.knots.neighbourhoods.xy
    start = np.where(ground.hidden[knot, None], np.nan, ground.warp[knot])
    part = _about(xy + start[:, :2], settings.radius, current, current)
    matches = correlate_independently(reference, part, xy, settings, start, repeated=True)
    if matches.good.sum() < _AGREEING * (~ground.hidden[knot]).sum():
        return None
    better = _Ground.of_matches(points, _warp(matches))
    return matches, current, better or ground


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


def _warp(matches: PointMatches) -> Floats:
    """Warps (n, 12) of matches."""
    n = len(matches.xy)
    return np.concatenate([matches.uv, matches.gradient.reshape(n, 4), matches.curvature.reshape(n, 6)], axis=1)


def _warp_of(fit: QuadraticFit) -> Floats:
    """Warps (m, 12) of local quadratics."""
    return np.concatenate([fit.value, fit.gradient.reshape(-1, 4), fit.curvature.reshape(-1, 6)], axis=1)


def _predicted_warps(first: PointMatches, ground: Floats, points: TrackedPoints, radius: int) -> Floats:
    """Predict the warps (n, 12) of all points from the knots' matches, with the second derivatives to be held fixed.

    ground : (n, 12), to which the field that is fitted is added.
    """
    near, at = points.knots.neighbourhoods, ground[points.knots.index]
    fit = robust_quadratics(near, first.uv - at[:, :2], np.hypot(*first.sigma.T))
    warp = _warp_of(fit)
    warp = np.where(np.isfinite(warp).all(axis=1, keepdims=True), warp, _warp(first) - at)
    knot = points.knots.nearest(np.asarray(np.isfinite(warp).all(axis=1)), points.pixels, near.window)
    out = shift_warps(warp[knot], points.pixels - near.xy[knot])
    out[knot < 0] = np.nan
    curvature, known = _change_of_curvature(fit, first, np.zeros((len(first.xy), 6)), radius)
    out[:, 6:] = points.knots.interpolate(curvature, known, points.pixels) if known.any() else 0.0
    return out + ground


def _change_of_curvature(fit: QuadraticFit, matches: PointMatches, held: Floats, radius: int) -> tuple[Floats, Mask]:
    """Second derivatives of quadratics about m knots less those that were held, as far as they exceed the noise.

    fit : to the displacements. matches : of the knots. held : (m, 6) 1/px. Returns (m, 6) 1/px, and which of them are
    certain enough, (m,) bool. A wrong second derivative δ moves a round first-order subset of radius r by δ r²/8, the
    mean of δ x²/2 over it.
    """
    size = np.hypot(*matches.sigma.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = (matches.sigma / size[:, None])[:, :, None] * fit.curvature_sigma[:, None, :]
        harm = fit.curvature_sigma.max(axis=1) * radius**2 / 8.0
        known: Mask = np.asarray(np.isfinite(fit.curvature).all(axis=(1, 2)) & (harm < size))
        change = fit.curvature.reshape(-1, 6) - held
        return change * _shrinkage(change, sigma.reshape(-1, 6), _CURVED), known


def _mend_curvature(
    second: PointMatches, predicted: Pixels, ground: Floats, points: TrackedPoints, radius: int
) -> tuple[PointMatches, Indices]:
    """Correct the second pass for the curvature of its own displacements, over smaller neighbourhoods.

    predicted : (n, 2) px, the displacements that it started from; what contradicts them is left out. ground : (n, 12),
    to which the field that is fitted is added. Returns the matches, and the points (k,) int at the rim of a strongly
    curved field, where it is unknown.
    """
    knots = points.fine_knots
    distance = np.hypot(*(second.uv - predicted).T)
    with np.errstate(invalid="ignore"):
        agreeing = distance <= contradiction_limit(distance)
    own, at = second.part(knots.index), ground[knots.index]
    values = np.where(agreeing[:, None], second.uv - ground[:, :2], np.nan)
    fit = knots.neighbourhoods.fit(values, np.hypot(*second.sigma.T))
    change, known = _change_of_curvature(fit, own, own.curvature.reshape(-1, 6) - at[:, 6:], radius)
    if not known.any():
        return second, np.zeros(0, np.int64)
    by_point = knots.interpolate(change, known, points.pixels).reshape(-1, 2, 3)
    bias = radius**2 / 8.0 * (by_point[..., 0] + by_point[..., 2])
    mended = replace(second, uv=second.uv - bias, curvature=second.curvature + by_point)
    bent = radius**2 / 8.0 * np.abs(mended.curvature.reshape(-1, 6) - ground[:, 6:]).max(axis=1)
    with np.errstate(invalid="ignore"):
        strong = second.good & (bent > _BENT * np.hypot(*second.sigma.T))
    return mended, np.flatnonzero(strong & points.one_sided)


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


def _reject_outliers(matches: PointMatches, points: TrackedPoints, ground: Pixels | float = 0.0) -> ImageMatches:
    """Matches at the points themselves; those unlike the reference or contradicting their neighbours are lost.

    ground : (n, 2) px, displacements from which those of neighbours differ by a smooth field.
    """
    status = matches.status.copy()
    mean_square = _mean_square(matches, points)
    with np.errstate(invalid="ignore"):
        status[mean_square > points.largest_difference(mean_square)] = Status.LOW_ZNCC
    plausible = status == Status.GOOD
    uv = np.where(plausible[:, None], matches.uv - ground, np.nan)
    status[points.contradict(uv, np.hypot(*matches.sigma.T))] = Status.INCONSISTENT
    good = status == Status.GOOD
    warp = shift_warps(_warp(matches), -points.shift) if points.shift.any() else _warp(matches)
    return ImageMatches(
        np.where(good[:, None], warp, np.nan),
        np.where(good[:, None], matches.sigma, np.nan),
        np.where(good, matches.c_ls, np.nan),
        np.where(good, mean_square, np.nan),
        status,
    )
