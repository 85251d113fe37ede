"""Neighbours on a grid and among scattered points, and what they say about one another."""

import numpy as np
from ringdic.correlation.neighbours import inconsistent_points, local_affine_fit, point_neighbours
from scipy.spatial import cKDTree

STEP = 10.0


def holed_grid() -> np.ndarray:
    xy = STEP * np.stack(np.meshgrid(np.arange(30.0), np.arange(20.0)), -1).reshape(-1, 2) + (3.0, 7.0)
    return xy[np.random.default_rng(0).uniform(size=len(xy)) > 0.2]


def affine(xy: np.ndarray) -> np.ndarray:
    """Parameters (n, 12) of an affine field."""
    p = np.zeros((len(xy), 12))
    for at, (c, cx, cy) in ((0, (3.0, 0.02, -0.05)), (6, (-7.0, 0.04, 0.01))):
        p[:, at], p[:, at + 1], p[:, at + 2] = c + cx * xy[:, 0] + cy * xy[:, 1], cx, cy
    return p


def judged(xy: np.ndarray, p: np.ndarray, good: np.ndarray) -> np.ndarray:
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


def test_a_point_that_contradicts_its_neighbours_and_a_small_island_are_found():
    xy = holed_grid()
    p, good = affine(xy), np.ones(len(xy), bool)
    assert not judged(xy, p, good).any()
    p[250, 0] += 3.0
    np.testing.assert_array_equal(np.flatnonzero(judged(xy, p, good)), [250])
    alone = (xy[:, 0] > 280.0) & (xy[:, 1] < 20.0)
    around = (xy[:, 0] > 260.0) & (xy[:, 1] < 40.0) & ~alone
    assert 0 < alone.sum() < 4
    np.testing.assert_array_equal(judged(xy, affine(xy), ~around), alone)


def test_the_judgement_of_what_has_changed_is_that_of_everything():
    xy, random = holed_grid(), np.random.default_rng(2)
    near, p, good = point_neighbours(xy, STEP), affine(xy), np.ones(len(xy), bool)
    jump, stale = np.full(len(xy), np.nan), np.ones(len(xy), bool)
    for _ in range(10):
        some = random.integers(0, len(xy), 12)
        p[some, 0] += random.normal(0.0, 2.0, 12)
        good[some[:4]] = False
        stale[some] = True
        bad = inconsistent_points(xy, p, good, near, jump, stale)
        np.testing.assert_array_equal(bad, judged(xy, p, good))
        assert not stale.any()


def test_a_fit_continues_an_affine_field_and_a_row_of_points_along_itself():
    xy = holed_grid()
    p, near = affine(xy), point_neighbours(xy, STEP)
    good = np.abs(xy[:, 0] - 150.0) > 25.0
    wanted = np.flatnonzero(~good)
    p[wanted] = np.nan
    np.testing.assert_allclose(local_affine_fit(xy, p, good, near, wanted), affine(xy[wanted]), atol=1e-6)
    row = STEP * np.stack([np.arange(20.0), np.zeros(20)], 1)
    good = np.arange(20) != 7
    fit = local_affine_fit(row, affine(row), good, point_neighbours(row, STEP), np.array([7]))
    np.testing.assert_allclose(fit[0, [0, 1, 6, 7]], affine(row[7:8])[0, [0, 1, 6, 7]], atol=1e-6)
    np.testing.assert_allclose(fit[0, [2, 8]], 0.0, atol=1e-9)
    assert np.isnan(
        local_affine_fit(row[:6], affine(row[:6]), np.arange(6) > 0, point_neighbours(row[:6], STEP), np.array([0]))
    ).all()
