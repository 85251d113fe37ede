"""Compilation or loading of the kernels used after the matching, by processing a small synthetic plate once.

Triangulation, merging, deformation, uncertainty and the writing of results run on the exact matches of the plate, so
the first step of a session need not wait for their compilation.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ringdic.arrays import Points
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.pairs.matching import StepMatches
from ringdic.pairs.reconstruction import pair_shape
from ringdic.pairs.surfaces import PairSurface, pairs_surface, reconstruct_pair
from ringdic.results.series import StepCache
from ringdic.results.uncertainty import StepUncertainty
from ringdic.results.writer import write_series
from ringdic.settings import Settings

_SIDE = 16  # points along an edge of a pair's part of the plate
_PITCH = 10.0  # distance of the points, mm on the plate and px in the images
_DISTANCE = 1000.0  # mm, from the cameras to the plate
_FOCAL = 1000.0  # px
_SIZE = (800, 800)
_STEPS = 2


def run_small_plate() -> None:
    """Process a synthetic plate at the reference and slightly stretched, seen by two overlapping pairs of cameras.

    The three cameras stand in a row. The results are discarded; the compiled kernels remain.
    """
    cameras = [_camera(str(k), x) for k, x in enumerate((-80.0, 0.0, 80.0))]
    settings = Settings()
    with TemporaryDirectory() as folder:
        cache = StepCache(Path(folder))
        pairs = [_pair_surface((cameras[k], cameras[k + 1]), 80.0 * k - 120.0, cache) for k in range(2)]
        series, _ = pairs_surface("plate", cameras, pairs, [str(k) for k in range(_STEPS)], settings)
        StepUncertainty(series.reference, None, series.noise).complete(series.at(1), 1)
        write_series(Path(folder) / "results.h5", series, lambda _: None, {}, {})
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


def _pair_surface(cameras: tuple[Camera, Camera], left: float, cache: StepCache) -> PairSurface:
    """The surface that a pair measures of its part of the plate, which begins at x = ``left`` mm."""
    column, row = (axis.ravel() for axis in np.meshgrid(np.arange(_SIDE), np.arange(_SIDE), indexing="ij"))
    places = np.column_stack([left + _PITCH * column, _PITCH * row - 80.0, np.zeros(len(row))])
    first = np.flatnonzero((column < _SIDE - 1) & (row < _SIDE - 1))
    quad = np.stack([first, first + _SIDE, first + _SIDE + 1, first + 1], axis=1)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int32)
    steps = [_matches(cameras, places * [1.0 + 1e-3 * k, 1.0, 1.0]) for k in range(_STEPS)]
    grid = _PITCH * np.column_stack([column, row]).astype(np.float64)
    shape = pair_shape(cameras, grid, faces, steps[0], int(_PITCH), 1.0)
    return reconstruct_pair(shape, steps.__getitem__, _STEPS, cache)


def _matches(cameras: tuple[Camera, Camera], xyz: Points) -> StepMatches:
    """The exact matches of points xyz : (n, 3) mm in the images of both cameras."""
    n = len(xyz)
    px = np.stack([camera.project(xyz) for camera in cameras])
    return StepMatches(px, np.full((2, n, 2), 0.01, np.float32), np.full(n, 0.01, np.float32), np.zeros(n, np.int8))
