"""Neighbour search in cubes finds the same points as an exhaustive search."""

import numpy as np
import pytest
from ringdic.mesh.nearest import away_from_other_labels, cubes, near


@pytest.mark.parametrize("size", [0.02, 0.3, 5.0])
def test_what_is_near_is_found_whatever_the_size_of_the_cubes(size: float) -> None:
    random = np.random.default_rng(1)
    points = random.random((500, 3)) * [3, 1, 2]
    grid = cubes(points, size)
    np.testing.assert_array_equal(np.sort(grid.order), np.arange(500))
    np.testing.assert_array_equal(grid.at, points[grid.order])
    neighbours, distances = np.empty(500, np.int64), np.empty(500)
    for place in random.uniform(-1, 4, (50, 3)):
        for radius in (0.1, 0.8):
            count = near(grid, *place, radius, neighbours, distances)
            square = np.sum((points - place) ** 2, axis=1)
            assert set(grid.order[neighbours[:count]]) == set(np.flatnonzero(square <= radius**2))
            np.testing.assert_allclose(distances[:count], square[grid.order[neighbours[:count]]])


def test_points_among_their_like_have_no_others_near() -> None:
    """Two labels on either side of a plane: no point is wrongly said to be away from the other, and most are found."""
    points = np.random.default_rng(2).random((4000, 3)) * [10, 2, 2]
    label = (points[:, 0] > 5).astype(np.int64)
    apart = away_from_other_labels(cubes(points, 0.5), label, 0.9)
    assert (np.abs(points[apart, 0] - 5) > 0.9).all()
    assert apart.mean() > 0.6


def test_no_points_and_points_in_one_place_are_no_harder() -> None:
    neighbours, distances = np.empty(3, np.int64), np.empty(3)
    assert near(cubes(np.zeros((0, 3)), 1.0), 0.0, 0.0, 0.0, 1.0, neighbours, distances) == 0
    assert near(cubes(np.ones((3, 3)), 0.0), 1.0, 1.0, 1.0, 0.0, neighbours, distances) == 3
