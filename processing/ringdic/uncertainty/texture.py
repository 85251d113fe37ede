"""What an image holds for matching: slopes and contrast of the grey levels over a subset's area."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask

Image = NDArray[np.uint8] | NDArray[np.uint16] | Floats

# Central differences of sixth order: right to 1 % up to a period of 5 px.
_SLOPE = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0], dtype=np.float32) / np.float32(60.0)
#: Mean square of the slopes that white noise of unit variance has.
SLOPE_GAIN = float(np.sum(_SLOPE.astype(float) ** 2))


@dataclass(frozen=True)
class Texture:
    """Of n subsets of one image; NaN where a point lies outside it.

    contrast : (n,) standard deviation of the grey levels. slopes : (n, 3) means of fx², fx fy and fy² over the subset,
    grey levels² a px², the noise's own slopes among them. peaked : (n,) mean of (fx² + fy²)² over its square: 1 where
    slopes are alike all over the subset, the more the fewer the edges that hold them all.
    """

    contrast: Floats
    slopes: Floats
    peaked: Floats

    def __post_init__(self) -> None:
        n = len(self.contrast)
        if self.slopes.shape != (n, 3) or self.peaked.shape != (n,):
            raise ValueError("texture has a contrast, three mean products of slopes and their peak a point")

    def part(self, index: Indices) -> Texture:
        """The texture of some of the points."""
        return Texture(self.contrast[index], self.slopes[index], self.peaked[index])

    def clean(self, noise: float) -> Floats:
        """Mean squares of fx and fy, (n, 2), without those that noise of this variance adds."""
        return np.asarray(self.slopes[:, [0, 2]] - noise * SLOPE_GAIN)

    def spread(self, noise: float) -> Floats:
        """Diagonal of the inverse of the mean of ∇f ∇fᵀ without the noise's, (n, 2) px² a squared grey level.

        NaN where the pattern does not tell its place in some direction.
        """
        (xx, yy), xy = self.clean(noise).T, self.slopes[:, 1]
        determinant = xx * yy - xy * xy
        with np.errstate(invalid="ignore"):
            known = (determinant > 1e-6 * (xx + yy) ** 2) & (xx > 0)
        return np.column_stack([yy, xx]) / np.where(known, determinant, np.nan)[:, None]


@dataclass(frozen=True)
class TextureMap:
    """The textures of all places of an image, every ``stride`` px, for subsets of one radius.

    values : (h, w, 5) contrast, three mean products of slopes, peak. shape : (height, width) of the image, px.
    """

    values: NDArray[np.float32]
    stride: int
    shape: tuple[int, int]

    def at(self, px: Floats) -> Texture:
        """The texture about px (n, 2), to the nearest place of the map; NaN outside the image."""
        px = np.asarray(px, dtype=float)
        with np.errstate(invalid="ignore"):
            inside: Mask = np.asarray(((px > -0.5) & (px < (self.shape[1] - 0.5, self.shape[0] - 0.5))).all(axis=1))
        last = np.array(self.values.shape[1::-1]) - 1
        at = np.minimum(np.rint(np.where(inside[:, None], px, 0.0) / self.stride).astype(np.int64), last)
        found = np.where(inside[:, None], self.values[at[:, 1], at[:, 0]].astype(float), np.nan)
        return Texture(found[:, 0], found[:, 1:4], found[:, 4])


def texture_map(image: Image, radius: int, *, stride: int | None = None) -> TextureMap:
    """The textures of an image (h, w), over squares of the area of a round subset of this radius, px.

    stride : px, by default a fifth of the radius, over which a mean over the subset changes little.
    """
    stride = stride or max(1, radius // 5)
    size = (2 * round(0.5 * np.sqrt(np.pi) * radius) + 1,) * 2
    grey = np.asarray(image, dtype=np.float32)
    one = np.ones(1, dtype=np.float32)

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(values, size, borderType=cv2.BORDER_REFLECT_101)[::stride, ::stride])

    centred = grey - np.float32(grey.mean())
    out = np.empty((*grey[::stride, ::stride].shape, 5), dtype=np.float32)
    out[..., 0] = np.sqrt(np.maximum(mean(centred * centred) - mean(centred) ** 2, 0.0))
    fx, fy = cv2.sepFilter2D(grey, cv2.CV_32F, _SLOPE, one), cv2.sepFilter2D(grey, cv2.CV_32F, one, _SLOPE)
    out[..., 2] = mean(fx * fy)
    xx, yy = fx * fx, fy * fy
    out[..., 1], out[..., 3] = mean(xx), mean(yy)
    total = xx + yy
    out[..., 4] = mean(total * total) / np.maximum(out[..., 1] + out[..., 3], 1e-6) ** 2
    return TextureMap(out, stride, (grey.shape[0], grey.shape[1]))
