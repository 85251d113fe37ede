"""The neighbours of one point in a Delaunay triangulation, found without the triangulation."""

import numpy as np
import pytest
from ringdic.merging.stars import delaunay_ring
from scipy.spatial import Delaunay


def inverted(points: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return points / np.sum(points**2, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(20))
def test_the_triangles_at_a_point_are_those_of_the_whole_triangulation(seed: int) -> None:
    """Inside the points and at their edge; triangles of the hull's far side run clockwise and do not count."""
    points = np.random.default_rng(seed).uniform(-1, 1, (40, 2)) + (0.0 if seed % 2 else 0.9)
    points[7] = 0.0
    ring = delaunay_ring(inverted(points))
    cross = points[ring, 0] * np.roll(points[ring], -1, axis=0)[:, 1]
    cross -= points[ring, 1] * np.roll(points[ring], -1, axis=0)[:, 0]
    found = {frozenset((7, int(a), int(b))) for a, b, c in zip(ring, np.roll(ring, -1), cross, strict=True) if c > 0}
    triangles = Delaunay(points).simplices
    assert found == {frozenset(map(int, t)) for t in triangles if 7 in t}


def test_of_neighbours_on_one_circle_the_outermost_are_found() -> None:
    """The corners of a square with the origin as its fourth, in any order, and a point far off."""
    square = np.array([[1.0, 0], [1, 1], [0, 1], [9, 9]])
    for order in ([0, 1, 2, 3], [2, 0, 1, 3], [1, 3, 2, 0], [3, 1, 0, 2]):
        ring = delaunay_ring(inverted(square[order]))
        assert {order[k] for k in ring} == {0, 2, 3}


def test_a_point_alone_or_with_its_like_has_no_neighbours() -> None:
    assert len(delaunay_ring(inverted(np.zeros((1, 2))))) == 0
    assert len(delaunay_ring(inverted(np.zeros((3, 2))))) == 0
