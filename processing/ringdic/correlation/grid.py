"""Regular grid of points inside a mask, and the triangles between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Mask, Pixels


def grid(mask: Mask, step: int) -> tuple[Pixels, NDArray[np.int32]]:
    """Points at the multiples of the step inside a mask, and the triangles of the grid that they form.

    mask : (height, width) bool, region of interest. step : px, grid spacing.
    Returns xy (n, 2) float64, px, column by column (x outer, y inner), and faces (m, 3) int32: the Delaunay triangles
    of the points whose edges are at most one diagonal of the grid. Faces run counter-clockwise on the screen (x right,
    y down: negative cross product), so that on a surface seen by the camera normals point outwards.
    """
    at_step = np.ascontiguousarray(mask[::step, ::step].T)
    column, row = np.nonzero(at_step)
    xy = np.stack([column, row], axis=1).astype(np.float64) * step
    index = np.full((at_step.shape[0] + 1, at_step.shape[1] + 1), -1, np.int64)
    index[column, row] = np.arange(len(xy))
    top_left, bottom_left = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    top_right, bottom_right = index[1:, :-1].ravel(), index[1:, 1:].ravel()
    return xy, _triangles(top_left, bottom_left, bottom_right, top_right)


def _triangles(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> NDArray[np.int32]:
    """Triangles of grid squares whose corners are the points a b c d, counter-clockwise on the screen.

    a, b, c, d : (k,) indices of points, -1 where there is none. A square that lacks one corner gives one triangle. (m,
        3).
    """
    whole = (a >= 0) & (b >= 0) & (c >= 0) & (d >= 0)
    parts = [np.stack([a, b, c], 1)[whole], np.stack([a, c, d], 1)[whole]]
    for first, second, third, missing in ((a, b, c, d), (b, c, d, a), (c, d, a, b), (d, a, b, c)):
        alone = (first >= 0) & (second >= 0) & (third >= 0) & (missing < 0)
        parts.append(np.stack([first, second, third], 1)[alone])
    return np.concatenate(parts).astype(np.int32)
