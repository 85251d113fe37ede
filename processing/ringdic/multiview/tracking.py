"""Points of one camera through all its images, each image compared with the camera's own reference image.

No image is compared with the one before unless it must be: errors do not add up. Where the surface has changed so
much that a point is not found again from the reference image, the last image that showed it takes the reference's
place, and displacement, gradient and variances are composed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Image, Indices, Mask
from ringdic.correlation import (
    CorrelationSettings,
    Current,
    Reference,
    Status,
    prepare_current,
    prepare_reference,
    search_warps,
)
from ringdic.errors import InputError
from ringdic.multiview.step_matching import ImageMatches, match_tracked_points
from ringdic.multiview.tracked_points import TrackedPoints, tracked_points

log = logging.getLogger(__name__)

_AGREE = 0.5  # px between a point found by way of another image and from the reference itself
_ASKED = 2  # images of earlier steps in which the points lost at a step are sought
_FEW = 2e-3  # share of the points below which those lost are not worth another image
_CHANGED = 0.5  # share of points found below which the image has changed, and start values are sought in it
_SUPPORT = 4.0  # steps about a lost point from which it takes its start value


@dataclass(frozen=True)
class Tracking:
    """How points are followed.

    two_pass : second derivatives of the neighbours' displacement held in a second first-order pass.
    update_reference : lost points are sought from the last image that showed them.
    order : of the subsets in time. window : px, radius of the neighbourhood of the two passes; None: 3 radii.
    """

    two_pass: bool = True
    update_reference: bool = True
    order: int = 1
    window: float | None = None

    def __post_init__(self) -> None:
        if self.order not in (1, 2):
            raise InputError(f"tracking: the order must be 1 or 2, not {self.order}")
        if self.order == 2 and self.two_pass:
            raise InputError("tracking: subsets of second order find their curvature themselves; use one pass")
        if self.window is not None and not self.window > 0:
            raise InputError(f"tracking: the window must be positive, not {self.window}")


@dataclass(frozen=True)
class CameraTrack:
    """n points of one camera at F steps; NaN where status is not 0.

    px : (F, n, 2). sigma : (F, n, 2) px, standard uncertainty of the displacement since the reference, 0 there.
    c_ls : (F, n), 0 at the reference; the largest on the way of a point that came through another image.
    status : (F, n), see ``Status``. updated : (F, n) bool, found by way of another image than the reference.
    """

    px: Floats
    sigma: Floats
    c_ls: Floats
    status: NDArray[np.int8]
    updated: Mask

    @classmethod
    def joined(cls, blocks: Sequence[CameraTrack]) -> CameraTrack:
        """The steps of several tracks of the same points, one after the other."""
        names = [each.name for each in fields(cls)]
        return cls(*(np.concatenate([getattr(block, name) for block in blocks]) for name in names))

    def arrays(self) -> dict[str, NDArray]:
        """All of it by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}


@dataclass(frozen=True)
class TrackState:
    """What a block of steps leaves to the next: the k points inside the reference image where each was seen last.

    warp, before : (k, 12) since the reference and at the step before, NaN if none. sigma : (k, 2). c_ls : (k,).
    last : (k,) the step they belong to. by_way : (k,) step of the image that took the reference's place, or 0.
    moved : () bool, whether any was found in any image.
    """

    warp: Floats
    before: Floats
    sigma: Floats
    c_ls: Floats
    last: Indices
    by_way: Indices
    moved: Mask

    @classmethod
    def at_rest(cls, k: int) -> TrackState:
        """Of k points in the reference image."""
        zero = np.zeros(k, np.int64)
        return cls(
            np.zeros((k, 12)), np.full((k, 12), np.nan), np.zeros((k, 2)), np.zeros(k), zero, zero, np.array(False)
        )

    def arrays(self) -> dict[str, NDArray]:
        """All of it by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}


def track_block(
    reference_image: Image,
    image_of_step: Callable[[int], Image | None],
    steps: range,
    x0: Floats,
    mask: Mask | None,
    settings: CorrelationSettings,
    options: Tracking = Tracking(),
    state: TrackState | None = None,
) -> tuple[CameraTrack, TrackState]:
    """Follow points of one camera from its reference image through some steps, and what the next steps set out from.

    reference_image : (h, w). image_of_step : the image of a step, None where there is none: all points are lost there;
    it may be asked twice, and for earlier steps. x0 : (n, 2) px, anywhere in the reference image, about settings.step
    apart; NaN where the camera does not see the point. mask : (h, w), what belongs to the surface and may be part of a
    subset; by default all within a step of a point. settings.order is that of ``options``. state : what the steps
    before left; None at step 1.
    """
    x0 = np.asarray(x0, dtype=np.float64)
    inside = _inside(x0, reference_image.shape)
    result = _lost(len(steps), x0, inside)
    index = np.flatnonzero(inside)
    state = state or TrackState.at_rest(len(index))
    if not len(index):
        return result, state
    settings = replace(settings, order=options.order)
    points = _Points.of(reference_image, image_of_step, x0[index], mask, settings, options, state)
    for k, step in enumerate(steps):
        found = points.advance(step)
        if found is not None:
            result.px[k, index] = x0[index] + found.warp[:, :2]
            result.sigma[k, index] = found.sigma
            result.c_ls[k, index] = found.c_ls
            result.status[k, index] = found.status
            result.updated[k, index] = found.good & (points.state.by_way > 0)
    return result, points.state


def at_reference(x0: Floats, shape: tuple[int, ...]) -> CameraTrack:
    """The points x0 (n, 2) px in the reference image of this shape, one step."""
    x0 = np.asarray(x0, dtype=np.float64)
    inside = _inside(x0, shape)
    result = _lost(1, x0, inside)
    result.px[0, inside], result.sigma[0, inside] = x0[inside], 0.0
    result.c_ls[0, inside], result.status[0, inside] = 0.0, Status.GOOD
    return result


def _inside(x0: Floats, shape: tuple[int, ...]) -> Mask:
    with np.errstate(invalid="ignore"):
        return np.asarray(((x0 >= 0) & (x0 <= (shape[1] - 1, shape[0] - 1))).all(axis=1))


def _lost(steps: int, x0: Floats, inside: Mask) -> CameraTrack:
    """Every point lost in every step."""
    n = len(x0)
    status = np.full((steps, n), Status.NOT_REACHED, np.int8)
    status[:, np.isfinite(x0).all(axis=1) & ~inside] = Status.OUTSIDE
    px, sigma = np.full((steps, n, 2), np.nan), np.full((steps, n, 2), np.nan)
    return CameraTrack(px, sigma, np.full((steps, n), np.nan), status, np.zeros((steps, n), bool))


def painted(xy: Floats, shape: tuple[int, ...], reach: float) -> Mask:
    """All pixels of an image of this shape within ``reach`` px of one of the points xy (n, 2). (h, w) bool."""
    out = np.zeros(shape[:2], np.uint8)
    at = np.rint(xy).astype(np.int64)
    out[np.clip(at[:, 1], 0, shape[0] - 1), np.clip(at[:, 0], 0, shape[1] - 1)] = 1
    size = 2 * round(reach) + 1
    return np.asarray(cv2.dilate(out, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))).astype(bool)


@dataclass
class _Points:
    """The points of one camera, where each was seen last, and the images they are followed through."""

    reference: Reference
    image_of_step: Callable[[int], Image | None]
    x0: Floats
    places: TrackedPoints
    settings: CorrelationSettings
    options: Tracking
    state: TrackState

    @classmethod
    def of(
        cls, image: Image, image_of_step: Callable[[int], Image | None], x0: Floats, mask: Mask | None,
        settings: CorrelationSettings, options: Tracking, state: TrackState,
    ) -> _Points:  # fmt: skip
        """The points x0 (n, 2) of the reference image, as the steps before left them."""
        region = painted(x0, image.shape, settings.step) if mask is None else mask
        reference = prepare_reference(image, region, settings)
        where = tracked_points(reference, x0, settings, options.window, thin=options.two_pass)
        return cls(reference, image_of_step, x0, where, settings, options, state)

    def advance(self, step: int) -> ImageMatches | None:
        """Find the points in the image of a step and remember those found. None without an image."""
        image = self.image_of_step(step)
        if image is None:
            return None
        if image.shape != self.reference.image.shape:
            raise InputError(
                f"step {step}: the image is {image.shape[1]} x {image.shape[0]} px but that of the reference is "
                f"{self.reference.image.shape[1]} x {self.reference.image.shape[0]} px; capture all steps at one size"
            )
        current = prepare_current(image, None, self.settings)
        found = self._follow(self.reference, current, self.places, self._start(current))
        by_way = np.zeros(len(self.x0), np.int64)
        if self.options.update_reference:
            for s in self._worth_asking(found):
                found = self._through(s, found, current, by_way)
        self._remember(step, found, by_way)
        return found

    def _follow(
        self, reference: Reference, current: Current, points: TrackedPoints, start: Floats | None, search: bool = True
    ) -> ImageMatches:
        return match_tracked_points(
            reference, current, points, start, self.settings, two_pass=self.options.two_pass, search=search
        )

    def _places(self, reference: Reference, at: Floats) -> TrackedPoints:
        return tracked_points(reference, at, self.settings, self.options.window, thin=self.options.two_pass)

    def _start(self, current: Current) -> Floats | None:
        """Start values (n, 12): the motion so far, or that carried on, whichever resembles the image better."""
        state = self.state
        if not state.moved:
            return None
        ahead = 2.0 * state.warp - state.before
        seeds = self.places.seeds
        seeds = seeds[np.isfinite(ahead[seeds]).all(axis=1)]
        if not len(seeds):
            return state.warp
        scores = [self._resemblance(current, seeds, warp) for warp in (state.warp, ahead)]
        return state.warp if scores[0] >= scores[1] else np.where(np.isfinite(ahead), ahead, state.warp)

    def _resemblance(self, current: Current, seeds: Indices, warp: Floats) -> float:
        xy = self.x0[seeds]
        found = search_warps(self.reference, current, np.rint(xy), warp[seeds][:, None, :6], self.settings.radius)
        return float(np.median(found[1]))

    def _worth_asking(self, found: ImageMatches) -> list[int]:
        """The steps whose images showed most of the points lost now, a few at most: each has to be filtered anew."""
        last = self.state.last
        step, count = np.unique(last[~found.good & (last > 0)], return_counts=True)
        order = np.argsort(-count, kind="stable")[:_ASKED]
        return [int(step[k]) for k in order if count[k] >= _FEW * len(self.x0)]

    def _through(self, step: int, found: ImageMatches, current: Current, by_way: Indices) -> ImageMatches:
        """Points lost now that were last seen at ``step``, sought from the image of that step. Fills by_way."""
        image, last, warp = self.image_of_step(step), self.state.last, self.state.warp
        lost = np.flatnonzero(~found.good & (last == step))
        if image is None:
            return found
        held = np.flatnonzero(found.good & (last == step))
        at = self.x0 + warp[:, :2]
        if len(held):
            near, _ = cKDTree(at[lost]).query(at[held], distance_upper_bound=_SUPPORT * self.settings.step)
            held = held[np.isfinite(near)]
        chosen = np.concatenate([lost, held])
        start = np.full((len(chosen), 12), np.nan)
        start[len(lost) :] = _between(warp[held], found.warp[held])
        changed = bool(found.good.mean() < _CHANGED)
        if not len(held) and not changed:  # a place that is hidden or worn, with nothing about it that moves along
            return found
        reference = prepare_reference(image, painted(at[chosen], image.shape, self.settings.step), self.settings)
        points = self._places(reference, at[chosen])
        since = self._follow(reference, current, points, start, search=changed).part(np.arange(len(lost)))
        limit = self.places.most_unlike(found.rest)[lost]
        there = since.good & ~(since.rest > limit)
        log.debug("%d of %d lost points found from the image of step %d", there.sum(), len(lost), step)
        if not there.any():
            return found
        composed = self._composed(lost[there], since.part(there))
        # Perhaps only the start value was wanting: then the reference itself says more, and nothing adds up.
        points = self._places(self.reference, self.x0[lost[there]])
        direct = self._follow(self.reference, current, points, composed.warp, search=False)
        agree = direct.good & ~(direct.rest > limit[there])
        agree &= np.hypot(*(direct.warp - composed.warp)[:, :2].T) < _AGREE
        by_way[lost[there]] = np.where(agree, 0, step)
        return self._accepted(found, lost[there], _placed(composed, np.flatnonzero(agree), direct.part(agree)))

    def _accepted(self, found: ImageMatches, index: Indices, other: ImageMatches) -> ImageMatches:
        """The points found, and the points ``index`` (k,) as others found them where they agree with the rest."""
        both = _placed(found, index, other)
        odd = self.places.contradict(both.warp[:, :2], np.hypot(*both.sigma.T))[index]
        return _placed(found, index[~odd], other.part(~odd))

    def _composed(self, index: Indices, since: ImageMatches) -> ImageMatches:
        """Points ``index`` (k,): their motion until they were last seen, and since."""
        state = self.state
        G = np.eye(2) + since.warp[:, 2:6].reshape(-1, 2, 2)
        warp = np.zeros((len(index), 12))
        warp[:, :2] = state.warp[index, :2] + since.warp[:, :2]
        warp[:, 2:6] = (G @ (np.eye(2) + state.warp[index, 2:6].reshape(-1, 2, 2)) - np.eye(2)).reshape(-1, 4)
        # An error of the position then is carried along by the gradient since.
        variance = np.einsum("nij,nj->ni", G**2, state.sigma[index] ** 2) + since.sigma**2
        return ImageMatches(warp, np.sqrt(variance), np.fmax(state.c_ls[index], since.c_ls), since.rest, since.status)

    def _remember(self, step: int, found: ImageMatches, by_way: Indices) -> None:
        good, state = found.good, self.state
        self.state = TrackState(
            warp=np.where(good[:, None], found.warp, state.warp),
            before=np.where((good & (state.last == step - 1))[:, None], state.warp, np.nan),
            sigma=np.where(good[:, None], found.sigma, state.sigma),
            c_ls=np.where(good, found.c_ls, state.c_ls),
            last=np.where(good, step, state.last),
            by_way=by_way,
            moved=np.array(bool(state.moved) or bool(good.any())),
        )


def _between(first: Floats, second: Floats) -> Floats:
    """The warps (n, 12) from where ``first`` leads to where ``second`` leads, at first's end, of first order."""
    G1 = np.eye(2) + first[:, 2:6].reshape(-1, 2, 2)
    G2 = np.eye(2) + second[:, 2:6].reshape(-1, 2, 2)
    out = np.zeros_like(first)
    out[:, :2] = second[:, :2] - first[:, :2]
    out[:, 2:6] = (G2 @ np.linalg.inv(G1) - np.eye(2)).reshape(-1, 4)
    return out


def _placed(found: ImageMatches, index: Indices, other: ImageMatches) -> ImageMatches:
    """``found`` with the points ``index`` (k,) as in ``other``."""
    arrays = []
    for name in ("warp", "sigma", "c_ls", "rest", "status"):
        values = getattr(found, name).copy()
        values[index] = getattr(other, name)
        arrays.append(values)
    return ImageMatches(*arrays)
