"""Depth sweep between two cameras: a lattice of image positions matched over a series of proxy cylinders.

Nothing is known of the shape but that it lies within reach of a cylinder about the target's axis. A match is accepted
where its ZNCC is high, no other depth matches nearly as well, and the neighbours lie at a similar depth. Most of an
image shows no specimen: every second position each way is tried first, the others only near accepted ones, at depths
near theirs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ringdic.arrays import Floats, Image, Indices, Mask, Pixels, Points
from ringdic.correlation import CorrelationSettings, Current, search_hypotheses
from ringdic.correlation.start_field import lattice_spacing
from ringdic.geometry.camera import Camera
from ringdic.sweep.proxies import cylinder_intersections, stereo_hypotheses, sweep_radii
from ringdic.sweep.region import ImageLattice, coherent_depths, contrast, image_lattice

# Bare skin next to the speckled surface can match too, but has less contrast than this share of the median.
_LEAST_CONTRAST = 0.3
_BEYOND = 3.0  # mm beyond the radii of accepted positions nearby; a position farther off would be rejected
_TOLERANCE = 2.0  # mm, largest difference between a position's radius and the median of its neighbours'
#: Spacing of the sweep's lattice, in subset radii, before it becomes a multiple of the grid step.
SWEEP_SPACING = 1.5


@dataclass(frozen=True)
class DepthSearch:
    """Where and how the surface is searched for between two cameras.

    radius : mm, of the proxy cylinder. reach : mm, how far from it the surface may lie.
    incidence : degrees, largest angle of incidence at which both cameras must see the surface.
    zncc_min : least ZNCC of a match.
    """

    radius: float
    reach: float
    incidence: float
    zncc_min: float = 0.75


@dataclass(frozen=True)
class DepthSweep:
    """Result of a depth sweep between two cameras: for each lattice position the best depth and warp, if accepted.

    points : lattice of rows x columns = n positions in the first image.
    px : (n, 2) float64, px, the positions, row by row.
    warps : (n, 6) float64, u v ux uy vx vy into the second image (u, v in px).
    xyz : (rows, columns, 3) float64, mm, in the world frame; NaN where not accepted.
    good : (rows, columns) bool, accepted: unambiguous, and at a depth like its neighbours'.
    """

    points: ImageLattice
    px: Pixels
    warps: Floats
    xyz: Points
    good: Mask


def search_radii(cameras: tuple[Camera, Camera], search: DepthSearch) -> Floats:
    """Radii of the sweep's cylinders, spaced so that the match moves by about 1.5 px from one to the next.

    Returns (K,) float64, mm, ascending.
    """
    first, second = cameras
    towards = first.centre[:2] + second.centre[:2]
    towards = towards / np.linalg.norm(towards)
    height = 0.5 * (first.centre[2] + second.centre[2])
    ends = [np.array([*(radius * towards), height]) for radius in (search.radius, search.radius + 1.0)]
    px = [camera.project(np.array(ends)) for camera in cameras]
    px_per_mm = float(np.linalg.norm(np.diff(px[1], axis=0) - np.diff(px[0], axis=0)))
    return sweep_radii(search.radius, search.reach, float(np.clip(1.5 / max(px_per_mm, 1e-6), 0.1, 2.0)))


class _Matches:
    """Best warps (n, 6) into the second image, indices (n,) of their radii, and which matches (n,) are unambiguous."""

    def __init__(
        self, cameras: tuple[Camera, Camera], px: Pixels, radii: Floats, search: DepthSearch, radius: int
    ) -> None:
        self.cameras, self.px, self.radii, self.search, self.radius = cameras, px, radii, search, radius
        self.warps, self.unambiguous = np.full((len(px), 6), np.nan), np.zeros(len(px), bool)
        self.index: Indices = np.zeros(len(px), np.int64)

    def add(self, image: Image, current: Current, wanted: Mask, between: tuple[Floats, Floats] | None = None) -> None:
        """Match the wanted positions (n,), at radii between two bounds (n,) mm if these are given."""
        at = np.flatnonzero(wanted)
        within = None if between is None else (between[0][at], between[1][at])
        hypotheses = stereo_hypotheses(*self.cameras, self.px[at], self.radii, self.radius, within)
        best = search_hypotheses(image, current, self.px[at], hypotheses, self.radius, zncc_min=self.search.zncc_min)
        self.warps[at], self.index[at] = best.warps, best.index
        self.unambiguous[at] = unambiguous_matches(self.search, best.zncc, best.second_peak)
        self.unambiguous[at] &= (best.index > 0) & (best.index < len(self.radii) - 1)  # a true peak lies inside


def sweep_depths(
    cameras: tuple[Camera, Camera],
    image: Image,
    current: Current,
    mask: Mask | None,
    radii: Floats,
    search: DepthSearch,
    settings: CorrelationSettings,
    min_positions: int = 0,
) -> DepthSweep:
    """Search for the surface that two cameras share, by a sweep of proxy cylinders from the first camera's image.

    Parameters
    ----------
    image : (height, width) grey levels of the first camera. current : the image of the second.
    mask : (height, width) bool, where in the first image to search; None for everywhere, and then positions of low
        contrast are rejected.
    radii : (K,) float64, mm, of the cylinders, ascending.
    search, settings : of the sweep and of the correlation; the lattice's spacing is a multiple of the grid step.
    min_positions : smallest size of a connected piece of surface that remains; 0 leaves only the largest piece.
    """
    first, _ = cameras
    points = image_lattice(first.size, lattice_spacing(settings, SWEEP_SPACING), settings.radius + 2)
    shape = points.xy.shape[:2]
    px = points.xy.reshape(-1, 2)
    inside = np.ones(len(px), bool) if mask is None else mask[px[:, 1].astype(int), px[:, 0].astype(int)]
    on_proxy = np.zeros(len(px), bool)
    on_proxy[inside] = np.isfinite(cylinder_intersections(first, px[inside], radii[-1:])).all(axis=(1, 2))
    matches = _Matches(cameras, px, radii, search, settings.radius)
    sparse = _every_second(shape).ravel()
    matches.add(image, current, on_proxy & sparse)
    near, between = _near(np.where(matches.unambiguous, radii[matches.index], np.nan).reshape(shape))
    matches.add(image, current, on_proxy & ~sparse & near, between)
    candidates = matches.unambiguous
    if mask is None:
        at = np.flatnonzero(candidates)
        texture = contrast(image, px[at], settings.radius)
        median = float(np.median(texture)) if len(at) else 0.0
        candidates[at[~(texture > _LEAST_CONTRAST * median)]] = False
    radius = radii[matches.index]
    good = coherent_depths(radius.reshape(shape), candidates.reshape(shape), _TOLERANCE, min_positions).ravel()
    xyz = np.full((len(px), 3), np.nan)
    xyz[good] = cylinder_intersections(first, px[good], radius[good, None])[:, 0]
    return DepthSweep(points, px, matches.warps, xyz.reshape(*shape, 3), good.reshape(shape))


def _every_second(shape: tuple[int, ...]) -> Mask:
    """Every second position of a lattice each way, (rows, columns)."""
    sparse = np.zeros(shape, bool)
    sparse[::2, ::2] = True
    return sparse


def _near(radius: Floats) -> tuple[Mask, tuple[Floats, Floats]]:
    """Lattice positions (n,) within two of one whose radius (rows, columns) mm is known, and bounds of their radii.

    The bounds, two (n,) in mm, exceed the range of the known radii nearby by that range again and by ``_BEYOND`` mm.
    """
    reach, known = np.ones((5, 5), np.uint8), np.isfinite(radius)
    high = cv2.dilate(np.where(known, radius, 0.0), reach).ravel()
    low = np.minimum(cv2.erode(np.where(known, radius, np.inf), reach).ravel(), high)
    beyond = high - low + _BEYOND
    return high > 0.0, (low - beyond, high + beyond)


def unambiguous_matches(search: DepthSearch, zncc: Floats, second_peak: Floats) -> Mask:
    """Matches whose ZNCC reaches the limit and whose second peak on the epipolar line is clearly lower.

    zncc, second_peak : (n,) float64, no unit, ZNCC of the best and of the next best match elsewhere. Returns (n,) bool.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((zncc > search.zncc_min) & (second_peak < 0.9 * zncc))
