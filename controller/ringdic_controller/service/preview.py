"""Small pictures of archived images for the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from ringdic.session.images import read_gray

_HIGHEST = 16_384  # px; a JPEG can have 65 535


def preview_jpeg(path: Path, width: int = 320) -> bytes:
    """A JPEG (as bytes) of the image in a file, at most ``width`` px wide.

    The grey levels of 16-bit images are mapped linearly from their 0.5 % and 99.5 % quantiles to 0 … 255. Raises
    InputError if the file is missing or is not an image.
    """
    image = read_gray(path)
    if image.dtype != np.uint8:
        image = _no_wider(image, width)
        low, high = np.percentile(image, [0.5, 99.5])
        image = np.clip((image - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    return _jpeg(_no_wider(image, width))


def picture_jpeg(picture: NDArray[np.uint8], width: int) -> bytes:
    """A JPEG (as bytes) of a picture (height, width, 3) sRGB, at most ``width`` px wide."""
    return _jpeg(_no_wider(picture[..., ::-1], width))


def _no_wider(image: NDArray[Any], width: int) -> NDArray[Any]:
    scale = min(1.0, width / image.shape[1], _HIGHEST / image.shape[0])
    if scale == 1.0:
        return image
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _jpeg(image: NDArray[Any]) -> bytes:
    _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return bytes(jpeg)
