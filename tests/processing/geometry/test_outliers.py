"""Outlier tests find planted wrong points among noisy good ones, and no others."""

import numpy as np
from ringdic.geometry.outliers import grid_neighbours, surface_outliers

STEP = 10


def cylinder_grid() -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(100, 500, STEP), np.arange(100, 800, STEP), indexing="ij")
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    theta = (xy[:, 0] - 300) / 570
    return xy, np.stack([57 * np.cos(theta), 57 * np.sin(theta), xy[:, 1] / 10], axis=1)


def test_a_bent_plane_has_no_outlier_but_at_its_fold() -> None:
    xy, _ = cylinder_grid()
    values = xy @ np.array([[0.1, 0.2, -0.3], [0.02, 0.5, 1.0]]) + 7
    assert not surface_outliers(grid_neighbours(xy, STEP), values, floor=1e-9).any(), "a linear field"
    values[:, 2] += 0.5 * np.abs(xy[:, 0] - 300.0)
    found = surface_outliers(grid_neighbours(xy, STEP), values, floor=1e-9)
    np.testing.assert_array_equal(np.unique(xy[found, 0]), [300.0])


def test_planted_outliers_are_found_and_no_good_point_is_lost() -> None:
    rng = np.random.default_rng(3)
    xy, xyz = cylinder_grid()
    xyz += rng.normal(0, 0.005, xyz.shape)
    apart = np.flatnonzero((xy % (4 * STEP) == 20).all(axis=1))
    planted = rng.choice(apart, 20, replace=False)
    xyz[planted] += rng.choice([-1.0, 1.0], (20, 3)) * rng.uniform(0.5, 2.0, (20, 3))
    outliers = np.flatnonzero(surface_outliers(grid_neighbours(xy, STEP), xyz))
    np.testing.assert_array_equal(outliers, np.sort(planted))


def test_lost_points_are_no_outliers() -> None:
    xy, xyz = cylinder_grid()
    xyz[50] = np.nan
    assert not surface_outliers(grid_neighbours(xy, STEP), xyz)[50]
