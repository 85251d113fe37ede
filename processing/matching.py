"""Matching one camera pair over all steps: region, start values, correlation.

The reference is the first camera's first image; every image of both cameras is matched to it (Solav et al. 2018,
step 2). Start values between the cameras come from the calibration and a sweep of proxy cylinders, at the
reference and again at every step, so a large motion does not matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.camera import Camera
from processing.correlation import (
    Correlation,
    CorrelationSettings,
    Current,
    Reference,
    Status,
    correlate,
    grid,
    prepare_current,
    prepare_reference,
    search_hypotheses,
)
from processing.errors import ComputationError
from processing.proxy import compose, stereo_hypotheses
from processing.region import paint, well_seen
from processing.results import Matches
from processing.sweep import Search, convincing, radii_of, sweep

Array = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.uint16]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class PairMatches:
    """The matched points of one camera pair and the triangles between them, (m, 3), normals outwards."""

    matches: Matches
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class _Stereo:
    """What a pair keeps from its reference step."""

    cameras: tuple[Camera, Camera]
    search: Search
    settings: CorrelationSettings
    radii: Array


def match_pair(
    cameras: tuple[Camera, Camera],
    image: Callable[[str, int], Image | None],
    steps: int,
    mask: Mask | None,
    search: Search,
    settings: CorrelationSettings,
    progress: Callable[[float], None] = lambda _: None,
) -> PairMatches:
    """Match all points of a pair in ``steps`` images (reference included) of both cameras.

    image : gives the grey image of a camera id and a step; None where a later step has none: its points are lost.
    mask : a region drawn by the user, or None to find it.
    Raises ComputationError where the cameras share no textured surface.
    """
    first, second = cameras
    stereo = _Stereo(cameras, search, settings, radii_of(cameras, search))
    reference_image, second_image = image(first.id, 0), image(second.id, 0)
    if reference_image is None or second_image is None:
        raise ComputationError(f"cameras {first.id} and {second.id}: the reference capture lacks an image")
    current = prepare_current(second_image, settings=settings)
    region, seeds, warps = _find_region(stereo, reference_image, current, mask)
    xy, faces = grid(region, settings.step)
    reference = prepare_reference(reference_image, region, settings)
    images = 2 * steps - 1
    found = {(0, 1): correlate(reference, current, xy, settings, start=_start_at(xy, seeds, warps))}
    progress(1 / images)
    for step in range(1, steps):
        in_time = None
        if (seen := image(first.id, step)) is not None:
            in_time = correlate(reference, prepare_current(seen, settings=settings), xy, settings)
            found[step, 0] = in_time
        progress((2 * step) / images)
        if in_time is not None and (seen := image(second.id, step)) is not None:
            current = prepare_current(seen, settings=settings)
            start = _start_after_motion(stereo, reference, current, xy, in_time)
            if np.isfinite(start).any():
                found[step, 1] = correlate(reference, current, xy, settings, start=start)
        progress((2 * step + 1) / images)
    return PairMatches(_collect((first.id, second.id), xy, found, steps), faces)


def _find_region(stereo: _Stereo, image: Image, current: Current, mask: Mask | None) -> tuple[Mask, Array, Array]:
    """The region of interest (height, width), lattice positions (k, 2) px in it and their warps (k, 6)."""
    first, second = stereo.cameras
    found = sweep(stereo.cameras, image, current, mask, stereo.radii, stereo.search, stereo.settings)
    good = found.good
    if mask is None:
        xyz = np.where(good[..., None], found.xyz, np.nan)
        good = good & well_seen(xyz, stereo.cameras, stereo.search.incidence)
    if good.sum() < 4:
        where = "" if mask is None else f" inside the mask of camera {first.id}"
        covered = "" if mask is None else ", that the mask covers it"
        raise ComputationError(
            f"cameras {first.id} and {second.id}: no textured surface that both see was found{where}; check that the "
            f"specimen is speckled and stands where the target stood{covered}, and that the images are in focus"
        )
    region = mask if mask is not None else paint(found.points, good, first.size)
    return region, found.px[good.ravel()], found.warps[good.ravel()]


def _start_at(xy: Array, seeds: Array, warps: Array) -> Array:
    """Start values (n, 6) of the grid: known at the seeds, NaN elsewhere."""
    start = np.full((len(xy), 6), np.nan)
    where = {(int(x), int(y)): i for i, (x, y) in enumerate(xy)}
    for (x, y), warp in zip(seeds, warps, strict=True):
        i = where.get((int(x), int(y)))
        if i is not None:
            start[i] = warp
    return start


def _start_after_motion(
    stereo: _Stereo, reference: Reference, current: Current, xy: Array, in_time: Correlation
) -> Array:
    """Start values (n, 6) in the second camera's image of a later step, from the first camera's motion and a sweep."""
    settings = stereo.settings
    spacing = settings.step * max(1, round(2 * settings.radius / settings.step))
    chosen = np.flatnonzero((in_time.status == Status.GOOD) & (np.mod(xy, spacing) == 0).all(axis=1))
    moved = xy[chosen] + in_time.uv[chosen]
    hypotheses = stereo_hypotheses(*stereo.cameras, moved, stereo.radii, settings.radius)
    motion = np.concatenate([in_time.uv[chosen], in_time.gradient[chosen].reshape(-1, 4)], axis=1)
    candidates = compose(motion[:, None, :], hypotheses.warps)
    warps, zncc, second_best = search_hypotheses(reference, current, xy[chosen], candidates, settings.radius)
    believed = convincing(stereo.search, zncc, second_best)
    start = np.full((len(xy), 6), np.nan)
    start[chosen[believed]] = warps[believed]
    return start


def _collect(pair: tuple[str, str], xy: Array, found: dict[tuple[int, int], Correlation], steps: int) -> Matches:
    n = len(xy)
    px = np.full((steps, 2, n, 2), np.nan)
    sigma = np.full((steps, 2, n, 2), np.nan)
    c_ls = np.full((steps, n), np.nan)
    status = np.zeros((steps, n), np.int8)
    px[0, 0], sigma[0, 0] = xy, 0.0  # the grid itself is exact
    for step in range(steps):
        for camera in (1,) if step == 0 else (0, 1):
            match = found.get((step, camera))
            if match is None:
                status[step] = np.where(status[step] == Status.GOOD, Status.NOT_REACHED, status[step])
                continue
            px[step, camera] = xy + match.uv
            sigma[step, camera] = match.sigma
            c_ls[step] = np.fmax(c_ls[step], match.c_ls)
            status[step] = np.where(status[step] == Status.GOOD, match.status, status[step])
    seconds = {
        name: float(sum(match.seconds[name] for match in found.values())) for name in ("prepare", "start", "refine")
    }
    return Matches(pair, xy, px, c_ls, sigma, status, np.full(n, -1), seconds)
