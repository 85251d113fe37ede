"""The points that are followed in a camera's images, and what about them is the same in every image.

What is smooth over the image, the field's curvature and the bias that subsets leave, is taken from a part of the
points, the knots, one in each square not quite a subset's radius wide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask
from ringdic.correlation import CorrelationSettings, Reference
from ringdic.correlation.quadratic import LowerQuartiles, Neighbourhoods, QuadraticFit
from ringdic.correlation.seeds import even_sample

_APART = 0.8  # subset radii, side of the squares with a knot each
_REACH = 3.0  # subset radii about a knot in which its neighbours tell its curvature and its bias
_SCATTERS = 8.0  # a point this many times off its neighbours' quadratic contradicts it
_LEAST_OFF = 0.1  # px, and never less than this
_STRICTER = (4.0, 1.0)  # the most distant knots go first, so that they do not drag good ones along
_UNLIKE = 3.0  # a mean square difference this many times the usual one is not noise, which stays below 2


@dataclass(frozen=True)
class TrackedPoints:
    """n points of a reference image, m of them knots.

    at : (n, 2) px. pixel : (n, 2), the whole pixels next to them, where their subsets lie. variance : (n,) of the grey
    levels there; least : the mean square difference that rounding to whole grey levels makes. seeds : some points
    spread evenly. knots : (m,) indices of the knots, knot : (n,) the one next to each point, around : their
    neighbourhoods, quartile : of the knots about each point.
    """

    at: Floats
    pixel: Floats
    variance: Floats
    least: float
    seeds: Indices
    knots: Indices
    knot: Indices
    around: Neighbourhoods
    quartile: LowerQuartiles

    @property
    def shift(self) -> Floats:
        """From the points to their whole pixels. (n, 2) px."""
        return self.pixel - self.at

    @property
    def beside(self) -> Floats:
        """From the knot of each point to the point, whole pixels. (n, 2)."""
        return self.pixel - self.around.xy[self.knot]

    def nearest(self, known: Mask, reach: float = np.inf) -> Indices:
        """The nearest of the known knots (m,) of every point, (n,), -1 where none lies within reach, px."""
        if not known.any():
            return np.full(len(self.at), -1)
        out = self.knot.copy()
        lost = np.flatnonzero(~known[out])
        if len(lost):
            which = np.flatnonzero(known)
            distance, index = cKDTree(self.around.xy[which]).query(self.pixel[lost], distance_upper_bound=reach)
            out[lost] = np.where(np.isfinite(distance), which[np.minimum(index, len(which) - 1)], -1)
        return out

    def quadratics(self, values: Floats, sigma: Floats) -> QuadraticFit:
        """Quadratics of a field about the knots, those that contradict it left out. values (n, 2), sigma (n,)."""
        return robust(self.around, values[self.knots], sigma[self.knots])

    def contradict(self, values: Floats, sigma: Floats) -> Mask:
        """Points (n,) whose values (n, 2) lie far off the quadratic of their neighbours; NaN does not."""
        fit = self.quadratics(values, sigma)
        knot = self.nearest(np.asarray(np.isfinite(fit.value).all(axis=1)), self.around.window)
        off = np.hypot(*(values - fit.extrapolate(knot, self.pixel - self.around.xy[knot])).T)
        off[knot < 0] = np.nan
        own = np.hypot(*fit.leave_one_out.T)
        off[self.knots] = np.where(np.isfinite(own), own, off[self.knots])
        with np.errstate(invalid="ignore"):
            return np.asarray(off > _limit(off))

    def most_unlike(self, rest: Floats) -> Floats:
        """The largest mean square difference (n,) of a good match, from those of all, (n,); NaN where none is known.

        A point whose subsets differ by far more than those about it is partly covered, or worn; beside what covers it
        only the best of those about it are clear. Noise leaves the same
        in weak and in strong texture, so weak texture is not taken for a difference.
        """
        known = np.isfinite(rest)
        if not known.any():
            return np.full(len(rest), np.nan)
        return _UNLIKE * np.fmax(self.quartile(rest[self.knots]), np.median(rest[known]))


def tracked_points(
    reference: Reference, at: Floats, settings: CorrelationSettings, window: float | None = None, *, thin: bool = True
) -> TrackedPoints:
    """Of points ``at`` (n, 2) px of a reference image. window : px, by default 3 subset radii.

    thin : without it every point is a knot.
    """
    pixel = np.rint(at)
    knots = thinned(pixel, _APART * settings.radius) if thin else np.arange(len(at))
    around = Neighbourhoods(pixel[knots], window or _REACH * settings.radius)
    quartile = LowerQuartiles(pixel, around.xy, around.window)
    _, knot = cKDTree(pixel[knots]).query(pixel)
    variance = _variance(reference, pixel, settings.radius)
    least = (reference.grey_range / 255.0) ** 2
    return TrackedPoints(
        at, pixel, variance, least, even_sample(at), knots, np.asarray(knot, np.int64), around, quartile
    )


def thinned(xy: Floats, side: float) -> Indices:
    """Of points (n, 2), in every square of this side the one nearest its middle. (m,) indices, rising."""
    place = (xy - xy.min(axis=0)) / side
    cell = np.floor(place).astype(np.int64)
    label = cell[:, 1] * (int(cell[:, 0].max()) + 1) + cell[:, 0]
    order = np.lexsort((np.hypot(*(place - cell - 0.5).T), label))
    return np.sort(order[np.flatnonzero(np.diff(label[order], prepend=-1))])


def robust(around: Neighbourhoods, values: Floats, sigma: Floats) -> QuadraticFit:
    """Quadratics of a field (m, 2), points far off their neighbours' left out."""
    kept = values
    fit = around.fit(values, sigma)
    for factor in _STRICTER:
        with np.errstate(invalid="ignore"):
            off = np.hypot(*np.where(np.isfinite(kept), fit.leave_one_out, values - fit.value).T)
            odd = off > factor * _limit(off)
        if (odd == (np.isfinite(values) & ~np.isfinite(kept)).any(axis=1)).all():
            continue
        kept = np.where(odd[:, None], np.nan, values)
        fit = around.fit(kept, sigma)
    return replace(fit, leave_one_out=np.where(np.isfinite(kept), fit.leave_one_out, values - fit.value))


def _limit(off: Floats) -> float:
    """The distance from a quadratic beyond which a point contradicts it, from the distances of all, px."""
    known = np.isfinite(off)
    scatter = 1.4826 * float(np.median(off[known])) if known.any() else 0.0
    return max(_LEAST_OFF, _SCATTERS * scatter)


def _variance(reference: Reference, xy: Floats, radius: int) -> Floats:
    """Variance (n,) of the grey levels in the squares about points xy (n, 2), what the mask cuts left out."""
    size = (2 * radius + 1,) * 2
    inside = reference.mask.astype(np.float32)
    level = (reference.grey - np.float32(reference.grey.mean())).astype(np.float32) * inside
    column, row = np.rint(xy - reference.origin).astype(np.int64).T

    def total(values: NDArray[np.float32]) -> Floats:
        summed = cv2.boxFilter(values, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed[row, column], dtype=np.float64)

    count = np.maximum(total(inside), 1.0)
    return np.maximum(total(level * level) / count - (total(level) / count) ** 2, 0.0)
