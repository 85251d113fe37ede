"""Detection of dark dots on a white surface, with centroids good to a hundredth of a pixel.

The position of a dot is the centroid of its darkness ``q = 1 − I / W``, where I is the linear light of a pixel and W a
plane fitted to the white round the dot: position = Σ q x / Σ q. Values of q near 0 and 1 are clipped.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Mask, Pixels
from ringdic.session.rig import Target

Grey = NDArray[np.float32]

#: Long side to which an image is reduced for the detection of dots, px.
_SEARCH_SIZE = 1640
#: Darkness from which a spot is a candidate, as a part of the white around it.
_SEARCH_CONTRAST = 0.25
#: Darkness above which a pixel certainly belongs to a dot.
_SPOT_CONTRAST = 0.2
#: Parts of a dot's full darkness that count as 0 and as 1: beyond them are noise, texture and gloss.
_EMPTY, _FULL = 0.05, 0.95


@dataclass(frozen=True)
class Dots:
    """Dark spots of an image that may be dots of the target.

    px : (n, 2) px, centroids.
    width, height : (n,) px, of the upright box round each spot.
    contrast : (n,) median darkness of its pixels, 0 to 1.
    size : (width, height) of the image, px.
    """

    px: Pixels
    width: Floats
    height: Floats
    contrast: Floats
    size: tuple[int, int]

    def __post_init__(self) -> None:
        n = len(self.px)
        if self.px.shape != (n, 2) or not (len(self.width) == len(self.height) == len(self.contrast) == n):
            raise ValueError("dots need one width, height and contrast for each position (n, 2)")

    def __len__(self) -> int:
        return len(self.px)

    def __getitem__(self, chosen: NDArray[np.generic]) -> Dots:
        return Dots(self.px[chosen], self.width[chosen], self.height[chosen], self.contrast[chosen], self.size)


def find_dots(image: NDArray[np.generic], target: Target) -> Dots:
    """Detect dark spots of an image that may be dots of the target, and measure their centroids.

    image : (height, width) grey, uint8, uint16 or float in 0 … 255, sRGB-coded; centroids are taken after decoding.
    target : its description bounds the size of a dot, supposing that all of its rows are in the image.
    """
    if image.ndim != 2:
        raise ValueError(f"a grey image has two axes, not {image.ndim}")
    grey = _as_unit(image)
    boxes = _candidate_boxes(grey, target)
    light = _to_linear(grey)
    size = (grey.shape[1], grey.shape[0])
    spots = [spot for box in boxes if (spot := _measure(light, box)) is not None]
    if not spots:
        return Dots(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0), size)
    table = np.array(spots)
    return Dots(table[:, :2], table[:, 2], table[:, 3], table[:, 4], size)


def _as_unit(image: NDArray[np.generic]) -> Grey:
    """Grey levels of the image (height, width) scaled to 0 … 1."""
    full = 65535.0 if image.dtype == np.uint16 else 255.0
    return image.astype(np.float32) / np.float32(full)


def _to_linear(coded: Grey) -> Grey:
    """Linear light of sRGB values in 0 … 1 (IEC 61966-2-1), by a table finer than the steps of 12-bit images."""
    x = np.linspace(0.0, 1.0, 65536)
    table = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return table[np.clip(coded * 65535.0 + 0.5, 0, 65535).astype(np.uint16)]


def _candidate_boxes(grey: Grey, target: Target) -> NDArray[np.intp]:
    """Upright boxes round solid dark spots on bright ground: (m, 4) x, y, width and height, px of the full image."""
    height, width = grey.shape
    scale = min(1.0, _SEARCH_SIZE / max(height, width))
    small = grey
    if scale < 1:
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    largest = max(small.shape) / (target.rows - 1) * target.dot_size_mm / target.row_spacing_mm
    kernel = np.ones((2 * int(0.75 * largest) + 3,) * 2, np.uint8)
    white = cv2.morphologyEx(small, cv2.MORPH_CLOSE, kernel)
    bright = 0.3 * float(np.percentile(white, 98))
    dark = (white > bright) & (small < (1 - _SEARCH_CONTRAST) * white)
    _, _, stats, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8), connectivity=4)
    x, y, w, h, area = stats[1:].T
    solid = area > 0.5 * w * h
    sized = (w >= 2) & (h >= 4) & (w <= 1.8 * largest) & (h <= 1.8 * largest) & (w < 2.5 * h) & (h < 8 * w)
    inside = (x > 0) & (y > 0) & (x + w < small.shape[1]) & (y + h < small.shape[0])
    boxes = np.column_stack([x, y, w, h])[solid & sized & inside]
    factor = np.array([width / small.shape[1], height / small.shape[0]] * 2)
    return np.rint(boxes * factor).astype(np.intp)


def _measure(light: Grey, box: NDArray[np.intp]) -> tuple[float, float, float, float, float] | None:
    """Centroid x and y, width, height (px) and contrast of the spot in a box; None where it is not on white ground."""
    x, y, w, h = (int(value) for value in box)
    # Blur spreads the edge of a dot a few pixels outwards.
    edge = 2 if h < 12 else 3
    mx, my = max(edge + 3, w // 2), max(edge + 3, h // 2)
    x0, y0 = max(x - mx, 0), max(y - my, 0)
    window = light[y0 : y + h + my, x0 : x + w + mx].astype(float)
    rows, columns = np.mgrid[: window.shape[0], : window.shape[1]]
    near = (
        (columns >= x - x0 - edge)
        & (columns < x - x0 + w + edge)
        & (rows >= y - y0 - edge)
        & (rows < y - y0 + h + edge)
    )
    ground = ~near
    level = float(np.percentile(window[ground], 75))
    white = ground & (window > 0.7 * level) & (window < 1.3 * level)
    if level <= 0 or white.sum() < 0.6 * ground.sum():
        return None
    plane = _fit_plane(columns, rows, window, white)
    missing = 1.0 - window / np.maximum(plane, 1e-6)
    labels = cv2.connectedComponents((near & (missing > _SPOT_CONTRAST)).astype(np.uint8), connectivity=8)[1]
    counts = np.bincount(labels[y - y0 : y - y0 + h, x - x0 : x - x0 + w].ravel())
    counts[0] = 0
    if counts.max() < 4:
        return None
    spot = labels == counts.argmax()
    # The blurred edge belongs to the dot: without its faint pixels the centroid would be biased to the dark side.
    reach = cv2.dilate(spot.astype(np.uint8), np.ones((2 * edge + 1,) * 2, np.uint8)).astype(bool)
    full = float(np.median(missing[spot]))
    q = np.where(reach, np.clip((missing / full - _EMPTY) / (_FULL - _EMPTY), 0.0, 1.0), 0.0)
    total = q.sum()
    return (
        x0 + float((q * columns).sum() / total),
        y0 + float((q * rows).sum() / total),
        float(w),
        float(h),
        full,
    )


def _fit_plane(columns: NDArray[np.intp], rows: NDArray[np.intp], window: Floats, chosen: Mask) -> Floats:
    """Least-squares plane through the chosen pixels, evaluated at all pixels of the window (height, width)."""
    cx, cy = columns.mean(), rows.mean()
    A = np.column_stack([columns[chosen] - cx, rows[chosen] - cy, np.ones(int(chosen.sum()))])
    a, b, c = np.linalg.solve(A.T @ A, A.T @ window[chosen])
    return a * (columns - cx) + b * (rows - cy) + c
