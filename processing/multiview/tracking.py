"""Points of one camera through all its images, each image compared with the camera's own reference image.

No image is compared with the one before unless it must be: errors do not add up. Where the surface has changed so
much that a point is not found again from the reference image, the last image that showed it takes the reference's
place, and displacement, gradient and variances are composed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.correlation import (
    CorrelationSettings,
    Current,
    Reference,
    Status,
    prepare_current,
    prepare_reference,
    search_hypotheses,
)
from processing.correlation.quadratic import Neighbourhoods
from processing.correlation.seeds import spread
from processing.errors import InputError
from processing.multiview.following import Followed, contradicts, follow, most_unlike, neighbourhoods

Array = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.uint16]
Mask = NDArray[np.bool_]

log = logging.getLogger(__name__)

_MARGIN = 100  # px about the predicted positions in which a current image is prepared
_AGREE = 0.5  # px between a point found by way of another image and from the reference itself
_SUPPORT = 4.0  # steps about a lost point from which it takes its start value


@dataclass(frozen=True)
class Tracking:
    """How points are followed.

    two_pass : second derivatives of the neighbours' displacement held in a second first-order pass.
    update_reference : lost points are sought from the last image that showed them.
    order : of the subsets in time. window : px, radius of the neighbourhood of the two passes; None: 2.5 radii.
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
class Track:
    """n points of one camera at F steps, the reference included; NaN where status is not 0.

    px : (F, n, 2). sigma : (F, n, 2) px, standard uncertainty of the displacement since the reference, 0 there.
    c_ls : (F, n), 0 at the reference; the largest on the way of a point that came through another image.
    status : (F, n), see ``Status``. updated : (F, n) bool, found by way of another image than the reference.
    """

    px: Array
    sigma: Array
    c_ls: Array
    status: NDArray[np.int8]
    updated: Mask


def track(
    reference_image: Image,
    image_of_step: Callable[[int], Image | None],
    steps: int,
    x0: Array,
    mask: Mask | None,
    settings: CorrelationSettings,
    options: Tracking = Tracking(),
    progress: Callable[[float], None] = lambda _: None,
) -> Track:
    """Follow points of one camera from its reference image, step 0, through the images of steps 1 … steps - 1.

    reference_image : (h, w). image_of_step : the image of a step, None where there is none: all points are lost there;
    it may be asked twice. x0 : (n, 2) px, anywhere in the reference image, about settings.step apart; NaN where the
    camera does not see the point. mask : (h, w), what belongs to the surface and may be part of a subset; by default
    all within a step of a point. settings.order is that of ``options``.
    """
    x0 = np.asarray(x0, dtype=np.float64)
    height, width = reference_image.shape[:2]
    with np.errstate(invalid="ignore"):
        inside: Mask = np.asarray(((x0 >= 0) & (x0 <= (width - 1, height - 1))).all(axis=1))
    result = _empty(steps, x0, inside)
    index = np.flatnonzero(inside)
    if not len(index):
        return result
    settings = replace(settings, order=options.order)
    points = _Points.at_rest(reference_image, image_of_step, x0[index], mask, settings, options)
    for step in range(1, steps):
        found = points.advance(step)
        if found is not None:
            result.px[step, index] = x0[index] + found.warp[:, :2]
            result.sigma[step, index] = found.sigma
            result.c_ls[step, index] = found.c_ls
            result.status[step, index] = found.status
            result.updated[step, index] = found.good & (points.by_way > 0)
        progress(step / max(steps - 1, 1))
    return result


def _empty(steps: int, x0: Array, inside: Mask) -> Track:
    """Every point at rest in step 0 and lost in all others."""
    n = len(x0)
    px, sigma = np.full((steps, n, 2), np.nan), np.full((steps, n, 2), np.nan)
    c_ls = np.full((steps, n), np.nan)
    status = np.full((steps, n), Status.NOT_REACHED, np.int8)
    status[:, np.isfinite(x0).all(axis=1) & ~inside] = Status.OUTSIDE
    px[0, inside], sigma[0, inside], c_ls[0, inside], status[0, inside] = x0[inside], 0.0, 0.0, Status.GOOD
    return Track(px, sigma, c_ls, status, np.zeros((steps, n), bool))


def painted(xy: Array, shape: tuple[int, ...], reach: float) -> Mask:
    """All pixels of an image of this shape within ``reach`` px of one of the points xy (n, 2). (h, w) bool."""
    out = np.zeros(shape[:2], np.uint8)
    at = np.rint(xy).astype(np.int64)
    out[np.clip(at[:, 1], 0, shape[0] - 1), np.clip(at[:, 0], 0, shape[1] - 1)] = 1
    size = 2 * round(reach) + 1
    return np.asarray(cv2.dilate(out, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))).astype(bool)


@dataclass
class _Points:
    """The n points of one camera where each was seen last.

    warp (n, 12), sigma (n, 2) and c_ls (n,) : since the reference. last : (n,) the step they belong to. before :
    (n, 12) of the step before it, NaN if none. by_way : (n,) step of the image that took the reference's place, or 0.
    """

    reference: Reference
    image_of_step: Callable[[int], Image | None]
    x0: Array
    warp: Array
    before: Array
    sigma: Array
    c_ls: Array
    last: NDArray[np.int64]
    by_way: NDArray[np.int64]
    settings: CorrelationSettings
    options: Tracking
    around: Neighbourhoods = field(init=False)
    moved: bool = field(default=False)

    def __post_init__(self) -> None:
        self.around = neighbourhoods(self.x0, self.settings, self.options.window)

    @classmethod
    def at_rest(
        cls, image: Image, image_of_step: Callable[[int], Image | None], x0: Array, mask: Mask | None,
        settings: CorrelationSettings, options: Tracking,
    ) -> _Points:  # fmt: skip
        """The points in the reference image."""
        n = len(x0)
        region = painted(x0, image.shape, settings.step) if mask is None else mask
        reference = prepare_reference(image, region, settings)
        zero = np.zeros(n, np.int64)
        return cls(
            reference, image_of_step, x0, np.zeros((n, 12)), np.full((n, 12), np.nan), np.zeros((n, 2)), np.zeros(n),
            zero, zero.copy(), settings, options,
        )  # fmt: skip

    def advance(self, step: int) -> Followed | None:
        """Find the points in the image of a step and remember those found. None without an image."""
        image = self.image_of_step(step)
        if image is None:
            return None
        if image.shape != self.reference.image.shape:
            raise InputError(
                f"step {step}: the image is {image.shape[1]} x {image.shape[0]} px but that of the reference is "
                f"{self.reference.image.shape[1]} x {self.reference.image.shape[0]} px; capture all steps at one size"
            )
        current = prepare_current(image, self._box(), self.settings)
        found = self._follow(self.reference, current, self.x0, self._start(current))
        if (found.status == Status.OUTSIDE).any():  # of the box, or of the image
            current = prepare_current(image, None, self.settings)
            again = self._follow(self.reference, current, self.x0, self._start(current))
            found = again if again.good.sum() >= found.good.sum() else found
        by_way = np.zeros(len(self.x0), np.int64)
        if self.options.update_reference:
            for s in np.unique(self.last[~found.good & (self.last > 0)]):
                found = self._through(int(s), found, current, by_way)
        self._remember(step, found, by_way)
        return found

    def _follow(
        self, reference: Reference, current: Current, at: Array, start: Array | None, search: bool = True
    ) -> Followed:
        around = self.around if at is self.x0 else neighbourhoods(at, self.settings, self.options.window)
        two_pass = self.options.two_pass
        return follow(reference, current, at, start, self.settings, around=around, two_pass=two_pass, search=search)

    def _box(self) -> tuple[int, int, int, int] | None:
        """Where the points may be now: about where they were, or anywhere."""
        if not self.moved:
            return None
        at = self.x0 + self.warp[:, :2]
        margin = self.settings.radius + _MARGIN
        low, high = np.floor(at.min(axis=0) - margin), np.ceil(at.max(axis=0) + margin)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def _start(self, current: Current) -> Array | None:
        """Start values (n, 12): the motion so far, or that carried on, whichever resembles the image better."""
        if not self.moved:
            return None
        ahead = 2.0 * self.warp - self.before
        seeds = spread(self.x0)
        seeds = seeds[np.isfinite(ahead[seeds]).all(axis=1)]
        if not len(seeds):
            return self.warp
        scores = [self._resemblance(current, seeds, warp) for warp in (self.warp, ahead)]
        return self.warp if scores[0] >= scores[1] else np.where(np.isfinite(ahead), ahead, self.warp)

    def _resemblance(self, current: Current, seeds: NDArray[np.int64], warp: Array) -> float:
        xy = self.x0[seeds]
        found = search_hypotheses(self.reference, current, np.rint(xy), warp[seeds][:, None, :6], self.settings.radius)
        return float(np.median(found[1]))

    def _through(self, step: int, found: Followed, current: Current, by_way: NDArray[np.int64]) -> Followed:
        """Points lost now that were last seen at ``step``, sought from the image of that step. Fills by_way."""
        image = self.image_of_step(step)
        lost = np.flatnonzero(~found.good & (self.last == step))
        if image is None:
            return found
        held = np.flatnonzero(found.good & (self.last == step))
        at = self.x0 + self.warp[:, :2]
        if len(held):
            near, _ = cKDTree(at[lost]).query(at[held], distance_upper_bound=_SUPPORT * self.settings.step)
            held = held[np.isfinite(near)]
        chosen = np.concatenate([lost, held])
        start = None
        if len(held):
            start = np.full((len(chosen), 12), np.nan)
            start[len(lost) :] = _between(self.warp[held], found.warp[held])
        reference = prepare_reference(image, painted(at[chosen], image.shape, self.settings.step), self.settings)
        since = self._follow(reference, current, at[chosen], start).part(np.arange(len(lost)))
        limit = most_unlike(found.rest, self.around)[lost]
        there = since.good & ~(since.rest > limit)
        log.debug("%d of %d lost points found from the image of step %d", there.sum(), len(lost), step)
        if not there.any():
            return found
        composed = self._composed(lost[there], since.part(there))
        # Perhaps only the start value was wanting: then the reference itself says more, and nothing adds up.
        direct = self._follow(self.reference, current, self.x0[lost[there]], composed.warp, search=False)
        agree = direct.good & ~(direct.rest > limit[there])
        agree &= np.hypot(*(direct.warp - composed.warp)[:, :2].T) < _AGREE
        by_way[lost[there]] = np.where(agree, 0, step)
        return self._accepted(found, lost[there], _placed(composed, np.flatnonzero(agree), direct.part(agree)))

    def _accepted(self, found: Followed, index: NDArray[np.int64], other: Followed) -> Followed:
        """The points found, and the points ``index`` (k,) as others found them where they agree with the rest."""
        both = _placed(found, index, other)
        odd = contradicts(self.around.fit(both.warp[:, :2], np.hypot(*both.sigma.T)))[index]
        return _placed(found, index[~odd], other.part(~odd))

    def _composed(self, index: NDArray[np.int64], since: Followed) -> Followed:
        """Points ``index`` (k,): their motion until they were last seen, and since."""
        G = np.eye(2) + since.warp[:, 2:6].reshape(-1, 2, 2)
        warp = np.zeros((len(index), 12))
        warp[:, :2] = self.warp[index, :2] + since.warp[:, :2]
        warp[:, 2:6] = (G @ (np.eye(2) + self.warp[index, 2:6].reshape(-1, 2, 2)) - np.eye(2)).reshape(-1, 4)
        # An error of the position then is carried along by the gradient since.
        variance = np.einsum("nij,nj->ni", G**2, self.sigma[index] ** 2) + since.sigma**2
        return Followed(warp, np.sqrt(variance), np.fmax(self.c_ls[index], since.c_ls), since.rest, since.status)

    def _remember(self, step: int, found: Followed, by_way: NDArray[np.int64]) -> None:
        good = found.good
        self.before = np.where((good & (self.last == step - 1))[:, None], self.warp, np.nan)
        self.warp = np.where(good[:, None], found.warp, self.warp)
        self.sigma = np.where(good[:, None], found.sigma, self.sigma)
        self.c_ls = np.where(good, found.c_ls, self.c_ls)
        self.last = np.where(good, step, self.last)
        self.by_way = by_way
        self.moved = self.moved or bool(good.any())


def _between(first: Array, second: Array) -> Array:
    """The warps (n, 12) from where ``first`` leads to where ``second`` leads, at first's end, of first order."""
    G1 = np.eye(2) + first[:, 2:6].reshape(-1, 2, 2)
    G2 = np.eye(2) + second[:, 2:6].reshape(-1, 2, 2)
    out = np.zeros_like(first)
    out[:, :2] = second[:, :2] - first[:, :2]
    out[:, 2:6] = (G2 @ np.linalg.inv(G1) - np.eye(2)).reshape(-1, 4)
    return out


def _placed(found: Followed, index: NDArray[np.int64], other: Followed) -> Followed:
    """``found`` with the points ``index`` (k,) as in ``other``."""
    arrays = []
    for name in ("warp", "sigma", "c_ls", "rest", "status"):
        values = getattr(found, name).copy()
        values[index] = getattr(other, name)
        arrays.append(values)
    return Followed(*arrays)
