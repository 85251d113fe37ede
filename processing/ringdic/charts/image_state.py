"""Figures of a camera's image of a step beside its reference image: blur, light, clipping, and a digest of its pixels.

Squares of the reference image are compared with those that the same material takes in the later image, after the
measured deformation. Where hardly a point was matched, the squares at the same pixels are compared.
"""

from __future__ import annotations

import hashlib
from dataclasses import astuple, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Pixels
from ringdic.charts.blur import SQUARE_PX, blur_change
from ringdic.correlation.seeds import even_sample

_SQUARES = 20
_CANDIDATES = 1000  # points, about, of which those of the squares are chosen
_FEWEST = 12  # matched points from which the squares follow the material
_ROWS = 16  # every so many rows of an image are enough to tell that it is another one


@dataclass(frozen=True)
class ImageState:
    """State of a camera's image of a step beside its reference image; NaN where unknown.

    points, matched : numbers of points of the camera's grid, and of those that were matched. blur : px, standard
    deviation by which the image is more blurred than the reference along the direction where it is most; negative where
    it is sharper along all. along : degrees, that direction, from x (right) towards y (down). across : px, the same at
    right angles. contrast : of the pattern, in units of the reference's, without the blur. bright, dark : shares of the
    pixels of the pattern at the ends of the grey levels. level : mean grey level of the pattern, of 255.
    """

    points: int
    matched: int
    blur: float
    along: float
    across: float
    contrast: float
    bright: float
    dark: float
    level: float

    def array(self) -> Floats:
        """The figures, (9,) float64, in the order and the units of the fields: numbers, px, degrees, shares."""
        return np.array(astuple(self), dtype=np.float64)

    @classmethod
    def of_array(cls, values: Floats) -> ImageState:
        """The state from its figures. values : (9,) float64, of :meth:`array`, in its units px, degrees and shares."""
        return cls(int(values[0]), int(values[1]), *values[2:].tolist())

    @property
    def lost(self) -> float:
        """Share of the points that were not matched, 0 to 1."""
        return 1.0 - self.matched / max(self.points, 1)


def pixel_digest(image: Image) -> str:
    """Digest of the grey levels (height, width) of an image; two images have the same one only where they are the same.

    The noise of a camera is never the same twice.
    """
    return hashlib.blake2b(np.ascontiguousarray(image[::_ROWS]).tobytes(), digest_size=16).hexdigest()


def image_state(reference: Image, image: Image, xy: Pixels, warp: Floats) -> ImageState:
    """Compare the pattern in a camera's image of a step with that in its reference image.

    reference, image : (height, width) grey levels. xy : (n, 2) px, points of the reference image. warp : (n, 6) u v ux
    uy vx vy, of their matches, px; NaN where lost.
    """
    good = np.flatnonzero(np.isfinite(warp[:, :6]).all(axis=1))
    moved = len(good) >= _FEWEST
    index = good if moved else np.arange(len(xy))
    index = index[:: max(1, len(index) // _CANDIDATES)]
    chosen = index[even_sample(xy[index], _SQUARES)] if len(index) else index
    first, second = _squares(reference, image, xy[chosen], warp[chosen, :6] if moved else np.zeros((len(chosen), 6)))
    if not len(first):
        return ImageState(len(xy), len(good), *[np.nan] * 7)
    change = blur_change(first, second)
    low, high = grey_limits(image)
    return ImageState(
        len(xy), len(good), change.along, change.angle, change.across, change.contrast,
        float((second >= high).mean()), float((second <= low).mean()), float(second.mean() * 255.0 / _range(image)),
    )  # fmt: skip


def grey_limits(image: Image) -> tuple[float, float]:
    """Grey levels at and below, and at and above which an image (height, width) is clipped."""
    if image.dtype == np.uint8:
        return 1.0, 254.0
    return 0.0, float(image.max())


def _range(image: Image) -> float:
    return 255.0 if image.dtype == np.uint8 else max(float(image.max()), 1.0)


def _squares(
    reference: Image, image: Image, xy: Pixels, warp: Floats
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Squares (k, side, side) of the later image about matched points, and the reference's warped onto them.

    xy : (n, 2) px. warp : (n, 6) of their matches. Squares that leave an image are left out.
    """
    half, (height, width) = SQUARE_PX // 2, image.shape
    pairs = []
    for point, (u, v, ux, uy, vx, vy) in zip(xy, warp, strict=False):
        to = point + np.array([u, v])
        x, y = np.rint(to).astype(int)
        back = np.linalg.inv([[1.0 + ux, uy], [vx, 1.0 + vy]])
        start = point + back @ (np.array([x, y]) - half - to)
        corners = start + np.array([[0, 0], [SQUARE_PX, 0], [0, SQUARE_PX], [SQUARE_PX, SQUARE_PX]]) @ back.T
        inside = half <= x < width - half and half <= y < height - half
        if not inside or (corners < 0).any() or (corners > (reference.shape[1] - 1, reference.shape[0] - 1)).any():
            continue
        x0, y0 = np.floor(corners.min(axis=0)).astype(int)
        x1, y1 = np.ceil(corners.max(axis=0)).astype(int) + 1
        part = reference[max(y0, 0) : y1, max(x0, 0) : x1].astype(np.float32)
        matrix = np.column_stack([back, start - (max(x0, 0), max(y0, 0))])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        warped = cv2.warpAffine(part, matrix, (SQUARE_PX, SQUARE_PX), flags=flags, borderMode=cv2.BORDER_REFLECT)
        pairs.append((warped, image[y - half : y + half, x - half : x + half].astype(np.float32)))
    both = np.array(pairs, np.float32).reshape(-1, 2, SQUARE_PX, SQUARE_PX)
    return both[:, 0], both[:, 1]
