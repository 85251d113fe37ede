"""Linear triangulation of points with known positions."""

import numpy as np
import pytest
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.triangulation import reprojection_residuals, triangulate

SIZE = (1640, 1232)


def ring(count: int, lens: bool = True) -> list[Camera]:
    """Cameras on a ring of 700 mm, 30° apart, looking at the axis."""
    K = np.array([[2611.7, -1.4, 820.0], [0.0, 2615.4, 610.0], [0.0, 0.0, 1.0]])
    intrinsics = Intrinsics(K, np.array([0.18, -0.3, 2e-4, 7e-4, -0.2]), SIZE)
    cameras = []
    for i in range(count):
        a = np.deg2rad(30.0 * i)
        R_cw = np.array([[-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, -1.0], [-np.cos(a), -np.sin(a), 0.0]])
        t = -R_cw @ np.array([350.0 * np.cos(a), 350.0 * np.sin(a), 0.0])
        P = intrinsics.K_undistorted @ np.hstack([R_cw, t[:, None]])
        cameras.append(Camera(str(i), P / P[2, 3], SIZE, intrinsics if lens else None))
    return cameras


def cloud(n: int = 40) -> np.ndarray:
    return np.random.default_rng(3).uniform(-45.0, 45.0, (n, 3))


@pytest.mark.parametrize("count", [2, 3, 4])
def test_exact_pixels_give_the_exact_points(count: int) -> None:
    cameras, xyz = ring(count), cloud()
    px = np.stack([camera.project(xyz) for camera in cameras])
    np.testing.assert_allclose(triangulate(cameras, px), xyz, rtol=0, atol=1e-8)
    np.testing.assert_allclose(reprojection_residuals(cameras, xyz, px), 0.0, atol=1e-9)


def test_a_camera_that_did_not_match_takes_no_part_and_one_alone_is_not_enough() -> None:
    cameras, xyz = ring(3), cloud()
    px = np.stack([camera.project(xyz) for camera in cameras])
    px[2, :20] = np.nan  # two cameras are left
    px[1, :10, 0] = np.nan  # one camera is left
    result = triangulate(cameras, px)
    assert np.isnan(result[:10]).all()
    np.testing.assert_allclose(result[10:], xyz[10:], rtol=0, atol=1e-8)


def test_parallel_lines_of_sight_are_lost_points() -> None:
    camera = ring(1)[0]
    px = np.stack([camera.project(cloud())] * 2)
    assert np.isnan(triangulate([camera, camera], px)).all()
