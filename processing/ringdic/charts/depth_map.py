"""Depth of the surface over a lattice of one camera's pixels, from matches with the cameras beside it.

A sweep of slanted planes gives start values at some places; from there the matches grow over the lattice by the local
tangent planes, as the affine warp of a match predicts those around it. Nothing is assumed of the body's shape or place.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ringdic.arrays import Floats, Image, Indices, Mask, Pixels
from ringdic.charts.contrast import contrast
from ringdic.charts.patches import Patches, patches_from_warps, warps_between
from ringdic.charts.plane_sweep import DepthRange, reduced, reduction, sweep_planes
from ringdic.correlation import (
    CorrelationSettings,
    Current,
    Reference,
    correlate_points,
    prepare_current,
    prepare_reference,
    search_warps,
)
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import reprojection_residuals, triangulate
from ringdic.uncertainty.noise import flat_noise

log = logging.getLogger(__name__)

LATTICE_RADII = 1.5  # spacing of the lattice, in subset radii
_SEEDS_APART = (4, 2, 1)  # steps of the lattice from one place of the sweep to the next, first and where few are found
_ENOUGH_SEEDS = 12  # depths from which the others are reached
_MOST_SEEDS = 400  # places of a second or third sweep, which a small image may need
_ZNCC = 0.75  # least ZNCC of a match
_PATIENCE = 12  # iterations of a match at most; the places about it have given it a good start
_OFF_LINE = 1.0  # px, largest distance of a match from its epipolar line
_RADIUS = 10  # px, least radius of a subset in the reduced images
_OVER_EVEN = 1.7  # contrast of a textured place, in units of that of the even parts of the image
_LEAST_CONTRAST = 0.3  # of the strongest: bare skin matches too, but has less
_LIKE_KNOWN = 0.35  # of the slopes at the places with a depth, along the direction in which they are least
_HARDLY = 0.25  # of the textured places; with fewer depths, the pattern may be too fine for reduced images
_SMALL = 1e6  # pixels of the largest image that is tried whole


@dataclass(frozen=True)
class DepthMap:
    """Depth and slant of the surface at n places of a camera's reference image, on a lattice.

    spacing : px, of the lattice. patches : about the places. sigma : (n,) 1/mm, standard deviation of the inverse
    depth. textured : (m, 2) px, all places of the lattice with enough texture. patterned : (m,) bool, those of them
    with a pattern as at the places with a depth, and not an edge alone. grey_noise : variance of the noise of the full
    image, grey levels².
    """

    spacing: int
    patches: Patches
    sigma: Floats
    textured: Pixels
    patterned: Mask
    grey_noise: float


def lattice_places(size: tuple[int, int], spacing: int, margin: int, mask: Mask | None) -> Pixels:
    """All multiples of a spacing that keep a margin from the image's edge and lie in a mask.

    size : (width, height) px. spacing, margin : px. mask : (height, width) bool, or None. Returns (n, 2) float64, px,
    column by column.
    """
    first = -(-margin // spacing) * spacing
    x, y = (np.arange(first, side - margin, spacing) for side in size)
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    if mask is not None:
        xy = xy[mask[xy[:, 1], xy[:, 0]]]
    return xy.astype(np.float64)


@dataclass
class DepthImages:
    """Reference images of all cameras, reduced to the size at which depth is measured; each is reduced once.

    The depths need no finer images, since the points that they lead to are matched in the full ones. cameras : the C
    calibrated cameras of the reduced images. image : function that returns the full image of camera number k, (height,
    width) grey levels. settings : of the correlation of the reduced images. factor : of the reduction. sweep_factor :
    of the further reduction for the sweep.
    """

    cameras: Sequence[Camera]
    image: Callable[[int], Image]
    settings: CorrelationSettings
    factor: int
    sweep_factor: int
    _current: dict[int, Current] = field(default_factory=dict)
    _coarse: dict[int, Current] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        cameras: Sequence[Camera],
        image: Callable[[int], Image],
        settings: CorrelationSettings,
        *,
        whole: bool = False,
    ) -> DepthImages:
        """Reference images of all cameras, to be reduced to a size at which subsets keep a radius of 10 px.

        cameras : of the full images. image : function that returns the full image of camera number k, (height, width)
        grey levels. settings : of the correlation in the full images, lengths in px. whole : whether they are not
        reduced at all, as for a pattern that is as fine as the pixels.
        """
        if whole:
            settings = replace(settings, radius=_RADIUS)
        factor = max(1, round(settings.radius / _RADIUS))
        radius = max(_RADIUS, round(settings.radius / factor))
        spacing = max(1, round(LATTICE_RADII * radius))
        reduced_settings = replace(
            settings, radius=radius, step=spacing, order=1, zncc_min=_ZNCC, max_iterations=_PATIENCE, tolerance=5e-3
        )
        sweep_factor = 1 if whole else reduction(radius)
        return cls([camera.reduced(factor) for camera in cameras], image, reduced_settings, factor, sweep_factor)

    def current(self, k: int) -> Current:
        """Reduced image of camera k as a current image."""
        if k not in self._current:
            self._current[k] = prepare_current(reduced(self.image(k), self.factor), settings=self.settings)
        return self._current[k]

    def coarse(self, k: int) -> Current:
        """Image of camera k reduced further, for the sweep."""
        if k not in self._coarse:
            small = reduced(self.current(k).image, self.sweep_factor)
            self._coarse[k] = prepare_current(small)
        return self._coarse[k]


def depths_at_fitting_size(
    cameras: Sequence[Camera],
    image: Callable[[int], Image],
    settings: CorrelationSettings,
    k: int,
    partners: Sequence[int],
    space: DepthRange,
    mask: Mask | None,
) -> tuple[DepthImages, DepthMap]:
    """Measure the depth over a camera's reference image, reduced, or where hardly anything matches so in whole images.

    cameras : of the full images. image : function that returns the full image of camera number k, (height, width) grey
    levels. settings : of the correlation in the full images, lengths in px. k : the camera's index. partners : indices
    of the cameras that it is matched with, the most similar view first. space : where the surface may be. mask :
    (height, width) bool, where to search; None for everywhere. Returns the images that were used, and the depths.
    """
    images = DepthImages.of(cameras, image, settings)
    depth_map = measure_depths(images, k, partners, space, mask)
    width, height = cameras[k].size
    found = len(depth_map.patches.px)
    if found > _HARDLY * len(depth_map.textured) or width * height > _SMALL:
        return images, depth_map
    whole = DepthImages.of(cameras, image, settings, whole=True)
    finer = measure_depths(whole, k, partners, space, mask)
    if len(finer.patches.px) * finer.spacing**2 > found * depth_map.spacing**2:
        return whole, finer
    return images, depth_map


def measure_depths(
    images: DepthImages, k: int, partners: Sequence[int], space: DepthRange, mask: Mask | None
) -> DepthMap:
    """Measure the depth over a camera's reference image.

    Parameters
    ----------
    images : of all cameras.
    k : the camera's index.
    partners : indices of the cameras that it is matched with, the most similar view first.
    space : where the surface may be.
    mask : (height, width) bool, where to search in the full image; None for everywhere.
    """
    settings, factor = images.settings, images.factor
    grey = images.current(k).image
    if mask is not None:
        mask = mask[factor // 2 :: factor, factor // 2 :: factor][: grey.shape[0], : grey.shape[1]]
    places = lattice_places(images.cameras[k].size, settings.step, settings.radius + 2, mask)
    textured = places[_textured(grey, places, settings.radius, settings.texture_min)]
    search = _DepthSearch(images, k, textured if mask is None else places, space)
    for partner in partners if len(search.places) else ():
        search.match(partner)
    return search.result(textured)


def _textured(grey: Image, places: Pixels, radius: int, least: float) -> Mask:
    """Places (n, 2) px about which an image has texture, (n,) bool.

    The contrast must exceed that of most of the image's even parts, and a share of that of its textured ones.
    """
    if not len(places):
        return np.zeros(0, bool)
    level = contrast(grey, places, radius)
    even, strong = np.percentile(level, [5.0, 95.0])
    return np.asarray(level > max(least, min(_OVER_EVEN * even, _LEAST_CONTRAST * strong)))


def _patterned(grey: Image, textured: Pixels, known: Pixels, radius: int) -> Mask:
    """Which textured places (m, 2) px have grey levels that vary in all directions, as at the known ones (n, 2) px.

    Edges of things that are no specimen vary in one direction only.
    """
    usual = _weakest_slopes(grey, known if len(known) else textured, radius)
    least = _LIKE_KNOWN * (float(np.median(usual)) if len(usual) else 0.0)
    return np.asarray(_weakest_slopes(grey, textured, radius) > least)


def _weakest_slopes(grey: Image, px: Pixels, radius: int) -> Floats:
    """Root mean square of the slopes about pixels (n, 2), along the direction in which it is least, grey levels a px.

    Every third pixel of a square counts.
    """
    beside = np.arange(1 - radius, radius, 3)
    x, y = (np.rint(px[:, i]).astype(np.int64)[:, None, None] for i in (0, 1))
    height, width = grey.shape
    column, row = np.clip(x + beside, 1, width - 2), np.clip(y + beside[:, None], 1, height - 2)
    flat, at = grey.ravel(), row * width + column
    along_x = 0.5 * (flat[at + 1].astype(np.float32) - flat[at - 1])
    along_y = 0.5 * (flat[at + width].astype(np.float32) - flat[at - width])
    xx, xy, yy = (np.mean(a * b, axis=(1, 2)) for a, b in ((along_x,) * 2, (along_x, along_y), (along_y,) * 2))
    return np.sqrt(np.maximum(0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy), 0.0))


def _about(places: Pixels, settings: CorrelationSettings, shape: tuple[int, ...]) -> Mask:
    """Part of an image of a shape (h, w) about the places (n, 2) px, as a box, (h, w) bool."""
    out = np.zeros(shape, bool)
    if len(places):
        left, top = np.maximum(places.min(axis=0).astype(int) - settings.radius, 0)
        right, bottom = places.max(axis=0).astype(int) + settings.radius + 1
        out[top:bottom, left:right] = True
    return out


class _DepthSearch:
    """State of the search of depth at the textured places of a camera's image."""

    def __init__(self, images: DepthImages, k: int, places: Pixels, space: DepthRange) -> None:
        n = len(places)
        self.images, self.k, self.settings = images, k, images.settings
        self.places, self.space = places, space
        self.camera = images.cameras[k]
        self.patches = Patches(places, np.full(n, np.nan), np.full((n, 2), np.nan), np.zeros((n, 3)))
        self.sigma, self.zncc = np.full(n, np.nan), np.full(n, -1.0)

    @cached_property
    def reference(self) -> Reference:
        """The camera's image as a reference image, in the box about the places."""
        grey = self.images.current(self.k).image
        return prepare_reference(grey, _about(self.places, self.settings, grey.shape), self.settings)

    @property
    def known(self) -> Mask:
        """Places whose depth is known, (n,)."""
        return np.isfinite(self.patches.inverse_depth)

    def match(self, partner: int) -> None:
        """Match the places with another camera and take over the depths that are new or better."""
        other = self.images.cameras[partner]
        start = self._start(partner)
        if not np.isfinite(start).all(axis=1).any():
            return
        current = self.images.current(partner)
        matches = correlate_points(self.reference, current, self.places, self.settings, start=start)
        good = np.flatnonzero(matches.good)
        if not len(good):
            return
        px = np.stack([self.places[good], self.places[good] + matches.uv[good]])
        xyz = triangulate([self.camera, other], px)
        off = np.abs(reprojection_residuals([self.camera, other], xyz, px)).max(axis=(0, 2))
        inside = self.space.holds(self.camera, xyz) & self.space.holds(other, xyz) & (off < _OFF_LINE)
        good, xyz = good[inside], xyz[inside]
        patches, travel = patches_from_warps(self.camera, other, self.places[good], xyz, matches.gradient[good])
        sigma = np.hypot(*matches.sigma[good].T) / travel
        log.debug("cameras %s, %s: %d of %d places matched", self.camera.id, other.id, len(good), len(self.places))
        self._store(good, patches, sigma, matches.zncc[good])

    def _store(self, index: Indices, patches: Patches, sigma: Floats, zncc: Floats) -> None:
        """Enter depths at places (k,): new ones, or those with the better ZNCC."""
        better = zncc > self.zncc[index]
        at = index[better]
        self.patches.inverse_depth[at] = patches.inverse_depth[better]
        self.patches.gradient[at] = patches.gradient[better]
        self.sigma[at], self.zncc[at] = sigma[better], zncc[better]

    def _start(self, partner: int) -> Floats:
        """Start values (n, 6) of the matches with another camera: from the depths known so far, and a sweep at some
        of the other places; NaN where there are none.
        """
        images, places = self.images, self.places
        known = np.flatnonzero(self.known)
        other = images.cameras[partner]
        start = np.full((len(places), 6), np.nan)
        patches, reach = self.patches.part(known), 0.5 * self.settings.radius
        start[known] = warps_between(other, patches.px, patches.stencil(self.camera, reach), reach)[:, :6]
        cell = np.rint(places / self.settings.step).astype(np.int64)
        pair = (images.coarse(self.k), images.coarse(partner))
        factor = images.sweep_factor
        untried = ~self.known
        for apart in _SEEDS_APART:
            chosen = np.flatnonzero((cell % apart == 0).all(axis=1) & untried)
            if not len(chosen) or (len(chosen) > _MOST_SEEDS and apart < _SEEDS_APART[0]):
                continue
            untried[chosen] = False
            swept = sweep_planes((self.camera, other), pair, places[chosen], self.space, factor)
            good = chosen[swept.good]
            if len(good):
                start[good] = self._sharpened(partner, places[good], swept.warps[swept.good], factor)
            if np.isfinite(start[:, 0]).sum() >= _ENOUGH_SEEDS:
                break
        return start

    def _sharpened(self, partner: int, px: Pixels, warps: Floats, factor: int) -> Floats:
        """Warps (n, 6) of a sweep moved along their epipolar lines to where the full images agree best."""
        first, second = self.camera, self.images.cameras[partner]
        xyz = triangulate([first, second], np.stack([px, px + warps[:, :2]]))
        ray = xyz - first.centre
        along = second.project(first.centre + 1.001 * ray) - second.project(xyz)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        base = second.project(xyz) - px
        shifts = np.arange(-1.5 * factor, 1.5 * factor + 0.1, 1.0)
        tried = np.repeat(warps[:, None], len(shifts), axis=1)
        tried[..., :2] = base[:, None] + shifts[:, None] * along[:, None]
        best, zncc, _ = search_warps(self.reference, self.images.current(partner), px, tried, self.settings.radius)
        return np.where((zncc > 0.5)[:, None], best, np.nan)

    def result(self, textured: Pixels) -> DepthMap:
        """The depths that were measured. textured : (m, 2) px, places with enough texture."""
        index = np.flatnonzero(self.known)
        patches, factor = self.patches.part(index), self.images.factor
        full = Patches(
            (patches.px + 0.5) * factor - 0.5, patches.inverse_depth, patches.gradient / factor, patches.curvature
        )
        patterned = _patterned(self.images.current(self.k).image, textured, patches.px, self.settings.radius)
        noise, spacing = _grey_noise(self.images.image(self.k)), factor * self.settings.step
        textured = (textured + 0.5) * factor - 0.5
        return DepthMap(spacing, full, self.sigma[index], textured, patterned, noise)


def _grey_noise(grey: Image) -> float:
    """Variance of the noise of an image, grey levels², from its middle, where the body stands."""
    height, width = grey.shape
    return flat_noise(grey[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3])
