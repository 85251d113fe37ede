"""The surface at the reference: the charts triangulated from all their views, and merged into one mesh."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.charts.agreement import triangulate_agreeing
from ringdic.charts.chart import Chart
from ringdic.charts.weights import CELL_STEPS, smooth_sigma
from ringdic.correlation import Status
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint, grid_neighbours, surface_outliers
from ringdic.merging import SurfacePart, merge, side_by_side
from ringdic.mesh.mesh import Mesh, used_vertices
from ringdic.results.unmeasured import BY_CODE

_BEND = 0.2  # spacings by which a point lies off the middle of its neighbours on a surface bent as sharply as a finger
_LONGEST = 4.0  # median edges, of a triangle beyond which it joins two surfaces
_FLOOR = 0.005  # px, standard deviation of a pixel due to errors of the cameras and of the shape that warps are held at


@dataclass(frozen=True)
class ReferenceSurface:
    """Measured points of the surface at the reference: N points, C cameras, M triangles.

    xyz : (N, 3) mm, world frame. faces : (M, 3), normals outwards. own : (N,) index of the camera whose chart a point
    belongs to, in whose image it lies on a whole pixel. px : (C, N, 2) px, NaN for a camera that was not used. sigma :
    (C, N, 2) px, standard deviation due to all causes, smoothed over the image. scatter : (C, N, 2) px, that of
    each match alone. texture : (C, N, 5), of `Chart`. grey_noise : (C,), variance of each camera's noise, grey
    levels², NaN where it took no part. chi2, degrees : (N,), of the triangulation. c_ls : (N,), the largest over the
    cameras. neighbours : (N, 4, 2), of `grid_neighbours`. lost : (K, 2), status and number of the points of charts
    that were lost. lost_at : (L, 4), camera, x and y (px) and status of each of them. mismatch : (J, 8), distances of
    every two charts that overlap: their numbers, the number of points compared, mean, standard deviation, bias, root
    mean square and largest, mm.
    """

    xyz: Points
    faces: Indices
    own: Indices
    px: Pixels
    sigma: NDArray[np.float32]
    scatter: NDArray[np.float32]
    texture: NDArray[np.float32]
    grey_noise: Floats
    chi2: Floats
    degrees: Indices
    c_ls: Floats
    neighbours: Indices
    lost: Indices
    lost_at: Indices
    mismatch: Floats

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the surface by name, as stored in a task's output: (N, ...) mm, (C, N, ...) px, (M, 3) indices."""
        return {each.name: np.asarray(getattr(self, each.name)) for each in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray]) -> ReferenceSurface:
        """The surface from its arrays by name, as from :meth:`arrays`: (N, ...) mm, (C, N, ...) px, (M, 3) indices."""
        return cls(**{each.name: arrays[each.name] for each in fields(cls)})


def reference_surface(
    cameras: Sequence[Camera], charts: Sequence[Chart], step: int, sigma_max: float, heuristic: str = "combined"
) -> ReferenceSurface:
    """Triangulate the points of all charts from all their views and merge the charts into one surface.

    Parameters
    ----------
    cameras : the C cameras.
    charts : n points each, of which some may have none.
    step : px, of the grids.
    sigma_max : px, greatest standard deviation of an accepted match.
    heuristic : of the merging, or none to leave the charts one over the other.

    Raises ComputationError where no chart gave a triangle: why most points were lost.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        measured = list(pool.map(lambda chart: _measure(cameras, chart, step, sigma_max), charts))
    parts = [SurfacePart(one.xyz, one.faces, one.c_ls) for one in measured]
    if not any(len(part.faces) for part in parts):
        raise ComputationError(f"no two cameras share a textured surface: {_losses(measured)}")
    merged = merge(parts, heuristic) if heuristic != "none" else side_by_side(parts)
    number = np.full(sum(len(one.xyz) for one in measured) + 1, -1, np.int64)
    number[merged.vertex] = np.arange(len(merged.vertex))

    def joined(name: str, axis: int = 0) -> NDArray[Any]:
        return np.concatenate([getattr(one, name) for one in measured], axis=axis).take(merged.vertex, axis=axis)

    offsets = np.cumsum([0, *(len(one.xyz) for one in measured)])
    shifted = [
        np.where(one.neighbours >= 0, one.neighbours + offset, -1)
        for one, offset in zip(measured, offsets, strict=False)
    ]
    neighbours = np.concatenate(shifted)[merged.vertex]
    lost_at = np.concatenate([one.lost for one in measured])
    status, count = np.unique(lost_at[:, 3], return_counts=True)
    grey_noise = np.full(len(cameras), np.nan)
    for chart in charts:
        grey_noise[chart.cameras] = chart.grey_noise
    return ReferenceSurface(
        joined("xyz"), number[merged.faces], joined("own"), joined("px", 1), joined("sigma", 1), joined("scatter", 1),
        joined("texture", 1), grey_noise, joined("chi2"), joined("degrees"), joined("c_ls"), number[neighbours],
        np.stack([status, count], axis=1), lost_at,
        np.array([astuple(one) for one in merged.mismatch]).reshape(-1, 8),
    )  # fmt: skip


@dataclass(frozen=True)
class _MeasuredChart:
    """Points of one chart in space, with arrays as in `ReferenceSurface`, and those that were lost."""

    xyz: Points
    faces: Indices
    own: Indices
    px: Pixels
    sigma: NDArray[np.float32]
    scatter: NDArray[np.float32]
    texture: NDArray[np.float32]
    chi2: Floats
    degrees: Indices
    c_ls: Floats
    neighbours: Indices
    lost: Indices


def _measure(cameras: Sequence[Camera], chart: Chart, step: int, sigma_max: float) -> _MeasuredChart:
    """Triangulate the points of a chart and keep those that form triangles."""
    if len(chart.cameras) < 2 or not len(chart.xy):
        return _empty(len(cameras), chart)
    own = [cameras[c] for c in chart.cameras]
    sigma = np.sqrt(chart.noise.astype(float) ** 2 + chart.systematic.astype(float) ** 2 + _FLOOR**2)
    stated = np.hypot(sigma, chart.bend[..., None])
    with np.errstate(invalid="ignore"):
        uncertain: Mask = np.asarray((sigma > sigma_max).any(axis=2))
    uncertain[0] = False  # its pixel defines the point
    px = np.where(uncertain[..., None] | ~np.isfinite(sigma), np.nan, chart.px)
    smooth = np.stack([smooth_sigma(at, one, CELL_STEPS * step) for at, one in zip(px, sigma, strict=True)])
    n = len(chart.xy)
    points, used = triangulate_agreeing(own, px, smooth, np.zeros(n, np.int64))
    status = _status(chart, px, points.xyz)
    xyz = np.where((status == 0)[:, None], points.xyz, np.nan)
    neighbours = grid_neighbours(chart.xy, step)
    floor = (_BEND + _off_the_grid(chart.xy, step, neighbours)) * _spacing(xyz, neighbours)
    off = surface_outliers(neighbours, xyz, floor=floor) & (status == 0)
    status[off], xyz[off] = LostPoint.SURFACE, np.nan
    faces = _without_steps(xyz, chart.faces)
    rows = used_vertices(faces)
    number = np.full(n + 1, -1, np.int64)
    number[rows] = np.arange(len(rows))

    def everywhere(values: NDArray[Any]) -> NDArray[Any]:
        out = np.full((len(cameras), len(rows), *values.shape[2:]), np.nan, values.dtype)
        out[chart.cameras] = np.where(used[:, rows].reshape(len(own), len(rows), 1), values[:, rows], np.nan)
        return out

    c_ls = np.max(np.where(used, chart.c_ls, -np.inf), axis=0, initial=-np.inf)
    return _MeasuredChart(
        xyz[rows], number[faces], np.full(len(rows), chart.cameras[0]), everywhere(px),
        everywhere(smooth.astype(np.float32)), everywhere(stated.astype(np.float32)), everywhere(chart.texture),
        points.chi2[rows], points.degrees[rows], c_ls[rows].astype(float), number[neighbours[rows]],
        _lost_at(chart, status),
    )  # fmt: skip


def _off_the_grid(xy: Pixels, step: int, neighbours: Indices) -> Floats:
    """Largest distance (n,) in steps by which each point or one of its neighbours lies beside its place on the grid."""
    off = np.append(np.abs(xy / step - np.rint(xy / step)).max(axis=1), 0.0)
    return np.asarray(np.maximum(off[:-1], off[neighbours].max(axis=(1, 2))))


def _spacing(xyz: Points, neighbours: Indices) -> float:
    """Median distance of opposite neighbours from one another, halved, mm; 0.1 where there are none."""
    pairs = neighbours[:, :2].reshape(-1, 2)
    apart = np.linalg.norm(np.diff(xyz[pairs[(pairs >= 0).all(axis=1)]], axis=1)[:, 0], axis=1)
    apart = apart[np.isfinite(apart)]
    return 0.5 * float(np.median(apart)) if len(apart) else 0.1


def _empty(count: int, chart: Chart) -> _MeasuredChart:
    """A chart without points, of a rig of ``count`` cameras."""
    nothing, triples = np.zeros(0), np.zeros((0, 3))
    views = np.zeros((count, 0, 2))
    deviations = views.astype(np.float32)
    return _MeasuredChart(
        triples, triples.astype(np.int64), nothing.astype(np.int64), views, deviations, deviations,
        np.zeros((count, 0, 5), np.float32), nothing, nothing.astype(np.int64), nothing,
        np.zeros((0, 4, 2), np.int64), _lost_at(chart, chart.status[0]),
    )  # fmt: skip


def _lost_at(chart: Chart, status: NDArray[np.int8]) -> Indices:
    """Camera, x, y (px) and status (L, 4) of the points of a chart whose status is not 0."""
    lost = status != 0
    own = np.full(int(lost.sum()), chart.cameras[0])
    return np.column_stack([own, chart.xy[lost], status[lost]]).astype(np.int64)


def _status(chart: Chart, px: Pixels, xyz: Points) -> NDArray[np.int8]:
    """Reasons (n,) why points have no position, 0 where they have one."""
    lost = ~np.isfinite(xyz).all(axis=1)
    matched = (chart.status[1:] == Status.GOOD).any(axis=0)
    why = np.max(chart.status[1:], axis=0, initial=Status.NOT_REACHED)
    views = np.isfinite(px[1:, :, 0]).any(axis=0)
    reason = np.where(matched, np.where(views, LostPoint.RESIDUAL, LostPoint.UNCERTAIN), why)
    return np.where(lost, reason, 0).astype(np.int8)


def _losses(charts: Sequence[_MeasuredChart]) -> str:
    """Why most points of charts without any triangle were lost, and what helps."""
    codes = [code for one in charts for code in one.lost[:, 3].tolist()]
    if not codes:
        return "no camera has places with a depth that another one sees"
    status, most = Counter(codes).most_common(1)[0]
    reason = BY_CODE[status]
    return f"{len(codes)} points were lost, {most} of them because: {reason.sentence}; {reason.remedy}"


def _without_steps(xyz: Points, faces: NDArray[np.int32]) -> Indices:
    """Triangles (M, 3) between measured points, without those that join two surfaces across a step in depth."""
    mesh = Mesh(xyz, faces.astype(np.int64)).without_lost()
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return mesh.faces[longest < _LONGEST * np.median(longest)] if len(longest) else mesh.faces
