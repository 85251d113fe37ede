"""How points scatter when their pixels do, against trials and against the triangulation's own derivatives."""

import numpy as np
from ringdic.geometry.camera import Camera
from ringdic.geometry.weighted_triangulation import triangulate_weighted
from ringdic.uncertainty.position import (
    along_surface,
    covariance,
    position_gain,
    reference_covariance,
    step_covariance,
)

SIZE = (2464, 3280)
RADIUS = 57.0


def ring(count: int) -> list[Camera]:
    K = np.array([[2611.7, 0.0, 1246.5], [0.0, 2615.4, 1627.7], [0.0, 0.0, 1.0]])
    cameras = []
    for i in range(count):
        a = np.deg2rad(30.0 * i - 15.0 * (count - 1))
        R = np.array([[-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, -1.0], [-np.cos(a), -np.sin(a), 0.0]])
        P = K @ np.column_stack([R, -R @ [350.0 * np.cos(a), 350.0 * np.sin(a), 0.0]])
        cameras.append(Camera(str(i), P / P[2, 3], SIZE))
    return cameras


def on_cylinder(theta: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    normals = np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], axis=-1)
    return RADIUS * normals + np.stack([0 * z, 0 * z, z], axis=-1), normals


def seen(cameras: list[Camera], xyz: np.ndarray) -> np.ndarray:
    return np.stack([camera.project(xyz) for camera in cameras])


def meets(camera: Camera, px: np.ndarray) -> np.ndarray:
    """Where lines of sight (n, 2) px meet the cylinder first. (n, 3)."""
    d = camera.ray(px)
    o = camera.centre
    a, b = (d[:, :2] ** 2).sum(axis=1), d[:, :2] @ o[:2]
    t = (-b - np.sqrt(b * b - a * (o[:2] @ o[:2] - RADIUS**2))) / a
    return o + t[:, None] * d


def scatter(xyz: np.ndarray) -> np.ndarray:
    return np.cov(xyz.T)


def test_the_gain_is_the_derivative_of_the_triangulation() -> None:
    cameras, h = ring(3), 1e-3
    xyz, _ = on_cylinder(np.linspace(-0.5, 0.5, 7), np.linspace(-60.0, 60.0, 7))
    px, sigma = seen(cameras, xyz), np.random.default_rng(0).uniform(0.01, 0.05, (3, 7, 2))
    sigma[2, 3] = np.nan
    gain = position_gain(cameras, xyz, sigma)
    assert (gain[2, 3] == 0.0).all()
    for c in range(3):
        for axis in range(2):
            d = np.zeros_like(px)
            d[c, :, axis] = h
            slope = triangulate_weighted(cameras, px + d, sigma).xyz - triangulate_weighted(cameras, px - d, sigma).xyz
            np.testing.assert_allclose(gain[c, :, :, axis], slope / (2 * h), atol=1e-6)


def test_with_the_weights_own_deviations_the_covariance_is_that_of_the_triangulation() -> None:
    cameras = ring(4)
    xyz, _ = on_cylinder(np.linspace(-0.5, 0.5, 7), np.linspace(-60.0, 60.0, 7))
    sigma = np.random.default_rng(0).uniform(0.01, 0.05, (4, 7, 2))
    sigma[1:, 0] = np.nan
    found = covariance(position_gain(cameras, xyz, sigma), sigma)
    of_triangulation = triangulate_weighted(cameras, seen(cameras, xyz), sigma).covariance
    # Gains and deviations have single precision, seven digits, and components may nearly cancel.
    np.testing.assert_allclose(found, of_triangulation, rtol=1e-6, atol=1e-6 * np.nanmax(of_triangulation))
    assert np.isnan(found[0]).all()


def test_a_pixel_moves_its_point_along_the_surface() -> None:
    cameras, h = ring(3), 0.01
    xyz, normals = on_cylinder(np.linspace(-0.4, 0.4, 5), np.linspace(-60.0, 60.0, 5))
    reference = np.array([0, 0, 1, 2, 2])
    B = along_surface(cameras, reference, xyz, normals)
    for n, k in enumerate(reference):
        px = cameras[k].project(xyz[n : n + 1])
        for axis, d in enumerate(np.eye(2) * h):
            moved = (meets(cameras[k], px + d) - meets(cameras[k], px - d))[0] / (2 * h)
            np.testing.assert_allclose(B[n, :, axis], moved, atol=1e-5)


def test_points_named_by_a_pixel_scatter_as_stated_at_the_reference_and_at_a_step() -> None:
    cameras, trials, rng = ring(3), 6000, np.random.default_rng(4)
    xyz, normals = on_cylinder(np.array([-0.1]), np.array([20.0]))
    motion = np.array([0.3, -0.2, 0.1])
    zero = np.array([1])
    p = cameras[1].project(xyz)
    # Errors of the subsets in time (whole) and between cameras (narrow: the whole one's and more), px.
    whole, narrow = np.array([0.010, 0.008, 0.012]), np.array([0.014, 0.008, 0.020])
    weights = np.broadcast_to(np.array([0.03, 0.01, 0.04])[:, None, None], (3, 1, 2))
    later_weights = np.broadcast_to(np.array([0.014, 0.012, 0.017])[:, None, None], (3, 1, 2))
    eps0 = rng.normal(size=(3, trials, 2)) * whole[:, None, None]
    eps1 = rng.normal(size=(3, trials, 2)) * whole[:, None, None]
    delta = eps0 + rng.normal(size=(3, trials, 2)) * np.sqrt(narrow**2 - whole**2)[:, None, None]
    # The pattern about p stands for the place of the surface that p less the error shows.
    named = meets(cameras[1], p - delta[1])
    px = seen(cameras, named) + delta
    assert np.ptp(px[1], axis=0).max() < 1e-9
    first = triangulate_weighted(cameras, px, np.repeat(weights, trials, axis=1)).xyz
    # A camera's displacement is measured at the projection of the point that was found.
    tracked = seen(cameras, first + motion) + eps1 - eps0
    later = triangulate_weighted(cameras, tracked, np.repeat(later_weights, trials, axis=1)).xyz

    gains = position_gain(cameras, xyz, weights), position_gain(cameras, xyz + motion, later_weights)
    B = along_surface(cameras, zero, xyz, normals)
    alone, in_time = (np.broadcast_to(each[:, None, None], (3, 1, 2)) for each in (narrow, whole))
    stated = {
        "reference": (first, reference_covariance(gains[0], alone, zero, B)),
        "step": (later, step_covariance(gains, alone, (in_time, in_time), zero, B)),
        "displacement": (later - first, covariance(gains[1], np.sqrt(2) * in_time)),
    }
    for name, (trial, expected) in stated.items():
        # Variances of 6000 trials are known to 1.8 %.
        size = np.sqrt(np.outer(*[np.diag(expected[0])] * 2))
        np.testing.assert_allclose(scatter(trial) / size, expected[0] / size, atol=0.08, err_msg=name)
