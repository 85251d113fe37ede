"""Matching of one camera pair: between its reference images, then at every step by tracking in either camera.

The reference is the first camera's first image (Solav et al. 2018, step 2). Start values between the cameras come from
the calibration and a sweep of proxy cylinders. Each later image is matched to the reference image of its own camera
(``tracking``), in the second camera at the pixels matched here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Mask, Pixels
from ringdic.charts.tracking import CameraPixels
from ringdic.correlation import CorrelationSettings, Current, Status, grid, prepare_current, prepare_reference
from ringdic.correlation.start_field import lattice_spacing, match_from_lattice
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.sweep.region import lattice_region, within_incidence
from ringdic.sweep.sweep import SWEEP_SPACING, DepthSearch, search_radii, sweep_depths


@dataclass(frozen=True)
class Stereo:
    """Two calibrated cameras, the reference camera first, and the settings by which they are matched."""

    cameras: tuple[Camera, Camera]
    search: DepthSearch
    settings: CorrelationSettings

    @cached_property
    def radii(self) -> Floats:
        """Radii (K,) mm of the sweep's proxy cylinders."""
        return search_radii(self.cameras, self.search)

    @property
    def ids(self) -> tuple[str, str]:
        """Ids of the two cameras."""
        return self.cameras[0].id, self.cameras[1].id


@dataclass(frozen=True)
class PairGrid:
    """Region of interest and grid of one camera pair, in the first camera's reference image.

    region : (height, width) bool. xy : (n, 2) float64, px, the grid's points. faces : (m, 3) int, triangles between
    them.
    """

    region: Mask
    xy: Pixels
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class StepMatches:
    """Matches of a pair's n points in both cameras' images of one step; NaN where a camera has no match.

    px : (2, n, 2) px. sigma : (2, n, 2) px. c_ls : (n,), the largest over the images used. status : (n,) int, 0 where
    matched in both images. seconds : time of the match between the cameras, by stage.
    """

    px: Pixels
    sigma: NDArray[np.float32]
    c_ls: NDArray[np.float32]
    status: NDArray[np.int8]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def good(self) -> Mask:
        """Points matched in both images, (n,) bool."""
        return np.asarray(self.status == Status.GOOD)

    @property
    def second_px(self) -> Pixels:
        """Pixels (n, 2) px of the matched points in the second camera's image, NaN elsewhere."""
        return np.where(self.good[:, None], self.px[1], np.nan)


def match_reference(stereo: Stereo, first: Image, second: Image, mask: Mask | None) -> tuple[PairGrid, StepMatches]:
    """Determine a pair's region of interest, lay the grid over it, and match its points between the cameras.

    first, second : (height, width) grey levels, the cameras' reference images. mask : (height, width) bool, a region
    drawn by the user; None: the region is determined by a sweep.

    Raises ComputationError where the cameras share no textured surface.
    """
    settings = stereo.settings
    current = prepare_current(second, settings=settings)
    region, seeds, warps = _find_region(stereo, first, current, mask)
    xy, faces = grid(region, settings.step)
    reference = prepare_reference(first, region, settings)
    matches = match_from_lattice(
        reference, current, xy, settings, _start_at(xy, seeds, warps), lattice_spacing(settings, SWEEP_SPACING)
    )
    px = np.stack([xy, xy + matches.uv])  # the grid itself is exact
    sigma = np.stack([np.zeros_like(matches.sigma), matches.sigma]).astype(np.float32)
    status = matches.status.astype(np.int8)
    step = StepMatches(px, sigma, matches.c_ls.astype(np.float32), status, matches.seconds)
    return PairGrid(region, xy, faces), step


def step_matches(reference: StepMatches, pixels: tuple[CameraPixels | None, CameraPixels | None]) -> StepMatches:
    """Matches of a pair at a step, from the pixels of its points in either camera's image.

    A point that the pair's reference images do not share keeps its status: it never has a position in space. The
    standard deviation is that of the match in time.

    reference : matches between the reference images. pixels : of each camera at the step, None where it has no image.
    """
    px, sigma = np.full_like(reference.px, np.nan), np.full_like(reference.sigma, np.nan)
    status, c_ls = reference.status.copy(), reference.c_ls.copy()
    shared = reference.good
    for camera, camera_pixels in enumerate(pixels):
        good = status == Status.GOOD
        if camera_pixels is None:
            status[good] = Status.NOT_REACHED
            continue
        status[good] = camera_pixels.status[good]
        px[camera, shared], sigma[camera, shared] = camera_pixels.px[shared], camera_pixels.sigma[shared]
        c_ls[shared] = np.fmax(c_ls[shared], camera_pixels.c_ls[shared].astype(np.float32))
    return StepMatches(px, sigma, c_ls, status)


def _find_region(stereo: Stereo, image: Image, current: Current, mask: Mask | None) -> tuple[Mask, Pixels, Floats]:
    """Region of interest (height, width), and positions (k, 2) px of the sweep in it with their warps (k, 6)."""
    first, second = stereo.cameras
    depths = sweep_depths(stereo.cameras, image, current, mask, stereo.radii, stereo.search, stereo.settings)
    good = depths.good
    if mask is None:
        xyz = np.where(good[..., None], depths.xyz, np.nan)
        good = good & within_incidence(xyz, stereo.cameras, stereo.search.incidence)
    if good.sum() < 4:
        where = "" if mask is None else f" inside the mask of camera {first.id}"
        covered = "" if mask is None else ", that the mask covers it"
        raise ComputationError(
            f"cameras {first.id} and {second.id}: no textured surface that both see was found{where}; check that the "
            f"specimen is speckled and stands where the target stood{covered}, and that the images are in focus"
        )
    region = mask if mask is not None else lattice_region(depths.points, good, first.size)
    return region, depths.px[good.ravel()], depths.warps[good.ravel()]


def _start_at(xy: Pixels, seeds: Pixels, warps: Floats) -> Floats:
    """Start values (n, 6) of the grid: the warps at the positions of the sweep, NaN elsewhere."""
    start = np.full((len(xy), 6), np.nan)
    high = max(xy[:, 1].max(), seeds[:, 1].max()) + 1.0
    number, seed_number = xy[:, 0] * high + xy[:, 1], seeds[:, 0] * high + seeds[:, 1]  # a grid goes column by column
    at = np.minimum(np.searchsorted(number, seed_number), len(xy) - 1)
    is_seed = number[at] == seed_number
    start[at[is_seed]] = warps[is_seed]
    return start
