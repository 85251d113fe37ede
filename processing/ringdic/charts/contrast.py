"""Contrast of an image about a position: the strength of its texture there."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Pixels


def contrast(image: NDArray[np.generic], xy: Pixels, half_width: int) -> Floats:
    """Root mean square of the grey level's gradient in a square around positions of an image, by Sobel differences.

    image : (height, width) grey levels. xy : (..., 2) float64, px. half_width : px, of the square, of which the part
        inside the image counts.
    Returns (...), in grey levels per px.
    """
    at = np.ascontiguousarray(xy.reshape(-1, 2), dtype=np.float64)
    out = np.empty(len(at))
    _contrast(np.ascontiguousarray(image), at, half_width, out)
    return out.reshape(xy.shape[:-1])


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _contrast(image, xy, half_width, out):  # type: ignore[no-untyped-def]
    """Fill out (n,) with the contrast of ``contrast`` around positions xy (n, 2)."""
    (height, width), one = image.shape, np.uint64(1)
    kind: Any = np.float32
    for k in range(len(xy)):
        column, row = int(xy[k, 0]), int(xy[k, 1])
        left, right = max(column - half_width, 1), min(column + half_width + 1, width - 1)
        total, count = 0.0, 0
        for i in range(max(row - half_width, 1), min(row + half_width + 1, height - 1)):
            of_row = kind(0.0)
            for j in range(np.uint64(left), np.uint64(right)):
                before, after = j - one, j + one
                a, b, c = kind(image[i - 1, before]), kind(image[i - 1, j]), kind(image[i - 1, after])
                d, e = kind(image[i, before]), kind(image[i, after])
                f, g, h = kind(image[i + 1, before]), kind(image[i + 1, j]), kind(image[i + 1, after])
                along_x, along_y = c - a + e - d + e - d + h - f, f - a + g - b + g - b + h - c
                of_row += along_x * along_x + along_y * along_y
            total += of_row
            count += max(right - left, 0)
        out[k] = math.sqrt(total / count) / 8.0 if count else 0.0
