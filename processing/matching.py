"""Matching one camera pair over all steps: region, start values, correlation.

The reference is the first camera's first image; every image of both cameras is matched to it (Solav et al. 2018,
step 2). Start values between the cameras come from the calibration and a sweep of proxy cylinders, at the
reference and again at every step, so a large motion does not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

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
from processing.correlation.seeds import flow_starts
from processing.errors import ComputationError
from processing.proxy import compose, stereo_hypotheses
from processing.region import paint, well_seen
from processing.results import Matches
from processing.start_field import lattice_spacing, match_from_lattice, on_lattice
from processing.sweep import SWEEP_RADII, Search, convincing, radii_of, sweep

Array = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.uint16]
Mask = NDArray[np.bool_]

_STAGES = ("prepare", "start", "refine")
_HELD = 0.6  # ZNCC under the warp that optical flow tells, from which on it is a start value
_ENOUGH = 0.8  # share of the points that must be matched, or start values are looked for in other ways
_SOME = 0.2  # share of the lattice that must hold for the rest of it to be reached from there
_COARSE = 4.0  # subset radii between the lattice's points where what has changed since the reference is looked for


@dataclass(frozen=True)
class PairMatches:
    """The matched points of one camera pair and the triangles between them, (m, 3), normals outwards."""

    matches: Matches
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class Stereo:
    """Two calibrated cameras, the first that of the reference image, and how they are matched."""

    cameras: tuple[Camera, Camera]
    search: Search
    settings: CorrelationSettings

    @cached_property
    def radii(self) -> Array:
        """Radii (K,) mm of the sweep."""
        return radii_of(self.cameras, self.search)

    @property
    def ids(self) -> tuple[str, str]:
        """The cameras' ids."""
        return self.cameras[0].id, self.cameras[1].id


@dataclass(frozen=True)
class Grid:
    """What is matched of a pair: region (height, width) of the first camera's reference image, its points xy (n, 2) px
    and the triangles between them (m, 3)."""

    region: Mask
    xy: Array
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class StepMatches:
    """The n points of a pair in both cameras' images of one step; NaN where a camera has no match.

    px : (2, n, 2). sigma : (2, n, 2) px. c_ls : (n,), the larger. status : (n,), 0 good in both. seconds : by stage.
    gradient : (n, 2, 2) of the second camera's displacements; (0, 2, 2) where a step was read from its file.
    """

    px: Array
    sigma: NDArray[np.float32]
    c_ls: NDArray[np.float32]
    status: NDArray[np.int8]
    seconds: dict[str, float]
    gradient: NDArray[np.float32]

    @property
    def good(self) -> Mask:
        """Points (n,) matched in both images."""
        return np.asarray(self.status == Status.GOOD)


def match_reference(
    stereo: Stereo, first: Image, second: Image, mask: Mask | None, progress: Callable[[float], None] = lambda _: None
) -> tuple[Grid, StepMatches]:
    """Find the region in the reference images of both cameras, lay the points and match them between the two.

    mask : a region drawn by the user, or None to find it.
    Raises ComputationError where the cameras share no textured surface.
    """
    settings = stereo.settings
    current = prepare_current(second, settings=settings)
    region, seeds, warps = _find_region(stereo, first, current, mask)
    progress(0.5)
    xy, faces = grid(region, settings.step)
    reference = prepare_reference(first, region, settings)
    found = match_from_lattice(
        reference, current, xy, settings, _start_at(xy, seeds, warps), lattice_spacing(settings, SWEEP_RADII)
    )
    everyone = np.arange(len(xy))
    matched = _of_step(xy, np.full(len(xy), Status.GOOD, np.int8), ((1, everyone, found),))
    matched.px[0], matched.sigma[0] = xy, 0.0  # the grid itself, exact
    return Grid(region, xy, faces), matched


def match_step(
    stereo: Stereo,
    reference: Reference,
    xy: Array,
    first: Image | None,
    second: Image | None,
    at_reference: StepMatches,
) -> StepMatches:
    """Match the points xy (n, 2) px of a pair in both cameras' images of a step; None where one is missing.

    The first camera's image is matched in time; the second's from there, by the calibration and a sweep, so a large
    motion does not matter. A point that the pair's reference images do not share keeps its status there: it never has
    a place in space. One lost in the first camera's image is not looked for in the second's.
    """
    settings = stereo.settings
    in_time = between = None
    points, there = np.flatnonzero(at_reference.good), np.arange(0)
    if first is not None and len(points):
        in_time = _match_in_time(reference, prepare_current(first, settings=settings), xy[points], settings)
        there = np.flatnonzero(in_time.good)
    if in_time is not None and second is not None and len(there):
        current = prepare_current(second, settings=settings)
        start = _start_after_motion(stereo, reference, current, xy[points], in_time)[there]
        both = points[there]
        before = np.concatenate(
            [at_reference.px[1, both] - xy[both], at_reference.gradient[both].reshape(-1, 4)], axis=1
        )
        if np.isfinite(start).any():
            between = match_from_lattice(
                reference, current, xy[both], settings, start, lattice_spacing(settings, _COARSE), before
            )
    return _of_step(xy, at_reference.status, ((0, points, in_time), (1, points[there], between)))


def _match_in_time(reference: Reference, current: Current, xy: Array, settings: CorrelationSettings) -> Correlation:
    """The first camera's points in its image of a step, from where optical flow puts some of them.

    Where that leads to few matches the correlation looks for start values in its own ways.
    """
    chosen = np.flatnonzero(on_lattice(xy, lattice_spacing(settings)))
    flow = flow_starts(reference, current, xy[chosen], settings.radius)[:, [0, 6, 1, 2, 7, 8]]
    known = np.flatnonzero(np.isfinite(flow).all(axis=1))
    warps, zncc, _ = search_hypotheses(reference, current, xy[chosen[known]], flow[known][:, None], settings.radius)
    held = zncc > _HELD
    if held.sum() < _SOME * max(len(chosen), 1):
        return correlate(reference, current, xy, settings)
    start = np.full((len(xy), 6), np.nan)
    start[chosen[known[held]]] = warps[held]
    found = match_from_lattice(reference, current, xy, settings, start, lattice_spacing(settings))
    if found.good.mean() >= _ENOUGH:
        return found
    searched = correlate(reference, current, xy, settings)
    return searched if searched.good.sum() > found.good.sum() else found


def collect(pair: tuple[str, str], grid_: Grid, steps: Sequence[StepMatches]) -> PairMatches:
    """The matches of all steps, the reference first."""
    seconds = {name: float(sum(step.seconds.get(name, 0.0) for step in steps)) for name in _STAGES}
    matches = Matches(
        pair,
        grid_.xy,
        np.stack([step.px for step in steps]),
        np.stack([step.c_ls for step in steps]).astype(float),
        np.stack([step.sigma for step in steps]).astype(float),
        np.stack([step.status for step in steps]),
        np.full(len(grid_.xy), -1),
        seconds,
    )
    return PairMatches(matches, grid_.faces)


def _find_region(stereo: Stereo, image: Image, current: Current, mask: Mask | None) -> tuple[Mask, Array, Array]:
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
    stereo: Stereo, reference: Reference, current: Current, xy: Array, in_time: Correlation
) -> Array:
    """Start values (n, 6) in the second camera's image of a later step, from the first camera's motion and a sweep."""
    settings = stereo.settings
    chosen = np.flatnonzero(in_time.good & on_lattice(xy, lattice_spacing(settings, _COARSE)))
    moved = xy[chosen] + in_time.uv[chosen]
    hypotheses = stereo_hypotheses(*stereo.cameras, moved, stereo.radii, settings.radius)
    motion = np.concatenate([in_time.uv[chosen], in_time.gradient[chosen].reshape(-1, 4)], axis=1)
    candidates = compose(motion[:, None, :], hypotheses.warps)
    warps, zncc, second_best = search_hypotheses(reference, current, xy[chosen], candidates, settings.radius)
    believed = convincing(stereo.search, zncc, second_best)
    start = np.full((len(xy), 6), np.nan)
    start[chosen[believed]] = warps[believed]
    return start


def _of_step(
    xy: Array, status: NDArray[np.int8], found: Sequence[tuple[int, NDArray[np.int64], Correlation | None]]
) -> StepMatches:
    """The matches of a step's images together: found are a camera, the points (k,) it was asked for, and their matches.

    status : (n,) of the points before.
    """
    n, status = len(xy), status.copy()
    px, sigma = np.full((2, n, 2), np.nan), np.full((2, n, 2), np.nan, np.float32)
    c_ls, gradient = np.full(n, np.nan, np.float32), np.full((n, 2, 2), np.nan, np.float32)
    seconds = dict.fromkeys(_STAGES, 0.0)
    for camera, points, match in found:
        open_points = points[status[points] == Status.GOOD]
        status[open_points] = Status.NOT_REACHED
        if match is None:
            continue
        px[camera, points], sigma[camera, points] = xy[points] + match.uv, match.sigma
        c_ls[points] = np.fmax(c_ls[points], match.c_ls.astype(np.float32))
        status[points] = match.status
        if camera == 1:
            gradient[points] = match.gradient
        for name in _STAGES:
            seconds[name] += match.seconds[name]
    return StepMatches(px, sigma, c_ls, status, seconds, gradient)
