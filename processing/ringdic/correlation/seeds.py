"""Seed points, and their start values in another image of the same camera by optical flow and by template matching.

Both methods work on reduced images whose local mean and contrast are equalised, so that a change of light between the
images does not matter. Between cameras, ``features`` gives start values.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Pixels
from ringdic.correlation.prepared import Current, Reference, as_8_bit

_SEEDS = 150
_FLOW_SIDE = 300  # px of the longer side of the reduced region
_FLOW_TIMES = 8.0  # times that it is reduced at most
_FLOW_BLUR = 0.5  # subset radii, standard deviation of the Gaussian that smooths the flow
_FLOW_MARGIN = 96  # px around the region
_LEVELLED = 35  # px of the reduced image over which mean and contrast are equalised
_SEARCH = 160  # px, largest displacement of the template search
_ROW = 1024  # samples in a row of those that OpenCV takes at a time: it takes fewer than 32,767 rows


def even_sample(xy: Pixels, count: int = _SEEDS) -> Indices:
    """Sample of about ``count`` points spread evenly over the area of all.

    xy : (n, 2) float64, px. Returns indices (k,), ascending: in each cell of a grid the point nearest to its middle.
    """
    if len(xy) <= count:
        return np.arange(len(xy))
    low, size = xy.min(axis=0), np.ptp(xy, axis=0) + 1.0
    # Occupied area is unknown; shrink the cell until enough cells are occupied.
    side = float(np.sqrt(size[0] * size[1] / count))
    for _ in range(12):
        cell = np.floor((xy - low) / side).astype(np.int64)
        label = cell[:, 0] * (int(size[1] / side) + 2) + cell[:, 1]
        if len(np.unique(label)) >= 0.8 * count:
            break
        side *= 0.8
    off = np.hypot(*((xy - low) / side - cell - 0.5).T)
    order = np.lexsort((off, label))
    first = np.flatnonzero(np.diff(label[order], prepend=label.min() - 1))
    return np.sort(order[first])


def flow_start_values(reference: Reference, current: Current, xy: Pixels, radius: int) -> Floats:
    """Start values from dense inverse search optical flow (Kroeger et al. 2016) on a reduced region of the images.

    xy : (n, 2) float64, px, points of the reference image. radius : px, of the subset.
    Returns (n, 12), displacement in px and its gradients in the order of the kernels' parameters; NaN if the region is
    too small.
    """
    h, w = reference.mask.shape
    scale = _flow_scale(max(h, w))
    x0, y0 = (np.maximum(reference.origin - _FLOW_MARGIN, 0)).astype(int)
    x1, y1 = (reference.origin + np.array([w, h]) + _FLOW_MARGIN).astype(int)
    ref = reference.get_or_compute(("levelled", scale), lambda: _reduced(reference.image[y0:y1, x0:x1], scale))
    cur = _reduced(current.image[y0:y1, x0:x1], scale)
    height, width = min(ref.shape[0], cur.shape[0]), min(ref.shape[1], cur.shape[1])
    if min(height, width) < 16:
        return np.full((len(xy), 12), np.nan)
    flow_search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    # The whole resolution of a small image is more exact, and faster, than a part of a large one's and smoothing there.
    flow_search.setFinestScale(0)
    flow_search.setVariationalRefinementIterations(0)
    flow = flow_search.calc(ref[:height, :width], cur[:height, :width], np.zeros((height, width, 2), np.float32))
    smooth = np.float32(1.0 / scale) * cv2.GaussianBlur(flow, (0, 0), max(_FLOW_BLUR * radius * scale, 0.5)).astype(
        np.float32
    )
    at = _reduced_position(xy - (x0, y0), scale)
    reach = max(0.7 * radius * scale, 1.0)
    centre, left, right, up, down = (
        _sample(smooth, at + np.array(shift) * reach) for shift in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))
    )
    out = np.zeros((len(xy), 12))
    d_dx, d_dy = (right - left) * scale / (2 * reach), (down - up) * scale / (2 * reach)
    out[:, [0, 6]], out[:, [1, 7]], out[:, [2, 8]] = centre, d_dx, d_dy
    return out


def _flow_scale(side: int) -> float:
    """Scale, at most 1, to which a region is reduced for the optical flow; side : px, the longer side of the region.

    From about a half down it is one over a whole number: averages over whole pixels cost a tenth.
    """
    times = min(max(side / _FLOW_SIDE, 1.0), _FLOW_TIMES)
    return 1.0 / (round(times) if times > 1.5 else times)


def template_start_values(reference: Reference, current: Current, xy: Pixels, radius: int) -> Floats:
    """Start values from normalised cross-correlation of a template within ± 160 px, on reduced images.

    xy : (n, 2) float64, px, points of the reference image. radius : px, of the subset.
    Returns (n, 12), displacement in px and zeros, in the order of the kernels' parameters; NaN where no peak is high
    enough.
    """
    scale = 1.0 / max(1, min(4, radius // 8))
    ref, cur = _reduced(reference.image, scale), _reduced(current.image, scale)
    half, reach = round(max(1.2 * radius, 12) * scale), round(_SEARCH * scale)
    out = np.full((len(xy), 12), np.nan)
    for k, (x, y) in enumerate(np.rint(_reduced_position(xy, scale)).astype(int)):
        top, left = max(y - half, 0), max(x - half, 0)
        template = ref[top : y + half + 1, left : x + half + 1]
        top_c, left_c = max(top - reach, 0), max(left - reach, 0)
        window = cur[top_c : y + half + 1 + reach, left_c : x + half + 1 + reach]
        if min(template.shape) < half + 1 or window.shape[0] < template.shape[0] or window.shape[1] < template.shape[1]:
            continue
        _, peak, _, (at_x, at_y) = cv2.minMaxLoc(cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED))
        if peak > 0.4:
            out[k] = 0.0
            out[k, 0], out[k, 6] = (left_c + at_x - left) / scale, (top_c + at_y - top) / scale
    return out


def _reduced(image: NDArray, scale: float) -> NDArray[np.uint8]:
    """An image in 8 bits, reduced by area averaging, with a local mean of 128 and a local standard deviation of 40."""
    grey: NDArray = as_8_bit(image)
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    level = grey.astype(np.float32)
    level -= cv2.blur(level, (_LEVELLED, _LEVELLED))
    deviation = np.sqrt(np.maximum(cv2.blur(level * level, (_LEVELLED, _LEVELLED)), 4.0))
    return np.clip(128.0 + 40.0 * level / deviation, 0, 255).astype(np.uint8)


def _reduced_position(xy: Pixels, scale: float) -> Pixels:
    """Positions (n, 2) in the reduced image of positions in the full one, px.

    Area averaging keeps the outer corner of the corner pixel, at (-0.5, -0.5), in place.
    """
    return (xy + 0.5) * scale - 0.5


def _sample(flow: NDArray[np.float32], at: Pixels) -> Pixels:
    """Bilinear samples (n, 2) of a flow field at positions (n, 2), px of the field."""
    rows = len(at) // _ROW + 1
    filled = np.zeros((2, rows * _ROW), np.float32)
    filled[:, : len(at)] = at.T
    x, y = filled.reshape(2, rows, _ROW)
    sampled = cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled.reshape(-1, 2)[: len(at)], dtype=np.float64)
