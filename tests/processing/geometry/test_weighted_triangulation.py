"""Weighted triangulation of points with known positions: exact, of least χ², with errors of the stated size."""

import numpy as np
import pytest
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.triangulation import triangulate
from ringdic.geometry.weighted_triangulation import WeightedPoints, triangulate_weighted

SIZE = (1640, 1232)


def ring(count: int, lens: bool = True) -> list[Camera]:
    """Cameras on a ring of 700 mm, 30° apart, looking at the axis, each with its own lens."""
    cameras = []
    for i in range(count):
        K = np.array([[2611.7 + 9 * i, -1.4, 820.0], [0.0, 2615.4 - 5 * i, 610.0], [0.0, 0.0, 1.0]])
        intrinsics = Intrinsics(K, np.array([0.18, -0.3 + 0.02 * i, 2e-4, 7e-4, -0.2]), SIZE)
        a = np.deg2rad(30.0 * i)
        R = np.array([[-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, -1.0], [-np.cos(a), -np.sin(a), 0.0]])
        P = intrinsics.K_undistorted @ np.column_stack([R, -R @ [350.0 * np.cos(a), 350.0 * np.sin(a), 0.0]])
        cameras.append(Camera(str(i), P / P[2, 3], SIZE, intrinsics if lens else None))
    return cameras


def cloud(n: int = 40) -> np.ndarray:
    return np.random.default_rng(3).uniform(-45.0, 45.0, (n, 3))


def seen(cameras: list[Camera], xyz: np.ndarray) -> np.ndarray:
    return np.stack([camera.project(xyz) for camera in cameras])


@pytest.mark.parametrize("lens", [True, False])
@pytest.mark.parametrize("count", [2, 3, 5])
def test_exact_pixels_give_the_exact_points_whatever_their_weights(count: int, lens: bool) -> None:
    cameras, xyz = ring(count, lens), cloud()
    px = seen(cameras, xyz)
    result = triangulate_weighted(cameras, px, np.random.default_rng(0).uniform(0.005, 0.5, px.shape))
    np.testing.assert_allclose(result.xyz, xyz, rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.chi2, 0.0, atol=1e-12)
    np.testing.assert_array_equal(result.degrees, 2 * count - 3)


def test_equal_weights_and_small_noise_agree_with_the_minimum_of_the_squares() -> None:
    cameras, xyz, h = ring(4), cloud(), 1e-4
    px = seen(cameras, xyz) + np.random.default_rng(1).normal(0.0, 0.5, (4, len(xyz), 2))
    sigma = np.random.default_rng(2).uniform(0.1, 1.0, px.shape)
    result = triangulate_weighted(cameras, px, sigma)

    def chi2(points: np.ndarray) -> np.ndarray:
        return np.sum(((px - seen(cameras, points)) / sigma) ** 2, axis=(0, 2))

    np.testing.assert_allclose(result.chi2, chi2(result.xyz), rtol=1e-6)
    for d in np.eye(3) * h:  # the slope of a parabola of curvature 2 / σ² is zero at its minimum
        slope = (chi2(result.xyz + d) - chi2(result.xyz - d)) / (2 * h)
        assert np.abs(slope).max() < 1e-3 * (2 * h / np.einsum("nii->ni", result.covariance)).max()


def test_scatter_covariance_and_chi_square_are_those_of_the_noise_that_was_put_in() -> None:
    cameras, rng, trials = ring(4), np.random.default_rng(5), 4000
    xyz = np.array([[30.0, 20.0, 10.0]])
    exact = np.repeat(seen(cameras, xyz), trials, axis=1)
    sigma = np.broadcast_to(np.array([0.01, 0.02, 0.05, 0.1])[:, None, None], exact.shape)
    result = triangulate_weighted(cameras, exact + rng.normal(size=exact.shape) * sigma, sigma)
    whitened = np.linalg.solve(np.linalg.cholesky(result.covariance), (result.xyz - xyz)[..., None])[..., 0]
    # A variance of 4000 trials is known to √(2/4000) = 2.2 %, a correlation to 1.6 %.
    np.testing.assert_allclose(whitened.T @ whitened / trials, np.eye(3), atol=0.09)
    assert result.chi2.mean() == pytest.approx(5.0, abs=4 * np.sqrt(10.0 / trials))
    assert result.chi2.var() == pytest.approx(10.0, rel=0.2)
    np.testing.assert_allclose(result.sigma, np.sqrt(np.einsum("nii->ni", result.covariance)))


def test_weights_bring_points_nearer_than_the_unweighted_solution() -> None:
    cameras, rng = ring(3), np.random.default_rng(6)
    xyz = np.repeat(cloud(1), 2000, axis=0)
    sigma = np.broadcast_to(np.array([0.01, 0.01, 0.2])[:, None, None], (3, 2000, 2))
    px = seen(cameras, xyz) + rng.normal(size=sigma.shape) * sigma
    weighted = np.linalg.norm(triangulate_weighted(cameras, px, sigma).xyz - xyz, axis=1)
    plain = np.linalg.norm(triangulate(cameras, px) - xyz, axis=1)
    assert np.sqrt(np.mean(weighted**2)) < 0.3 * np.sqrt(np.mean(plain**2))


def test_a_camera_that_did_not_match_takes_no_part_and_one_alone_is_not_enough() -> None:
    cameras, xyz = ring(3), cloud()
    px, sigma = seen(cameras, xyz), np.full((3, len(xyz), 2), 0.01)
    px[2, :20] = np.nan  # two cameras are left
    sigma[1, :10, 0] = np.inf  # one camera is left
    result = triangulate_weighted(cameras, px, sigma)
    assert np.isnan(result.xyz[:10]).all()
    assert np.isnan(result.covariance[:10]).all()
    assert np.isnan(result.chi2[:10]).all()
    np.testing.assert_array_equal(result.degrees, [0] * 10 + [1] * 10 + [3] * 20)
    np.testing.assert_allclose(result.xyz[10:], xyz[10:], rtol=0, atol=1e-9)


def test_parallel_lines_of_sight_are_lost_points() -> None:
    camera = ring(1)[0]
    px = np.stack([camera.project(cloud())] * 2)
    result = triangulate_weighted([camera, camera], px, np.full_like(px, 0.01))
    assert np.isnan(result.xyz).all()
    assert (result.degrees == 0).all()


def test_a_wrong_match_is_told_by_chi_square_and_does_not_disturb_its_neighbours() -> None:
    cameras, xyz = ring(3), cloud()
    px, sigma = seen(cameras, xyz), np.full((3, len(xyz), 2), 0.01)
    px[1, 7] += 5.0
    result = triangulate_weighted(cameras, px, sigma)
    assert result.chi2[7] > 1e4
    others = np.arange(len(xyz)) != 7
    np.testing.assert_allclose(result.xyz[others], xyz[others], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("px", "sigma"),
    [((2, 5, 2), (2, 5, 2)), ((3, 5, 2), (3, 5)), ((3, 5, 3), (3, 5, 3))],
)
def test_arrays_that_do_not_belong_together_are_refused(px: tuple[int, ...], sigma: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="do not go with"):
        triangulate_weighted(ring(3), np.zeros(px), np.ones(sigma))


def test_a_standard_deviation_of_zero_is_refused() -> None:
    cameras = ring(2)
    px = seen(cameras, cloud())
    with pytest.raises(ValueError, match="no weight"):
        triangulate_weighted(cameras, px, np.zeros_like(px))


def test_points_that_do_not_match_their_covariance_are_refused() -> None:
    with pytest.raises(ValueError, match="a covariance"):
        WeightedPoints(np.zeros((2, 3)), np.zeros((3, 3, 3)), np.zeros(2), np.zeros(2, dtype=np.int64))
