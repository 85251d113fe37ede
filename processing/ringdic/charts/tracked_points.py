"""Points tracked through a camera's images, with quantities that are computed once for all images.

Quantities that are smooth over the image, the field's curvature and the bias of the subsets, are computed at a part
of the points only, the knots: one in each square not quite a subset's radius wide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.correlation import CorrelationSettings, Reference
from ringdic.correlation.quadratic import LowerQuartiles, Neighbourhoods, QuadraticFit
from ringdic.correlation.seeds import even_sample

_APART = 0.8  # subset radii, side of the squares with one knot each
_REACH = 3.0  # subset radii about a knot, of the neighbours that its curvature and bias are computed from
_SCATTERS = 8.0  # standard deviations from the neighbours' quadratic beyond which a point contradicts it
_LEAST_OFF = 0.1  # px, least distance that is a contradiction
_STRICTER = (4.0, 1.0)  # times the limit: the most distant knots are rejected first, so that they do not bias the fit
_UNLIKE = 3.0  # times the usual mean square difference that noise alone, which stays below 2, does not reach


@dataclass(frozen=True)
class TrackedPoints:
    """Points of a reference image that are tracked through later images: n points, of which m are knots.

    positions : (n, 2) float64, px. pixels : (n, 2) float64, px, the whole pixels next to them, on which their
    subsets lie. variance : (n,), of the grey levels there, grey levels². least : mean square difference due
    to rounding to whole grey levels, grey levels². seeds : (s,) int, some points spread evenly. knots : (m,) int,
    indices of the knots. knot : (n,) int, the knot next to each point. neighbourhoods : of the knots. quartile : of
    the knots about each point.
    """

    positions: Pixels
    pixels: Pixels
    variance: Floats
    least: float
    seeds: Indices
    knots: Indices
    knot: Indices
    neighbourhoods: Neighbourhoods
    quartile: LowerQuartiles

    @property
    def shift(self) -> Pixels:
        """Offsets from the points to their whole pixels, (n, 2) px."""
        return self.pixels - self.positions

    def nearest(self, known: Mask, reach: float = np.inf) -> Indices:
        """Nearest known knot of every point.

        known : (m,) bool, of the knots. reach : px. Returns indices (n,) of knots, -1 where none lies within reach.
        """
        if not known.any():
            return np.full(len(self.positions), -1)
        out = self.knot.copy()
        lost = np.flatnonzero(~known[out])
        if len(lost):
            which = np.flatnonzero(known)
            distance, index = cKDTree(self.neighbourhoods.xy[which]).query(
                self.pixels[lost], distance_upper_bound=reach
            )
            out[lost] = np.where(np.isfinite(distance), which[np.minimum(index, len(which) - 1)], -1)
        return out

    def quadratics(self, values: Pixels, sigma: Floats) -> QuadraticFit:
        """Fit local quadratics of a displacement field about the knots, with rejection of outlying knots.

        values : (n, 2) px, at the points. sigma : (n,) px.
        """
        return robust_quadratics(self.neighbourhoods, values[self.knots], sigma[self.knots])

    def contradict(self, values: Pixels, sigma: Floats) -> Mask:
        """Outlying points, whose displacement is far from the quadratic fitted to their neighbours.

        values : (n, 2) px, NaN where unknown. sigma : (n,) px. Returns (n,) bool, False where the displacement is
        unknown.
        """
        fit = self.quadratics(values, sigma)
        knot = self.nearest(np.asarray(np.isfinite(fit.value).all(axis=1)), self.neighbourhoods.window)
        distance = np.hypot(*(values - fit.extrapolate(knot, self.pixels - self.neighbourhoods.xy[knot])).T)
        distance[knot < 0] = np.nan
        own = np.hypot(*fit.leave_one_out.T)
        distance[self.knots] = np.where(np.isfinite(own), own, distance[self.knots])
        with np.errstate(invalid="ignore"):
            return np.asarray(distance > _limit(distance))

    def largest_difference(self, mean_square: Floats) -> Floats:
        """Limit of the mean square difference of a good match at each point, from those of its neighbours.

        A point whose subsets differ by far more than those about it is partly covered or worn; next to an obstacle
        only the best of its neighbours are unobstructed, so the lower quartile about a point is taken. Noise
        contributes equally in weak and in strong texture, so weak texture is not mistaken for a difference.

        mean_square : (n,) grey levels², NaN where unknown. Returns (n,) grey levels², NaN where nothing is known.
        """
        known = np.isfinite(mean_square)
        if not known.any():
            return np.full(len(mean_square), np.nan)
        return _UNLIKE * np.fmax(self.quartile(mean_square[self.knots]), np.median(mean_square[known]))


def tracked_points(
    reference: Reference,
    positions: Pixels,
    settings: CorrelationSettings,
    window: float | None = None,
    *,
    thin: bool = True,
) -> TrackedPoints:
    """Prepare points of a reference image for tracking.

    positions : (n, 2) float64, px. window : px, radius of the neighbourhoods; None: 3 subset radii. thin : whether only
    one point in each square is a knot; otherwise every point is one.
    """
    pixels = np.rint(positions)
    knots = thin_to_grid(pixels, _APART * settings.radius) if thin else np.arange(len(positions))
    neighbourhoods = Neighbourhoods(pixels[knots], window or _REACH * settings.radius)
    quartile = LowerQuartiles(pixels, neighbourhoods.xy, neighbourhoods.window)
    _, knot = cKDTree(pixels[knots]).query(pixels)
    variance = _variance(reference, pixels, settings.radius)
    least = (reference.grey_range / 255.0) ** 2
    return TrackedPoints(
        positions,
        pixels,
        variance,
        least,
        even_sample(positions),
        knots,
        np.asarray(knot, np.int64),
        neighbourhoods,
        quartile,
    )


def thin_to_grid(xy: Pixels, side: float) -> Indices:
    """Choose in every square of a grid the point nearest to its middle.

    xy : (n, 2) px. side : px, of the squares. Returns indices (m,), rising.
    """
    position = (xy - xy.min(axis=0)) / side
    cell = np.floor(position).astype(np.int64)
    label = cell[:, 1] * (int(cell[:, 0].max()) + 1) + cell[:, 0]
    order = np.lexsort((np.hypot(*(position - cell - 0.5).T), label))
    return np.sort(order[np.flatnonzero(np.diff(label[order], prepend=-1))])


def robust_quadratics(neighbourhoods: Neighbourhoods, values: Pixels, sigma: Floats) -> QuadraticFit:
    """Fit local quadratics of a field with rejection of outlying points.

    neighbourhoods : of the m points. values : (m, 2) px. sigma : (m,) px.
    """
    agreeing = values
    fit = neighbourhoods.fit(values, sigma)
    for factor in _STRICTER:
        with np.errstate(invalid="ignore"):
            distance = np.hypot(*np.where(np.isfinite(agreeing), fit.leave_one_out, values - fit.value).T)
            contradicting = distance > factor * _limit(distance)
        if (contradicting == (np.isfinite(values) & ~np.isfinite(agreeing)).any(axis=1)).all():
            continue
        agreeing = np.where(contradicting[:, None], np.nan, values)
        fit = neighbourhoods.fit(agreeing, sigma)
    return replace(fit, leave_one_out=np.where(np.isfinite(agreeing), fit.leave_one_out, values - fit.value))


def _limit(distance: Floats) -> float:
    """Distance from a quadratic, px, beyond which a point contradicts it, from the distances (m,) px of all points."""
    known = np.isfinite(distance)
    scatter = 1.4826 * float(np.median(distance[known])) if known.any() else 0.0
    return max(_LEAST_OFF, _SCATTERS * scatter)


def _variance(reference: Reference, xy: Pixels, radius: int) -> Floats:
    """Variance of the grey levels in the squares about points, without the pixels that the mask excludes.

    xy : (n, 2) px. Returns (n,) grey levels².
    """
    size = (2 * radius + 1,) * 2
    inside = reference.mask.astype(np.float32)
    level = (reference.grey - np.float32(reference.grey.mean())).astype(np.float32) * inside
    column, row = np.rint(xy - reference.origin).astype(np.int64).T

    def total(values: NDArray[np.float32]) -> Floats:
        summed = cv2.boxFilter(values, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed[row, column], dtype=np.float64)

    count = np.maximum(total(inside), 1.0)
    return np.maximum(total(level * level) / count - (total(level) / count) ** 2, 0.0)
