"""The dots of the calibration cylinder told apart: which row, which column, which point in space.

The dots nearest the camera are joined to a lattice. All rows are in the image, so the rows number themselves. The
columns do once the camera's azimuth is roughly known: each numbering that is possible gives a camera by DLT, and only
one of these cameras stands where the rig says, because neighbouring numberings are a column's angle apart. Where the
seam of the columns is in view it decides by itself. The camera then says where every other dot must be.
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

from ringdic.arrays import Floats, Indices, Mask
from ringdic.calibration import dlt, lattice
from ringdic.calibration.dots import Dots
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.session.rig import Target

log = logging.getLogger(__name__)

#: Fewest dots and columns that make a camera.
DOTS_NEEDED, COLUMNS_NEEDED = 24, 3
#: A nominal azimuth further off than this is not believed, degrees.
_AZIMUTH_LIMIT = 12.0
#: Numberings whose distances from the nominal azimuth differ by less than this cannot be told apart, degrees.
_AZIMUTH_MARGIN = 1.0
#: A dot is one of the target's if it lies within this part of its own size of its place. Printed numbers above the
#: top row, some 2 mm off the place of one more row of 4 mm dots, are not.
_PLACE = 0.35


@dataclass(frozen=True)
class DotObservations:
    """Dots of the target seen by one camera.

    rows, columns : (n,), from 1, as DOT (row, column) of the target: row 1 lowest, column 1 on +x.
    px : (n, 2) centroids in the image, px.
    xyz : (n, 3) nominal positions of the dots' centres, mm.
    azimuth_deg : where the camera stands, about +z from +x.
    margin_deg : how much worse the second-best numbering of the columns agrees with the nominal azimuth.
    """

    camera: str
    rows: Indices
    columns: Indices
    px: Floats
    xyz: Floats
    azimuth_deg: float
    margin_deg: float

    def __post_init__(self) -> None:
        n = len(self.px)
        if self.px.shape != (n, 2) or self.xyz.shape != (n, 3) or len(self.rows) != n or len(self.columns) != n:
            raise ValueError("dot observations need one row, column and point for each position")

    def __len__(self) -> int:
        return len(self.px)

    def chosen(self, keep: Mask) -> DotObservations:
        """Some of the dots."""
        return DotObservations(
            self.camera,
            self.rows[keep],
            self.columns[keep],
            self.px[keep],
            self.xyz[keep],
            self.azimuth_deg,
            self.margin_deg,
        )

    def to_dict(self) -> dict[str, Any]:
        """The dots as JSON values."""
        return {
            "camera": self.camera,
            "rows": self.rows.tolist(),
            "columns": self.columns.tolist(),
            "px": self.px.tolist(),
            "xyz": self.xyz.tolist(),
            "azimuth_deg": self.azimuth_deg,
            "margin_deg": self.margin_deg if math.isfinite(self.margin_deg) else None,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> DotObservations:
        """The dots of :meth:`to_dict`."""
        margin = values["margin_deg"]
        return cls(
            values["camera"],
            np.array(values["rows"], dtype=np.intp),
            np.array(values["columns"], dtype=np.intp),
            np.array(values["px"], dtype=float).reshape(-1, 2),
            np.array(values["xyz"], dtype=float).reshape(-1, 3),
            float(values["azimuth_deg"]),
            math.inf if margin is None else float(margin),
        )


def dot_points(target: Target, rows: Indices, columns: Indices) -> Floats:
    """Centres of dots on the cylinder. rows, columns : (n,), from 1. (n, 3) mm."""
    angle = (np.asarray(columns) - 1) * target.column_angle
    z = target.first_row_z_mm + (np.asarray(rows) - 1) * target.row_spacing_mm
    return np.column_stack([target.radius_mm * np.cos(angle), target.radius_mm * np.sin(angle), z])


def identify(
    dots: Dots,
    target: Target,
    azimuth_deg: float,
    *,
    camera: str = "",
    intrinsics: Intrinsics | None = None,
    rotation_deg: float = 0.0,
    height_mm: float | None = None,
    max_incidence_deg: float = 55.0,
) -> DotObservations:
    """Row, column and point of every dot seen under less than ``max_incidence_deg``.

    dots : spots of the image, most of them dots of the target.
    azimuth_deg : nominal azimuth of the camera, good to ± 5°.
    intrinsics : the lens, if known: it makes the expected places sharper, the positions stay image pixels.
    rotation_deg : by how much the image is turned clockwise; the nearest multiple of 90 is used.
    height_mm : of the camera, good to a third of the rows' spacing: it tells the rows apart where the image shows
        neither end of the target.

    Raises InputError, with the camera's name and what was found, where the dots do not make a camera.
    """
    dots, upright = _prepared(dots, intrinsics, rotation_deg)
    numbering = _number(upright, target, azimuth_deg, camera, lens_known=intrinsics is not None)
    _, border = _prepared(_border(dots.size), intrinsics, rotation_deg)
    frame = _straightened(border, numbering.bend).px.astype(np.float32)
    numbering = replace(numbering, L=_with_rows(numbering, frame, target, camera, height_mm))
    upright = _straightened(upright, numbering.bend)
    L = numbering.L
    all_rows = range(1, target.rows + 1)
    for _ in range(3):
        found, rows, columns = _match(upright, L, target, all_rows, max_incidence_deg)
        _require_dots(camera, len(found), len(set(columns.tolist())))
        xyz = dot_points(target, rows, columns)
        L, kept = dlt.solve_dlt_robust(xyz, upright.px[found], sigmas=8.0, floor=1.0)
    found, rows, columns, xyz = found[kept], rows[kept], columns[kept], xyz[kept]
    _require_dots(camera, len(found), len(set(columns.tolist())))
    centre = Camera(camera, dlt.to_projection(L), (1, 1)).centre
    azimuth = math.degrees(math.atan2(centre[1], centre[0])) % 360.0
    log.info(
        "camera %s: %d dots in columns %s, azimuth %.1f° (nominal %.1f°)",
        camera,
        len(found),
        sorted(set(columns.tolist())),
        azimuth,
        azimuth_deg,
    )
    return DotObservations(camera, rows, columns, dots.px[found], xyz, azimuth, numbering.margin)


def possible_azimuths(dots: Dots, target: Target, rotation_deg: float = 0.0) -> Floats:
    """Azimuths, degrees, at which the camera may stand by its own image alone, best first: one where it sees the seam
    or an edge of the columns, else one for each column. Empty where no lattice on a cylinder is seen.
    """
    upright = _upright(dots, rotation_deg)
    spots, rows, columns = lattice.walk(upright, target)
    if len(spots) < DOTS_NEEDED or len(np.unique(columns)) < COLUMNS_NEEDED:
        return np.zeros(0)
    bend = _find_bend(upright[spots], dot_points(target, rows + 1, columns + 1))
    upright = _straightened(upright, bend)
    last = target.columns if _closed(target) else target.columns - int(columns.max())
    found = []
    for shift in range(1, last + 1):
        number = (columns + shift - 1) % target.columns + 1
        xyz = dot_points(target, rows + 1, number)
        try:
            L = dlt.solve_dlt(xyz, upright.px[spots])
            centre = Camera("", dlt.to_projection(L), (1, 1)).centre
        except (ComputationError, np.linalg.LinAlgError):
            continue
        off = float(np.mean(np.linalg.norm(dlt.residuals(L, xyz, upright.px[spots]), axis=1)))
        if np.hypot(centre[0], centre[1]) > target.radius_mm:
            found.append((off, math.degrees(math.atan2(centre[1], centre[0])) % 360.0))
    # A numbering that puts the seam, or none, where it is not leaves a column off its place.
    best = min(found, default=(0.0, 0.0))[0]
    if best > 0.25 * float(np.median(upright.height[spots])):
        return np.zeros(0)
    return np.array([azimuth for off, azimuth in sorted(found) if off <= 1.5 * best + 0.1])


def _closed(target: Target) -> bool:
    """Whether the columns go all the way round."""
    step = math.degrees(target.column_angle)
    return 360.0 - (target.columns - 1) * step < 1.6 * step


def _prepared(dots: Dots, intrinsics: Intrinsics | None, rotation_deg: float) -> tuple[Dots, Dots]:
    """Dots that the lens can show, and the same undistorted, where it is known, and turned upright."""
    if intrinsics is None:
        return dots, _upright(dots, rotation_deg)
    px = intrinsics.to_undistorted(dots.px)
    usable = np.flatnonzero(np.isfinite(px).all(axis=1))
    return dots[usable], _upright(replace(dots[usable], px=px[usable]), rotation_deg)


def _border(size: tuple[int, int]) -> Dots:
    """Points along the border of an image, as if they were dots."""
    side = np.linspace(0, 1, 16, endpoint=False)
    none, full = np.zeros(16), np.ones(16)
    around = np.concatenate([[side, none], [full, side], [1 - side, full], [none, 1 - side]], axis=1).T
    n = len(around)
    return Dots(around * (np.array(size) - 1.0), np.ones(n), np.ones(n), np.ones(n), size)


def _upright(dots: Dots, rotation_deg: float) -> Dots:
    """Dots of an image turned back to upright, about the middle of the image."""
    quarters = round(rotation_deg / 90.0) % 4
    width, height = dots.size
    x, y = (dots.px - _middle(dots.size)).T
    turned = {0: (x, y), 1: (y, -x), 2: (-x, -y), 3: (-y, x)}[quarters]
    if quarters % 2:
        width, height = height, width
        dots = replace(dots, width=dots.height, height=dots.width)
    return replace(dots, px=np.column_stack(turned) + _middle((width, height)), size=(width, height))


def _straightened(dots: Dots, bend: float) -> Dots:
    """Dots moved from the middle of the image by ``bend`` r³: a lens of one parameter, for lack of a better."""
    middle = _middle(dots.size)
    offset = dots.px - middle
    r2 = np.sum(offset**2, axis=1, keepdims=True) / np.sum(middle**2)
    return replace(dots, px=middle + offset * (1 + bend * r2))


def _middle(size: tuple[int, int]) -> Floats:
    return (np.array(size, dtype=float) - 1) / 2


def _require_dots(camera: str, dots: int, columns: int) -> None:
    if dots < DOTS_NEEDED or columns < COLUMNS_NEEDED:
        found = f"{dots} dots in {columns} column{'' if columns == 1 else 's'}"
        raise InputError(
            f"camera {camera}: {found} of the calibration target were recognised; at least "
            f"{DOTS_NEEDED} in {COLUMNS_NEEDED} columns are needed. Check that the image shows the whole target, "
            "upright, evenly lit and sharp, and that [target] in rig.toml describes it"
        )


@dataclass(frozen=True)
class _Numbering:
    """One way of numbering rows and columns, and the camera it means.

    L : (11,) DLT parameters.
    agreeing : dots that are where this camera sees dots.
    deviation : azimuth of the camera minus the nominal one, degrees.
    rows : how many rows of dots are seen; the lowest has number 1.
    bend : see ``_straightened``; 0 where the lens is known.
    margin : see ``DotObservations.margin_deg``.
    """

    L: Floats
    agreeing: int
    deviation: float
    rows: int
    bend: float
    margin: float = math.inf


def _number(dots: Dots, target: Target, azimuth_deg: float, camera: str, *, lens_known: bool) -> _Numbering:
    """The numbering that puts the camera where the rig says it is."""
    spots, rows, columns = lattice.walk(dots, target)
    _require_dots(camera, len(spots), len(set(columns.tolist())))
    # The lattice faces the camera: its middle column has a number near that of the nominal azimuth.
    middle = (azimuth_deg % 360.0) / math.degrees(target.column_angle) + 1 - float(np.median(columns))
    tried = [
        _try(dots, spots, rows, columns + shift, target, azimuth_deg, lens_known)
        for shift in range(math.floor(middle) - 3, math.ceil(middle) + 4)
    ]
    possible = [n for n in tried if n is not None and abs(n.deviation) <= _AZIMUTH_LIMIT]
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
    """The DLT parameters with the rows numbered, where the image cuts some of them off.

    frame : the border of the image, a polygon (m, 2) in the coordinates of the dots.
    A row that is not seen must lie outside the image: that leaves one place for those that are, if the image shows an
    end of the target, and the camera's height decides otherwise.
    """
    possible = []
    for below in range(target.rows - numbering.rows + 1):
        L = _lifted(numbering.L, below * target.row_spacing_mm)
        rows = [*range(1, below + 1), *range(below + numbering.rows + 1, target.rows + 1)]
        if not _any_inside(L, rows, frame, target):
            possible.append((float(Camera("", dlt.to_projection(L), (1, 1)).centre[2]), L))
    if height_mm is not None and len(possible) > 1:
        possible = [each for each in possible if abs(each[0] - height_mm) < target.row_spacing_mm / 2]
    if len(possible) == 1:
        return possible[0][1]
    seen = f"camera {camera}: {numbering.rows} rows of dots are seen in the target image, "
    if possible:
        raise InputError(
            f"{seen}[target] in rig.toml says {target.rows}, and neither the lowest nor the highest is in view; show "
            f"one of them, or give the camera's height_mm in rig.toml to within {target.row_spacing_mm / 3:.0f} mm"
        )
    raise InputError(
        f"{seen}[target] in rig.toml says {target.rows}; rows within the image must not be hidden over the whole "
        "width, and [target] rows must be right"
    )


def _lifted(L: Floats, z: float) -> Floats:
    """The camera that sees points lifted by z mm where this one sees them."""
    P = dlt.to_projection(L)
    P[:, 3] -= z * P[:, 2]
    return np.asarray((P / P[2, 3]).ravel()[:11])


def _any_inside(L: Floats, rows: list[int], frame: NDArray[np.float32], target: Target) -> bool:
    """Whether dots of these rows, seen well, would lie in the image by more than their size."""
    if not rows:
        return False
    camera = Camera("", dlt.to_projection(L), (1, 1))
    grid = np.meshgrid(rows, np.arange(1, target.columns + 1))
    xyz = dot_points(target, grid[0].ravel(), grid[1].ravel())
    normals = xyz * np.array([1 / target.radius_mm, 1 / target.radius_mm, 0])
    xyz = xyz[camera.incidence_cosine(xyz, normals) > math.cos(math.radians(40.0))]
    if not len(xyz):
        return False
    margin = _projected_size(camera, xyz, target)[1]
    px = camera.project_undistorted(xyz)
    depth = np.array([cv2.pointPolygonTest(frame, (float(x), float(y)), True) for x, y in px])
    inside = depth > margin
    return bool(inside.mean() > 0.2)


def _try(
    dots: Dots, spots: Indices, rows: Indices, columns: Indices, target: Target, azimuth_deg: float, lens_known: bool
) -> _Numbering | None:
    """The camera of one numbering of the columns, or None where it is not one outside the target.

    The rows are counted from any row at first: a target shifted by a row is the same camera shifted in height. That
    camera says where further rows must be, whether or not the lattice reached them.
    """
    if _closed(target):
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
            bend = _find_bend(dots[spots], dot_points(target, rows, columns))
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
        centre = Camera("", dlt.to_projection(L), (1, 1)).centre
    except (ComputationError, np.linalg.LinAlgError):
        return None
    if np.hypot(centre[0], centre[1]) <= target.radius_mm:
        return None
    azimuth = math.degrees(math.atan2(centre[1], centre[0]))
    deviation = (azimuth - azimuth_deg + 180.0) % 360.0 - 180.0
    return _Numbering(L, len(spots), deviation, int(np.ptp(occupied)) + 1, bend)


def _find_bend(dots: Dots, xyz: Floats) -> float:
    """The bend after which a camera without distortion agrees best with the dots."""

    def misfit(bend: float) -> float:
        px = _straightened(dots, bend).px
        return float(np.median(np.linalg.norm(dlt.residuals(dlt.solve_dlt(xyz, px), xyz, px), axis=1)))

    return float(
        scipy.optimize.minimize_scalar(misfit, bounds=(-0.4, 0.4), method="bounded", options={"xatol": 1e-3}).x
    )


def _occupied_rows(rows: Indices, columns: Indices) -> Indices:
    """Rows that hold dots in at least a third of the columns: a smudge above the target is not a row."""
    number, count = np.unique(rows, return_counts=True)
    return number[count >= max(2, len(np.unique(columns)) / 3)]


def _match(
    dots: Dots, L: Floats, target: Target, all_rows: range, max_incidence_deg: float
) -> tuple[Indices, Indices, Indices]:
    """Spots that are where dots must be and as large as they must be: their indices, rows and columns."""
    camera = Camera("", dlt.to_projection(L), (1, 1))
    grid = np.mgrid[all_rows.start : all_rows.stop, 1 : target.columns + 1]
    rows, columns = (axis.ravel() for axis in grid)
    xyz = dot_points(target, rows, columns)
    normals = xyz * np.array([1 / target.radius_mm, 1 / target.radius_mm, 0])
    seen = camera.incidence_cosine(xyz, normals) > math.cos(math.radians(max_incidence_deg))
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


def _projected_size(camera: Camera, xyz: Floats, target: Target) -> tuple[Floats, Floats]:
    """Width and height of the upright boxes round the dots' images. (n,) each, px."""
    half = target.dot_size_mm / 2
    angle = np.arctan2(xyz[:, 1], xyz[:, 0])
    turn = half / target.radius_mm
    corners = [
        camera.project_undistorted(
            np.column_stack(
                [target.radius_mm * np.cos(angle + a), target.radius_mm * np.sin(angle + a), xyz[:, 2] + dz]
            )
        )
        for a in (-turn, turn)
        for dz in (-half, half)
    ]
    extent = np.ptp(np.stack(corners), axis=0)
    return extent[:, 0], extent[:, 1]
