"""Quality measures of a lens calibration: part of the image covered by the board, and systematic residuals."""

from __future__ import annotations

import cv2
import numpy as np

from ringdic.arrays import Pixels

#: Cells along the longer side of the image, for the area covered and for the residuals.
_AREA_CELLS, _CELLS = 120, 10
#: A cell with fewer corners has no reliable mean.
_FEWEST = 8


def coverage(views: Pixels, size: tuple[int, int]) -> float:
    """Part of the image, 0 to 1, that lies inside the convex outline of the corners of at least one view.

    views : (v, n, 2) px, corners of the board in v views. size : (width, height) of the image, px.
    """
    scale = _AREA_CELLS / max(size)
    covered = np.zeros((max(1, round(size[1] * scale)), max(1, round(size[0] * scale))), np.uint8)
    for view in views:
        hull = cv2.convexHull(np.asarray(view, dtype=np.float32)).reshape(-1, 2)
        cv2.fillConvexPoly(covered, np.rint((hull + 0.5) * scale - 0.5).astype(np.int32), 1)
    return float(covered.mean())


def residual_distortion(px: Pixels, residuals: Pixels, size: tuple[int, int]) -> float:
    """Systematic residuals of a lens model: RMS over cells of the image of the mean residual in a cell, px.

    The variance that random errors of single corners give to such means is subtracted.
    px, residuals : (..., 2) px, positions of the corners and their residuals. size : (width, height) of the image, px.
    NaN where no cell has enough corners.
    """
    positions, residuals = px.reshape(-1, 2), residuals.reshape(-1, 2)
    cell = max(size) / _CELLS
    column, row = np.floor(positions.T / cell).astype(int)
    _, index, count = np.unique(row * 1000 + column, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(index, weights=axis) for axis in residuals.T], axis=1) / count[:, None]
    spread = np.sum((residuals - mean[index]) ** 2, axis=1)
    enough = count >= _FEWEST
    if not enough.any():
        return float("nan")
    variance = np.bincount(index, weights=spread)[enough] / (count[enough] - 1)
    own = np.sum(mean[enough] ** 2, axis=1) - variance / count[enough]
    return float(np.sqrt(max(np.mean(own), 0.0)))
