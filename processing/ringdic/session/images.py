"""Decoding of image files to grey levels and of mask files to regions. A damaged file is refused, never half read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Mask
from ringdic.errors import InputError
from ringdic.session.image_headers import jpeg_segments, stated_size

# OpenCV would print lines about a damaged file that do not name it; an InputError does.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

# Grey = 0.298936 R + 0.587043 G + 0.114021 B (ITU-R BT.601), in millionths: exact in whole numbers.
_RED, _GREEN, _BLUE = 298936, 587043, 114021
_MILLION = 1_000_000
# So many rows of sums stay in the processor's cache: seven times faster than a whole image at a time.
_ROWS = 32
_PNG_END = b"IEND\xaeB`\x82"
#: Bytes of the largest image that is decoded: 250 megapixels of 16 bits, 170 of colour.
LARGEST_IMAGE = 512 << 20


def read_gray(path: Path) -> NDArray:
    """Read the grey levels of a JPEG, PNG, PGM or TIFF file.

    Colour becomes round(0.298936 R + 0.587043 G + 0.114021 B), the luma of ITU-R BT.601.

    Returns
    -------
    image : (height, width) uint8 or uint16, grey levels as stored.

    Raises
    ------
    InputError
        The file is missing, truncated, too large or no image; the sentence names it.
    """
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST_IMAGE:
            raise InputError(
                f"{path}: larger than {LARGEST_IMAGE >> 20} MB, which no image may be; store it compressed"
            )
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if not data:
        raise InputError(f"{path}: the image file is empty; copy or capture it again")
    if not _is_whole(data):
        raise InputError(f"{path}: the image file is truncated; copy or capture it again")
    size = stated_size(data)
    if size is None:
        raise InputError(f"{path}: truncated or not an image; use JPEG, PNG, PGM or TIFF and copy it again")
    if size.bytes > LARGEST_IMAGE:
        raise InputError(
            f"{path}: {size.width} x {size.height} px would take {size.bytes / 2**30:.1f} GB of memory, and an image "
            f"may take {LARGEST_IMAGE >> 20} MB; use smaller images"
        )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"{path}: not a readable image ({error.err}); use JPEG, PNG, PGM or TIFF") from error
    if image is None:
        raise InputError(f"{path}: truncated or not an image; use JPEG, PNG, PGM or TIFF and copy it again")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: grey levels of type {image.dtype} are not supported; use 8 or 16 bits")
    return np.asarray(image) if image.ndim == 2 else gray(np.asarray(image))


def gray(image: NDArray) -> NDArray:
    """Grey levels of a colour image by the luma of ITU-R BT.601.

    image : (height, width, 1, 3 or 4) uint8 or uint16, levels of blue, green, red and opacity, or grey alone.
    Returns (height, width) grey levels of the same type.
    """
    if image.shape[2] == 1:
        return image[:, :, 0]
    levels = np.empty(image.shape[:2], image.dtype)
    for first in range(0, len(image), _ROWS):
        levels[first : first + _ROWS] = _weighed(image[first : first + _ROWS])
    return levels


def _weighed(image: NDArray) -> NDArray:
    """Weighted sum of the colours, rounded, as whole numbers of twice the size."""
    wide = np.dtype(np.uint32 if image.dtype == np.uint8 else np.uint64)
    total = np.full(image.shape[:2], _MILLION // 2, wide)
    for channel, weight in enumerate((_BLUE, _GREEN, _RED)):
        total += image[:, :, channel].astype(wide) * wide.type(weight)
    total //= wide.type(_MILLION)
    return total


def read_mask(path: Path, shape: tuple[int, int]) -> Mask:
    """Read a region of interest from a mask image.

    Parameters
    ----------
    path : an image that is not black inside the region.
    shape : (height, width) px of the image that the region lies in.

    Returns
    -------
    mask : (height, width) bool, true inside.

    Raises
    ------
    InputError
        The mask has another size or marks no pixel.
    """
    mask = read_gray(path) > 0
    if mask.shape != tuple(shape):
        raise InputError(
            f"{path}: the mask is {mask.shape[1]} x {mask.shape[0]} px but its image is {shape[1]} x {shape[0]} px; "
            "draw it on the reference image"
        )
    if not mask.any():
        raise InputError(f"{path}: the mask marks no pixel; paint the region of interest white")
    return mask


def _is_whole(data: bytes) -> bool:
    """Whether the file's end is there, as far as the structure of its format shows."""
    if data.startswith(b"\x89PNG"):
        return _PNG_END in data
    if data.startswith(b"\xff\xd8"):
        return any(marker == 0xD9 for marker, _ in jpeg_segments(data))
    return True
