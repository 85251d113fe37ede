"""Rasterisation of triangles into an image of triangle numbers, the nearest triangle in front."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices

FaceImage = NDArray[np.int32]

_AT_ONCE = 2_000_000  # pixels tried at a time


def paint(corners: Floats, depth: Floats, shape: tuple[int, int]) -> FaceImage:
    """Rasterise triangles: the number of the triangle seen at each pixel's centre, (height, width); −1 for none.

    corners : (M, 3, 2) px; a triangle with a corner that is not finite is left out. depth : (M,), the smaller the
    nearer. Triangles are taken from far to near, each as a whole, as is right where none pass through one another.
    """
    height, width = shape
    image = np.full(height * width, -1, dtype=np.int32)
    low, high = np.ceil(corners.min(axis=1)), np.floor(corners.max(axis=1))
    with np.errstate(invalid="ignore"):
        visible = (high[:, 0] >= 0) & (high[:, 1] >= 0) & (low[:, 0] <= width - 1) & (low[:, 1] <= height - 1)
        visible &= (high >= low).all(axis=1) & np.isfinite(depth)
    order = np.flatnonzero(visible)
    order = order[np.argsort(-depth[order], kind="stable")]
    first = np.clip(low[order], 0, (width - 1, height - 1)).astype(np.int64)
    last = np.clip(high[order], 0, (width - 1, height - 1)).astype(np.int64)
    across = last[:, 0] - first[:, 0] + 1
    tried = across * (last[:, 1] - first[:, 1] + 1)
    begin = 0
    while begin < len(order):
        end = begin + max(1, int(np.searchsorted(np.cumsum(tried[begin:]), _AT_ONCE)))
        some = slice(begin, end)
        _fill(image, width, corners, order[some], first[some], across[some], tried[some])
        begin = end
    return image.reshape(height, width)


def _fill(
    image: FaceImage,
    width: int,
    corners: Floats,
    faces: Indices,
    first: Indices,
    across: Indices,
    tried: Indices,
) -> None:
    """Rasterise some triangles in their order by testing every pixel of their bounding boxes."""
    of = np.repeat(np.arange(len(faces)), tried)
    row, column = np.divmod(np.arange(len(of)) - np.repeat(np.cumsum(tried) - tried, tried), across[of])
    x, y = first[of, 0] + column, first[of, 1] + row
    a, b, c = np.moveaxis(corners[faces], 1, 0)
    sides = np.stack([_turn(a, b, x, y, of), _turn(b, c, x, y, of), _turn(c, a, x, y, of)])
    inside = (sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)
    image[y[inside] * width + x[inside]] = faces[of[inside]]  # of several, the last one stays


def _turn(a: Floats, b: Floats, x: Indices, y: Indices, of: Indices) -> Floats:
    """Signed distance of pixels from the line a to b, times its length: its sign says on which side a pixel lies."""
    along = b - a
    constant = along[:, 0] * a[:, 1] - along[:, 1] * a[:, 0]
    return np.asarray(along[of, 0] * y - along[of, 1] * x - constant[of])
