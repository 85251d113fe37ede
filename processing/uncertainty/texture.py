"""What an image holds for matching: slopes and contrast of the grey levels over a subset's area."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float64]

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

    contrast: Array
    slopes: Array
    peaked: Array

    def __post_init__(self) -> None:
        n = len(self.contrast)
        if self.slopes.shape != (n, 3) or self.peaked.shape != (n,):
            raise ValueError("texture has a contrast, three mean products of slopes and their peak a point")

    def clean(self, noise: float) -> Array:
        """Mean squares of fx and fy, (n, 2), without those that noise of this variance adds."""
        return np.asarray(self.slopes[:, [0, 2]] - noise * SLOPE_GAIN)

    def spread(self, noise: float) -> Array:
        """Diagonal of the inverse of the mean of ∇f ∇fᵀ without the noise's, (n, 2) px² a squared grey level.

        NaN where the pattern does not tell its place in some direction.
        """
        (xx, yy), xy = self.clean(noise).T, self.slopes[:, 1]
        determinant = xx * yy - xy * xy
        with np.errstate(invalid="ignore"):
            known = (determinant > 1e-6 * (xx + yy) ** 2) & (xx > 0)
        return np.column_stack([yy, xx]) / np.where(known, determinant, np.nan)[:, None]


def texture_at(image: Image, px: Array, radius: int, square: bool = False) -> Texture:
    """The texture about px (n, 2) of an image (h, w), over a square of the area of a subset of this radius, px."""
    px = np.asarray(px, dtype=float)
    n = len(px)
    contrast, slopes, peaked = np.full(n, np.nan), np.full((n, 3), np.nan), np.full(n, np.nan)
    height, width = image.shape
    with np.errstate(invalid="ignore"):
        inside = ((px > -0.5) & (px < (width - 0.5, height - 0.5))).all(axis=1)
    if not inside.any():
        return Texture(contrast, slopes, peaked)
    at = np.rint(px[inside]).astype(np.int64)
    half = radius if square else round(0.5 * np.sqrt(np.pi) * radius)
    margin = half + len(_SLOPE)
    left, top = np.maximum(at.min(axis=0) - margin, 0)
    right, bottom = at.max(axis=0) + margin + 1
    grey = np.asarray(image[top:bottom, left:right], dtype=np.float32)
    rows, columns = at[:, 1] - top, at[:, 0] - left

    def mean(values: NDArray[np.float32]) -> Array:
        size = (2 * half + 1, 2 * half + 1)
        filtered = cv2.blur(values, size, borderType=cv2.BORDER_REFLECT_101)
        return np.asarray(filtered[rows, columns], dtype=float)

    centred = grey - np.float32(grey.mean())
    contrast[inside] = np.sqrt(np.maximum(mean(centred**2) - mean(centred) ** 2, 0.0))
    one = np.ones(1, dtype=np.float32)
    fx, fy = cv2.sepFilter2D(grey, cv2.CV_32F, _SLOPE, one), cv2.sepFilter2D(grey, cv2.CV_32F, one, _SLOPE)
    slopes[inside] = np.column_stack([mean(fx * fx), mean(fx * fy), mean(fy * fy)])
    total = fx * fx + fy * fy
    peaked[inside] = mean(total * total) / np.maximum(mean(total), 1e-9) ** 2
    return Texture(contrast, slopes, peaked)
