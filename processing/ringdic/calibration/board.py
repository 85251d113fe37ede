"""Detection of the corners of a checkerboard in an image, refined to sub-pixel positions at full resolution."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Pixels
from ringdic.session.rig import Board

#: Long sides to which an image is scaled for the detection of the board, px: the smallest first, as it is fastest.
_SEARCH_SIZES = (1000, 2000)
#: Squares more or less, across and along together, that are tried where the board is not found.
_MISCOUNT = 2


def board_points(board: Board) -> Floats:
    """Positions of the inner corners on the board, (n, 2) mm, the first at (0, 0), in the order of `find_corners`."""
    across, along = board.inner_corners
    y, x = np.mgrid[:along, :across]
    return np.column_stack([x.ravel(), y.ravel()]) * float(board.square_mm)


def find_corners(image: NDArray[np.generic], inner_corners: tuple[int, int]) -> Pixels | None:
    """Sub-pixel positions of the inner corners of a checkerboard in an image.

    image : (height, width) grey, uint8, uint16 or float in 0 … 255.
    inner_corners : numbers of corners (across, along) the board.

    Returns (n, 2) px, row by row, ``across`` running fastest, or None where the whole board is not detected. Which end
    of the board comes first is arbitrary; the intrinsics do not depend on it. A corner is the point to which the grey
    gradients around it are perpendicular (Förstner & Gülch 1987).
    """
    grey = _as_uint8(image)
    rough = _search(grey, inner_corners)
    if rough is None:
        return None
    spacing = _spacing(rough, inner_corners)
    half = int(np.clip(round(0.35 * spacing), 2, 15))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    start = np.ascontiguousarray(rough, dtype=np.float32).reshape(-1, 1, 2)
    fine = cv2.cornerSubPix(grey, start.copy(), (half, half), (-1, -1), stop).reshape(-1, 2).astype(float)
    moved = np.linalg.norm(fine - rough, axis=1)
    return fine if np.all(moved < 0.35 * spacing) else None


def count_squares(image: NDArray[np.generic], board: Board) -> tuple[int, int] | None:
    """Count the squares of the checkerboard in an image: their number (across, along), None if far from the board's.

    image : (height, width) grey, uint8, uint16 or float in 0 … 255.
    """
    grey = _as_uint8(image)
    scale = min(_SEARCH_SIZES[0] / max(grey.shape), 2.0)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    across, along = board.squares
    off = sorted(itertools.product(range(-_MISCOUNT, _MISCOUNT + 1), repeat=2), key=lambda each: sum(map(abs, each)))
    for more_across, more_along in off:
        squares = across + more_across, along + more_along
        near = abs(more_across) + abs(more_along) <= _MISCOUNT
        if (
            near
            and min(squares) > 3
            and cv2.findChessboardCornersSB(small, (squares[0] - 1, squares[1] - 1), flags=0)[0]
        ):
            return squares
    return None


def _search(grey: NDArray[np.uint8], inner_corners: tuple[int, int]) -> Pixels | None:
    """Corners (n, 2) px good to about a pixel, from the smallest scaled image in which the board is detected."""
    height, width = grey.shape
    for size in _SEARCH_SIZES:
        scale = min(size / max(height, width), 2.0)
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = cv2.resize(grey, (round(width * scale), round(height * scale)), interpolation=method).astype(np.uint8)
        detected, corners = cv2.findChessboardCornersSB(small, inner_corners, flags=0)
        if detected:
            factor = np.array([width / small.shape[1], height / small.shape[0]])
            return (corners.reshape(-1, 2).astype(float) + 0.5) * factor - 0.5
    return None


def _spacing(corners: Pixels, inner_corners: tuple[int, int]) -> float:
    """Smallest distance between neighbouring corners (n, 2), px."""
    grid = corners.reshape(inner_corners[1], inner_corners[0], 2)
    return float(
        min(
            np.linalg.norm(np.diff(grid, axis=0), axis=-1).min(),
            np.linalg.norm(np.diff(grid, axis=1), axis=-1).min(),
        )
    )


def _as_uint8(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Grey levels of the image (height, width) in 8 bits."""
    if image.ndim != 2:
        raise ValueError(f"a grey image has two axes, not {image.ndim}")
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image, dtype=np.uint8)
    if image.dtype == np.uint16:
        return np.ascontiguousarray(image.astype(np.float32) / 257.0 + 0.5).astype(np.uint8)
    return np.clip(image.astype(np.float32) + 0.5, 0, 255).astype(np.uint8)
