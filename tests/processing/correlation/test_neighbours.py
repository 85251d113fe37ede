"""Neighbours on a grid and among scattered points, and the outliers and extrapolations found from them."""

import numpy as np
from ringdic.correlation.neighbours import inconsistent_points, local_affine_fit, point_neighbours
from scipy.spatial import cKDTree

STEP = 10.0


def holed_grid() -> np.ndarray:
    """Points (n, 2) of a grid of which a fifth is missing."""
    xy = STEP * np.stack(np.meshgrid(np.arange(30.0), np.arange(20.0)), -1).reshape(-1, 2) + (3.0, 7.0)
    return xy[np.random.default_rng(0).uniform(size=len(xy)) > 0.2]


def affine_parameters(xy: np.ndarray) -> np.ndarray:
    """Parameters (n, 12) of an affine field."""
    p = np.zeros((len(xy), 12))
    for at, (c, cx, cy) in ((0, (3.0, 0.02, -0.05)), (6, (-7.0, 0.04, 0.01))):
        p[:, at], p[:, at + 1], p[:, at + 2] = c + cx * xy[:, 0] + cy * xy[:, 1], cx, cy
    return p


def outliers(xy: np.ndarray, p: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Inconsistent points (n,) of parameters p (n, 12), without an earlier result."""
    return inconsistent_points(
        xy, p, good, point_neighbours(xy, STEP), np.full(len(xy), np.nan), np.ones(len(xy), bool)
    )


def test_neighbours_are_all_points_within_reach_on_a_grid_and_off_it():
    grid = holed_grid()
    for xy in (grid, grid + np.random.default_rng(1).uniform(-1.0, 1.0, grid.shape), grid[::40]):
        expected = cKDTree(xy).query_ball_point(xy, 1.6 * STEP)
        for k, row in enumerate(point_neighbours(xy, STEP)):
            assert set(row[row >= 0]) == set(expected[k]) - {k}
            assert (row >= 0).sum() == len(expected[k]) - 1


def test_an_outlier_and_a_small_island_are_inconsistent():
    xy = holed_grid()
    p, good = affine_parameters(xy), np.ones(len(xy), bool)
    assert not outliers(xy, p, good).any()
    p[250, 0] += 3.0
    np.testing.assert_array_equal(np.flatnonzero(outliers(xy, p, good)), [250])
    alone = (xy[:, 0] > 280.0) & (xy[:, 1] < 20.0)
    around = (xy[:, 0] > 260.0) & (xy[:, 1] < 40.0) & ~alone
    assert 0 < alone.sum() < 4
    np.testing.assert_array_equal(outliers(xy, affine_parameters(xy), ~around), alone)


def test_updating_stale_points_alone_gives_the_result_of_all_points():
    xy, random = holed_grid(), np.random.default_rng(2)
    near, p, good = point_neighbours(xy, STEP), affine_parameters(xy), np.ones(len(xy), bool)
    deviation, stale = np.full(len(xy), np.nan), np.ones(len(xy), bool)
    for _ in range(10):
        some = random.integers(0, len(xy), 12)
        p[some, 0] += random.normal(0.0, 2.0, 12)
        good[some[:4]] = False
        stale[some] = True
        bad = inconsistent_points(xy, p, good, near, deviation, stale)
        np.testing.assert_array_equal(bad, outliers(xy, p, good))
        assert not stale.any()


def test_an_affine_field_is_extrapolated_exactly_and_a_line_of_points_along_itself():
    xy = holed_grid()
    p, near = affine_parameters(xy), point_neighbours(xy, STEP)
    good = np.abs(xy[:, 0] - 150.0) > 25.0
    wanted = np.flatnonzero(~good)
    p[wanted] = np.nan
    np.testing.assert_allclose(local_affine_fit(xy, p, good, near, wanted), affine_parameters(xy[wanted]), atol=1e-6)
    row = STEP * np.stack([np.arange(20.0), np.zeros(20)], 1)
    good = np.arange(20) != 7
    fit = local_affine_fit(row, affine_parameters(row), good, point_neighbours(row, STEP), np.array([7]))
    np.testing.assert_allclose(fit[0, [0, 1, 6, 7]], affine_parameters(row[7:8])[0, [0, 1, 6, 7]], atol=1e-6)
    np.testing.assert_allclose(fit[0, [2, 8]], 0.0, atol=1e-9)
    assert np.isnan(
        local_affine_fit(
            row[:6], affine_parameters(row[:6]), np.arange(6) > 0, point_neighbours(row[:6], STEP), np.array([0])
        )
    ).all()
