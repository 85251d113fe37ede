"""Compilation or loading of the kernels used after the matching, by processing a small synthetic plate once.

Triangulation, merging, deformation, uncertainty and the writing of results run on the exact matches of the plate, so
the first step of a session need not wait for their compilation.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ringdic.arrays import Points
from ringdic.charts.chart import Chart
from ringdic.charts.series import SurfaceSeries
from ringdic.charts.surface import reference_surface
from ringdic.charts.tracking import CameraMatches
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.results.series import StepCache
from ringdic.results.writer import write_steps
from ringdic.settings import Settings

_SIDE = 16  # points along an edge of a camera's part of the plate
_PITCH = 10  # distance of the points, mm on the plate and px in the images
_DISTANCE = 1000.0  # mm, from the cameras to the plate
_FOCAL = 1000.0  # px
_SIZE = (800, 800)
_STRETCH = 1.001


def run_small_plate() -> None:
    """Process a synthetic plate at the reference and slightly stretched, seen by three cameras in a row.

    The results are discarded; the compiled kernels remain.
    """
    cameras = [_camera(str(k), 80.0 * k - 80.0) for k in range(3)]
    settings = Settings()
    with TemporaryDirectory() as folder:
        cache = StepCache(Path(folder))
        charts = [_chart(cameras, k) for k in range(2)]
        surface = reference_surface(cameras, charts, _PITCH, 1.0)
        pairs = [("0", "1"), ("1", "2")]
        series = SurfaceSeries(
            "plate", cameras, pairs, ("0", "1"), ("0", "1"), surface, lambda k, _: _matches(cameras[k]), settings, cache
        )
        write_steps(Path(folder) / "results.h5", series.names, series.at, lambda _: None, {}, {})
        cache.close()


def _camera(name: str, x: float) -> Camera:
    """A camera at x mm that looks along z, perpendicular to the plate."""
    lens = Intrinsics(
        np.array([[_FOCAL, 0.0, 400.0], [0.0, _FOCAL, 400.0], [0.0, 0.0, 1.0]]),
        np.array([1e-3, 0.0, 0.0, 0.0, 0.0]),
        _SIZE,
    )
    P = lens.K_undistorted @ np.column_stack([np.eye(3), [-x, 0.0, _DISTANCE]])
    return Camera(name, P / P[2, 3], _SIZE, lens)


def _plate(camera: Camera, px: Points) -> Points:
    """Points (n, 3) mm of the plate, z = 0, that a camera shows at pixels (n, 2)."""
    ray = camera.ray(px)
    return np.asarray(camera.centre - camera.centre[2] / ray[:, 2:] * ray)


def _grid(first: int, side: int) -> Points:
    """Pixels (side², 2) of a square grid whose corner lies at (first, 320) px."""
    column, row = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    return np.column_stack([first + _PITCH * column, 320 + _PITCH * row]).astype(np.float64)


def _chart(cameras: list[Camera], k: int) -> Chart:
    """Exact matches of camera k's grid on its part of the plate in all cameras."""
    xy = _grid(320 + 40 * k, _SIDE)
    order = np.array([k, *(c for c in range(len(cameras)) if c != k)])
    px = np.stack([xy, *(cameras[c].project(_plate(cameras[k], xy)) for c in order[1:])])
    first = np.arange(_SIDE**2).reshape(_SIDE, _SIDE)[:-1, :-1].ravel()
    quad = np.stack([first, first + _SIDE, first + _SIDE + 1, first + 1], axis=1)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int32)
    count, n = px.shape[:2]
    sigma, texture = np.full((count, n, 2), 0.01, np.float32), np.ones((count, n, 5), np.float32)
    c_ls, status = np.full((count, n), 0.01, np.float32), np.zeros((count, n), np.int8)
    return Chart(order, xy, faces, px, sigma, sigma, sigma[..., 0], c_ls, status, texture, np.ones(count))


def _matches(camera: Camera) -> CameraMatches:
    """Exact matches of a camera's whole grid after the plate was stretched along x."""
    xy = _grid(0, _SIZE[0] // _PITCH)
    xyz = _plate(camera, xy)
    uv = camera.project(xyz * [_STRETCH, 1.0, 1.0]) - xy
    n = len(xy)
    gradient, curvature = np.zeros((n, 2, 2), np.float32), np.zeros((n, 2, 3), np.float32)
    sigma = np.full((n, 2), 0.01, np.float32)
    c_ls, status = np.full(n, 0.01, np.float32), np.zeros(n, np.int8)
    return CameraMatches(xy.astype(np.int32), _PITCH, uv, gradient, curvature, sigma, c_ls, status)
