"""Tracking in one camera: a grid over the regions of its pairs, matched from its reference image in each later image.

The points of a pair's first camera lie on that grid. Those of its second camera, at the pixels where the pair's
reference images were matched, lie between the grid's points, and their displacement is interpolated. So every image is
matched once, with an image that differs from it by the motion alone, and what remains of the error between the cameras
is the same at every step.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Image, Mask, Pixels
from ringdic.charts.tracking import CameraGrid, CameraMatches
from ringdic.correlation import (
    CorrelationSettings,
    Current,
    PointMatches,
    Reference,
    correlate_points,
    prepare_current,
    search_warps,
)
from ringdic.correlation.seeds import flow_start_values
from ringdic.correlation.start_field import lattice_spacing, match_from_lattice, on_lattice

_START_ZNCC = 0.6  # least ZNCC under the warp by optical flow that makes it a start value
_ENOUGH = 0.8  # share of the points that must be matched, or start values are sought in other ways
_SOME = 0.2  # share of the sparse lattice with start values from which the rest can be reached
_DIGITS = 4  # binary digits after the point of the corners of drawn triangles

#: View of a pair's first camera: region of interest (height, width) and matched points of the grid (n, 2) px.
FirstCameraView = tuple[Mask, Pixels]
#: View of a pair's second camera: pixels of the points (n, 2), NaN where not matched, and triangles (m, 3) over them.
SecondCameraView = tuple[Pixels, NDArray[np.int32]]


def camera_grid(
    size: tuple[int, int], step: int, first: Sequence[FirstCameraView], second: Sequence[SecondCameraView]
) -> CameraGrid:
    """Determine the region and grid of a camera from the matches of its pairs.

    size : (width, height) of its images, px. step : px, of the grid. first : views of the pairs of which it is the
    first camera. second : views of the pairs of which it is the second camera.
    """
    width, height = size
    region = np.zeros((height, width), np.uint8)
    wanted = np.zeros((width // step + 2, height // step + 2), bool)
    for mask, xy in first:
        region |= mask.view(np.uint8)
        column, row = np.rint(xy / step).astype(np.int64).T
        wanted[column, row] = True
    for px, faces in second:
        corners = px[faces]
        triangles = corners[np.isfinite(corners).all(axis=(1, 2))]
        cv2.fillPoly(region, list(np.rint(triangles * 2**_DIGITS).astype(np.int32)), 1, shift=_DIGITS)
        column, row = np.floor(px[np.isfinite(px).all(axis=1)] / step).astype(np.int64).T
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            wanted[column + i, row + j] = True
    inside = region[::step, ::step].T > 0
    column, row = np.nonzero(inside & wanted[: inside.shape[0], : inside.shape[1]])
    return CameraGrid(region > 0, step * np.stack([column, row], axis=1).astype(np.float64), step)


def match_camera(reference: Reference, image: Image, grid: CameraGrid, settings: CorrelationSettings) -> CameraMatches:
    """Match the points of a camera's grid in its image of a step.

    reference : its reference image, prepared with the grid's region. image : (height, width) grey levels. grid : the
    points, (n, 2) px.
    """
    matches = track_points(reference, prepare_current(image, settings=settings), grid.xy, settings)
    return CameraMatches(
        grid.xy.astype(np.int32),
        grid.step,
        matches.uv,
        matches.gradient.astype(np.float32),
        matches.sigma.astype(np.float32),
        matches.c_ls.astype(np.float32),
        matches.status.astype(np.int8),
    )


def track_points(reference: Reference, current: Current, xy: Pixels, settings: CorrelationSettings) -> PointMatches:
    """Match points of a camera's reference image in a later image, with start values from optical flow.

    Where these give few matches, the correlation searches for start values itself. xy : (n, 2) float64, px.
    """
    sparse = np.flatnonzero(on_lattice(xy, lattice_spacing(settings)))
    flow = flow_start_values(reference, current, xy[sparse], settings.radius)[:, [0, 6, 1, 2, 7, 8]]
    known = np.flatnonzero(np.isfinite(flow).all(axis=1))
    warps, zncc, _ = search_warps(reference, current, xy[sparse[known]], flow[known][:, None], settings.radius)
    holds = zncc > _START_ZNCC
    if holds.sum() < _SOME * max(len(sparse), 1):
        return correlate_points(reference, current, xy, settings)
    start = np.full((len(xy), 6), np.nan)
    start[sparse[known[holds]]] = warps[holds]
    matches = match_from_lattice(reference, current, xy, settings, start, lattice_spacing(settings))
    if matches.good.mean() >= _ENOUGH:
        return matches
    searched = correlate_points(reference, current, xy, settings)
    return searched if searched.good.sum() > matches.good.sum() else matches
