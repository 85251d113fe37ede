"""Points tracked through a camera's images, with quantities that are computed once for all images.

The field's curvature, which is smooth over the image, is computed about a part of the points only, the knots: one in
each square of a grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.charts.body_motion import PredictedPoints, SeenBody
from ringdic.correlation import CorrelationSettings, Reference
from ringdic.correlation.quadratic import Neighbourhoods, QuadraticFit

#: Side of the squares with one knot each, in subset radii.
APART = 1.5
_REACH = 3.0  # subset radii about a knot, of the neighbours that its curvature is computed from
_FINE = (1.0, 2.5)  # subset radii, side of the squares and reach of the fine knots
_LEAST_SHARE = 0.1  # of known knots about a point, from which a value is interpolated
_ONE_SIDED = 0.12  # windows between a knot and the mean of its neighbours; 0.42 where these are a half disc
_LATTICE = 0.2  # subset radii between the pixels by which the extent of subsets that are cut off is judged
_SCATTERS = 8.0  # standard deviations from the neighbours' quadratic beyond which a point contradicts it
_LEAST_OFF = 0.1  # px, least distance that is a contradiction
_STRICTER = (4.0, 1.0)  # times the limit: the most distant knots are rejected first, so that they do not bias the fit
_UNLIKE = 3.0  # times the usual mean square difference that noise alone, which stays below 2, does not reach


@dataclass(frozen=True)
class Knots:
    """Some of n points, about which local quadratics of a field are fitted: m knots.

    index : (m,) int, among the points. of_points : (n,) int, the knot next to each point. shares : (n, m), of the
    knots about each point in what is interpolated there, bilinear where they lie on a lattice. neighbourhoods : of the
    knots, at whole pixels.
    """

    index: Indices
    of_points: Indices
    shares: csr_array
    neighbourhoods: Neighbourhoods

    @classmethod
    def of(cls, pixels: Pixels, side: float, window: float, *, alone: bool = False) -> Knots:
        """Choose the knots of points.

        pixels : (n, 2) px. side : px, of squares with one knot each. window : px, radius of the neighbourhoods. alone :
        whether only knots are neighbours of a knot, else all points are.
        """
        index = thin_to_grid(pixels, side)
        about = Neighbourhoods(pixels[index], window) if alone else Neighbourhoods(pixels, window, index)
        return cls(index, *_about(pixels, index, side), about)

    def nearest(self, known: Mask, pixels: Pixels, reach: float = np.inf) -> Indices:
        """Nearest known knot of every point.

        known : (m,) bool, of the knots. pixels : (n, 2) px, the points. reach : px. Returns indices (n,) of knots, -1
        where none lies within reach.
        """
        if not known.any():
            return np.full(len(pixels), -1)
        out = self.of_points.copy()
        lost = np.flatnonzero(~known[out])
        if len(lost):
            which = np.flatnonzero(known)
            distance, index = cKDTree(self.neighbourhoods.centres[which]).query(
                pixels[lost], distance_upper_bound=reach
            )
            out[lost] = np.where(np.isfinite(distance), which[np.minimum(index, len(which) - 1)], -1)
        return out

    def interpolate(self, values: Floats, known: Mask, pixels: Pixels) -> Floats:
        """Values (n, k) at every point from those of the knots about it, else of the nearest knot where they are known.

        values : (m, k), of the knots. known : (m,) bool, some of them at least. pixels : (n, 2) px, the points.
        """
        share = self.shares @ np.column_stack([np.where(known[:, None], values, 0.0), known])
        alone = np.flatnonzero(share[:, -1] < _LEAST_SHARE)
        with np.errstate(invalid="ignore", divide="ignore"):
            out = share[:, :-1] / share[:, -1:]
        if len(alone):
            out[alone] = values[self.nearest(known, pixels)[alone]]
        return np.asarray(out)


@dataclass(frozen=True)
class TrackedPoints:
    """Points of a reference image that are tracked through later images: n points.

    positions : (n, 2) float64, px. pixels : (n, 2) float64, px, the whole pixels next to them, on which their
    subsets lie. variance : (n,), of the grey levels there, grey levels². least : mean square difference due
    to rounding to whole grey levels, grey levels². knots : matched before all other points. fine_knots : closer
    together, with smaller neighbourhoods. reference : the image. radius : px, of the subsets. body : what the camera
    sees of the surface, None where that is unknown.
    """

    positions: Pixels
    pixels: Pixels
    variance: Floats
    least: float
    knots: Knots
    fine_knots: Knots
    reference: Reference
    radius: int
    body: SeenBody | None = None

    @property
    def shift(self) -> Pixels:
        """Offsets from the points to their whole pixels, (n, 2) px."""
        return self.pixels - self.positions

    @cached_property
    def one_sided(self) -> Mask:
        """Points (n,) bool whose neighbours lie to one side, as at the rim of the surface."""
        knots = self.fine_knots
        eccentricity = knots.neighbourhoods.eccentricity[:, None]
        return knots.interpolate(eccentricity, np.ones(len(eccentricity), bool), self.pixels)[:, 0] > _ONE_SIDED

    @cached_property
    def next_to_knots(self) -> Indices:
        """Number (m,), without unit, of the point of the body that the camera sees next to each knot."""
        return np.zeros(0, np.int64) if self.body is None else self.body.nearest(self.knots.neighbourhoods.xy)

    @cached_property
    def on_body(self) -> PredictedPoints:
        """The points on the body, which must be known, prepared for predictions; computed where it turns far."""
        assert self.body is not None
        spacing, reference = max(1, round(_LATTICE * self.radius)), self.reference
        row, column = np.nonzero(reference.mask[::spacing, ::spacing])
        lattice = spacing * np.stack([column, row], axis=1) + reference.origin
        energy = np.stack([slope[::spacing, ::spacing][row, column] ** 2.0 for slope in reference.gradient], axis=1)
        return PredictedPoints(self.body, self.pixels, lattice, energy, self.radius, spacing)

    def contradict(self, values: Pixels, sigma: Floats) -> Mask:
        """Outlying points, whose displacement is far from the quadratic fitted to their neighbours.

        values : (n, 2) px, NaN where unknown. sigma : (n,) px. Returns (n,) bool, False where the displacement is
        unknown.
        """
        near, index = self.knots.neighbourhoods, self.knots.index
        fit = robust_quadratics(near, values[index], sigma[index])
        knot = self.knots.nearest(np.asarray(np.isfinite(fit.value).all(axis=1)), self.pixels, near.window)
        distance = np.hypot(*(values - fit.extrapolate(knot, self.pixels - near.xy[knot])).T)
        distance[knot < 0] = np.nan
        own = np.hypot(*fit.leave_one_out.T)
        distance[index] = np.where(np.isfinite(own), own, distance[index])
        with np.errstate(invalid="ignore"):
            return np.asarray(distance > contradiction_limit(distance))

    def largest_difference(self, mean_square: Floats) -> Floats:
        """Limit of the mean square difference of a good match at each point, from those of its neighbours.

        A point whose subsets differ by far more than those about it is partly covered or worn; next to an obstacle
        only the best of its neighbours are unobstructed, so the lower quartile about its knot is taken. Noise
        contributes equally in weak and in strong texture, so weak texture is not mistaken for a difference.

        mean_square : (n,) grey levels², NaN where unknown. Returns (n,) grey levels², NaN where nothing is known.
        """
        known = np.isfinite(mean_square)
        if not known.any():
            return np.full(len(mean_square), np.nan)
        quartile = self.knots.neighbourhoods.lower_quartile(mean_square[self.knots.index])
        return _UNLIKE * np.fmax(quartile[self.knots.of_points], np.median(mean_square[known]))


def tracked_points(
    reference: Reference, positions: Pixels, settings: CorrelationSettings, body: SeenBody | None = None
) -> TrackedPoints:
    """Prepare points of a reference image for tracking.

    positions : (n, 2) float64, px. body : what the camera sees of the surface.
    """
    pixels, radius = np.rint(positions), settings.radius
    knots = Knots.of(pixels, APART * radius, _REACH * radius, alone=True)
    fine_knots = Knots.of(pixels, _FINE[0] * radius, _FINE[1] * radius)
    least = (reference.grey_range / 255.0) ** 2
    variance = _variance(reference, pixels, radius)
    return TrackedPoints(positions, pixels, variance, least, knots, fine_knots, reference, radius, body)


def thin_to_grid(xy: Pixels, side: float) -> Indices:
    """Choose in every square of a grid the point nearest to its middle.

    xy : (n, 2) px. side : px, of the squares. Returns indices (m,), rising.
    """
    position = (xy - xy.min(axis=0)) / side
    cell = np.floor(position).astype(np.int64)
    label = cell[:, 1] * (int(cell[:, 0].max()) + 1) + cell[:, 0]
    order = np.lexsort((np.hypot(*(position - cell - 0.5).T), label))
    return np.sort(order[np.flatnonzero(np.diff(label[order], prepend=-1))])


def _about(xy: Pixels, index: Indices, side: float) -> tuple[Indices, csr_array]:
    """Find the knot next to each point, and the weights by which values are interpolated from the knots about it.

    xy : (n, 2) px. index : (m,), the knots among the points, one in every square that is not empty. side : px, of the
    squares. Returns (n,) numbers of knots and shares (n, m).
    """
    x, y = np.ascontiguousarray((xy - xy.min(axis=0)).T) / side
    column, row = x.astype(np.int64) + 1, y.astype(np.int64) + 1
    width = int(column.max()) + 2
    cell = row * width + column
    table = np.full(int(cell.max()) + width + 2, len(index))  # the last one stands for none
    table[cell[index]] = np.arange(len(index))
    knot_x, knot_y = np.append(x[index], np.inf), np.append(y[index], np.inf)
    knot = np.stack([table[cell + (j - 1) * width + i - 1] for j, i in np.ndindex(3, 3)], axis=1)
    share = np.maximum(1.0 - np.abs(x[:, None] - knot_x[knot]), 0.0)
    share *= np.maximum(1.0 - np.abs(y[:, None] - knot_y[knot]), 0.0)
    some = share > 0
    begin = np.append(0, np.cumsum(some.sum(axis=1)))
    shares = csr_array((share[some], knot[some], begin), shape=(len(xy), len(index)))
    return knot[np.arange(len(xy)), share.argmax(axis=1)], shares


def robust_quadratics(neighbourhoods: Neighbourhoods, values: Pixels, sigma: Floats) -> QuadraticFit:
    """Fit local quadratics of a field with rejection of outlying points.

    neighbourhoods : of the m points. values : (m, 2) px. sigma : (m,) px.
    """
    agreeing = values
    fit = neighbourhoods.fit(values, sigma)
    for factor in _STRICTER:
        with np.errstate(invalid="ignore"):
            distance = np.hypot(*np.where(np.isfinite(agreeing), fit.leave_one_out, values - fit.value).T)
            contradicting = distance > factor * contradiction_limit(distance)
        if (contradicting == (np.isfinite(values) & ~np.isfinite(agreeing)).any(axis=1)).all():
            continue
        agreeing = np.where(contradicting[:, None], np.nan, values)
        fit = neighbourhoods.fit(agreeing, sigma)
    return replace(fit, leave_one_out=np.where(np.isfinite(agreeing), fit.leave_one_out, values - fit.value))


def contradiction_limit(distance: Floats) -> float:
    """Distance from a quadratic, px, beyond which a point contradicts it.

    distance : (m,) px, of all points from their quadratics, NaN where unknown.
    """
    known = np.isfinite(distance)
    scatter = 1.4826 * float(np.median(distance[known])) if known.any() else 0.0
    return max(_LEAST_OFF, _SCATTERS * scatter)


def _variance(reference: Reference, xy: Pixels, radius: int) -> Floats:
    """Variance of the grey levels in the squares about points, without the pixels that the mask excludes.

    It is taken from every ``thin``-th pixel each way. xy : (n, 2) px. Returns (n,) grey levels².
    """
    thin = max(radius // 8, 1)
    size = (2 * (radius // thin) + 1,) * 2
    inside = reference.mask[::thin, ::thin].astype(np.float32)
    grey = reference.grey[::thin, ::thin].astype(np.float32)
    level = (grey - grey.mean()) * inside
    column, row = np.rint((xy - reference.origin) / thin).astype(np.int64).T
    at = np.minimum(row, inside.shape[0] - 1), np.minimum(column, inside.shape[1] - 1)

    def total(values: NDArray[np.float32]) -> Floats:
        summed = cv2.boxFilter(values, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed[at], dtype=np.float64)

    count = np.maximum(total(inside), 1.0)
    return np.maximum(total(level * level) / count - (total(level) / count) ** 2, 0.0)
