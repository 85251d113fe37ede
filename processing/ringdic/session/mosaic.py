"""Raw images of a colour sensor, one colour filter a pixel, made as even as grey ones.

A grey pattern under white light differs at the four places of the mosaic by a factor and an offset alone, which follow
from the means of small squares.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.session.images import read_gray

_ALTERNATING = 0.1  # relative difference of the mean grey levels at the four places, from which it is a mosaic
_SMALLEST = 256  # px, side of an image in which chance makes no such difference
_SQUARE = 16  # px, side of the squares whose means are compared


def level_mosaic(image: NDArray[Any]) -> NDArray[Any]:
    """Grey levels (height, width), those under each colour filter brought to those under the brightest.

    image : (height, width) uint8 or uint16, raw or not; one that does not alternate from row to row or column to column
    is returned as it is.
    """
    height, width = image.shape
    places = [(row, column) for row in (0, 1) for column in (0, 1)]
    means = np.array([image[row::8, column::8].mean() for row, column in places])
    if min(height, width) < _SMALLEST or means.max() <= (1.0 + _ALTERNATING) * means.min():
        return image
    size = (width // _SQUARE, height // _SQUARE)
    sites = [image[row::2, column::2].astype(np.float32) for row, column in places]
    squares = [cv2.resize(site, size, interpolation=cv2.INTER_AREA) for site in sites]
    brightest = squares[int(means.argmax())].ravel()
    out = image.astype(np.float32)
    for (row, column), own in zip(places, squares, strict=True):
        slope, offset = np.polyfit(brightest, own.ravel(), 1)
        if slope > 0.0:
            out[row::2, column::2] = (out[row::2, column::2] - offset) / slope
    return np.clip(np.rint(out), 0, np.iinfo(image.dtype).max).astype(image.dtype)


def read_level_gray(path: Path) -> NDArray[Any]:
    """The grey levels (height, width), uint8 or uint16, of an image file as by `read_gray`, a raw mosaic levelled.

    Raises InputError as `read_gray` does.
    """
    return level_mosaic(read_gray(path))
