"""Matching of a chart: a grid over the part of a camera's reference image that it faces most squarely, in other images.

The depth map gives every point of the grid its start value in each image, and the curvature of its warp, which is held
while the match is refined with an affine subset: a subset of second order, free of bias, would be twice as noisy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.charts.depth_map import DepthMap
from ringdic.charts.images import ChartImages
from ringdic.charts.patches import Patches, depths, warps_between
from ringdic.charts.tracked_points import robust_quadratics
from ringdic.charts.views import ChartPlan, chart_region
from ringdic.correlation import (
    CorrelationSettings,
    Current,
    PointMatches,
    Reference,
    Status,
    correlate_independently,
    correlate_points,
    grid,
    prepare_reference,
)
from ringdic.correlation.quadratic import Neighbourhoods
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint
from ringdic.geometry.triangulation import triangulate

_WINDOW = 2.7  # steps of the lattice about a place, of the neighbours from which its curvature is computed
_NEAR = 2.5  # subset radii about a point, of the neighbours from which its curvature is computed again
_OVERLAP = 1.5  # subsets share pixels: a fit to several is this much less certain than to independent ones
_HARM = 0.01  # px, bias due to a wrong curvature beyond which a point is matched again
_FEWEST = 30  # points of a chart from which curvature is computed again
_DIFFERENCE = 0.6  # subset radii over which a warp's central differences are taken


@dataclass(frozen=True)
class ChartMatches:
    """Matches of a chart at the reference: n points of a grid in camera number ``camera`` and in the other C - 1.

    cameras : (C,) indices, the chart's own first. region : (height, width) bool. xy : (n, 2) px, the grid. faces : (m,
    3) int. px : (C, n, 2) px, NaN where there is no match; px[0] is the grid. sigma : (C, n, 2) px, as the correlation
    states it. gradient : (C, n, 2, 2). c_ls : (C, n). status : (C, n).
    """

    cameras: Indices
    region: Mask
    xy: Pixels
    faces: NDArray[np.int32]
    px: Pixels
    sigma: Pixels
    gradient: Floats
    c_ls: Floats
    status: NDArray[np.int8]


def match_chart(
    images: ChartImages, k: int, depth_map: DepthMap, plan: ChartPlan, mask: Mask | None, incidence_deg: float = 65.0
) -> ChartMatches:
    """Match a chart's grid from its own camera in all cameras that see it.

    Parameters
    ----------
    images : of all cameras.
    k : the chart's camera.
    depth_map : of that camera.
    plan : places of the depth map that belong to the chart, and the cameras that see them.
    mask : (height, width) bool, drawn by the user; None: the region follows from the places.
    incidence_deg : degrees, largest angle of incidence of a view that is used.
    """
    camera, settings = images.cameras[k], images.settings
    region, of_points = chart_region(images.image(k), depth_map, plan.inside, settings.radius)
    if mask is not None:
        region, of_points = region & mask, of_points & mask
    xy, faces = grid(of_points, settings.step)
    partners = np.flatnonzero(plan.sees[plan.inside].any(axis=0))
    cameras = np.concatenate([[k], partners]).astype(np.int64)
    count, n = len(cameras), len(xy)
    out = ChartMatches(
        cameras, region, xy, faces,
        np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan), np.full((count, n, 2, 2), np.nan),
        np.full((count, n), np.nan), np.full((count, n), Status.NOT_REACHED, np.int8),
    )  # fmt: skip
    if not n or not len(partners):
        return out
    out.px[0], out.sigma[0], out.c_ls[0], out.status[0], out.gradient[0] = xy, 0.0, 0.0, Status.GOOD, 0.0
    reference = prepare_reference(images.image(k), region, settings)
    patches, nearest = interpolated_patches(camera, depth_map, xy)
    views = [
        _View(images.cameras[other], reference, images.current(other), np.flatnonzero(plan.sees[nearest, other]))
        for other in partners.tolist()
    ]
    stencil = patches.stencil(camera, _reach(settings))
    for slot, view in enumerate(views, start=1):
        _enter(out, slot, view.index, view.first_pass(xy, stencil, settings))
    refined = _measured_patches([images.cameras[c] for c in cameras], out, depth_map, settings)
    if refined is None:
        return out
    stencil = refined.stencil(camera, _reach(settings))
    for slot, view in enumerate(views, start=1):
        index, matches = view.second_pass(xy, stencil, settings)
        _enter(out, slot, index, matches)
    _drop_oblique(out, [images.cameras[c] for c in cameras], refined, incidence_deg)
    return out


def _drop_oblique(out: ChartMatches, cameras: Sequence[Camera], patches: Patches, incidence_deg: float) -> None:
    """Drop the views of points that a camera sees more obliquely than a limit, and points that their own camera does.

    out : matches in the C cameras. patches : about the points.
    """
    xyz, normals = patches.points(cameras[0], np.zeros((1, 2)))[:, 0], patches.normals(cameras[0])
    with np.errstate(invalid="ignore"):
        oblique = [camera.incidence_cosine(xyz, normals) < np.cos(np.radians(incidence_deg)) for camera in cameras]
    for slot in range(1, len(cameras)):
        lost = (oblique[slot] | oblique[0]) & (out.status[slot] == Status.GOOD)
        out.px[slot, lost], out.status[slot, lost] = np.nan, LostPoint.OBLIQUE


def _enter(out: ChartMatches, slot: int, index: Indices, matches: PointMatches | None) -> None:
    """Enter the matches of points ``index`` (k,) in one camera."""
    if matches is None:
        return
    out.px[slot, index], out.sigma[slot, index] = matches.xy + matches.uv, matches.sigma
    out.gradient[slot, index], out.c_ls[slot, index] = matches.gradient, matches.c_ls
    out.status[slot, index] = matches.status


def _reach(settings: CorrelationSettings) -> float:
    """Distance over which a warp's central differences are taken, px."""
    return max(2.0, _DIFFERENCE * settings.radius)


@dataclass
class _View:
    """One camera in which points ``index`` (k,) of a chart are matched, and their matches so far."""

    camera: Camera
    reference: Reference
    current: Current
    index: Indices
    matches: PointMatches | None = None

    def first_pass(self, xy: Pixels, stencil: Points, settings: CorrelationSettings) -> PointMatches | None:
        """Match all points from the warps of the depth map's patches, stencil (n, 9, 3); None without any."""
        start = self._warps(xy, stencil, settings)
        if np.isfinite(start).any():
            first_order = replace(settings, order=1)
            self.matches = correlate_points(self.reference, self.current, xy[self.index], first_order, start=start)
        return self.matches

    def second_pass(
        self, xy: Pixels, stencil: Points, settings: CorrelationSettings
    ) -> tuple[Indices, PointMatches | None]:
        """Match the lost points, and those whose curvature differs from that held before, by the measured shape.

        stencil : (n, 9, 3) mm, of patches fitted to the first pass. Returns the points (j,) that changed, and their
        matches.
        """
        if self.matches is None:
            return self.index, None
        first = self.matches
        start = self._warps(xy, stencil, settings)
        held = first.curvature.reshape(-1, 6)
        with np.errstate(invalid="ignore"):
            harm = np.abs(start[:, 6:] - held).max(axis=1) * settings.radius**2 / 8.0
            again = np.flatnonzero(np.isfinite(start).all(axis=1) & ((harm > _HARM) | ~first.good))
        if not len(again):
            return self.index[again], None
        sound = first.good[again]
        warp = np.concatenate([first.uv, first.gradient.reshape(-1, 4)], axis=1)[again]
        start = start[again]
        start[sound, :6] = warp[sound]
        at = xy[self.index[again]]
        matches = correlate_independently(self.reference, self.current, at, replace(settings, order=1), start)
        better = matches.good & (matches.zncc > settings.zncc_min)
        return self.index[again[better]], matches.part(better)

    def _warps(self, xy: Pixels, stencil: Points, settings: CorrelationSettings) -> Floats:
        """Warps (k, 12) of the points into this camera; NaN where there is none."""
        warps = warps_between(self.camera, xy[self.index], stencil[self.index], _reach(settings))
        warps[~np.isfinite(warps).all(axis=1)] = np.nan
        return warps


def _measured_patches(
    cameras: Sequence[Camera], matches: ChartMatches, depth_map: DepthMap, settings: CorrelationSettings
) -> Patches | None:
    """Curved patches about all points, from quadratics of the inverse depths that were measured; None without any."""
    depth = depths(cameras[0], triangulate(cameras, matches.px))
    known = np.isfinite(depth) & (depth > 0)
    if known.sum() < _FEWEST:
        return None
    usual = float(np.median(depth_map.sigma))
    values = np.stack([1.0 / np.where(known, depth, np.nan), np.zeros(len(depth))], axis=1) / usual
    fit = robust_quadratics(Neighbourhoods(matches.xy, _NEAR * settings.radius), values, np.ones(len(depth)))
    scatter = _OVERLAP * 1.4826 * float(np.nanmedian(np.abs(fit.leave_one_out[:, 0])))
    with np.errstate(invalid="ignore"):
        harm = scatter * fit.curvature_sigma.max(axis=1) * settings.radius**2 / 8.0
        certain = np.flatnonzero(np.isfinite(fit.curvature[:, 0]).all(axis=1) & (harm < scatter))
    if not len(certain):
        return None
    # At the rim, where the neighbours lie to one side, the curvature is that of the nearest point that has it.
    curvature = fit.curvature[certain[cKDTree(matches.xy[certain]).query(matches.xy)[1]], 0]
    return Patches(matches.xy, fit.value[:, 0] * usual, fit.gradient[:, 0] * usual, curvature * usual)


def interpolated_patches(camera: Camera, depth_map: DepthMap, xy: Pixels) -> tuple[Patches, Indices]:
    """Curved patches about pixels between the places of a depth map, from local quadratics of the inverse depth.

    camera : of the map. xy : (n, 2) px. Returns the patches, and the index (n,) of the place nearest to each pixel.
    """
    places = depth_map.patches
    neighbourhoods = Neighbourhoods(places.px, _WINDOW * depth_map.spacing)
    values = np.stack([places.inverse_depth, np.zeros(len(places.px))], axis=1)
    usual = float(np.median(depth_map.sigma))
    fit = robust_quadratics(neighbourhoods, values / usual, depth_map.sigma / usual)
    known: Mask = np.asarray(np.isfinite(fit.value).all(axis=1))
    nearest = cKDTree(places.px).query(xy)[1]
    value = np.where(known, fit.value[:, 0] * usual, places.inverse_depth)
    gradient = np.where(known[:, None], fit.gradient[:, 0] * usual, places.gradient)
    curvature = np.zeros((len(places.px), 3))
    if known.any():  # at the rim the curvature is that of the nearest place that has enough neighbours
        curvature = fit.curvature[np.flatnonzero(known)[cKDTree(places.px[known]).query(places.px)[1]], 0] * usual
    at = Patches(places.px, value, gradient, curvature).part(nearest)
    dx, dy = (xy - at.px).T
    xx, xy_, yy = at.curvature.T
    shifted = at.inverse_depth + at.gradient[:, 0] * dx + at.gradient[:, 1] * dy
    shifted = shifted + 0.5 * xx * dx**2 + xy_ * dx * dy + 0.5 * yy * dy**2
    slope = at.gradient + np.stack([xx * dx + xy_ * dy, xy_ * dx + yy * dy], axis=1)
    return Patches(xy, shifted, slope, at.curvature), nearest
