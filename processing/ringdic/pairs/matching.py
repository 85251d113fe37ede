"""Matching one camera pair: its reference images to one another, and with both cameras followed in time, every step.

The reference is the first camera's first image (Solav et al. 2018, step 2). Start values between the cameras come from
the calibration and a sweep of proxy cylinders. Later images are matched each to its own camera's reference image
(``in_time``), where the second camera's points are the places matched here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Mask
from ringdic.correlation import CorrelationSettings, Current, Status, grid, prepare_current, prepare_reference
from ringdic.correlation.start_field import lattice_spacing, match_from_lattice
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.pairs.tracking import CameraPixels
from ringdic.sweep.region import lattice_region, within_incidence
from ringdic.sweep.sweep import SWEEP_SPACING, DepthSearch, search_radii, sweep_depths


@dataclass(frozen=True)
class Stereo:
    """Two calibrated cameras, the first that of the reference image, and how they are matched."""

    cameras: tuple[Camera, Camera]
    search: DepthSearch
    settings: CorrelationSettings

    @cached_property
    def radii(self) -> Floats:
        """Radii (K,) mm of the sweep."""
        return search_radii(self.cameras, self.search)

    @property
    def ids(self) -> tuple[str, str]:
        """The cameras' ids."""
        return self.cameras[0].id, self.cameras[1].id


@dataclass(frozen=True)
class Grid:
    """What is matched of a pair: region (height, width) of the first camera's reference image, its points xy (n, 2) px
    and the triangles between them (m, 3)."""

    region: Mask
    xy: Floats
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class StepMatches:
    """The n points of a pair in both cameras' images of one step; NaN where a camera has no match.

    px : (2, n, 2). sigma : (2, n, 2) px. c_ls : (n,), the largest over the images used. status : (n,), 0 good in
    both. seconds : of the match between the cameras, by stage.
    """

    px: Floats
    sigma: NDArray[np.float32]
    c_ls: NDArray[np.float32]
    status: NDArray[np.int8]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def good(self) -> Mask:
        """Points (n,) matched in both images."""
        return np.asarray(self.status == Status.GOOD)

    @property
    def second(self) -> Floats:
        """Places (n, 2) px of the matched points in the second camera's image, NaN elsewhere."""
        return np.where(self.good[:, None], self.px[1], np.nan)


def match_reference(stereo: Stereo, first: Image, second: Image, mask: Mask | None) -> tuple[Grid, StepMatches]:
    """Find the region in the reference images of both cameras, lay the points and match them between the two.

    mask : a region drawn by the user, or None to find it.
    Raises ComputationError where the cameras share no textured surface.
    """
    settings = stereo.settings
    current = prepare_current(second, settings=settings)
    region, seeds, warps = _find_region(stereo, first, current, mask)
    xy, faces = grid(region, settings.step)
    reference = prepare_reference(first, region, settings)
    found = match_from_lattice(
        reference, current, xy, settings, _start_at(xy, seeds, warps), lattice_spacing(settings, SWEEP_SPACING)
    )
    px = np.stack([xy, xy + found.uv])  # the grid itself, exact
    sigma = np.stack([np.zeros_like(found.sigma), found.sigma]).astype(np.float32)
    status = found.status.astype(np.int8)
    matched = StepMatches(px, sigma, found.c_ls.astype(np.float32), status, found.seconds)
    return Grid(region, xy, faces), matched


def at_step(at_reference: StepMatches, seen: tuple[CameraPixels | None, CameraPixels | None]) -> StepMatches:
    """A pair's points at a step, by what its cameras' images say of their places there; None where one is missing.

    A point that the pair's reference images do not share keeps its status: it never has a place in space. sigma is that
    of the match in time.
    """
    px, sigma = np.full_like(at_reference.px, np.nan), np.full_like(at_reference.sigma, np.nan)
    status, c_ls = at_reference.status.copy(), at_reference.c_ls.copy()
    shared = at_reference.good
    for camera, places in enumerate(seen):
        still = status == Status.GOOD
        if places is None:
            status[still] = Status.NOT_REACHED
            continue
        status[still] = places.status[still]
        px[camera, shared], sigma[camera, shared] = places.px[shared], places.sigma[shared]
        c_ls[shared] = np.fmax(c_ls[shared], places.c_ls[shared].astype(np.float32))
    return StepMatches(px, sigma, c_ls, status)


def _find_region(stereo: Stereo, image: Image, current: Current, mask: Mask | None) -> tuple[Mask, Floats, Floats]:
    """The region of interest (height, width), lattice positions (k, 2) px in it and their warps (k, 6)."""
    first, second = stereo.cameras
    found = sweep_depths(stereo.cameras, image, current, mask, stereo.radii, stereo.search, stereo.settings)
    good = found.good
    if mask is None:
        xyz = np.where(good[..., None], found.xyz, np.nan)
        good = good & within_incidence(xyz, stereo.cameras, stereo.search.incidence)
    if good.sum() < 4:
        where = "" if mask is None else f" inside the mask of camera {first.id}"
        covered = "" if mask is None else ", that the mask covers it"
        raise ComputationError(
            f"cameras {first.id} and {second.id}: no textured surface that both see was found{where}; check that the "
            f"specimen is speckled and stands where the target stood{covered}, and that the images are in focus"
        )
    region = mask if mask is not None else lattice_region(found.points, good, first.size)
    return region, found.px[good.ravel()], found.warps[good.ravel()]


def _start_at(xy: Floats, seeds: Floats, warps: Floats) -> Floats:
    """Start values (n, 6) of the grid: known at the seeds, NaN elsewhere."""
    start = np.full((len(xy), 6), np.nan)
    high = max(xy[:, 1].max(), seeds[:, 1].max()) + 1.0
    number, sought = xy[:, 0] * high + xy[:, 1], seeds[:, 0] * high + seeds[:, 1]  # a grid goes column by column
    at = np.minimum(np.searchsorted(number, sought), len(xy) - 1)
    there = number[at] == sought
    start[at[there]] = warps[there]
    return start
