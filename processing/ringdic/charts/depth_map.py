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
from ringdic.charts.patches import Patches, patches_from_warps
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
from ringdic.sweep.region import contrast
from ringdic.uncertainty.noise import flat_noise

log = logging.getLogger(__name__)

LATTICE_RADII = 1.5  # spacing of the lattice, in subset radii
_SEEDS_APART = 3  # steps of the lattice from one place of the sweep to the next
_ZNCC = 0.75  # least ZNCC of a match
_PATIENCE = 12  # iterations of a match at most; the places about it have given it a good start
_OFF_LINE = 1.0  # px, largest distance of a match from its epipolar line
_RADIUS = 10  # px, least radius of a subset in the reduced images
_OVER_EVEN = 1.7  # contrast of a textured place, in units of that of the even parts of the image
_LEAST_CONTRAST = 0.3  # of the strongest: bare skin matches too, but has less
_FEWEST = 4  # places of the smallest group that remains


@dataclass(frozen=True)
class DepthMap:
    """Depth and slant of the surface at n places of a camera's reference image, on a lattice.

    camera : its id. spacing : px, of the lattice. patches : about the places. sigma : (n,) 1/mm, standard deviation of
    the inverse depth. zncc : (n,), of the match. textured : (m, 2) px, all places of the lattice with enough texture.
    grey_noise : variance of the noise of the full image, grey levels².
    """

    camera: str
    spacing: int
    patches: Patches
    sigma: Floats
    zncc: Floats
    textured: Pixels
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
    width) grey levels. settings : of the correlation of the reduced images. factor : of the reduction.
    """

    cameras: Sequence[Camera]
    image: Callable[[int], Image]
    settings: CorrelationSettings
    factor: int
    _current: dict[int, Current] = field(default_factory=dict)
    _coarse: dict[int, Current] = field(default_factory=dict)

    @classmethod
    def of(cls, cameras: Sequence[Camera], image: Callable[[int], Image], settings: CorrelationSettings) -> DepthImages:
        """Reference images of all cameras, to be reduced to a size at which subsets keep a radius of 10 px.

        cameras : of the full images. image : function that returns the full image of camera number k, (height, width)
        grey levels. settings : of the correlation in the full images, lengths in px.
        """
        factor = max(1, round(settings.radius / _RADIUS))
        radius = max(_RADIUS, round(settings.radius / factor))
        spacing = max(1, round(LATTICE_RADII * radius))
        reduced_settings = replace(
            settings, radius=radius, step=spacing, order=1, zncc_min=_ZNCC, max_iterations=_PATIENCE, tolerance=5e-3
        )
        return cls([camera.reduced(factor) for camera in cameras], image, reduced_settings, factor)

    def current(self, k: int) -> Current:
        """Reduced image of camera k as a current image."""
        if k not in self._current:
            self._current[k] = prepare_current(reduced(self.image(k), self.factor), settings=self.settings)
        return self._current[k]

    def coarse(self, k: int) -> Current:
        """Image of camera k reduced further, for the sweep."""
        if k not in self._coarse:
            small = reduced(self.current(k).image, reduction(self.settings.radius))
            self._coarse[k] = prepare_current(small)
        return self._coarse[k]


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
    textured = _textured(grey, places, settings.radius, settings.texture_min)
    if mask is None:
        places = places[textured]
    search = _DepthSearch(images, k, places, space)
    for partner in partners if len(places) else ():
        search.match(partner)
    return search.result()


def _textured(grey: Image, places: Pixels, radius: int, least: float) -> Mask:
    """Places (n, 2) px about which an image has texture, (n,) bool.

    The contrast must exceed that of most of the image's even parts, and a share of that of its textured ones.
    """
    if not len(places):
        return np.zeros(0, bool)
    level = contrast(grey, places, radius)
    even, strong = np.percentile(level, [5.0, 95.0])
    return np.asarray(level > max(least, min(_OVER_EVEN * even, _LEAST_CONTRAST * strong)))


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
        """Start values (n, 6) of the matches with another camera from a sweep, NaN where there are none."""
        images, spacing = self.images, self.settings.step
        cell = np.rint(self.places / spacing).astype(np.int64)
        chosen = np.flatnonzero((cell % _SEEDS_APART == 0).all(axis=1))
        start = np.full((len(self.places), 6), np.nan)
        if not len(chosen):
            return start
        cameras = (self.camera, images.cameras[partner])
        pair = (images.coarse(self.k), images.coarse(partner))
        factor = reduction(self.settings.radius)
        swept = sweep_planes(cameras, pair, self.places[chosen], self.space, factor)
        good = np.flatnonzero(swept.good)
        if len(good):
            start[chosen[good]] = self._sharpened(cameras, self.places[chosen[good]], swept.warps[good], factor)
        return start

    def _sharpened(self, cameras: tuple[Camera, Camera], px: Pixels, warps: Floats, factor: int) -> Floats:
        """Warps (n, 6) of a sweep moved along their epipolar lines to where the full images agree best."""
        first, second = cameras
        xyz = triangulate([first, second], np.stack([px, px + warps[:, :2]]))
        ray = xyz - first.centre
        along = second.project(first.centre + 1.001 * ray) - second.project(xyz)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        base = second.project(xyz) - px
        shifts = np.arange(-1.5 * factor, 1.5 * factor + 0.1, 1.0)
        tried = np.repeat(warps[:, None], len(shifts), axis=1)
        tried[..., :2] = base[:, None] + shifts[:, None] * along[:, None]
        best, zncc, _ = search_warps(
            self.reference, self.images.current(self.images.cameras.index(second)), px, tried, self.settings.radius
        )
        return np.where((zncc > 0.5)[:, None], best, np.nan)

    def result(self) -> DepthMap:
        """The depths that were measured."""
        index = np.flatnonzero(self.known)
        patches, factor = self.patches.part(index), self.images.factor
        full = Patches(
            (patches.px + 0.5) * factor - 0.5, patches.inverse_depth, patches.gradient / factor, patches.curvature
        )
        places = (self.places + 0.5) * factor - 0.5
        noise = _grey_noise(self.images.image(self.k))
        spacing = factor * self.settings.step
        return DepthMap(self.camera.id, spacing, full, self.sigma[index], self.zncc[index], places, noise)


def _grey_noise(grey: Image) -> float:
    """Variance of the noise of an image, grey levels², from its middle, where the body stands."""
    height, width = grey.shape
    return flat_noise(grey[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4])
