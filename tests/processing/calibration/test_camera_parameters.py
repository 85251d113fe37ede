"""A camera by its sixteen parameters: conversion to and fro, and derivatives of the projection."""

import cv2
import numpy as np
import pytest
from ringdic.calibration.parameters import PER_CAMERA, CameraParameters, projection_jacobians
from ringdic.geometry.camera import Camera, Intrinsics

K = np.array([[2611.7, -1.37, 1246.5], [0, 2615.4, 1627.7], [0, 0, 1]])
LENS = Intrinsics(K, np.array([0.179, -0.295, 1.5e-4, 6.8e-4, -0.05]), (2464, 3280))
R = cv2.Rodrigues(np.array([1.5, 0.2, -0.1]))[0]
T = np.array([4.0, 110.0, 350.0])


def camera(lens: Intrinsics | None) -> Camera:
    P = (K if lens is None else lens.K_undistorted) @ np.column_stack([R, T])
    return Camera("c", P / P[2, 3], (2464, 3280), lens)


@pytest.fixture
def points() -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.uniform([-50, -50, 10], [50, 50, 230], (40, 3))


@pytest.mark.parametrize("lens", [LENS, None], ids=["with a lens", "by projection alone"])
def test_parameters_make_the_camera_they_were_taken_from(lens, points):
    parameters = CameraParameters.of(camera(lens))
    assert np.allclose(parameters.rotation, R, atol=1e-12)
    assert np.allclose(parameters.translation, T, atol=1e-9)
    again = parameters.camera(camera(lens))
    assert np.allclose(again.project(points), camera(lens).project(points), atol=1e-8)


@pytest.mark.parametrize("lens", [LENS, None], ids=["with a lens", "by projection alone"])
def test_derivatives_are_those_of_the_projection(lens, points):
    start = CameraParameters.of(camera(lens))
    px, by_parameters, by_point = projection_jacobians(start, points)
    assert np.allclose(px, camera(lens).project(points), atol=1e-8)
    sizes = np.array([1, 1, 1, 1, 1, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, *[1e-5] * 3, *[1e-2] * 3])
    free = range(PER_CAMERA) if lens is not None else [0, 1, 2, 3, 4, *range(10, 16)]
    for k in free:
        step = np.zeros(PER_CAMERA)
        step[k] = sizes[k]
        both = [start.plus(sign * step).camera(camera(lens)).project(points) for sign in (1, -1)]
        numeric = (both[0] - both[1]) / (2 * sizes[k])
        assert np.allclose(by_parameters[..., k], numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max() + 1e-7)
    for k in range(3):
        shift = 1e-3 * np.eye(3)[k]
        numeric = (camera(lens).project(points + shift) - camera(lens).project(points - shift)) / 2e-3
        assert np.allclose(by_point[..., k], numeric, rtol=1e-5, atol=1e-6)
