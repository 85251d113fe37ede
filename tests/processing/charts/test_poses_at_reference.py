"""A shift of an image that the calibration's uncertainty explains is no motion of a camera; a larger one is."""

import numpy as np
import pytest
from ringdic.arrays import Pixels
from ringdic.calibration.moved_cameras import find_moved_cameras
from ringdic.calibration.parameters import LENS, CameraParameters
from ringdic.charts.chart import Chart
from ringdic.charts.poses import is_within_calibration, poses_of_charts
from ringdic.geometry.camera import Camera, Intrinsics

SIZE, FOCAL = (700, 900), 780.0
LENS_OF_ALL = Intrinsics(np.array([[FOCAL, 0, 350.0], [0, FOCAL, 450.0], [0, 0, 1]]), np.zeros(5), SIZE)
SIGMA = 0.01  # px, of the matches
MM_PER_PX = 330.0 / FOCAL
POSE_PX = 0.13  # px, by which the calibration's uncertainty moves an image in x and in y


def arc() -> list[Camera]:
    cameras = []
    for k in range(3):
        a = np.deg2rad(30.0 * (k - 1))
        centre = np.array([350 * np.cos(a), 350 * np.sin(a), 124.0])
        R = np.array([[-np.sin(a), np.cos(a), 0], [0, 0, -1], [-np.cos(a), -np.sin(a), 0]])
        P = LENS_OF_ALL.K_undistorted @ np.column_stack([R, -R @ centre])
        cameras.append(Camera(f"c{k}", P / P[2, 3], SIZE, LENS_OF_ALL))
    return cameras


def images_of_a_plate(shift_px: float) -> Pixels:
    """Pixels (3, 900, 2) of a plate across the middle camera's axis, in the last camera moved along its columns."""
    rng = np.random.default_rng(4)
    xyz = np.column_stack([np.full(900, 20.0), rng.uniform(-60, 60, 900), rng.uniform(40, 210, 900)])
    true = arc()
    motion = np.zeros(LENS + 6)
    motion[LENS + 4] = shift_px * MM_PER_PX
    true[2] = CameraParameters.of(true[2]).plus(motion).camera(true[2])
    return np.stack([camera.project(xyz) + rng.normal(0, SIGMA, (900, 2)) for camera in true])


def chart(px: Pixels) -> Chart:
    sigma = np.full(px.shape, SIGMA, np.float32)
    n, none = px.shape[1], np.zeros(px.shape[:2], np.float32)
    return Chart(
        np.arange(3), px[0], np.zeros((0, 3), np.int32), px, sigma, 0 * sigma, none, none, none.astype(np.int8),
        np.zeros((3, n, 5), np.float32), np.ones(3),
    )  # fmt: skip


@pytest.mark.parametrize(("shift", "moved"), [(0.25, False), (2.0, True)])
def test_a_motion_counts_beyond_what_the_calibration_leaves_open(shift: float, moved: bool) -> None:
    covariance = np.tile(np.diag([1e-12] * 3 + [(POSE_PX * MM_PER_PX) ** 2] * 2 + [1e-12]), (3, 1, 1))
    px = images_of_a_plate(shift)
    found = find_moved_cameras(arc(), px, SIGMA, covariance)
    assert found.moved[2]  # the matches show it either way
    assert is_within_calibration(found, px, covariance) != moved
    assert poses_of_charts(arc(), [chart(px)], [], covariance).moved.any() == moved
    assert poses_of_charts(arc(), [chart(px)], [], None).moved.any()
