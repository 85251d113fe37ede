"""Points in cubes give what looking at every point gives."""

import numpy as np
import pytest
from ringdic.mesh.nearest import away_from_other_labels, cubes, near


@pytest.mark.parametrize("size", [0.02, 0.3, 5.0])
def test_what_is_near_is_found_whatever_the_size_of_the_cubes(size: float) -> None:
    random = np.random.default_rng(1)
    points = random.random((500, 3)) * [3, 1, 2]
    held = cubes(points, size)
    np.testing.assert_array_equal(np.sort(held.order), np.arange(500))
    np.testing.assert_array_equal(held.at, points[held.order])
    found, apart = np.empty(500, np.int64), np.empty(500)
    for place in random.uniform(-1, 4, (50, 3)):
        for radius in (0.1, 0.8):
            count = near(held, *place, radius, found, apart)
            square = np.sum((points - place) ** 2, axis=1)
            assert set(held.order[found[:count]]) == set(np.flatnonzero(square <= radius**2))
            np.testing.assert_allclose(apart[:count], square[held.order[found[:count]]])


def test_points_among_their_like_have_no_others_near() -> None:
    """Two labels on either side of a plane: whoever is said to be among its like is, and most are told so."""
    points = np.random.default_rng(2).random((4000, 3)) * [10, 2, 2]
    label = (points[:, 0] > 5).astype(np.int64)
    alike = away_from_other_labels(cubes(points, 0.5), label, 0.9)
    assert (np.abs(points[alike, 0] - 5) > 0.9).all()
    assert alike.mean() > 0.6


def test_no_points_and_points_in_one_place_are_no_harder() -> None:
    found, apart = np.empty(3, np.int64), np.empty(3)
    assert near(cubes(np.zeros((0, 3)), 1.0), 0.0, 0.0, 0.0, 1.0, found, apart) == 0
    assert near(cubes(np.ones((3, 3)), 0.0), 1.0, 1.0, 1.0, 0.0, found, apart) == 3
