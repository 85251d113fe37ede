"""Smoothing of pixels' standard deviations over the image, for the weights of the views in triangulation.

Where cameras have moved a little since they were calibrated, their lines of sight miss one another by far more than
the noise, and similarly all over the surface; the weights then decide where between them a point lies. The standard
deviation of a single match varies by a tenth with the texture: weights from it would turn a smooth misfit into a rough
surface.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from ringdic.arrays import Floats, Pixels

#: Side of the cells over which weights are smoothed, in steps of the correlation's grid.
CELL_STEPS = 8


def smooth_sigma(px: Pixels, sigma: Floats, cell: float) -> Floats:
    """Smooth the standard deviations of one camera's pixels over its image.

    Medians are taken over square cells, blurred over a cell's width and interpolated between the middles of the cells.

    px : (n, 2) float64, px. sigma : (n, 2) px. cell : px, side of the cells. Returns (n, 2) px, NaN where ``sigma`` is.
    """
    known = np.isfinite(px).all(axis=1) & np.isfinite(sigma).all(axis=1)
    out = np.full_like(sigma, np.nan)
    if not known.any():
        return out
    cell_position = (px[known] - px[known].min(axis=0)) / cell
    column, row = cell_position.astype(np.int64).T
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    number = row * shape[1] + column
    count = np.bincount(number, minlength=math.prod(shape))
    cells = np.flatnonzero(count)
    members = count[cells]
    first = np.cumsum(members) - members
    total = np.zeros((2, len(count)))
    for axis, values in enumerate(sigma[known].T):
        ordered = values[np.argsort(number + values / (2.0 * values.max()))]  # by cell, and by value within one
        median = 0.5 * (ordered[first + (members - 1) // 2] + ordered[first + members // 2])
        total[axis, cells] = members * median

    def blurred(values: Floats) -> Floats:
        smooth = gaussian_filter(values.reshape(shape), 1.0, mode="constant")
        return np.asarray(map_coordinates(smooth, cell_position.T[::-1] - 0.5, order=1, mode="nearest"))

    out[known] = np.column_stack([blurred(total[0]), blurred(total[1])]) / blurred(count.astype(float))[:, None]
    return out
