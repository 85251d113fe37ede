"""Matching of a chart: a grid over the part of a camera's reference image that it faces most squarely, in other images.

The depth map gives every point of the grid its start value in each image, and the curvature of its warp, which is held
while the match is refined with an affine subset: a subset of second order, free of bias, would be twice as noisy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points, Vectors
from ringdic.charts.depth_map import DepthMap
from ringdic.charts.images import ChartImages
from ringdic.charts.patches import STENCIL, Patches, depths, stencil_rays, warps_between
from ringdic.charts.tracked_points import robust_quadratics
from ringdic.charts.views import ChartPlan, chart_region, grid_to_the_border
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
from ringdic.correlation.refinement import SubsetCache
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint, grid_neighbours
from ringdic.geometry.triangulation import triangulate

_WINDOW = 2.7  # steps of the lattice about a place, of the neighbours from which its curvature is computed
_NEAR = 1.2  # subset radii about a point, of the neighbours from which its curvature is computed again
_NOISE = 0.015  # px, standard deviation of the matches from which on that radius grows, to twice of it at most
_NEAREST = 2.3  # steps of the grid, the least such radius, of a circle with 21 points
_OVERLAP = 1.5  # subsets share pixels: a fit to several is this much less certain than to independent ones
_HARM = 0.008  # px, bias due to a wrong curvature beyond which a point is matched again
_ROUNDS = 2  # times that the curvature is computed again from the matches
_SETTLED = 0.05  # matches with another curvature, as a share of the points, below which the rounds end
_STEEPER = 10.0  # degrees by which the incidence at the rim of a subset may exceed the limit
_MARGIN = 3.0  # subset radii about the points, of the part of an image in which they are matched
_SHARP = 0.1  # px, bias due to the change of curvature over half a radius from which on smaller subsets are better
_SMALL = 0.7  # radius of these, in that of the others
_SMALLEST = 5  # px, least radius of these
_FEWEST = 30  # points of a chart from which curvature is computed again
_DIFFERENCE = 0.6  # subset radii over which a warp's central differences are taken


@dataclass(frozen=True)
class ChartMatches:
    """Matches of a chart at the reference: n points of a grid in camera number ``camera`` and in the other C - 1.

    cameras : (C,) indices, the chart's own first. xy : (n, 2) px, the grid. faces : (m, 3) int. px : (C, n, 2) px, NaN
    where there is no match; px[0] is the grid. sigma : (C, n, 2) px, as the correlation states it. gradient : (C, n,
    2, 2). c_ls : (C, n). status : (C, n). bend : (C, n) px, standard deviation due to a change of the curvature within
    the subset.
    """

    cameras: Indices
    xy: Pixels
    faces: NDArray[np.int32]
    px: Pixels
    sigma: Pixels
    gradient: Floats
    c_ls: Floats
    status: NDArray[np.int8]
    bend: Floats


def match_chart(
    images: ChartImages, k: int, depth_map: DepthMap, plan: ChartPlan, mask: Mask | None, incidence_deg: float = 65.0,
    *, curved: bool = True,
) -> ChartMatches:  # fmt: skip
    """Match a chart's grid from its own camera in all cameras that see it.

    Parameters
    ----------
    images : of all cameras.
    k : the chart's camera.
    depth_map : of that camera.
    plan : places of the depth map that belong to the chart, and the cameras that see them.
    mask : (height, width) bool, drawn by the user; None: the region follows from the places.
    incidence_deg : degrees, largest angle of incidence of a view that is used.
    curved : whether the curvature of the surface is held; otherwise subsets are as the settings' order says.
    """
    camera, settings = images.cameras[k], images.settings
    region, of_points = chart_region(images.image(k), depth_map, plan.inside, settings.radius)
    if mask is not None:
        region, of_points = region & mask, of_points & mask
    # At the border a flat subset, all on one side of its point, is biased.
    xy, faces = (grid_to_the_border if curved else grid)(of_points, settings.step)
    partners = sorted(c for c, seen in plan.sees.items() if seen[plan.inside].any())
    cameras = np.array([k, *partners], np.int64)
    n, out = len(xy), _unmatched(cameras, xy, faces)
    if not n or not len(partners):
        return out
    reference = prepare_reference(images.image(k), region, settings)
    patches, nearest = interpolated_patches(depth_map, xy)
    subsets = SubsetCache(n, 1, transposed=True) if curved else None
    others = [images.cameras[other] for other in partners]
    rays = stencil_rays(camera, xy, _reach(settings))
    stencil = patches.stencil(camera, _reach(settings), rays)
    views = [
        _View.of(
            reference, images.current(c), images.cameras[c], images.cameras[c].project(stencil[:, 0]),
            np.flatnonzero(plan.sees[c][nearest]), _MARGIN * settings.radius, subsets,
        )
        for c in partners
    ]  # fmt: skip
    if curved:
        _first_looks(out, views, stencil, settings)
    else:
        for slot, view in enumerate(views, start=1):
            every = np.ones(len(view.index), bool)
            _enter(out, slot, *view.first_look(xy, stencil, settings, every, curved=False))
    for _ in range(_ROUNDS if curved else 0):
        patches = _measured_patches([camera, *others], out, depth_map, settings) or patches
        stencil = patches.stencil(camera, _reach(settings), rays)
        for slot, view in enumerate(views, start=1):
            _enter(out, slot, *view.match(xy, stencil, settings))
        if sum(view.changed for view in views) < _SETTLED * n:
            break
    _match_bends(out, views if curved else (), stencil, settings)
    _drop_oblique(out, [camera, *others], stencil, incidence_deg, settings.radius / _reach(settings))
    return out


def _unmatched(cameras: Indices, xy: Pixels, faces: NDArray[np.int32]) -> ChartMatches:
    """A chart whose points are known in its own camera alone, the first of the cameras (C,)."""
    count, n = len(cameras), len(xy)
    out = ChartMatches(
        cameras, xy, faces,
        np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan), np.full((count, n, 2, 2), np.nan),
        np.full((count, n), np.nan), np.full((count, n), Status.NOT_REACHED, np.int8), np.zeros((count, n)),
    )  # fmt: skip
    if n and count > 1:
        out.px[0], out.sigma[0], out.c_ls[0], out.status[0], out.gradient[0] = xy, 0.0, 0.0, Status.GOOD, 0.0
    return out


def _match_bends(out: ChartMatches, views: Sequence[_View], stencil: Points, settings: CorrelationSettings) -> None:
    """State the bias due to a change of the curvature within subsets, and match with smaller ones where it is large.

    A subset with the curvature held is free of bias where the curvature changes evenly over it. At a rounded edge it
    does not, and the bias is, by measurement, that of the difference between the curvature and its mean on both sides.

    stencil : (n, 9, 3) mm, of the patches about the points.
    """
    n = len(out.xy)
    pairs = grid_neighbours(out.xy, settings.step)
    beside = np.moveaxis(pairs, 0, -1)  # (4, 2, n)
    small = replace(settings, radius=max(_SMALLEST, round(_SMALL * settings.radius)), order=1)
    apart = settings.radius / (2.0 * settings.step)
    for slot, view in enumerate(views, start=1):
        held = np.full((6, n + 1), np.nan)
        held[:, view.index] = view.held.T
        away = held[:, beside] - held[:, None, None, :-1]
        change = _bias(away.reshape(-1, n), settings) * apart
        uneven = _bias(away.mean(axis=2).reshape(-1, n), settings) * apart**2
        out.bend[slot] = np.maximum(uneven, np.append(uneven, 0.0)[beside].max(axis=(0, 1)))
        at = np.flatnonzero(change[view.index] > _SHARP)
        if not len(at):
            continue
        index, start = view.index[at], view.warps(out.xy, stencil, settings, at)
        matches = correlate_independently(view.reference, view.current, out.xy[index], small, start)
        _enter(out, slot, index[matches.good], matches.part(matches.good))


def _bias(difference: Floats, settings: CorrelationSettings) -> Floats:
    """Largest bias (n,) px of matches at curvatures wrong by some differences (k, n) 1/px; 0 where unknown."""
    return np.asarray(np.fmax.reduce(np.abs(difference), axis=0, initial=0.0) * settings.radius**2 / 8.0)


def _first_looks(out: ChartMatches, views: Sequence[_View], stencil: Points, settings: CorrelationSettings) -> None:
    """Match every point in the camera that faces it most squarely, and where that fails in the next one.

    A reflection or an obstacle hides a part of the surface from the one and not from the other. What lies beyond the
    border of the first image waits until the curvature has been measured.

    out : matches of n points. views : of the C cameras. stencil : (n, 9, 3) mm, of the depth map's patches.
    """
    tangents = _tangents(stencil, np.zeros((1, 2)))
    squarely = np.full((len(views), len(out.xy)), -np.inf)
    for view, cosine in zip(views, squarely, strict=True):
        cosine[view.index] = np.nan_to_num(_incidence_cosine(view.camera, tangents)[view.index], nan=-np.inf)
    while True:
        settled = np.isin(out.status[1:], (Status.GOOD, Status.OUTSIDE)).any(axis=0)
        wanted = (squarely.max(axis=0) > -np.inf) & ~settled
        if not wanted.any():
            return
        squarest = np.where(wanted, squarely.argmax(axis=0), -1)
        for slot, (view, cosine) in enumerate(zip(views, squarely, strict=True), start=1):
            chosen = squarest[view.index] == slot - 1
            if chosen.any():
                _enter(out, slot, *view.first_look(out.xy, stencil, settings, chosen, curved=True))
            cosine[view.index[chosen]] = -np.inf


def _drop_oblique(
    out: ChartMatches, cameras: Sequence[Camera], stencil: Points, incidence_deg: float, rim: float
) -> None:
    """Drop views of points that a camera sees more obliquely than a limit, and points that their own camera does.

    Views that are as oblique anywhere in the subset are dropped too, where another remains: no warp of second order
    describes them.

    out : matches in the C cameras. stencil : (n, 9, 3) mm, of patches about the points. rim : reaches of the stencil
    from a point to the rim of its subset.
    """
    limit, steepest = np.cos(np.radians(incidence_deg)), np.cos(np.radians(incidence_deg + _STEEPER))
    at_middle, at_rim = _tangents(stencil, np.zeros((1, 2))), _tangents(stencil, rim * STENCIL[1:5])
    middle = [_incidence_cosine(camera, at_middle) for camera in cameras]
    around = [_incidence_cosine(camera, at_rim) for camera in cameras[1:]]
    good = out.status[1:] == Status.GOOD
    oblique = np.stack([(middle[0] < limit) | (each < limit) for each in middle[1:]])
    steep = np.stack([each < steepest for each in around])
    steep &= (good & ~oblique & ~steep).any(axis=0)
    lost = good & (oblique | steep)
    out.px[1:][lost], out.status[1:][lost] = np.nan, LostPoint.OBLIQUE


def _tangents(stencil: Points, at: Pixels) -> tuple[Points, Vectors]:
    """Points (k, n, 3) mm and normals of unit length (k, n, 3) at places of patches, from quadratics through stencils.

    stencil : (n, 9, 3) mm. at : (k, 2), the places, in reaches of the stencil.
    """
    centre, right, left, below, above, br, bl, ar, al = np.moveaxis(stencil, 1, 0)
    along, down = 0.5 * (right - left), 0.5 * (below - above)
    xx, xy, yy = right - 2.0 * centre + left, 0.25 * (br - bl - ar + al), below - 2.0 * centre + above
    xyz, normals = np.empty((len(at), *centre.shape)), np.empty((len(at), *centre.shape))
    for k, (s, t) in enumerate(at):
        xyz[k] = centre + s * along + t * down + 0.5 * s * s * xx + s * t * xy + 0.5 * t * t * yy
        normals[k] = np.cross(down + s * xy + t * yy, along + s * xx + t * xy)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= np.sqrt(np.einsum("kni,kni->kn", normals, normals))[..., None]
    return xyz, normals


def _incidence_cosine(camera: Camera, tangents: tuple[Points, Vectors]) -> Floats:
    """Least cosine (n,) of the incidence at some places of patches. tangents : of `_tangents`."""
    return np.asarray(camera.incidence_cosine(*tangents).min(axis=0))


def drop_masked(matches: ChartMatches, masks: Callable[[int], Mask | None]) -> None:
    """Drop the views of points that lie outside the region drawn for the camera, in place.

    masks : function of a camera's index; returns its region (height, width) bool, None where none was drawn.
    """
    for slot, camera in enumerate(matches.cameras[1:].tolist(), start=1):
        mask = masks(camera)
        good = np.flatnonzero(matches.status[slot] == Status.GOOD)
        if mask is None or not len(good):
            continue
        column, row = np.rint(matches.px[slot, good]).astype(np.int64).T
        outside = good[~mask[row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)]]
        matches.px[slot, outside], matches.status[slot, outside] = np.nan, Status.NOT_REACHED


def _enter(out: ChartMatches, slot: int, index: Indices, matches: PointMatches | None) -> None:
    """Enter the matches of points ``index`` (k,) in one camera, if there are any."""
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
    """One camera in which points ``index`` (k,) of a chart are matched.

    current : its image in the box about them. held : (k, 6) 1/px, second derivatives that the warps were last held at,
    NaN for points not tried yet. good : (k,) bool, points that are matched. subsets : of all points of the chart, for
    all cameras; None where none are kept. changed : number of points whose curvature was another one in the round
    before.
    """

    camera: Camera
    reference: Reference
    current: Current
    index: Indices
    held: Floats
    good: Mask
    subsets: SubsetCache | None
    changed: int = 0

    @classmethod
    def of(
        cls, reference: Reference, current: Current, camera: Camera, at: Pixels, index: Indices, margin: float,
        subsets: SubsetCache | None,
    ) -> _View:  # fmt: skip
        """A camera with its whole image. at : (n, 2) px, where all points of the chart are there. margin : px."""
        at = at[index][np.isfinite(at[index]).all(axis=1)]
        if len(at):
            current = current.crop_around(at, margin)
        return cls(
            camera, reference, current, index, np.full((len(index), 6), np.nan), np.zeros(len(index), bool), subsets
        )

    def first_look(
        self, xy: Pixels, stencil: Points, settings: CorrelationSettings, chosen: Mask, *, curved: bool
    ) -> tuple[Indices, PointMatches | None]:
        """Match the ``chosen`` (k,) of the points, of which only the depth map's patches are known.

        xy : (n, 2) px. stencil : (n, 9, 3) mm, of those patches. curved : whether their curvature is held; otherwise
        subsets are as the settings say. Returns indices (j,) of points and their matches.
        """
        at = np.flatnonzero(chosen)
        start = self.warps(xy, stencil, settings, at)
        if not np.isfinite(start).any():
            return self.index[at], None
        points, used = xy[self.index[at]], replace(settings, order=1) if curved else settings
        start = start if curved or settings.order == 2 else start[:, :6]
        kept = self._kept(at)
        matches = correlate_points(self.reference, self.current, points, used, start=start, kept=kept)
        self.held[at], self.good[at] = matches.curvature.reshape(-1, 6), matches.good
        return self.index[at], matches

    def match(self, xy: Pixels, stencil: Points, settings: CorrelationSettings) -> tuple[Indices, PointMatches | None]:
        """Match the points whose curvature differs from that held before, or that have not been tried.

        xy : (n, 2) px. stencil : (n, 9, 3) mm, of measured patches. Returns indices (j,) of the points that changed,
        and their matches.
        """
        start = self.warps(xy, stencil, settings, np.arange(len(self.index)))
        with np.errstate(invalid="ignore"):
            harm = np.abs(start[:, 6:] - self.held).max(axis=1) * settings.radius**2 / 8.0
            at = np.flatnonzero(np.isfinite(start).all(axis=1) & ~(harm <= _HARM))
        self.changed = int(np.isfinite(self.held[at]).all(axis=1).sum())
        if not len(at):
            return self.index[at], None
        points = xy[self.index[at]]
        matches = correlate_independently(
            self.reference, self.current, points, replace(settings, order=1), start[at], kept=self._kept(at)
        )
        self.held[at] = start[at, 6:]
        entered = matches.good | ~self.good[at]
        self.good[at] |= matches.good
        return self.index[at[entered]], matches.part(entered)

    def _kept(self, at: Indices) -> tuple[SubsetCache, Indices] | None:
        """The subsets of all points, and those among them at ``at`` (j,) of the camera's own points."""
        return None if self.subsets is None else (self.subsets, self.index[at])

    def warps(self, xy: Pixels, stencil: Points, settings: CorrelationSettings, at: Indices) -> Floats:
        """Warps (j, 12) into this camera of the points at ``at`` (j,) of its own; NaN where there is none."""
        points = self.index[at]
        warps = warps_between(self.camera, xy[points], stencil[points], _reach(settings))
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
    noise = float(np.nanmedian(np.hypot(*np.moveaxis(matches.sigma[1:], -1, 0))))
    wider = float(np.clip((noise / _NOISE) ** (2.0 / 3.0), 1.0, 2.0))
    reach = max(_NEAR * wider * settings.radius, _NEAREST * settings.step)
    fit = robust_quadratics(Neighbourhoods(matches.xy, reach), values, np.ones(len(depth)))
    scatter = _OVERLAP * 1.4826 * float(np.nanmedian(np.abs(fit.leave_one_out[:, 0])))
    with np.errstate(invalid="ignore"):
        harm = scatter * fit.curvature_sigma.max(axis=1) * settings.radius**2 / 8.0
        certain: Mask = np.asarray(np.isfinite(fit.curvature[:, 0]).all(axis=1) & (harm < scatter))
    if not certain.any():
        return None
    # At the rim, where the neighbours lie to one side, the curvature is that of the nearest point that has it.
    curvature = fit.curvature[_nearest(matches.xy, certain), 0]
    return Patches(matches.xy, fit.value[:, 0] * usual, fit.gradient[:, 0] * usual, curvature * usual)


def interpolated_patches(depth_map: DepthMap, xy: Pixels) -> tuple[Patches, Indices]:
    """Curved patches about pixels between the places of a depth map, from local quadratics of the inverse depth.

    xy : (n, 2) px. Returns the patches, and the index (n,) of the place nearest to each pixel.
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
        curvature = fit.curvature[_nearest(places.px, known), 0] * usual
    at = Patches(places.px, value, gradient, curvature).part(nearest)
    dx, dy = (xy - at.px).T
    xx, xy_, yy = at.curvature.T
    shifted = at.inverse_depth + at.gradient[:, 0] * dx + at.gradient[:, 1] * dy
    shifted = shifted + 0.5 * xx * dx**2 + xy_ * dx * dy + 0.5 * yy * dy**2
    slope = at.gradient + np.stack([xx * dx + xy_ * dy, xy_ * dx + yy * dy], axis=1)
    return Patches(xy, shifted, slope, at.curvature), nearest


def _nearest(xy: Pixels, known: Mask) -> Indices:
    """Index (n,) of the nearest of the known ones to each of the points (n, 2) px, to a known one its own."""
    nearest, lost = np.arange(len(xy)), np.flatnonzero(~known)
    if len(lost):
        nearest[lost] = np.flatnonzero(known)[cKDTree(xy[known]).query(xy[lost])[1]]
    return nearest
