"""What points owe to uncertain cameras, against cameras that were moved."""

import numpy as np
import pytest
from ringdic.calibration.parameters import PER_CAMERA, CameraParameters
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.weighted_triangulation import triangulate_weighted
from ringdic.strain.deformation import deformation
from ringdic.uncertainty.calibration import (
    CameraCovariance,
    position_sensitivity,
    sensitivity_sigma,
    stretch_sigma_by_cameras,
)
from ringdic.uncertainty.position import position_gain

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
        CameraParameters.of(camera).plus(step[PER_CAMERA * k : PER_CAMERA * (k + 1)]).camera(camera)
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
    places = np.array(
        [triangulate_weighted(moved(cameras, root @ rng.normal(size=48)), px, sigma).xyz for _ in range(trials)]
    )
    share = position_sensitivity(cameras, xyz, position_gain(cameras, xyz, sigma), CameraCovariance(IDS, root @ root.T))
    for n in range(2):
        stated = share[n] @ share[n].T
        size = np.sqrt(np.outer(*[np.diag(stated)] * 2))
        # Variances of 1500 trials are known to 3.7 %.
        np.testing.assert_allclose(np.cov(places[:, n].T) / size, stated / size, atol=0.15)
        np.testing.assert_allclose(sensitivity_sigma(share[n]), np.sqrt(np.diag(stated)), rtol=1e-5)


@pytest.mark.parametrize("followed", [False, True])
def test_motions_and_stretches_scatter_as_cameras_of_that_covariance_measure_them(followed: bool) -> None:
    """A triangle moves by 8 mm and stretches; the cameras measure its pixels, or follow it from its projection."""
    cameras, rng, trials = ring(), np.random.default_rng(5), 600
    before = np.array([[55.0, 10.0, 30.0], [54.0, 13.0, 30.5], [54.8, 10.5, 34.0]])
    after = before @ np.diag([1.0, 1.05, 0.9]) + [1.0, 3.0, 7.0]
    seen = [np.stack([camera.project(xyz) for camera in cameras]) for xyz in (before, after)]
    sigma = [np.full((3, 3, 2), 0.01), np.full((3, 3, 2), 0.01)]
    sigma[1][2] = np.nan  # one camera lost it
    root = np.tile(STEPS, 3)[:, None] * (rng.normal(size=(48, 48)) + 2 * np.eye(48)) * 0.03
    faces = np.array([[0, 1, 2]])
    moves, stretches = [], []
    for _ in range(trials):
        believed = moved(cameras, root @ rng.normal(size=48))
        at_first = triangulate_weighted(believed, seen[0], sigma[0]).xyz
        start = np.stack([camera.project(at_first) for camera in believed]) if followed else seen[0]
        now = triangulate_weighted(believed, start + (seen[1] - seen[0]), sigma[1]).xyz
        moves.append(now - at_first)
        found = deformation(at_first, now, faces)
        stretches.append([found.lambda1[0], found.lambda2[0]])
    known = CameraCovariance(IDS, root @ root.T)
    share = position_sensitivity(cameras, before, position_gain(cameras, before, sigma[0]), known)
    gain = position_gain(cameras, after, sigma[1])
    then = position_sensitivity(cameras, after, gain, known, (before, share) if followed else None)
    # Deviations of 600 trials are known to 2.9 %.
    np.testing.assert_allclose(np.std(moves, axis=0), sensitivity_sigma(then - share), rtol=0.15)
    stated = stretch_sigma_by_cameras(deformation(before, after, faces), before, faces, share, then)
    np.testing.assert_allclose(np.std(stretches, axis=0), stated[0], rtol=0.15)


def test_cameras_in_another_order_and_points_without_views() -> None:
    cameras = ring()
    xyz = np.array([[55.0, 10.0, 30.0], [np.nan, 0.0, 0.0]])
    gain = position_gain(cameras, xyz, np.full((3, 2, 2), 0.01))
    covariance = np.diag(np.tile(STEPS**2, 3) * np.repeat([1.0, 4.0, 9.0], 16))
    turned = np.diag(np.tile(STEPS**2, 3) * np.repeat([9.0, 4.0, 1.0], 16))
    found = sensitivity_sigma(position_sensitivity(cameras, xyz, gain, CameraCovariance(IDS, covariance)))
    again = sensitivity_sigma(position_sensitivity(cameras, xyz, gain, CameraCovariance(IDS[::-1], turned)))
    np.testing.assert_allclose(found, again, rtol=1e-4)
    assert np.isnan(found[1]).all()
    two = CameraCovariance(IDS[:2], covariance[:32, :32])
    with pytest.raises(ValueError, match="camera c"):
        position_sensitivity(cameras, xyz, gain, two)
    with pytest.raises(ValueError, match="sixteen parameters a camera"):
        CameraCovariance(IDS, covariance[:32, :32])
