"""What points owe to uncertain cameras, against cameras that were moved."""

import numpy as np
import pytest

from processing.calibration.parameters import PER_CAMERA, Parameters
from processing.camera import Camera, Intrinsics
from processing.uncertainty.calibration import calibration_covariance
from processing.uncertainty.position import position_gain
from processing.weighted_triangulation import triangulate_weighted

STEPS = np.array([1.0, 1.0, 0.5, 1.0, 1.0, 1e-3, 1e-2, 1e-4, 1e-4, 1e-2, 1e-4, 1e-4, 1e-4, 0.05, 0.05, 0.05])
IDS = ("a", "b", "c")


def ring() -> list[Camera]:
    cameras = []
    for i, id_ in enumerate(IDS):
        K = np.array([[2611.7, -1.4, 1246.5], [0.0, 2615.4, 1627.7], [0.0, 0.0, 1.0]])
        lens = Intrinsics(K, np.array([0.18, -0.3, 2e-4, 7e-4, -0.1]), (2464, 3280))
        a = np.deg2rad(30.0 * (i - 1))
        R = np.array([[-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, -1.0], [-np.cos(a), -np.sin(a), 0.0]])
        P = lens.K_undistorted @ np.column_stack([R, -R @ [350.0 * np.cos(a), 350.0 * np.sin(a), 0.0]])
        cameras.append(Camera(id_, P / P[2, 3], lens.size, lens))
    return cameras


def moved(cameras: list[Camera], step: np.ndarray) -> list[Camera]:
    return [
        Parameters.of(camera).moved(step[PER_CAMERA * k : PER_CAMERA * (k + 1)]).camera(camera)
        for k, camera in enumerate(cameras)
    ]


def test_points_scatter_as_cameras_of_that_covariance_place_them() -> None:
    cameras, rng, trials = ring(), np.random.default_rng(0), 1500
    xyz = np.array([[55.0, 10.0, 30.0], [50.0, -25.0, -60.0]])
    px = np.stack([camera.project(xyz) for camera in cameras])
    sigma = np.full((3, 2, 2), 0.01)
    sigma[2, 1] = np.nan
    mixed = rng.normal(size=(48, 48)) + 2 * np.eye(48)
    root = np.tile(STEPS, 3)[:, None] * mixed * 0.05  # correlated parameters
    root[5] = 0.0  # one that is held
    covariance = np.zeros((51, 51))
    covariance[:48, :48] = root @ root.T
    places = np.array(
        [triangulate_weighted(moved(cameras, root @ rng.normal(size=48)), px, sigma).xyz for _ in range(trials)]
    )
    gain = position_gain(cameras, xyz, sigma)
    stated = calibration_covariance(cameras, xyz, gain, IDS, covariance)
    for n in range(2):
        size = np.sqrt(np.outer(*[np.diag(stated[n])] * 2))
        # Variances of 1500 trials are known to 3.7 %.
        np.testing.assert_allclose(np.cov(places[:, n].T) / size, stated[n] / size, atol=0.15)


def test_cameras_in_another_order_and_points_without_views() -> None:
    cameras = ring()
    xyz = np.array([[55.0, 10.0, 30.0], [np.nan, 0.0, 0.0]])
    gain = position_gain(cameras, xyz, np.full((3, 2, 2), 0.01))
    covariance = np.diag(np.tile(STEPS**2, 3) * np.repeat([1.0, 4.0, 9.0], 16))
    turned = np.diag(np.tile(STEPS**2, 3) * np.repeat([9.0, 4.0, 1.0], 16))
    found = calibration_covariance(cameras, xyz, gain, IDS, covariance)
    np.testing.assert_allclose(found, calibration_covariance(cameras, xyz, gain, IDS[::-1], turned), rtol=1e-9)
    assert np.isnan(found[1]).all()
    with pytest.raises(ValueError, match="camera c"):
        calibration_covariance(cameras, xyz, gain, IDS[:2], covariance)
