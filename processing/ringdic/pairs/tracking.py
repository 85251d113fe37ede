"""One camera followed in time: its own grid over what its pairs see, matched from its reference image in a later one.

A pair's first camera has its points on that grid; those of the second lie between, where the pair's reference images
were matched, and are read from it. So every image is matched once, between images that differ by the motion alone, and
what the match between the cameras left over is the same at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Mask
from ringdic.correlation import (
    Correlation,
    CorrelationSettings,
    Current,
    Reference,
    Status,
    correlate_points,
    prepare_current,
    search_warps,
)
from ringdic.correlation.lattice_field import interpolate_lattice
from ringdic.correlation.seeds import flow_start_values
from ringdic.correlation.start_field import lattice_spacing, match_from_lattice, on_lattice

_HELD = 0.6  # ZNCC under the warp that optical flow tells, from which on it is a start value
_ENOUGH = 0.8  # share of the points that must be matched, or start values are looked for in other ways
_SOME = 0.2  # share of the lattice that must hold for the rest of it to be reached from there
_LEAST = 0.02  # weight of the matched corners about a place below which nothing is said there
_DIGITS = 4  # binary digits after the point of the pixels that triangles are drawn with

#: Of a pair whose first camera it is: the region (height, width) and the grid points (n, 2) px that were matched.
Own = tuple[Mask, Floats]
#: Of a pair whose second camera it is: places (n, 2) px of the points, NaN where not matched, and triangles (m, 3).
Shared = tuple[Floats, NDArray[np.int32]]


@dataclass(frozen=True)
class CameraGrid:
    """What is followed of a camera: a region (height, width) of its reference image and points xy (n, 2) px in it,
    multiples of ``step`` px."""

    region: Mask
    xy: Floats
    step: int


@dataclass(frozen=True)
class CameraMatches:
    """The n points xy (n, 2) px of a camera's grid in its image of one step, NaN where lost.

    step : px, of the grid. uv : (n, 2) px. gradient : (n, 2, 2). sigma : (n, 2) px. c_ls, status : (n,).
    """

    xy: NDArray[np.int32]
    step: int
    uv: Floats
    gradient: NDArray[np.float32]
    sigma: NDArray[np.float32]
    c_ls: NDArray[np.float32]
    status: NDArray[np.int8]


@dataclass(frozen=True)
class CameraPixels:
    """What a camera's images of one step say of places in its reference image, NaN where nothing is known.

    px : (n, 2) there now. sigma : (n, 2) px. c_ls : (n,). status : (n,), 0 good.
    """

    px: Floats
    sigma: Floats
    c_ls: Floats
    status: NDArray[np.int8]


def camera_grid(size: tuple[int, int], step: int, own: Sequence[Own], shared: Sequence[Shared]) -> CameraGrid:
    """The grid over what a camera's pairs see of it.

    size : (width, height). own : of each pair whose first camera it is, shared : of each whose second it is.
    """
    width, height = size
    region = np.zeros((height, width), np.uint8)
    wanted = np.zeros((width // step + 2, height // step + 2), bool)
    for mask, xy in own:
        region |= mask.view(np.uint8)
        column, row = np.rint(xy / step).astype(np.int64).T
        wanted[column, row] = True
    for px, faces in shared:
        corners = px[faces]
        drawn = corners[np.isfinite(corners).all(axis=(1, 2))]
        cv2.fillPoly(region, list(np.rint(drawn * 2**_DIGITS).astype(np.int32)), 1, shift=_DIGITS)
        column, row = np.floor(px[np.isfinite(px).all(axis=1)] / step).astype(np.int64).T
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            wanted[column + i, row + j] = True
    inside = region[::step, ::step].T > 0
    column, row = np.nonzero(inside & wanted[: inside.shape[0], : inside.shape[1]])
    return CameraGrid(region > 0, step * np.stack([column, row], axis=1).astype(np.float64), step)


def match_camera(reference: Reference, image: Image, grid: CameraGrid, settings: CorrelationSettings) -> CameraMatches:
    """The camera's points in its image of a step. reference : its reference image with the grid's region."""
    found = match_in_time(reference, prepare_current(image, settings=settings), grid.xy, settings)
    return CameraMatches(
        grid.xy.astype(np.int32),
        grid.step,
        found.uv,
        found.gradient.astype(np.float32),
        found.sigma.astype(np.float32),
        found.c_ls.astype(np.float32),
        found.status.astype(np.int8),
    )


def places(found: CameraMatches, xy: Floats) -> CameraPixels:
    """Where places xy (n, 2) px of the camera's reference image lie in its image of a step."""
    values = np.column_stack([found.uv, found.gradient.reshape(-1, 4), found.sigma, found.c_ls]).astype(np.float64)
    told, weight = interpolate_lattice(found.xy, values, found.step, xy)
    lost = ~(weight >= _LEAST)
    told[lost] = np.nan
    status = np.zeros(len(xy), np.int8)
    status[lost] = _beside(found, xy[lost])
    return CameraPixels(xy + told[:, :2], told[:, 6:8], told[:, 8], status)


def match_in_time(reference: Reference, current: Current, xy: Floats, settings: CorrelationSettings) -> Correlation:
    """Points xy (n, 2) px of a camera's reference image in a later one, from where optical flow puts some of them.

    Where that leads to few matches the correlation looks for start values in its own ways.
    """
    chosen = np.flatnonzero(on_lattice(xy, lattice_spacing(settings)))
    flow = flow_start_values(reference, current, xy[chosen], settings.radius)[:, [0, 6, 1, 2, 7, 8]]
    known = np.flatnonzero(np.isfinite(flow).all(axis=1))
    warps, zncc, _ = search_warps(reference, current, xy[chosen[known]], flow[known][:, None], settings.radius)
    held = zncc > _HELD
    if held.sum() < _SOME * max(len(chosen), 1):
        return correlate_points(reference, current, xy, settings)
    start = np.full((len(xy), 6), np.nan)
    start[chosen[known[held]]] = warps[held]
    found = match_from_lattice(reference, current, xy, settings, start, lattice_spacing(settings))
    if found.good.mean() >= _ENOUGH:
        return found
    searched = correlate_points(reference, current, xy, settings)
    return searched if searched.good.sum() > found.good.sum() else found


def _beside(found: CameraMatches, xy: Floats) -> NDArray[np.int8]:
    """Why nothing is known at places xy (k, 2) px: what befell the grid's point nearest to each."""
    cells = found.xy // found.step
    told = np.full((found.xy.max(axis=0, initial=0) // found.step + 2), Status.NOT_REACHED, np.int8)
    told[tuple(cells.T)] = np.where(found.status == Status.GOOD, Status.NOT_REACHED, found.status)
    nearest = np.rint(np.nan_to_num(xy, nan=-1.0) / found.step).astype(np.int64)
    within: Mask = ((nearest >= 0) & (nearest < told.shape)).all(axis=1)
    return np.where(within, told[tuple(np.where(within[:, None], nearest, 0).T)], np.int8(Status.NOT_REACHED))
