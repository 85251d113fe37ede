"""Width of the sharpest edges in an image: that of the lens, where the pattern has edges as print and paint have.

A step of contrast A, blurred with a standard deviation σ, is A / (√(2π) σ) steep. The contrast and the steepest slope
of small squares so give a width, whatever the size of the speckles is; in focus it is that of a pixel and of the
smoothing that keeps noise out.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from ringdic.arrays import Image, Pixels
from ringdic.correlation.seeds import even_sample

_SQUARES = 30
_HALF = 16  # px, half the side of a square
_SMOOTH = 0.7  # px, standard deviation of the smoothing
_ENDS, _STEEPEST = (3.0, 97.0), 98.0  # percentiles, of the grey levels, and of the slopes
_OF_BEST = 0.5  # contrast of a square that counts, in units of that of the better ones
_SHARPEST = 25.0  # percentile over the squares


def edge_width(image: Image, xy: Pixels) -> float:
    """Standard deviation, px, of the blur of the sharpest edges about some places; NaN without any.

    image : (height, width) grey levels. xy : (n, 2) px, the places.
    """
    height, width = image.shape
    inside = ((xy >= _HALF) & (xy < (width - _HALF, height - _HALF))).all(axis=1)
    places = np.rint(xy[inside]).astype(int)
    rows = []
    for x, y in places[even_sample(xy[inside], _SQUARES)] if len(places) else places:
        square = image[y - _HALF : y + _HALF + 1, x - _HALF : x + _HALF + 1].astype(np.float32)
        low, high = np.percentile(square, _ENDS)
        smooth = cv2.GaussianBlur(square, (0, 0), _SMOOTH)
        by_x, by_y = (smooth[1:-1, 2:] - smooth[1:-1, :-2]) / 2.0, (smooth[2:, 1:-1] - smooth[:-2, 1:-1]) / 2.0
        slope = float(np.percentile(np.hypot(by_x, by_y), _STEEPEST))
        rows.append((high - low, (high - low) / (math.sqrt(2.0 * math.pi) * max(slope, 1e-6))))
    if not rows:
        return math.nan
    contrast, widths = np.array(rows).T
    return float(np.percentile(widths[contrast > _OF_BEST * np.percentile(contrast, 90.0)], _SHARPEST))
