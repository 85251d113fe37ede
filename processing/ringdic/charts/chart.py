"""A chart: matches of one camera's grid at the reference with their uncertainty, as stored in a task's output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Pixels
from ringdic.charts.images import ChartImages
from ringdic.charts.matching import ChartMatches
from ringdic.correlation import Status
from ringdic.uncertainty.matches import match_uncertainty
from ringdic.uncertainty.texture import Texture, texture_map

_MARGIN = 2  # subset radii about the points, of the part of an image whose texture is computed


@dataclass(frozen=True)
class Chart:
    """Matches of n points of one camera's grid in the C cameras that see them, the chart's own camera first.

    cameras : (C,) indices of the cameras. xy : (n, 2) px, the grid. faces : (m, 3). px : (C, n, 2) px, NaN where not
    matched. noise, systematic : (C, n, 2) px, standard deviations due to the noise of each image alone, and due to
    other causes. bend : (C, n) px, of `ChartMatches`. c_ls : (C, n). status : (C, n). texture : (C, n, 5), of each
    image about px: contrast, three mean products of slopes, peakedness. grey_noise : (C,), variance of each camera's
    noise, grey levels².
    """

    cameras: Indices
    xy: Pixels
    faces: NDArray[np.int32]
    px: Pixels
    noise: NDArray[np.float32]
    systematic: NDArray[np.float32]
    bend: NDArray[np.float32]
    c_ls: NDArray[np.float32]
    status: NDArray[np.int8]
    texture: NDArray[np.float32]
    grey_noise: Floats

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the chart by name, as stored in a task's output; shapes and units (px) are those of the class.

        The points come second: (C, n, ...).
        """
        return {each.name: np.asarray(getattr(self, each.name)) for each in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray]) -> Chart:
        """The chart from its arrays by name, as from :meth:`arrays`: (C, n, ...) px and without unit."""
        return cls(**{each.name: arrays[each.name] for each in fields(cls)})


def chart_with_uncertainty(images: ChartImages, matches: ChartMatches, grey_noise: Floats) -> Chart:
    """Complete the matches of a chart with their standard deviations by cause.

    images : of all cameras. matches : in C of them. grey_noise : (C,), variance of the noise of these cameras' images,
    grey levels².
    """
    count, n = matches.c_ls.shape
    noise, systematic = np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan)
    textures = [_texture(images, int(c), px) for c, px in zip(matches.cameras, matches.px, strict=True)]
    views = np.zeros(n)
    for slot in range(1, count):
        index = np.flatnonzero(matches.status[slot] == Status.GOOD)
        if not len(index):
            continue
        parts = match_uncertainty(
            matches.sigma[slot, index], matches.c_ls[slot, index],
            (textures[0].part(index), textures[slot].part(index)), (grey_noise[0], grey_noise[slot]),
            matches.gradient[slot, index],
        )  # fmt: skip
        noise[slot, index], systematic[slot, index] = parts.current**2, parts.systematic**2 / 2
        known = np.isfinite(parts.current).all(axis=1) & np.isfinite(parts.reference_systematic).all(axis=1)
        index = index[known]
        # The variance in the chart's own camera is the mean over the matches from it.
        share = 1.0 / (views[index] + 1.0)[:, None]
        for total, added in ((noise, parts.reference), (systematic, parts.reference_systematic / np.sqrt(2))):
            before = np.nan_to_num(total[0, index])
            total[0, index] = before + share * (added[known] ** 2 - before)
        views[index] += 1
    return Chart(
        matches.cameras, matches.xy, matches.faces, matches.px,
        np.sqrt(noise).astype(np.float32), np.sqrt(systematic).astype(np.float32),
        matches.bend.astype(np.float32), matches.c_ls.astype(np.float32), matches.status,
        np.stack([_as_array(each) for each in textures]), grey_noise,
    )  # fmt: skip


def texture_of(values: NDArray[np.float32]) -> Texture:
    """Texture of n subsets from its stored numbers.

    values : (n, 5), grey levels and their powers, a camera's part of `Chart.texture`.
    """
    numbers = np.asarray(values, dtype=np.float64)
    return Texture(numbers[:, 0], numbers[:, 1:4], numbers[:, 4])


def _as_array(texture: Texture) -> NDArray[np.float32]:
    return np.column_stack([texture.contrast, texture.slopes, texture.peakedness]).astype(np.float32)


def _texture(images: ChartImages, k: int, px: Pixels) -> Texture:
    """Texture of the image of camera k about px (n, 2), NaN where these are; computed about them only."""
    grey, radius = images.image(k), images.settings.radius
    known = px[np.isfinite(px).all(axis=1)]
    if not len(known):
        return Texture(np.full(len(px), np.nan), np.full((len(px), 3), np.nan), np.full(len(px), np.nan))
    low = np.maximum(np.floor(known.min(axis=0)).astype(int) - _MARGIN * radius, 0)
    high = np.ceil(known.max(axis=0)).astype(int) + _MARGIN * radius + 1
    part = texture_map(grey[low[1] : high[1], low[0] : high[0]], radius, stride=max(1, radius // 3))
    return part.at(px - low)
