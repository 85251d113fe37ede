"""Textured places of the reference images that the surface does not cover, and why.

The lattice of each camera's depth map is compared with the measured triangles as the camera sees them. A place without
a depth is taken to lie on the plane of the nearest place that has one: its area is an estimate. Its normal turns on as
those of the places with a depth do there, as on a rod, whose sides soon are seen squarely by one camera only.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.charts.depth_map import DepthMap
from ringdic.charts.patches import STENCIL, Patches, depths, focal_length
from ringdic.charts.surface import ReferenceSurface
from ringdic.correlation import Status
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint
from ringdic.results.unmeasured import UncountedPlace, UnmeasuredPlaces

_COVERED = 0.5  # share of a place's cell under measured triangles
_FARTHEST = 3.0  # steps of the lattice over which the plane of a known place is extended
_AROUND, _NEAR = 9, 4.5  # places with a depth that tell how the normals turn, and steps of the lattice to the farthest
_STIFF = 0.5  # square of the steps of the lattice, by which a turn that few places tell is held small
_BEHIND = 3.0  # steps of the lattice, in mm on the surface, by which something hidden lies behind the surface
_BENT = 0.15  # by which the cosine of incidence of a surface may fall beyond its last known depth, at the limit 10°
_STEEPEST = 0.2  # least cosine of incidence by which an area is divided


def unmeasured_places(
    cameras: Sequence[Camera], maps: Sequence[DepthMap], surface: ReferenceSurface, incidence_deg: float, centre: Points
) -> list[UnmeasuredPlaces]:
    """Determine the textured places that the surface does not cover, for each camera.

    Parameters
    ----------
    cameras : the C cameras.
    maps : their depth maps.
    surface : the measured one.
    incidence_deg : degrees, largest angle of incidence of a view that is used.
    centre : (3,) mm, world frame, about which the specimen stands, for a camera that has no depth at all.
    """
    triangles = _Triangles.of(surface)
    lost = [surface.lost_at[surface.lost_at[:, 0] == k] for k in range(len(cameras))]
    limit = math.cos(math.radians(incidence_deg))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        lattices = list(pool.map(lambda camera, one: _Lattice.of(camera, one, triangles, centre), cameras, maps))
        return list(pool.map(lambda k: _of_camera(k, lattices, lost, limit), range(len(cameras))))


def arrays_of_places(places: Sequence[UnmeasuredPlaces]) -> dict[str, NDArray[Any]]:
    """Arrays of the unmeasured places by name, as stored in a task's output: (K, 2) px, (K,) codes and mm².

    places : of all cameras.
    """
    count = [len(one.px) for one in places]
    return {
        "unmeasured_camera": np.repeat(np.arange(len(places)), count),
        "unmeasured_px": np.concatenate([one.px for one in places]),
        "unmeasured_status": np.concatenate([one.status for one in places]),
        "unmeasured_area": np.concatenate([one.area for one in places]),
        "unmeasured_spacing": np.array([one.spacing for one in places]),
    }


def places_of_arrays(cameras: Sequence[Camera], arrays: Mapping[str, NDArray[Any]]) -> tuple[UnmeasuredPlaces, ...]:
    """The unmeasured places of C cameras from their arrays by name, as from `arrays_of_places`: (K, 2) px, (K,) mm²."""
    owner = arrays["unmeasured_camera"]
    return tuple(
        UnmeasuredPlaces(
            camera.id, arrays["unmeasured_px"][owner == k], float(arrays["unmeasured_spacing"][k]),
            arrays["unmeasured_status"][owner == k], arrays["unmeasured_area"][owner == k],
        )
        for k, camera in enumerate(cameras)
    )  # fmt: skip


@dataclass(frozen=True)
class _Triangles:
    """Points of the surface, and its M triangles with their normals (not of unit length) and middles, mm."""

    xyz: Points
    faces: Indices
    normals: Points
    middles: Points

    @classmethod
    def of(cls, surface: ReferenceSurface) -> _Triangles:
        a, b, c = (surface.xyz[surface.faces[:, i]] for i in range(3))
        return cls(surface.xyz, surface.faces, np.cross(b - a, c - a), (a + b + c) / 3.0)


@dataclass(frozen=True)
class _Lattice:
    """A camera's lattice of places as a raster of cells, (columns, rows) each.

    bare : textured cells that are not covered, in a patch of texture of 3 x 3 cells at least; inner : those of them in
    the middle of one; beside : cells next to a bare one. surface : least depth of the measured surface, mm, inf where
    there is none. known : (columns, rows) index of the place with a depth, -1 without.
    """

    camera: Camera
    map: DepthMap
    centre: Points
    origin: Pixels
    bare: Mask
    inner: Mask
    beside: Mask
    surface: Floats
    known: NDArray[np.int64]

    @classmethod
    def of(cls, camera: Camera, depth_map: DepthMap, triangles: _Triangles, centre: Points) -> _Lattice:
        """The raster of a camera whose textured places and depths are those of its map."""
        spacing = depth_map.spacing
        origin = np.mod(depth_map.textured[0], spacing) if len(depth_map.textured) else np.zeros(2)
        shape = tuple(int(side) // spacing + 2 for side in camera.size)
        textured, known = np.zeros(shape, bool), np.full(shape, -1, np.int64)
        textured[_cells(depth_map.textured[depth_map.patterned], origin, spacing)] = True
        known[_cells(depth_map.patches.px, origin, spacing)] = np.arange(len(depth_map.patches.px))
        share, surface = _coverage(camera, triangles, origin, spacing, shape)
        solid = minimum_filter(textured, size=3, mode="constant", cval=0)
        bare = textured & maximum_filter(solid, size=3, mode="constant", cval=0) & (share < _COVERED)
        inner = bare & solid
        beside = maximum_filter(bare, size=3, mode="constant", cval=0)
        return cls(camera, depth_map, centre, origin, bare, inner, beside, surface, known)

    def patches(self, index: Indices) -> tuple[Patches, Mask]:
        """Patches (n,) of surface about cells, and which of them have a depth of their own.

        index : (n, 2) columns and rows.
        """
        places, spacing = self.map.patches, self.map.spacing
        px = self.origin + spacing * index
        own = self.known[tuple(index.T)]
        flat = np.zeros((len(px), 3))
        if not len(places.px):
            inverse = np.full(len(px), 1.0 / float(depths(self.camera, self.centre)))
            return Patches(px, inverse, np.zeros((len(px), 2)), flat), own >= 0
        nearest = np.where(own >= 0, own, cKDTree(places.px).query(px)[1])
        offset = px - places.px[nearest]
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        offset *= np.minimum(1.0, _FARTHEST * spacing / np.maximum(length, 1e-9))
        inverse, slope = places.inverse_depth[nearest], places.gradient[nearest]
        extended = inverse + np.sum(slope * offset, axis=1)
        extended = np.clip(extended, 0.8 * inverse, 1.25 * inverse)
        return Patches(px, extended, slope, flat), own >= 0

    def normals(self, index: Indices, patches: Patches) -> Points:
        """Unit normals (n, 3) of the surface about cells: they turn on from the nearest places that have a depth.

        index : (n, 2) columns and rows. patches : of these cells, as from :meth:`patches`.
        """
        places, flat = self.map.patches, patches.normals(self.camera)
        turning = np.flatnonzero(self.known[tuple(index.T)] < 0)
        if len(places.px) < _AROUND or not len(turning):
            return flat
        tree, spacing = cKDTree(places.px), self.map.spacing
        distance, near = tree.query(places.px[tree.query(patches.px[turning])[1]], _AROUND)
        first, weight = near[:, 0], distance < _NEAR * spacing
        known = places.normals(self.camera)
        steps = weight[..., None] * (places.px[near] - places.px[first, None]) / spacing
        square = np.einsum("nki,nkj->nij", steps, steps) + _STIFF * np.eye(2)
        turn = np.linalg.solve(square, np.einsum("nki,nkj->nij", steps, known[near] - known[first, None]))
        offset = (patches.px[turning] - places.px[first]) / spacing
        offset *= np.minimum(1.0, _FARTHEST / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9))
        out = known[first] + np.einsum("ni,nij->nj", offset, turn)
        flat[turning] = out / np.linalg.norm(out, axis=1, keepdims=True)
        return flat

    def shows(self, xyz: Points, margin_mm: Floats) -> tuple[Mask, Mask]:
        """At which points (n, 3) mm this camera has an unmeasured place, and at which one that is counted.

        margin_mm : (n,) mm, by which measured surface lies before a point that it hides.
        """
        px = self.camera.project(xyz)
        inside = ((px >= 0) & (px <= np.array(self.camera.size) - 1)).all(axis=1) & (depths(self.camera, xyz) > 0)
        cell = _cells(np.where(inside[:, None], px, self.origin), self.origin, self.map.spacing)
        clear = inside & ~(self.surface[cell] < depths(self.camera, xyz) - margin_mm)
        return clear & self.beside[cell], clear & self.inner[cell]


def _cells(px: Pixels, origin: Pixels, spacing: float) -> tuple[Indices, Indices]:
    """Columns and rows (n,) of the cells in which pixels lie."""
    column, row = np.rint((px - origin) / spacing).astype(np.int64).T
    return column, row


def _coverage(
    camera: Camera, triangles: _Triangles, origin: Pixels, spacing: int, shape: tuple[int, ...]
) -> tuple[Floats, Floats]:
    """Share of each cell under the nearest triangles that face a camera, and their least depth, mm."""
    nearest = np.full(math.prod(shape), np.inf)
    facing = np.flatnonzero(np.einsum("ni,ni->n", camera.centre - triangles.middles, triangles.normals) > 0)
    faces, depth = triangles.faces[facing], depths(camera, triangles.middles[facing])
    seen = np.zeros(len(triangles.xyz), bool)
    seen[faces] = True
    px = np.full((len(seen), 2), np.nan)
    px[seen] = camera.project(triangles.xyz[seen])
    a, b, c = (px[faces[:, k]] for k in range(3))
    middle = (a + b + c) / 3.0
    inside = ((middle >= 0) & (middle <= np.array(camera.size) - 1)).all(axis=1) & (depth > 0)
    at = np.flatnonzero(inside)
    column, row = _cells(middle[at], origin, spacing)
    cell, depth = column * shape[1] + row, depth[at]
    np.minimum.at(nearest, cell, depth)
    at = at[depth < nearest[cell] + _BEHIND / _STEEPEST * spacing * depth / focal_length(camera)]
    first, second = b[at] - a[at], c[at] - a[at]
    area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    share = np.zeros(len(nearest))
    for corner in (a, b, c):  # a third of each triangle counts half way to each of its corners
        column, row = _cells(0.5 * (middle[at] + corner[at]), origin, spacing)
        index = np.clip(column, 0, shape[0] - 1) * shape[1] + np.clip(row, 0, shape[1] - 1)
        share += np.bincount(index, area, len(share))
    share, nearest = share.reshape(shape), nearest.reshape(shape)
    return share / (3.0 * spacing**2), nearest


def _of_camera(k: int, lattices: Sequence[_Lattice], lost: Sequence[Indices], limit: float) -> UnmeasuredPlaces:
    """The unmeasured places of camera k. limit : least cosine of incidence."""
    own = lattices[k]
    spacing = own.map.spacing
    index = np.argwhere(own.bare)
    patches, known = own.patches(index)
    normals = own.normals(index, patches)
    points = patches.points(own.camera, STENCIL[:5])
    xyz = points[:, 0]
    one_px = np.linalg.norm(np.cross(points[:, 1] - points[:, 2], points[:, 3] - points[:, 4]), axis=1) / 4.0
    across = spacing * depths(own.camera, xyz) / focal_length(own.camera)
    area = np.minimum(one_px * spacing**2, across**2 / _STEEPEST)
    views, shares, square, best = (np.zeros(len(index)) for _ in range(4))
    status = np.full(len(index), Status.NOT_REACHED, np.int8)
    for c, other in enumerate(lattices):
        seen, counts = (np.ones(len(index), bool),) * 2 if c == k else other.shows(xyz, _BEHIND * across)
        views, shares = views + seen, shares + counts
        cosine = other.camera.incidence_cosine(xyz, normals)
        square += seen & (cosine > limit + np.where(known, 0.0, _BENT))
        code = _lost_near(lost[c], other.camera.project(xyz), spacing)
        better = (code > 0) & seen & (cosine > best)
        status[better], best[better] = code[better], cosine[better]
    matched = known & (views < 2)
    status[matched & (best == 0)] = Status.OUTSIDE
    status[(square < 2) & (views >= 2)] = LostPoint.OBLIQUE
    status[~known & (views < 2)] = UncountedPlace.ONE_VIEW
    status[~own.inner[tuple(index.T)]] = UncountedPlace.RIM
    return UnmeasuredPlaces(own.camera.id, patches.px, float(spacing), status, area / shares)


def _lost_near(lost: Indices, px: Pixels, spacing: float) -> NDArray[np.int8]:
    """Status (n,) of the lost point of a chart nearest to pixels (n, 2) within a step of the lattice, 0 without one.

    lost : (L, 4) camera, x, y, status.
    """
    code = np.zeros(len(px), np.int8)
    finite = np.flatnonzero(np.isfinite(px).all(axis=1))
    if not len(lost) or not len(finite):
        return code
    distance, nearest = cKDTree(lost[:, 1:3]).query(px[finite], distance_upper_bound=spacing)
    near = np.isfinite(distance)
    code[finite[near]] = lost[nearest[near], 3]
    return code
