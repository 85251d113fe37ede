"""Tracking of one camera's points through all its images, each compared with the camera's own reference image.

Images are not compared with the one before unless necessary, so errors do not accumulate. Where the surface has changed
so much that a point is not matched from the reference image, the last image in which it was matched serves as
reference, and displacement, gradient and variances are composed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Image, Indices, Mask, Pixels
from ringdic.charts.step_matching import ImageMatches, match_tracked_points
from ringdic.charts.tracked_points import TrackedPoints, tracked_points
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

log = logging.getLogger(__name__)

_AGREE = 0.5  # px, greatest distance between a point matched via another image and directly from the reference
_ASKED = 2  # images of earlier steps from which the points lost at a step are sought
_FEW = 2e-3  # share of the points that must be lost for another image to be filtered
_CHANGED = 0.5  # share of matched points below which the image has changed and is searched for start values
_SUPPORT = 4.0  # steps about a lost point from which it takes its start value


@dataclass(frozen=True)
class Tracking:
    """Settings of the tracking in time.

    two_pass : whether second derivatives of the neighbours' displacement are held fixed in a second, first-order pass.
    update_reference : whether lost points are sought from the last image in which they were matched. order : of the
    subsets, 1 or 2. window : px, radius of the neighbourhood of the two passes; None: 3 subset radii.

    Raises InputError for settings that contradict one another.
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
    """Track of n points of one camera through F steps; NaN where status is not 0.

    px : (F, n, 2) px. sigma : (F, n, 2) px, standard deviation of the displacement since the reference, 0 there.
    c_ls : (F, n), 0 at the reference; for a point matched via other images, the largest of all matches on the way.
    status : (F, n) int. updated : (F, n) bool, matched via an image other than the reference.
    """

    px: Pixels
    sigma: Pixels
    c_ls: Floats
    status: NDArray[np.int8]
    updated: Mask

    @classmethod
    def joined(cls, blocks: Sequence[CameraTrack]) -> CameraTrack:
        """Concatenate tracks of the same points over successive steps."""
        names = [each.name for each in fields(cls)]
        return cls(*(np.concatenate([getattr(block, name) for block in blocks]) for name in names))

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the track, (F, n, ...) px or without unit, by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}


@dataclass(frozen=True)
class TrackState:
    """State at the end of a block of steps: where and when each of k points was last matched.

    Only points inside the reference image are counted. warp : (k, 12), since the reference, in px and its powers.
    before : (k, 12), at the step before that, NaN if lost there. sigma : (k, 2) px. c_ls : (k,). last : (k,) int,
    the step. by_way : (k,) int, step of the image that served as reference, or 0. moved : () bool, whether
    any point was matched in any image.
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
        """State of k points in the reference image."""
        zero = np.zeros(k, np.int64)
        return cls(
            np.zeros((k, 12)), np.full((k, 12), np.nan), np.zeros((k, 2)), np.zeros(k), zero, zero, np.array(False)
        )

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the state, (k, ...) px or without unit, by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}


def track_block(
    reference_image: Image,
    image_of_step: Callable[[int], Image | None],
    steps: range,
    x0: Pixels,
    mask: Mask | None,
    settings: CorrelationSettings,
    options: Tracking = Tracking(),
    state: TrackState | None = None,
) -> tuple[CameraTrack, TrackState]:
    """Track points of one camera from its reference image through a block of steps.

    Parameters
    ----------
    reference_image : (h, w) grey levels.
    image_of_step : function that returns the image of a step, or None, and then all points are lost there. It may be
        called twice for a step, and for earlier steps.
    steps : of the block.
    x0 : (n, 2) float64, px, anywhere in the reference image, about ``settings.step`` apart; NaN where the camera does
        not see the point.
    mask : (h, w) bool, pixels that belong to the surface and may be part of a subset; None: all within a step of a
        point.
    settings : of the correlation; its order is replaced by that of ``options``.
    options : of the tracking.
    state : at the end of the previous block; None before step 1.

    Returns
    -------
    The track through the block, and the state at its end.
    """
    x0 = np.asarray(x0, dtype=np.float64)
    inside = _inside(x0, reference_image.shape)
    result = _lost(len(steps), x0, inside)
    index = np.flatnonzero(inside)
    state = state or TrackState.at_rest(len(index))
    if not len(index):
        return result, state
    settings = replace(settings, order=options.order)
    points = _CameraTracker.of(reference_image, image_of_step, x0[index], mask, settings, options, state)
    for k, step in enumerate(steps):
        matches = points.advance(step)
        if matches is not None:
            result.px[k, index] = x0[index] + matches.warp[:, :2]
            result.sigma[k, index] = matches.sigma
            result.c_ls[k, index] = matches.c_ls
            result.status[k, index] = matches.status
            result.updated[k, index] = matches.good & (points.state.by_way > 0)
    return result, points.state


def at_reference(x0: Pixels, shape: tuple[int, ...]) -> CameraTrack:
    """Track of a single step, the reference, at which the points have no displacement.

    x0 : (n, 2) float64, px. shape : (h, w) of the image.
    """
    x0 = np.asarray(x0, dtype=np.float64)
    inside = _inside(x0, shape)
    result = _lost(1, x0, inside)
    result.px[0, inside], result.sigma[0, inside] = x0[inside], 0.0
    result.c_ls[0, inside], result.status[0, inside] = 0.0, Status.GOOD
    return result


def _inside(x0: Floats, shape: tuple[int, ...]) -> Mask:
    """Points (n,) that lie inside an image of a shape (h, w)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((x0 >= 0) & (x0 <= (shape[1] - 1, shape[0] - 1))).all(axis=1))


def _lost(steps: int, x0: Floats, inside: Mask) -> CameraTrack:
    """Track in which every point is lost at every step."""
    n = len(x0)
    status = np.full((steps, n), Status.NOT_REACHED, np.int8)
    status[:, np.isfinite(x0).all(axis=1) & ~inside] = Status.OUTSIDE
    px, sigma = np.full((steps, n, 2), np.nan), np.full((steps, n, 2), np.nan)
    return CameraTrack(px, sigma, np.full((steps, n), np.nan), status, np.zeros((steps, n), bool))


def mask_about(xy: Pixels, shape: tuple[int, ...], reach: float) -> Mask:
    """Mask of the pixels of an image that lie within ``reach`` px of any of some points.

    xy : (n, 2) px. shape : (h, w). Returns (h, w) bool.
    """
    out = np.zeros(shape[:2], np.uint8)
    at = np.rint(xy).astype(np.int64)
    out[np.clip(at[:, 1], 0, shape[0] - 1), np.clip(at[:, 0], 0, shape[1] - 1)] = 1
    size = 2 * round(reach) + 1
    return np.asarray(cv2.dilate(out, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))).astype(bool)


@dataclass
class _CameraTracker:
    """The points of one camera, the state of their track, and the images that they are tracked through."""

    reference: Reference
    image_of_step: Callable[[int], Image | None]
    x0: Pixels
    points: TrackedPoints
    settings: CorrelationSettings
    options: Tracking
    state: TrackState

    @classmethod
    def of(
        cls, image: Image, image_of_step: Callable[[int], Image | None], x0: Pixels, mask: Mask | None,
        settings: CorrelationSettings, options: Tracking, state: TrackState,
    ) -> _CameraTracker:  # fmt: skip
        """Points x0 (n, 2) px of a reference image, in the state in which the previous block left them."""
        region = mask_about(x0, image.shape, settings.step) if mask is None else mask
        reference = prepare_reference(image, region, settings)
        points = tracked_points(reference, x0, settings, options.window, thin=options.two_pass)
        return cls(reference, image_of_step, x0, points, settings, options, state)

    def advance(self, step: int) -> ImageMatches | None:
        """Match the points in the image of a step and update the state; None without an image."""
        image = self.image_of_step(step)
        if image is None:
            return None
        if image.shape != self.reference.image.shape:
            raise InputError(
                f"step {step}: the image is {image.shape[1]} x {image.shape[0]} px but that of the reference is "
                f"{self.reference.image.shape[1]} x {self.reference.image.shape[0]} px; capture all steps at one size"
            )
        current = prepare_current(image, None, self.settings)
        matches = self._match(self.reference, current, self.points, self._start(current))
        by_way = np.zeros(len(self.x0), np.int64)
        if self.options.update_reference:
            for s in self._steps_to_search(matches):
                matches = self._match_by_way(s, matches, current, by_way)
        self._update_state(step, matches, by_way)
        return matches

    def _match(
        self, reference: Reference, current: Current, points: TrackedPoints, start: Floats | None, search: bool = True
    ) -> ImageMatches:
        """Match points in the current image with the options of this track."""
        return match_tracked_points(
            reference, current, points, start, self.settings, two_pass=self.options.two_pass, search=search
        )

    def _tracked_points(self, reference: Reference, at: Pixels) -> TrackedPoints:
        """Points (n, 2) px of a reference image, prepared for tracking with the options of this track."""
        return tracked_points(reference, at, self.settings, self.options.window, thin=self.options.two_pass)

    def _start(self, current: Current) -> Floats | None:
        """Start values (n, 12): the last warp, or its linear extrapolation, whichever resembles the image better."""
        state = self.state
        if not state.moved:
            return None
        ahead = 2.0 * state.warp - state.before
        seeds = self.points.seeds
        seeds = seeds[np.isfinite(ahead[seeds]).all(axis=1)]
        if not len(seeds):
            return state.warp
        scores = [self._resemblance(current, seeds, warp) for warp in (state.warp, ahead)]
        return state.warp if scores[0] >= scores[1] else np.where(np.isfinite(ahead), ahead, state.warp)

    def _resemblance(self, current: Current, seeds: Indices, warp: Floats) -> float:
        """Median ZNCC of some points (s,) under warps (n, 12)."""
        xy = self.x0[seeds]
        _, zncc, _ = search_warps(self.reference, current, np.rint(xy), warp[seeds][:, None, :6], self.settings.radius)
        return float(np.median(zncc))

    def _steps_to_search(self, matches: ImageMatches) -> list[int]:
        """Steps whose images showed most of the points lost now; a few at most, since each has to be filtered again."""
        last = self.state.last
        step, count = np.unique(last[~matches.good & (last > 0)], return_counts=True)
        order = np.argsort(-count, kind="stable")[:_ASKED]
        return [int(step[k]) for k in order if count[k] >= _FEW * len(self.x0)]

    def _match_by_way(self, step: int, matches: ImageMatches, current: Current, by_way: Indices) -> ImageMatches:
        """Match lost points that were last matched at a step from the image of that step. Fills by_way (n,)."""
        image, last, warp = self.image_of_step(step), self.state.last, self.state.warp
        lost = np.flatnonzero(~matches.good & (last == step))
        if image is None:
            return matches
        steady = np.flatnonzero(matches.good & (last == step))
        at = self.x0 + warp[:, :2]
        if len(steady):
            near, _ = cKDTree(at[lost]).query(at[steady], distance_upper_bound=_SUPPORT * self.settings.step)
            steady = steady[np.isfinite(near)]
        chosen = np.concatenate([lost, steady])
        start = np.full((len(chosen), 12), np.nan)
        start[len(lost) :] = _warps_between(warp[steady], matches.warp[steady])
        changed = bool(matches.good.mean() < _CHANGED)
        if not len(steady) and not changed:  # hidden or worn, with nothing about it that gives a start value
            return matches
        reference = prepare_reference(image, mask_about(at[chosen], image.shape, self.settings.step), self.settings)
        points = self._tracked_points(reference, at[chosen])
        since = self._match(reference, current, points, start, search=changed).part(np.arange(len(lost)))
        limit = self.points.largest_difference(matches.mean_square)[lost]
        accepted = since.good & ~(since.mean_square > limit)
        log.debug("%d of %d lost points matched from the image of step %d", accepted.sum(), len(lost), step)
        if not accepted.any():
            return matches
        composed = self._compose(lost[accepted], since.part(accepted))
        # Perhaps only the start value was missing: a match from the reference itself accumulates no errors.
        points = self._tracked_points(self.reference, self.x0[lost[accepted]])
        direct = self._match(self.reference, current, points, composed.warp, search=False)
        agree = direct.good & ~(direct.mean_square > limit[accepted])
        agree &= np.hypot(*(direct.warp - composed.warp)[:, :2].T) < _AGREE
        by_way[lost[accepted]] = np.where(agree, 0, step)
        return self._accept(matches, lost[accepted], _with_matches(composed, np.flatnonzero(agree), direct.part(agree)))

    def _accept(self, matches: ImageMatches, index: Indices, other: ImageMatches) -> ImageMatches:
        """Matches with the points ``index`` (k,) replaced by others where these agree with their neighbours."""
        both = _with_matches(matches, index, other)
        odd = self.points.contradict(both.warp[:, :2], np.hypot(*both.sigma.T))[index]
        return _with_matches(matches, index[~odd], other.part(~odd))

    def _compose(self, index: Indices, since: ImageMatches) -> ImageMatches:
        """Compose the motion of points ``index`` (k,) until they were last matched with their motion since."""
        state = self.state
        G = np.eye(2) + since.warp[:, 2:6].reshape(-1, 2, 2)
        warp = np.zeros((len(index), 12))
        warp[:, :2] = state.warp[index, :2] + since.warp[:, :2]
        warp[:, 2:6] = (G @ (np.eye(2) + state.warp[index, 2:6].reshape(-1, 2, 2)) - np.eye(2)).reshape(-1, 4)
        # The gradient since then carries along the error of the earlier position.
        variance = np.einsum("nij,nj->ni", G**2, state.sigma[index] ** 2) + since.sigma**2
        return ImageMatches(
            warp, np.sqrt(variance), np.fmax(state.c_ls[index], since.c_ls), since.mean_square, since.status
        )

    def _update_state(self, step: int, matches: ImageMatches, by_way: Indices) -> None:
        """Update the state by the matches of a step."""
        good, state = matches.good, self.state
        self.state = TrackState(
            warp=np.where(good[:, None], matches.warp, state.warp),
            before=np.where((good & (state.last == step - 1))[:, None], state.warp, np.nan),
            sigma=np.where(good[:, None], matches.sigma, state.sigma),
            c_ls=np.where(good, matches.c_ls, state.c_ls),
            last=np.where(good, step, state.last),
            by_way=by_way,
            moved=np.array(bool(state.moved) or bool(good.any())),
        )


def _warps_between(first: Floats, second: Floats) -> Floats:
    """First-order warps (n, 12) from the ends of the warps ``first`` to the ends of the warps ``second``."""
    G1 = np.eye(2) + first[:, 2:6].reshape(-1, 2, 2)
    G2 = np.eye(2) + second[:, 2:6].reshape(-1, 2, 2)
    out = np.zeros_like(first)
    out[:, :2] = second[:, :2] - first[:, :2]
    out[:, 2:6] = (G2 @ np.linalg.inv(G1) - np.eye(2)).reshape(-1, 4)
    return out


def _with_matches(matches: ImageMatches, index: Indices, other: ImageMatches) -> ImageMatches:
    """Matches with the points ``index`` (k,) replaced by those of other matches."""
    arrays = []
    for name in ("warp", "sigma", "c_ls", "mean_square", "status"):
        values = getattr(matches, name).copy()
        values[index] = getattr(other, name)
        arrays.append(values)
    return ImageMatches(*arrays)
