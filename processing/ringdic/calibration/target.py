"""Identification of the dots of the calibration cylinder in an image: row, column and position in space of each.

The dots that face the camera are linked to a lattice. If all rows are in the image, the lattice gives the row numbers.
The column numbers follow from a rough azimuth of the camera: each possible numbering gives a camera by DLT, and
neighbouring numberings give azimuths one column's angle apart, so only one agrees with the rig. Where the seam of the
columns is in view, the wrong numberings also leave large residuals. The camera of the right numbering then predicts the
positions of all other dots.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points, Vectors
from ringdic.calibration import dlt, lattice
from ringdic.calibration.dots import Dots
from ringdic.calibration.patch import cylinder_points
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Camera, Intrinsics, signed_degrees
from ringdic.session.json_values import from_json_value, json_value
from ringdic.session.rig import Target

log = logging.getLogger(__name__)

#: Fewest dots and columns that determine a camera.
DOTS_NEEDED, COLUMNS_NEEDED = 24, 3
#: Largest deviation of a camera from its nominal azimuth, degrees.
_AZIMUTH_LIMIT = 12.0
#: Least difference between the deviations of the best and the second-best numbering, degrees.
_AZIMUTH_MARGIN = 1.0
#: Largest distance of a dot from its predicted position, in dot sizes. Printed numbers above the top row, about 2 mm
#: from where one more row of 4 mm dots would be, are beyond it.
_PLACE = 0.35
#: Dots whose surface is seen more obliquely than this are left out, degrees.
_MAX_INCIDENCE = 55.0


@dataclass(frozen=True)
class DotObservations:
    """Identified dots of the target in the image of one camera.

    camera : its id.
    rows, columns : (n,) of the dots on the target, from 1; row 1 is the lowest, column 1 lies on +x.
    px : (n, 2) px, centroids in the image.
    xyz : (n, 3) mm, positions of the dots' centres, world frame.
    azimuth_deg : azimuth of the camera, about +z from +x.
    margin_deg : by how much the second-best numbering of the columns deviates more from the nominal azimuth.
    """

    camera: str
    rows: Indices
    columns: Indices
    px: Pixels
    xyz: Points
    azimuth_deg: float
    margin_deg: float

    def __post_init__(self) -> None:
        n = len(self.px)
        if self.px.shape != (n, 2) or self.xyz.shape != (n, 3) or len(self.rows) != n or len(self.columns) != n:
            raise ValueError("dot observations need one row, column and point for each position")

    def __len__(self) -> int:
        return len(self.px)

    def subset(self, which: Mask) -> DotObservations:
        """The observations restricted to some of the dots. which : (n,) bool."""
        return DotObservations(
            self.camera,
            self.rows[which],
            self.columns[which],
            self.px[which],
            self.xyz[which],
            self.azimuth_deg,
            self.margin_deg,
        )

    def to_dict(self) -> dict[str, Any]:
        """The observations as JSON values."""
        return dict(json_value(self))

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> DotObservations:
        """The observations from the JSON values of :meth:`to_dict`."""
        margin = values["margin_deg"]
        return from_json_value(cls, {**values, "margin_deg": math.inf if margin is None else margin})


def dot_points(target: Target, rows: Indices, columns: Indices) -> Points:
    """Nominal positions of the centres of dots. rows, columns : (n,), from 1. Returns (n, 3) mm, world frame."""
    angle = (np.asarray(columns, dtype=np.float64) - 1) * target.column_angle
    z = target.first_row_z_mm + (np.asarray(rows, dtype=np.float64) - 1) * target.row_spacing_mm
    return cylinder_points(target.radius_mm, angle, z)


def cylinder_normals(target: Target, xyz: Points) -> Vectors:
    """Outward unit normals (..., 3) of the target's cylinder at points xyz (..., 3) mm of its surface."""
    return xyz * np.array([1 / target.radius_mm, 1 / target.radius_mm, 0])


def identify_dots(
    dots: Dots,
    target: Target,
    azimuth_deg: float,
    *,
    camera: str = "",
    intrinsics: Intrinsics | None = None,
    rotation_deg: float = 0.0,
    height_mm: float | None = None,
) -> DotObservations:
    """Identify the dots of the target in an image: row, column and position in space of each.

    Parameters
    ----------
    dots : spots of the image, most of them dots of the target.
    azimuth_deg : nominal azimuth of the camera, good to ± 5°.
    camera : its id, for messages.
    intrinsics : the lens, if known; dots are then predicted more exactly. Their centroids stay image pixels.
    rotation_deg : clockwise rotation of the image; the nearest multiple of 90 is used.
    height_mm : of the camera, good to a third of the rows' spacing, or None; needed to number the rows where the image
        shows neither the lowest nor the highest.

    Raises
    ------
    InputError : the dots do not determine a camera near its nominal azimuth; names the camera.
    """
    dots, upright = _upright_undistorted(dots, intrinsics, rotation_deg)
    numbering = _number(upright, target, azimuth_deg, camera, lens_known=intrinsics is not None)
    _, border = _upright_undistorted(_border(dots.size), intrinsics, rotation_deg)
    frame = _straightened(border, numbering.bend).px.astype(np.float32)
    numbering = replace(numbering, L=_with_rows(numbering, frame, target, camera, height_mm))
    upright = _straightened(upright, numbering.bend)
    L = numbering.L
    all_rows = range(1, target.rows + 1)
    for _ in range(3):
        spots, rows, columns = _match(upright, L, target, all_rows, _MAX_INCIDENCE)
        _require_dots(camera, len(spots), len(set(columns.tolist())))
        xyz = dot_points(target, rows, columns)
        L, inliers = dlt.solve_dlt_robust(xyz, upright.px[spots], sigmas=8.0, floor=1.0)
    spots, rows, columns, xyz = spots[inliers], rows[inliers], columns[inliers], xyz[inliers]
    _require_dots(camera, len(spots), len(set(columns.tolist())))
    azimuth = dlt.to_camera(L).azimuth_deg % 360.0
    log.info(
        "camera %s: %d dots in columns %s, azimuth %.1f° (nominal %.1f°)",
        camera,
        len(spots),
        sorted(set(columns.tolist())),
        azimuth,
        azimuth_deg,
    )
    return DotObservations(camera, rows, columns, dots.px[spots], xyz, azimuth, numbering.margin)


def possible_azimuths(dots: Dots, target: Target, rotation_deg: float = 0.0) -> Floats:
    """Possible azimuths of a camera, from the dots in its own image alone.

    rotation_deg : clockwise rotation of the image; the nearest multiple of 90 is used.

    Returns (n,) degrees, the one with the least residuals first: one azimuth where the image shows the seam or an edge
    of the columns, else one for each column; none where no lattice on a cylinder is seen.
    """
    upright = _upright(dots, rotation_deg)
    spots, rows, columns = lattice.dot_lattice(upright, target)
    if len(spots) < DOTS_NEEDED or len(np.unique(columns)) < COLUMNS_NEEDED:
        return np.zeros(0)
    bend = _fit_bend(upright[spots], dot_points(target, rows + 1, columns + 1))
    upright = _straightened(upright, bend)
    last = target.columns if _is_closed(target) else target.columns - int(columns.max())
    candidates = []
    for shift in range(1, last + 1):
        number = (columns + shift - 1) % target.columns + 1
        xyz = dot_points(target, rows + 1, number)
        try:
            L = dlt.solve_dlt(xyz, upright.px[spots])
            camera = dlt.to_camera(L)
        except (ComputationError, np.linalg.LinAlgError):
            continue
        residual = float(np.mean(np.linalg.norm(dlt.residuals(L, xyz, upright.px[spots]), axis=1)))
        if np.hypot(camera.centre[0], camera.centre[1]) > target.radius_mm:
            candidates.append((residual, camera.azimuth_deg % 360.0))
    # A numbering with the seam at a wrong position displaces a column, which leaves large residuals.
    best = min(candidates, default=(0.0, 0.0))[0]
    if best > 0.25 * float(np.median(upright.height[spots])):
        return np.zeros(0)
    return np.array([azimuth for residual, azimuth in sorted(candidates) if residual <= 1.5 * best + 0.1])


def _is_closed(target: Target) -> bool:
    """Whether the columns go all the way round the cylinder."""
    step = math.degrees(target.column_angle)
    return 360.0 - (target.columns - 1) * step < 1.6 * step


def _upright_undistorted(dots: Dots, intrinsics: Intrinsics | None, rotation_deg: float) -> tuple[Dots, Dots]:
    """Dots in the lens model's valid range, in the image; and these dots upright and, if possible, undistorted."""
    if intrinsics is None:
        return dots, _upright(dots, rotation_deg)
    px = intrinsics.to_undistorted(dots.px)
    usable = np.flatnonzero(np.isfinite(px).all(axis=1))
    return dots[usable], _upright(replace(dots[usable], px=px[usable]), rotation_deg)


def _border(size: tuple[int, int]) -> Dots:
    """Points along the border of an image of a size (width, height), in the form of dots."""
    side = np.linspace(0, 1, 16, endpoint=False)
    none, full = np.zeros(16), np.ones(16)
    around = np.concatenate([[side, none], [full, side], [1 - side, full], [none, 1 - side]], axis=1).T
    n = len(around)
    return Dots(around * (np.array(size) - 1.0), np.ones(n), np.ones(n), np.ones(n), size)


def _upright(dots: Dots, rotation_deg: float) -> Dots:
    """Dots of an image that is rotated clockwise, rotated back to upright about the middle of the image."""
    quarters = round(rotation_deg / 90.0) % 4
    width, height = dots.size
    x, y = (dots.px - _middle(dots.size)).T
    rotated = {0: (x, y), 1: (y, -x), 2: (-x, -y), 3: (-y, x)}[quarters]
    if quarters % 2:
        width, height = height, width
        dots = replace(dots, width=dots.height, height=dots.width)
    return replace(dots, px=np.column_stack(rotated) + _middle((width, height)), size=(width, height))


def _straightened(dots: Dots, bend: float) -> Dots:
    """Dots corrected for a radial distortion of one parameter, ``r → r (1 + bend r²)`` about the middle of the image.

    r is 1 at the corner of the image.
    """
    middle = _middle(dots.size)
    offset = dots.px - middle
    r2 = np.sum(offset**2, axis=1, keepdims=True) / np.sum(middle**2)
    return replace(dots, px=middle + offset * (1 + bend * r2))


def _middle(size: tuple[int, int]) -> Pixels:
    """Middle of an image, (2,) px."""
    return (np.array(size, dtype=float) - 1) / 2


def _require_dots(camera: str, dots: int, columns: int) -> None:
    """Raise InputError where the dots are too few to determine a camera."""
    if dots < DOTS_NEEDED or columns < COLUMNS_NEEDED:
        count = f"{dots} dots in {columns} column{'' if columns == 1 else 's'}"
        raise InputError(
            f"camera {camera}: {count} of the calibration target were recognised; at least "
            f"{DOTS_NEEDED} in {COLUMNS_NEEDED} columns are needed. Check that the image shows the whole target, "
            "upright, evenly lit and sharp, and that [target] in rig.toml describes it"
        )


@dataclass(frozen=True)
class _Numbering:
    """A possible numbering of rows and columns, with the camera that it gives.

    L : (11,) DLT parameters of the camera.
    agreeing : number of dots that are where this camera predicts dots.
    deviation : azimuth of the camera minus the nominal one, degrees.
    rows : number of rows of dots seen; the lowest of them has number 1.
    bend : radial distortion, in the sense of ``_straightened``; 0 where the lens is known.
    margin : by how much the second-best numbering deviates more from the nominal azimuth, degrees.
    """

    L: Floats
    agreeing: int
    deviation: float
    rows: int
    bend: float
    margin: float = math.inf


def _number(dots: Dots, target: Target, azimuth_deg: float, camera: str, *, lens_known: bool) -> _Numbering:
    """The numbering whose camera deviates least from the nominal azimuth; InputError where there is none."""
    spots, rows, columns = lattice.dot_lattice(dots, target)
    _require_dots(camera, len(spots), len(set(columns.tolist())))
    # The lattice faces the camera: its middle column is about the one at the nominal azimuth.
    middle = (azimuth_deg % 360.0) / math.degrees(target.column_angle) + 1 - float(np.median(columns))
    numberings = [
        _numbering(dots, spots, rows, columns + shift, target, azimuth_deg, lens_known)
        for shift in range(math.floor(middle) - 3, math.ceil(middle) + 4)
    ]
    possible = [n for n in numberings if n is not None and abs(n.deviation) <= _AZIMUTH_LIMIT]
    if not possible:
        raise InputError(
            f"camera {camera}: no numbering of the target's columns puts the camera within {_AZIMUTH_LIMIT:.0f}° of "
            f"its nominal azimuth {azimuth_deg:.1f}°; check azimuth_deg, and [target] columns and spacings, in rig.toml"
        )
    most = max(numbering.agreeing for numbering in possible)
    good = sorted((n for n in possible if n.agreeing >= 0.97 * most), key=lambda n: abs(n.deviation))
    margin = abs(good[1].deviation) - abs(good[0].deviation) if len(good) > 1 else math.inf
    if margin < _AZIMUTH_MARGIN:
        raise InputError(
            f"camera {camera}: its nominal azimuth {azimuth_deg:.1f}° lies half-way between two numberings of the "
            f"target's columns (the camera stands at {azimuth_deg + good[0].deviation:.1f}° or "
            f"{azimuth_deg + good[1].deviation:.1f}°); give azimuth_deg to within 5°"
        )
    return replace(good[0], margin=margin)


def _with_rows(
    numbering: _Numbering,
    frame: NDArray[np.float32],
    target: Target,
    camera: str,
    height_mm: float | None,
) -> Floats:
    """DLT parameters (11,) of the camera for the true row numbers, also where the image does not show all rows.

    A row that is not seen must lie outside the image. If the image shows the lowest or the highest row, this leaves one
    numbering; otherwise the height of the camera decides.
    frame : (m, 2) border of the image, a polygon in the coordinates of the dots, px.
    """
    possible = []
    for below in range(target.rows - numbering.rows + 1):
        L = _lifted(numbering.L, below * target.row_spacing_mm)
        rows = [*range(1, below + 1), *range(below + numbering.rows + 1, target.rows + 1)]
        if not _any_inside(L, rows, frame, target):
            possible.append((float(dlt.to_camera(L).centre[2]), L))
    if height_mm is not None and len(possible) > 1:
        possible = [each for each in possible if abs(each[0] - height_mm) < target.row_spacing_mm / 2]
    if len(possible) == 1:
        return possible[0][1]
    intro = f"camera {camera}: {numbering.rows} rows of dots are seen in the target image, "
    if possible:
        raise InputError(
            f"{intro}[target] in rig.toml says {target.rows}, and neither the lowest nor the highest is in view; show "
            f"one of them, or give the camera's height_mm in rig.toml to within {target.row_spacing_mm / 3:.0f} mm"
        )
    raise InputError(
        f"{intro}[target] in rig.toml says {target.rows}; rows within the image must not be hidden over the whole "
        "width, and [target] rows must be right"
    )


def _lifted(L: Floats, z: float) -> Floats:
    """DLT parameters (11,) of the camera L (11,) raised by z mm, with its view unchanged."""
    P = dlt.to_projection(L)
    P[:, 3] -= z * P[:, 2]
    return np.asarray((P / P[2, 3]).ravel()[:11])


def _any_inside(L: Floats, rows: list[int], frame: NDArray[np.float32], target: Target) -> bool:
    """Whether well visible dots of some rows would lie inside the image, whose frame is a polygon (m, 2) px."""
    if not rows:
        return False
    camera = dlt.to_camera(L)
    grid = np.meshgrid(rows, np.arange(1, target.columns + 1))
    xyz = dot_points(target, grid[0].ravel(), grid[1].ravel())
    xyz = xyz[camera.incidence_cosine(xyz, cylinder_normals(target, xyz)) > math.cos(math.radians(40.0))]
    if not len(xyz):
        return False
    margin = _projected_size(camera, xyz, target)[1]
    px = camera.project_undistorted(xyz)
    depth = np.array([cv2.pointPolygonTest(frame, (float(x), float(y)), True) for x, y in px])
    inside = depth > margin
    return bool(inside.mean() > 0.2)


def _numbering(
    dots: Dots, spots: Indices, rows: Indices, columns: Indices, target: Target, azimuth_deg: float, lens_known: bool
) -> _Numbering | None:
    """The numbering of given columns, with its camera; None where this is not a camera outside the target.

    At first the rows are counted from an arbitrary one: a shift by a row only shifts the camera in height. That camera
    predicts where further rows are, also those that the lattice did not reach.
    """
    if _is_closed(target):
        columns = (columns - 1) % target.columns + 1
    inside = (columns >= 1) & (columns <= target.columns)
    spots, rows, columns = spots[inside], rows[inside], columns[inside]
    if len(spots) < DOTS_NEEDED or len(np.unique(columns)) < COLUMNS_NEEDED:
        return None
    floor = 0.25 * float(np.median(dots.height[spots]))
    span = range(-target.rows, 2 * target.rows)
    bend = 0.0
    try:
        if not lens_known:
            bend = _fit_bend(dots[spots], dot_points(target, rows, columns))
            dots = _straightened(dots, bend)
        L, _ = dlt.solve_dlt_robust(dot_points(target, rows, columns), dots.px[spots], sigmas=3.0, floor=floor)
        for _ in range(2):
            spots, rows, columns = _match(dots, L, target, span, 60.0)
            L, _ = dlt.solve_dlt_robust(dot_points(target, rows, columns), dots.px[spots], sigmas=3.0, floor=floor)
        occupied = _occupied_rows(rows, columns)
        if not occupied.size:
            return None
        L, _ = dlt.solve_dlt_robust(
            dot_points(target, rows - occupied.min() + 1, columns), dots.px[spots], sigmas=3.0, floor=floor
        )
        fitted = dlt.to_camera(L)
    except (ComputationError, np.linalg.LinAlgError):
        return None
    if np.hypot(fitted.centre[0], fitted.centre[1]) <= target.radius_mm:
        return None
    deviation = signed_degrees(fitted.azimuth_deg - azimuth_deg)
    return _Numbering(L, len(spots), deviation, int(np.ptp(occupied)) + 1, bend)


def _fit_bend(dots: Dots, xyz: Points) -> float:
    """Radial distortion, in the sense of ``_straightened``, by which a DLT camera fits dots at xyz (n, 3) mm best."""

    def misfit(bend: float) -> float:
        px = _straightened(dots, bend).px
        return float(np.median(np.linalg.norm(dlt.residuals(dlt.solve_dlt(xyz, px), xyz, px), axis=1)))

    return float(
        scipy.optimize.minimize_scalar(misfit, bounds=(-0.4, 0.4), method="bounded", options={"xatol": 1e-3}).x
    )


def _occupied_rows(rows: Indices, columns: Indices) -> Indices:
    """Rows that have dots in at least a third of the columns, so that a smudge above the target is no row."""
    number, count = np.unique(rows, return_counts=True)
    return number[count >= max(2, len(np.unique(columns)) / 3)]


def _match(
    dots: Dots, L: Floats, target: Target, all_rows: range, max_incidence_deg: float
) -> tuple[Indices, Indices, Indices]:
    """Spots with the predicted positions and sizes of dots: their indices, rows and columns, (n,) each.

    L : (11,) DLT parameters of the camera. all_rows : rows that may be seen.
    """
    camera = dlt.to_camera(L)
    grid = np.mgrid[all_rows.start : all_rows.stop, 1 : target.columns + 1]
    rows, columns = (axis.ravel() for axis in grid)
    xyz = dot_points(target, rows, columns)
    seen = camera.incidence_cosine(xyz, cylinder_normals(target, xyz)) > math.cos(math.radians(max_incidence_deg))
    rows, columns, xyz = rows[seen], columns[seen], xyz[seen]
    if not len(rows):
        return (np.zeros(0, dtype=np.intp),) * 3
    expected = camera.project_undistorted(xyz)
    width, height = _projected_size(camera, xyz, target)

    distance, nearest = scipy.spatial.cKDTree(dots.px).query(expected)
    back = scipy.spatial.cKDTree(expected).query(dots.px)[1]
    ok = back[nearest] == np.arange(len(expected))
    ok &= distance < np.maximum(_PLACE * np.minimum(width, height), 1.5)
    ok &= np.abs(dots.width[nearest] - width) < 0.3 * width + 3
    ok &= np.abs(dots.height[nearest] - height) < 0.3 * height + 3
    if ok.any():
        ok &= dots.contrast[nearest] > 0.4 * np.median(dots.contrast[nearest[ok]])
    return nearest[ok], rows[ok], columns[ok]


def _projected_size(camera: Camera, xyz: Points, target: Target) -> tuple[Floats, Floats]:
    """Width and height of the upright boxes round the images of dots at xyz (n, 3) mm; (n,) px each."""
    half = target.dot_size_mm / 2
    angle = np.arctan2(xyz[:, 1], xyz[:, 0])
    turn = half / target.radius_mm
    corners = [
        camera.project_undistorted(cylinder_points(target.radius_mm, angle + a, xyz[:, 2] + dz))
        for a in (-turn, turn)
        for dz in (-half, half)
    ]
    extent = np.ptp(np.stack(corners), axis=0)
    return extent[:, 0], extent[:, 1]
