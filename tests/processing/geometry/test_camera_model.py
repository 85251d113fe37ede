"""The lens and the projection: inverse functions of one another, derivatives, lines of sight."""

import numpy as np
import pytest
from ringdic.geometry.camera import Camera, Intrinsics

LENS = Intrinsics(
    np.array([[2611.7, -1.37, 1246.5], [0, 2615.4, 1627.7], [0, 0, 1]]),
    np.array([0.179, -0.295, 1.5e-4, 6.8e-4, -0.19]),
    (2464, 3280),
)


def camera(azimuth: float = 0.3, lens: Intrinsics | None = LENS) -> Camera:
    centre = np.array([350 * np.cos(azimuth), 350 * np.sin(azimuth), 110.0])
    z = -np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    y = np.array([0.0, 0.0, -1.0])
    R = np.stack([np.cross(y, z), y, z])
    P = LENS.K_undistorted @ np.column_stack([R, -R @ centre])
    return Camera("c", P / P[2, 3], LENS.size, lens)


def pixels() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 2463, 13), np.linspace(0, 3279, 17))
    return np.stack([x, y], axis=-1)


def test_undistortion_is_the_inverse_of_distortion() -> None:
    px = pixels()[1:-1, 1:-1]
    K = LENS.K
    ideal = (LENS.to_undistorted(px) - K[:2, 2]) / np.diag(K)[:2]
    np.testing.assert_allclose(LENS.distort_normalised(ideal) @ K[:2, :2].T + K[:2, 2], px, atol=1e-9)


def test_a_pixel_that_the_lens_cannot_show_is_lost_and_not_invented() -> None:
    # With k3 < 0 the distorted radius has a maximum; far outside there is nothing to find.
    assert np.isnan(LENS.to_undistorted(np.array([-3000.0, -3000.0]))).all()


def test_the_principal_point_stays_where_it_is() -> None:
    np.testing.assert_allclose(LENS.to_undistorted(LENS.K[:2, 2]), LENS.K[:2, 2], atol=1e-12)


def test_the_lens_derivative_is_that_of_its_formula() -> None:
    xy = (pixels() - LENS.K[:2, 2]) / 2613.0
    h = 1e-6
    for axis in range(2):
        step = np.eye(2)[axis] * h
        difference = (LENS.distort_normalised(xy + step) - LENS.distort_normalised(xy - step)) / (2 * h)
        np.testing.assert_allclose(LENS.jacobian_normalised(xy)[..., axis], difference, atol=1e-8)


@pytest.mark.parametrize("lens", [LENS, None])
def test_the_slope_of_the_projection_is_that_of_the_projection(lens: Intrinsics | None) -> None:
    c, h = camera(lens=lens), 1e-3
    xyz = np.array([[50.0, 10, 20], [40, 30, 200], [55, 5, 120]])
    px, slope = c.project_with_jacobian(xyz)
    np.testing.assert_array_equal(px, c.project(xyz))
    difference = np.stack([(c.project(xyz + d) - c.project(xyz - d)) / (2 * h) for d in np.eye(3) * h], axis=-1)
    np.testing.assert_allclose(slope, difference, atol=1e-7)


def test_a_line_of_sight_meets_the_point_that_was_projected() -> None:
    c = camera()
    xyz = np.array([[50.0, 10, 20], [40, 30, 200], [55, 5, 120]])
    towards = xyz - c.centre
    np.testing.assert_allclose(
        c.ray(c.project(xyz)), towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-12
    )


def test_the_centre_is_recovered_from_the_projection_matrix() -> None:
    np.testing.assert_allclose(camera(0.7).centre, [350 * np.cos(0.7), 350 * np.sin(0.7), 110.0], atol=1e-8)


def test_incidence_is_zero_along_the_normal() -> None:
    c = camera(0.3)
    normal = np.array([np.cos(0.3), np.sin(0.3), 0.0])
    xyz = 57 * normal + np.array([0, 0, 110.0])
    assert c.incidence_cosine(xyz[None], normal[None])[0] == pytest.approx(1.0)
