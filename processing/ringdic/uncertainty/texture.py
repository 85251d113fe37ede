"""Contrast and slopes of the grey levels over the subsets of an image, on which the uncertainty of a match depends."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Indices, Mask, Pixels

#: Grey levels (height, width) as a file holds them, or as floating-point numbers.
GreyImage = Image | Floats

# Central differences of sixth order; their error is below 1 % for periods of 5 px and more.
_SLOPE = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0], dtype=np.float32) / np.float32(60.0)
#: Mean square of the slopes of white noise of unit variance.
SLOPE_GAIN = float(np.sum(_SLOPE.astype(float) ** 2))
_LARGE = 16  # px, radius of a subset with so many pixels that every fourth of them tells its texture


@dataclass(frozen=True)
class Texture:
    """Statistics of the grey levels f in n subsets of one image; NaN where a point lies outside the image.

    contrast : (n,) standard deviation of the grey levels.
    slopes : (n, 3) means of fx², fx fy and fy² over the subset, grey levels² a px², including the slopes of the noise.
    peakedness : (n,) mean of (fx² + fy²)² over the square of the mean of fx² + fy², no unit: 1 for slopes spread evenly
        over the subset, larger the fewer edges they are concentrated on.
    """

    contrast: Floats
    slopes: Floats
    peakedness: Floats

    def __post_init__(self) -> None:
        n = len(self.contrast)
        if self.slopes.shape != (n, 3) or self.peakedness.shape != (n,):
            raise ValueError("texture has a contrast, three mean products of slopes and their peakedness a point")

    def part(self, index: Indices) -> Texture:
        """The texture of the subsets with these indices, index : (k,)."""
        return Texture(self.contrast[index], self.slopes[index], self.peakedness[index])

    def clean_slopes(self, noise: float) -> Floats:
        """Mean squares of fx and fy, (n, 2) grey levels² a px², without the part due to noise.

        noise : its variance, grey levels².
        """
        return np.asarray(self.slopes[:, [0, 2]] - noise * SLOPE_GAIN)

    def inverse_diagonal(self, noise: float) -> Floats:
        """Diagonal of the inverse of the mean of ∇f ∇fᵀ, (n, 2) px² a squared grey level, without that of noise.

        It is proportional to the variance of a match in x and y. NaN where the pattern does not vary in some direction.
        noise : its variance, grey levels².
        """
        (xx, yy), xy = self.clean_slopes(noise).T, self.slopes[:, 1]
        determinant = xx * yy - xy * xy
        with np.errstate(invalid="ignore"):
            known = (determinant > 1e-6 * (xx + yy) ** 2) & (xx > 0)
        return np.column_stack([yy, xx]) / np.where(known, determinant, np.nan)[:, None]


@dataclass(frozen=True)
class TextureMap:
    """The texture of an image on a grid of points ``stride`` px apart, for subsets of one radius.

    values : (h, w, 5) contrast, three mean products of slopes, peakedness, as in `Texture`. shape : (height, width) of
    the image, px.
    """

    values: NDArray[np.float32]
    stride: int
    shape: tuple[int, int]

    def at(self, px: Pixels) -> Texture:
        """The texture at the grid points nearest to px (n, 2); NaN outside the image."""
        px = np.asarray(px, dtype=float)
        with np.errstate(invalid="ignore"):
            inside: Mask = np.asarray(((px > -0.5) & (px < (self.shape[1] - 0.5, self.shape[0] - 0.5))).all(axis=1))
        last = np.array(self.values.shape[1::-1]) - 1
        at = np.minimum(np.rint(np.where(inside[:, None], px, 0.0) / self.stride).astype(np.int64), last)
        values = np.where(inside[:, None], self.values[at[:, 1], at[:, 0]].astype(float), np.nan)
        return Texture(values[:, 0], values[:, 1:4], values[:, 4])


def texture_map(image: GreyImage, radius: int, *, stride: int | None = None) -> TextureMap:
    """The texture of an image, over square subsets with the area of round ones.

    Of large subsets every second pixel each way counts, for speckle is wider than that.

    image : (h, w) grey levels. radius : of the round subsets, px. stride : distance of the grid points, px; by default
    a fifth of the radius, over which the texture changes little.
    """
    thin = 2 if radius >= _LARGE else 1
    step = max(1, (stride or radius // 5) // thin)
    size = (2 * round(0.5 * np.sqrt(np.pi) * radius / thin) + 1,) * 2
    grey = image if image.dtype in (np.uint8, np.uint16) else np.asarray(image, dtype=np.float32)
    unit = np.ones(1, dtype=np.float32)

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(values, size, borderType=cv2.BORDER_REFLECT_101)[::step, ::step])

    level = grey[::thin, ::thin].astype(np.float32)
    level -= level.mean()
    fx = np.asarray(cv2.sepFilter2D(grey[::thin], cv2.CV_32F, _SLOPE, unit))[:, ::thin].copy()
    fy = np.asarray(cv2.sepFilter2D(grey[:, ::thin].copy(), cv2.CV_32F, unit, _SLOPE))[::thin].copy()
    xx, yy = fx * fx, fy * fy
    total = xx + yy
    out = np.empty((*level[::step, ::step].shape, 5), dtype=np.float32)
    out[..., 0] = np.sqrt(np.maximum(mean(level * level) - mean(level) ** 2, 0.0))
    out[..., 1], out[..., 2], out[..., 3] = mean(xx), mean(fx * fy), mean(yy)
    out[..., 4] = mean(total * total) / np.maximum(out[..., 1] + out[..., 3], 1e-6) ** 2
    return TextureMap(out, thin * step, (grey.shape[0], grey.shape[1]))
