"""Tracking in one camera: a grid over all that the charts show of its reference image, matched in each later image.

The points of a camera's own chart lie on that grid. Those of other charts lie between the grid's points, and their
displacement is interpolated. So every image is matched once, and each step apart from all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Mask, Pixels
from ringdic.charts.step_matching import ImageMatches, match_tracked_points
from ringdic.charts.tracked_points import TrackedPoints
from ringdic.correlation import CorrelationSettings, Reference, Status, prepare_current
from ringdic.correlation.lattice_field import interpolate_lattice
from ringdic.mesh.adjacency import shared_edges
from ringdic.mesh.mesh import half_edges

_LEAST = 0.02  # least weight of the matched corners about a point for an interpolated value
_DIGITS = 4  # binary digits after the point of the corners of drawn triangles

#: View of a chart in one camera: pixels of its points (n, 2), NaN where the camera does not see them, and its
#: triangles (m, 3).
ChartView = tuple[Pixels, NDArray[np.int32]]


@dataclass(frozen=True)
class CameraGrid:
    """Region of interest and grid of one camera in its reference image, over the parts of all charts that it sees.

    region : (height, width) bool. xy : (n, 2) float64, px, points of the grid. step : px, of which they are multiples.
    """

    region: Mask
    xy: Pixels
    step: int


@dataclass(frozen=True)
class CameraMatches:
    """Matches of the n points of a camera's grid in its image of one step, NaN where lost.

    xy : (n, 2) int, px, the grid. step : px, of the grid. uv : (n, 2) px, displacement. gradient : (n, 2, 2),
    du_i/dx_j. curvature : (n, 2, 3) 1/px, second derivatives by xx, xy, yy. sigma : (n, 2) px of the later image.
    c_ls : (n,). status : (n,) int, 0 where good.
    """

    xy: NDArray[np.int32]
    step: int
    uv: Pixels
    gradient: NDArray[np.float32]
    curvature: NDArray[np.float32]
    sigma: NDArray[np.float32]
    c_ls: NDArray[np.float32]
    status: NDArray[np.int8]


@dataclass(frozen=True)
class CameraPixels:
    """Pixels of some points of a camera's reference image in its image of one step, NaN where unknown.

    px : (n, 2) px. sigma : (n, 2) px. c_ls : (n,). status : (n,) int, 0 where good.
    """

    px: Pixels
    sigma: Pixels
    c_ls: Floats
    status: NDArray[np.int8]


def surface_grid(size: tuple[int, int], step: int, views: Sequence[ChartView]) -> CameraGrid:
    """Determine the region and the grid of a camera from the charts that it sees.

    size : (width, height) of its images, px. step : px, of the grid. views : of the charts.
    """
    width, height = size
    region = np.zeros((height, width), np.uint8)
    wanted = np.zeros((width // step + 2, height // step + 2), bool)
    for px, faces in views:
        seen: Mask = np.asarray(np.isfinite(px).all(axis=1))
        first, second, third = seen[faces.T]
        corners = np.rint(np.where(seen[:, None], px, 0.0) * 2**_DIGITS).astype(np.int32)
        outlines = [corners[loop] for loop in _outlines(faces[first & second & third])]
        cv2.fillPoly(region, outlines, 1, shift=_DIGITS)
        at = px[seen]
        at = at[(at >= 0).all(axis=1) & (at <= (width - 1, height - 1)).all(axis=1)]
        column, row = np.floor(at / step).astype(np.int64).T
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            wanted[column + i, row + j] = True
    grown = np.asarray(cv2.dilate(region, np.ones((3, 3), np.uint8))) > 0
    inside = grown[::step, ::step].T
    column, row = np.nonzero(inside & wanted[: inside.shape[0], : inside.shape[1]])
    return CameraGrid(grown, step * np.stack([column, row], axis=1).astype(np.float64), step)


def _outlines(faces: NDArray[np.int32]) -> list[list[int]]:
    """Closed loops of vertices about triangles (m, 3), of edges that belong to one triangle alone."""
    half = half_edges(faces.astype(np.int64))
    _, alone = shared_edges(half)
    onward: dict[int, list[int]] = {}
    for start, end in half[alone].tolist():
        onward.setdefault(start, []).append(end)
    loops = []
    while onward:
        loop, (at, _) = [], next(iter(onward.items()))
        while at in onward:
            loop.append(at)
            ends = onward[at]
            at = ends.pop()
            if not ends:
                del onward[loop[-1]]
        loops.append(loop)
    return loops


def match_in_two_passes(
    reference: Reference, image: Image, points: TrackedPoints, settings: CorrelationSettings, *, curved: bool = True
) -> CameraMatches:
    """Match the points of a camera's grid in its image of a step.

    reference : its reference image, prepared with the grid's region. image : (height, width) grey levels. points : of
    the grid, prepared for tracking. curved : whether the curvature of the displacement is held; otherwise one
    pass as the settings say.
    """
    current = prepare_current(image, settings=settings)
    matches = match_tracked_points(reference, current, points, settings, curved=curved)
    return CameraMatches(
        points.pixels.astype(np.int32),
        settings.step,
        matches.warp[:, :2],
        matches.warp[:, 2:6].reshape(-1, 2, 2).astype(np.float32),
        matches.warp[:, 6:].reshape(-1, 2, 3).astype(np.float32),
        _sigma_in_current(matches).astype(np.float32),
        matches.c_ls.astype(np.float32),
        matches.status.astype(np.int8),
    )


def _sigma_in_current(matches: ImageMatches) -> Pixels:
    """Standard deviations (n, 2) of matches in pixels of the later image; the correlation states the reference's."""
    G = np.eye(2) + matches.warp[:, 2:6].reshape(-1, 2, 2)
    return np.sqrt(np.einsum("nij,nj->ni", G**2, matches.sigma**2))


def interpolate_matches(matches: CameraMatches, xy: Pixels) -> CameraPixels:
    """Interpolate a camera's matches at points of its reference image, to get their pixels in the image of a step.

    xy : (n, 2) float64, px, in the reference image.
    """
    slopes, bends = matches.gradient.reshape(-1, 4), matches.curvature.reshape(-1, 6)
    values = np.column_stack([matches.uv, slopes, bends, matches.sigma, matches.c_ls])
    interpolated, weight = interpolate_lattice(matches.xy, values.astype(np.float64), matches.step, xy)
    lost = ~(weight >= _LEAST)
    interpolated[lost] = np.nan
    status = np.zeros(len(xy), np.int8)
    status[lost] = _status_nearby(matches, xy[lost])
    return CameraPixels(xy + interpolated[:, :2], interpolated[:, 12:14], interpolated[:, 14], status)


def _status_nearby(matches: CameraMatches, xy: Pixels) -> NDArray[np.int8]:
    """Reasons (k,) why points have no pixel in the image: the status of the grid's point nearest to each.

    xy : (k, 2) px, in the reference image.
    """
    cells = matches.xy // matches.step
    status = np.full((matches.xy.max(axis=0, initial=0) // matches.step + 2), Status.NOT_REACHED, np.int8)
    status[tuple(cells.T)] = np.where(matches.status == Status.GOOD, Status.NOT_REACHED, matches.status)
    nearest = np.rint(np.nan_to_num(xy, nan=-1.0) / matches.step).astype(np.int64)
    within: Mask = ((nearest >= 0) & (nearest < status.shape)).all(axis=1)
    return np.where(within, status[tuple(np.where(within[:, None], nearest, 0).T)], np.int8(Status.NOT_REACHED))
