"""Looking for the surface between two cameras: a lattice of image positions tried against a row of proxy cylinders.

Nothing is known of the shape but that it lies within reach of a cylinder about the target's axis. A match is believed
where it looks alike, where no other depth looks nearly as alike, and where its neighbours lie at a like depth. Every
second position each way is tried first, the others only near those that are believed and near their depth: most of an
image is no specimen.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ringdic.arrays import Floats, Image, Mask
from ringdic.correlation import CorrelationSettings, Current, search_row
from ringdic.correlation.start_field import lattice_spacing
from ringdic.geometry.camera import Camera
from ringdic.sweep.proxies import on_cylinder, stereo_hypotheses, sweep_radii
from ringdic.sweep.region import ImageLattice, coherent, contrast, image_lattice

# Beside the speckled surface there may be bare skin that matches, but poorly: less contrast than this share of the
# usual is no speckle.
_LEAST_CONTRAST = 0.3
_BEYOND = 3.0  # mm, past the radii of positions nearby; farther off no position is believed
#: Subset radii from one position of the sweep to the next, to a multiple of the grid's step.
SWEEP_RADII = 1.5


@dataclass(frozen=True)
class Search:
    """How the surface is looked for. Lengths mm, angles degrees.

    radius, reach : the proxy cylinder and how far from it the surface may lie.
    incidence : the steepest angle at which both cameras must see the surface.
    zncc_min : of a convincing match of the sweep.
    """

    radius: float
    reach: float
    incidence: float
    zncc_min: float = 0.75


@dataclass(frozen=True)
class Sweep:
    """Where the surface was found. Lattice of rows x columns positions in the first image, flat where (n, ...).

    points : the lattice. px : (n, 2). warps : (n, 6) into the second image. xyz : (rows, columns, 3) mm.
    good : (rows, columns), convincing and at the depth of its neighbours.
    """

    points: ImageLattice
    px: Floats
    warps: Floats
    xyz: Floats
    good: Mask


def radii_of(cameras: tuple[Camera, Camera], search: Search) -> Floats:
    """Radii (K,) mm of the sweep, so close that the match moves by 1.5 px from one to the next."""
    first, second = cameras
    towards = first.centre[:2] + second.centre[:2]
    towards = towards / np.linalg.norm(towards)
    height = 0.5 * (first.centre[2] + second.centre[2])
    ends = [np.array([*(radius * towards), height]) for radius in (search.radius, search.radius + 1.0)]
    seen = [camera.project(np.array(ends)) for camera in cameras]
    px_per_mm = float(np.linalg.norm(np.diff(seen[1], axis=0) - np.diff(seen[0], axis=0)))
    return sweep_radii(search.radius, search.reach, float(np.clip(1.5 / max(px_per_mm, 1e-6), 0.1, 2.0)))


def sweep(
    cameras: tuple[Camera, Camera],
    image: Image,
    current: Current,
    mask: Mask | None,
    radii: Floats,
    search: Search,
    settings: CorrelationSettings,
    least: int = 0,
) -> Sweep:
    """Look for the surface from the first camera's image in the second's, inside the mask if there is one.

    image : of the first camera. radii : (K,) mm. The lattice is a multiple of the correlation's step. least : positions
    of a connected piece of surface that is kept; 0 keeps the largest alone.
    """
    first, second = cameras
    points = image_lattice(first.size, lattice_spacing(settings, SWEEP_RADII), settings.radius + 2)
    shape = points.xy.shape[:2]
    px = points.xy.reshape(-1, 2)
    drawn = np.ones(len(px), bool) if mask is None else mask[px[:, 1].astype(int), px[:, 0].astype(int)]
    hit = np.zeros(len(px), bool)
    hit[drawn] = np.isfinite(on_cylinder(first, px[drawn], radii[-1:])).all(axis=(1, 2))
    warps, which, believed = np.full((len(px), 6), np.nan), np.zeros(len(px), np.int64), np.zeros(len(px), bool)

    def look(wanted: Mask, between: tuple[Floats, Floats] | None = None) -> None:
        at = np.flatnonzero(wanted)
        within = None if between is None else (between[0][at], between[1][at])
        row = stereo_hypotheses(first, second, px[at], radii, settings.radius, within)
        found = search_row(image, current, px[at], row, settings.radius, least=search.zncc_min)
        warps[at], which[at] = found.warps, found.which
        believed[at] = convincing(search, found.zncc, found.second_peak)
        believed[at] &= (found.which > 0) & (found.which < len(radii) - 1)

    few = _few(shape).ravel()
    look(hit & few)
    near, between = _near(np.where(believed, radii[which], np.nan).reshape(shape))
    look(hit & ~few & near, between)
    if mask is None:
        seen = np.flatnonzero(believed)
        texture = contrast(image, px[seen], settings.radius)
        usual = float(np.median(texture)) if len(seen) else 0.0
        believed[seen[~(texture > _LEAST_CONTRAST * usual)]] = False
    good = coherent(radii[which].reshape(shape), believed.reshape(shape), tolerance=2.0, least=least).ravel()
    xyz = np.full((len(px), 3), np.nan)
    xyz[good] = on_cylinder(first, px[good], radii[which[good], None])[:, 0]
    return Sweep(points, px, warps, xyz.reshape(*shape, 3), good.reshape(shape))


def _few(shape: tuple[int, ...]) -> Mask:
    """Every second position of a lattice each way, (rows, columns)."""
    few = np.zeros(shape, bool)
    few[::2, ::2] = True
    return few


def _near(radius: Floats) -> tuple[Mask, tuple[Floats, Floats]]:
    """Positions (n,) of a lattice no farther than two from one whose radius (rows, columns) mm is known, and between
    which radii (n,) theirs is looked for: as far beyond those about them as those differ, and a little more."""
    reach, known = np.ones((5, 5), np.uint8), np.isfinite(radius)
    high = cv2.dilate(np.where(known, radius, 0.0), reach).ravel()
    low = np.minimum(cv2.erode(np.where(known, radius, np.inf), reach).ravel(), high)
    beyond = high - low + _BEYOND
    return high > 0.0, (low - beyond, high + beyond)


def convincing(search: Search, zncc: Floats, second_best: Floats) -> Mask:
    """Matches (n,) of a sweep that look alike enough, and more so than any other place on the line."""
    with np.errstate(invalid="ignore"):
        return np.asarray((zncc > search.zncc_min) & (second_best < 0.9 * zncc))
