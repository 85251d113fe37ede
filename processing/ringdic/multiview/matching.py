"""Nodes of the surface matched from the camera that faces them to the others, with start values from the shape."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Indices, Mask
from ringdic.correlation import (
    Correlation,
    CorrelationSettings,
    Current,
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
from ringdic.multiview.warps import surface_stencil, warps_to
from ringdic.uncertainty.matches import match_parts
from ringdic.uncertainty.noise import flat_noise
from ringdic.uncertainty.texture import Texture, TextureMap, texture_map

_KEPT = 16  # filtered images held at a time, the surface's part of each
_MARGIN = 48.0  # px that are filtered about the subsets
_FELT = 0.6  # share of the subset's radius over which the warp's differences are taken
_LOOSE = 5e-3  # px, tolerance of the second order
_PATIENCE = 25  # iterations; steep and small subsets take some ten


@dataclass
class ReferenceImages:
    """The cameras and their reference images.

    image : gives the grey image of a camera's id, or None where it has none. masks : regions drawn by the user.
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
        """The image of camera k. ComputationError where it has none."""
        found = self.image(self.cameras[k].id)
        if found is None:
            raise ComputationError(f"camera {self.cameras[k].id}: the reference capture lacks an image")
        return found

    def current(self, k: int) -> Current:
        """The image of camera k, filtered where the surface is looked for; the latest are kept."""
        if k not in self._filtered:
            while len(self._filtered) >= _KEPT:
                self._filtered.popitem(last=False)
            self._filtered[k] = prepare_current(self.grey(k), self._boxes.get(k), self.settings)
        self._filtered.move_to_end(k)
        return self._filtered[k]

    def look_at(self, k: int, px: Floats) -> None:
        """Camera k is searched about px (n, 2) from now on."""
        box = self._boxes.get(k)
        edge = np.array(self.cameras[k].size)
        low, high = (np.clip(values, 0, edge) for values in (px.min(axis=0), px.max(axis=0)))
        if box is not None and (low >= box[:2]).all() and (high <= box[2:]).all():
            return
        margin = 2.0 * self.settings.radius + _MARGIN
        low, high = np.maximum(np.floor(low - margin), 0), np.minimum(np.ceil(high + margin), edge)
        self._boxes[k] = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        self._filtered.pop(k, None)

    def texture(self, k: int, px: Floats) -> Texture:
        """What the image of camera k shows about px (n, 2)."""
        if k not in self._textures:
            self._textures[k] = texture_map(self.grey(k), self.settings.radius)
        return self._textures[k].at(px)

    def noise(self, k: int) -> float:
        """Variance of the grey levels of camera k by noise, from the middle of its image where the body stands."""
        if k not in self._noise:
            grey = self.grey(k)
            height, width = grey.shape
            self._noise[k] = flat_noise(grey[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4])
        return self._noise[k]

    def reference(self, k: int, px: Floats) -> Reference:
        """The image of camera k about px (n, 2), filtered to be searched for."""
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
    """Matches of n nodes in C cameras. px, sigma : (C, n, 2), NaN where a camera has none; c_ls : (C, n).

    The reference camera's pixel is whole and given, its sigma zero. noise, systematic : (C, n, 2) px, what the noise of
    each image alone and what is no noise leave uncertain, of the reference camera too. status : (n,), why a node has
    fewer than two views, 0 where it has.
    """

    px: Floats
    sigma: Floats
    noise: Floats
    systematic: Floats
    c_ls: Floats
    status: NDArray[np.int8]
    count: int = 0


def match_nodes(
    ring: ReferenceImages,
    pieces: Pieces,
    nodes: tuple[Indices, Indices],
    reference: Indices,
    partners: Mask,
    *,
    order: int,
    curved: bool = True,
) -> NodeMatches:
    """Match the nodes (columns (n,), rows (n,)) from their reference camera (n,) to their partners (C, n).

    order : of the subsets. curved : second derivatives from the shape, as start of the second order and held by the
    first; otherwise zero.
    """
    settings = _of_order(ring.settings, order)
    count, n = len(ring.cameras), len(reference)
    px, sigma = np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan)
    parts = _Parts(np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan), np.zeros(n))
    c_ls, status = np.full((count, n), np.nan), np.full(n, Status.NOT_REACHED, np.int8)
    made = 0
    xyz = pieces.xyz[nodes]
    theta, z = (place[nodes] for place in pieces.lattice.places)
    reach = max(2.0, _FELT * settings.radius)
    jobs = [(a, b) for a in range(count) for b in range(count) if (partners[b] & (reference == a)).any()]
    own = np.empty(0, np.int64)
    before = -1
    for a, b in jobs:
        if a != before:
            own, before = np.flatnonzero(reference == a), a
            at = np.rint(ring.cameras[a].project(xyz[own]))
            stencil = surface_stencil(
                pieces.lattice, pieces.coefficients[nodes][own], theta[own], z[own], ring.cameras[a], at, reach
            )
            filtered = ring.reference(a, at)
            px[a, own], sigma[a, own], c_ls[a, own] = at, 0.0, 0.0
        start = warps_to(ring.cameras[b], at, stencil, reach)
        if not curved:
            start[:, 6:] = 0.0
        chosen = np.flatnonzero(partners[b, own] & np.isfinite(start).all(axis=1))
        if not len(chosen):
            continue
        found = correlate_independently(filtered, ring.current(b), at[chosen], settings, start[chosen])
        made += len(chosen)
        who = own[chosen]
        px[b, who], sigma[b, who], c_ls[b, who] = at[chosen] + found.uv, found.sigma, found.c_ls
        parts.add(ring, (a, b), found, who)
        status[who] = np.where(status[who] == Status.GOOD, Status.GOOD, found.status)
    px[:, status != Status.GOOD] = np.nan
    return NodeMatches(px, sigma, np.sqrt(parts.noise), np.sqrt(parts.systematic), c_ls, status, made)


@dataclass(frozen=True)
class _Parts:
    """Variances (C, n, 2) px² by noise and by what is none, and the number (n,) of matches of each node."""

    noise: Floats
    systematic: Floats
    matches: Floats

    def add(self, ring: ReferenceImages, cameras: tuple[int, int], found: Correlation, nodes: Indices) -> None:
        """Add the matches found from the first camera to the second. The first has the mean of its nodes' matches.

        Half of what is no noise is laid to either image.
        """
        a, b = cameras
        textures = ring.texture(a, found.xy), ring.texture(b, found.xy + found.uv)
        parts = match_parts(found.sigma, found.c_ls, textures, (ring.noise(a), ring.noise(b)), found.gradient)
        self.noise[b, nodes], self.systematic[b, nodes] = parts.current**2, parts.systematic**2 / 2
        known = np.isfinite(parts.current).all(axis=1) & np.isfinite(parts.reference_systematic).all(axis=1)
        nodes = nodes[known]
        share = 1.0 / (self.matches[nodes] + 1.0)[:, None]
        for total, added in ((self.noise, parts.reference), (self.systematic, parts.reference_systematic / np.sqrt(2))):
            before = np.nan_to_num(total[a, nodes])
            total[a, nodes] = before + share * (added[known] ** 2 - before)
        self.matches[nodes] += 1


def _of_order(settings: CorrelationSettings, order: int) -> CorrelationSettings:
    """Settings of the subsets of an order. Second order serves the shape's pieces, which need not the last digit."""
    iterations = min(settings.max_iterations, _PATIENCE)
    tolerance = settings.tolerance if order == 1 or settings.order == 2 else max(settings.tolerance, _LOOSE)
    return replace(settings, order=order, max_iterations=iterations, tolerance=tolerance)
