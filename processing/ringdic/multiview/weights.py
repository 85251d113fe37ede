"""Weights of views that are smooth over the image.

Where cameras have moved a little since they were calibrated their lines of sight miss one another by far more than
noise, alike all over the surface, and a point lies between them as its weights share that out. A standard deviation of
a single match scatters by a tenth from one texture to the next: shared out by it, a smooth misfit becomes rough.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from ringdic.arrays import Floats


def smooth_sigma(px: Floats, sigma: Floats, cell: float) -> Floats:
    """The usual standard deviation about each point of one camera. (n, 2) px, NaN where ``sigma`` is.

    px, sigma : (n, 2). cell : px, side of the squares whose medians are taken, blurred over a square's width and
    interpolated between their middles.
    """
    known = np.isfinite(px).all(axis=1) & np.isfinite(sigma).all(axis=1)
    out = np.full_like(sigma, np.nan)
    if not known.any():
        return out
    place = (px[known] - px[known].min(axis=0)) / cell
    column, row = place.astype(np.int64).T
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    number = row * shape[1] + column
    order = np.argsort(number, kind="stable")
    cells, first = np.unique(number[order], return_index=True)
    count, total = np.zeros(shape), np.zeros((2, *shape))
    values = sigma[known]
    for which, members in zip(cells, np.split(order, first[1:]), strict=True):
        count.flat[which] = len(members)
        for axis in range(2):
            total[axis].flat[which] = len(members) * np.median(values[members, axis])

    def blurred(values: Floats) -> Floats:
        soft = gaussian_filter(values, 1.0, mode="constant")
        return np.asarray(map_coordinates(soft, place.T[::-1] - 0.5, order=1, mode="nearest"))

    out[known] = np.column_stack([blurred(total[0]), blurred(total[1])]) / blurred(count)[:, None]
    return out
