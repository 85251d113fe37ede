"""Matching of surface nodes from their reference camera to other cameras, with start values from the fitted surface."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Indices, Mask, Pixels
from ringdic.charts.patches import warps_between
from ringdic.correlation import (
    CorrelationSettings,
    Current,
    PointMatches,
    Reference,
    Status,
    correlate_independently,
    prepare_current,
    prepare_reference,
)
from ringdic.correlation.prepared import Box
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.multiview.lattice import Pieces
from ringdic.multiview.warps import surface_stencil
from ringdic.uncertainty.matches import match_uncertainty
from ringdic.uncertainty.noise import flat_noise
from ringdic.uncertainty.texture import Texture, TextureMap, texture_map

_CACHED = 16  # filtered images in memory at a time, of each the part with the surface
_MARGIN = 48.0  # px about the subsets in which an image is filtered
_DIFFERENCE = 0.6  # subset radii over which the warp's central differences are taken
_LOOSE = 5e-3  # px, tolerance of subsets of second order
_PATIENCE = 25  # iterations at most; steep and small subsets take some ten


@dataclass
class ReferenceImages:
    """The reference images of all cameras, with B-spline coefficients and texture where the surface is searched for.

    cameras : C calibrated cameras. image : function that returns the image of a camera id, (height, width) grey levels,
    or None where there is none. masks : (height, width) bool, regions drawn by the user, by camera id. settings : of
    the correlation.
    """

    cameras: Sequence[Camera]
    image: Callable[[str], Image | None]
    masks: Mapping[str, Mask]
    settings: CorrelationSettings
    _filtered: OrderedDict[int, Current] = field(default_factory=OrderedDict)
    _boxes: dict[int, Box] = field(default_factory=dict)
    _textures: dict[int, TextureMap] = field(default_factory=dict)
    _noise: dict[int, float] = field(default_factory=dict)

    def grey(self, k: int) -> Image:
        """Image of camera number k, (height, width) grey levels. Raises ComputationError where it has none."""
        matches = self.image(self.cameras[k].id)
        if matches is None:
            raise ComputationError(f"camera {self.cameras[k].id}: the reference capture lacks an image")
        return matches

    def current(self, k: int) -> Current:
        """Image of camera k as a current image, filtered about the pixels of ``look_at``; recent ones are cached."""
        if k not in self._filtered:
            while len(self._filtered) >= _CACHED:
                self._filtered.popitem(last=False)
            self._filtered[k] = prepare_current(self.grey(k), self._boxes.get(k), self.settings)
        self._filtered.move_to_end(k)
        return self._filtered[k]

    def look_at(self, k: int, px: Pixels) -> None:
        """Restrict later matching in the image of camera number k to the surroundings of px (n, 2) px."""
        box = self._boxes.get(k)
        edge = np.array(self.cameras[k].size)
        low, high = (np.clip(values, 0, edge) for values in (px.min(axis=0), px.max(axis=0)))
        if box is not None and (low >= box[:2]).all() and (high <= box[2:]).all():
            return
        margin = 2.0 * self.settings.radius + _MARGIN
        low, high = np.maximum(np.floor(low - margin), 0), np.minimum(np.ceil(high + margin), edge)
        self._boxes[k] = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        self._filtered.pop(k, None)

    def texture(self, k: int, px: Pixels) -> Texture:
        """Texture of the image of camera number k about px (n, 2) px."""
        if k not in self._textures:
            self._textures[k] = texture_map(self.grey(k), self.settings.radius)
        return self._textures[k].at(px)

    def noise(self, k: int) -> float:
        """Variance of camera number k's noise, grey levels², from the middle of its image, where the body stands."""
        if k not in self._noise:
            grey = self.grey(k)
            height, width = grey.shape
            self._noise[k] = flat_noise(grey[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4])
        return self._noise[k]

    def reference(self, k: int, px: Pixels) -> Reference:
        """Image of camera number k, filtered as a reference image about px (n, 2) px."""
        grey = self.grey(k)
        mask = np.zeros(grey.shape, bool)
        margin = self.settings.radius + 2
        left, top = np.maximum(px.min(axis=0) - margin, 0).astype(int)
        right, bottom = (px.max(axis=0) + margin + 1).astype(int)
        mask[top:bottom, left:right] = True
        drawn = self.masks.get(self.cameras[k].id)
        return prepare_reference(grey, mask if drawn is None else mask & drawn, self.settings)


@dataclass(frozen=True)
class NodeMatches:
    """Matches of n nodes in C cameras.

    px : (C, n, 2) px, NaN where a camera has none; in the reference camera of a node a whole pixel. noise, systematic :
    (C, n, 2) px, standard deviations due to the noise of each image alone and due to other causes, also of the
    reference camera. c_ls : (C, n). status : (n,), 0 for a node with two views or more, else the reason. count : number
    of matches that were computed.
    """

    px: Pixels
    noise: Pixels
    systematic: Pixels
    c_ls: Floats
    status: NDArray[np.int8]
    count: int


def match_nodes(
    images: ReferenceImages,
    pieces: Pieces,
    nodes: tuple[Indices, Indices],
    reference: Indices,
    partners: Mask,
    *,
    order: int,
    curved: bool = True,
) -> NodeMatches:
    """Match nodes of the surface from the image of their reference camera in the images of partner cameras.

    Parameters
    ----------
    images : of all C cameras.
    pieces : the surface, from which start values are computed.
    nodes : columns (n,) int and rows (n,) int.
    reference : (n,) int, index of the camera that each node is matched from.
    partners : (C, n) bool, cameras that each node is matched in.
    order : of the subsets, 1 or 2.
    curved : whether second derivatives are taken from the shape, as start values of the second order and as fixed
        values of the first; otherwise they are zero.
    """
    settings = _of_order(images.settings, order)
    count, n = len(images.cameras), len(reference)
    px = np.full((count, n, 2), np.nan)
    parts = _Parts(np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan), np.zeros(n))
    c_ls, status = np.full((count, n), np.nan), np.full(n, Status.NOT_REACHED, np.int8)
    computed = 0
    xyz = pieces.xyz[nodes]
    theta, z = (coordinate[nodes] for coordinate in pieces.lattice.coordinates)
    reach = max(2.0, _DIFFERENCE * settings.radius)
    jobs = [(a, b) for a in range(count) for b in range(count) if (partners[b] & (reference == a)).any()]
    own = np.empty(0, np.int64)
    previous = -1
    for a, b in jobs:
        if a != previous:
            own, previous = np.flatnonzero(reference == a), a
            at = np.rint(images.cameras[a].project(xyz[own]))
            stencil = surface_stencil(
                pieces.lattice, pieces.coefficients[nodes][own], theta[own], z[own], images.cameras[a], at, reach
            )
            filtered = images.reference(a, at)
            px[a, own], c_ls[a, own] = at, 0.0
        start = warps_between(images.cameras[b], at, stencil, reach)
        if not curved:
            start[:, 6:] = 0.0
        chosen = np.flatnonzero(partners[b, own] & np.isfinite(start).all(axis=1))
        if not len(chosen):
            continue
        matches = correlate_independently(filtered, images.current(b), at[chosen], settings, start[chosen])
        computed += len(chosen)
        matched = own[chosen]
        px[b, matched], c_ls[b, matched] = at[chosen] + matches.uv, matches.c_ls
        parts.add(images, (a, b), matches, matched)
        status[matched] = np.where(status[matched] == Status.GOOD, Status.GOOD, matches.status)
    px[:, status != Status.GOOD] = np.nan
    return NodeMatches(px, np.sqrt(parts.noise), np.sqrt(parts.systematic), c_ls, status, computed)


@dataclass(frozen=True)
class _Parts:
    """Variances of the matches by cause, and the number of matches of each node.

    noise, systematic : (C, n, 2) px², due to noise and to other causes. matches : (n,).
    """

    noise: Floats
    systematic: Floats
    matches: Floats

    def add(self, images: ReferenceImages, cameras: tuple[int, int], matches: PointMatches, nodes: Indices) -> None:
        """Add the variances of the matches of some nodes (k,) from the first of two cameras to the second.

        The variance in the first camera is the mean over the matches from it. Half of what is not noise is ascribed
        to either image.
        """
        a, b = cameras
        textures = images.texture(a, matches.xy), images.texture(b, matches.xy + matches.uv)
        parts = match_uncertainty(
            matches.sigma, matches.c_ls, textures, (images.noise(a), images.noise(b)), matches.gradient
        )
        self.noise[b, nodes], self.systematic[b, nodes] = parts.current**2, parts.systematic**2 / 2
        known = np.isfinite(parts.current).all(axis=1) & np.isfinite(parts.reference_systematic).all(axis=1)
        nodes = nodes[known]
        share = 1.0 / (self.matches[nodes] + 1.0)[:, None]
        for total, added in ((self.noise, parts.reference), (self.systematic, parts.reference_systematic / np.sqrt(2))):
            before = np.nan_to_num(total[a, nodes])
            total[a, nodes] = before + share * (added[known] ** 2 - before)
        self.matches[nodes] += 1


def _of_order(settings: CorrelationSettings, order: int) -> CorrelationSettings:
    """Correlation settings with another order of the shape functions.

    Those of second order serve the smooth pieces alone and need not converge to the last digit.
    """
    iterations = min(settings.max_iterations, _PATIENCE)
    tolerance = settings.tolerance if order == 1 or settings.order == 2 else max(settings.tolerance, _LOOSE)
    return replace(settings, order=order, max_iterations=iterations, tolerance=tolerance)
