"""Polygons triangulated over their own vertices: covered once, with short edges, and never against the rules."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ringdic.mesh.polygon import triangulate_polygon

UP = np.array([0.0, 0.0, 1.0])


def area(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return 0.5 * np.cross(b - a, c - a) @ UP


@settings(max_examples=40, deadline=None)
@given(st.integers(4, 14), st.integers(0, 10_000))
def test_a_star_shaped_polygon_is_covered_once(n: int, seed: int) -> None:
    """Triangles that all face upwards and add up to the polygon's area cannot overlap."""
    random = np.random.default_rng(seed)
    angle = np.sort((np.arange(n) + random.uniform(-0.3, 0.3, n)) * 2 * np.pi / n)
    radius = random.uniform(0.4, 1.0, n)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.05 * random.standard_normal(n)], axis=1)
    triangles = triangulate_polygon(points, UP)
    assert triangles is not None
    assert len(triangles) == n - 2
    areas = area(points, triangles)
    x, y = points[:, 0], points[:, 1]
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_the_shorter_diagonal_is_taken_unless_it_is_barred() -> None:
    points = np.array([[0, 0, 0], [2, -0.5, 0], [4, 0, 0], [2, 0.5, 0]], float)
    free = np.zeros((4, 4), bool)
    triangles = triangulate_polygon(points, UP, 10.0, free)
    assert {1, 3} in [set(row) & {1, 3} for row in triangles.tolist()]
    assert all({1, 3} <= set(row) for row in triangles.tolist())
    barred = free.copy()
    barred[1, 3] = True
    assert all({0, 2} <= set(row) for row in triangulate_polygon(points, UP, 10.0, barred).tolist())
    assert triangulate_polygon(points, UP, 3.0, barred) is None


def test_an_outline_with_vertices_in_line_has_no_triangle_without_an_area() -> None:
    """The outline of a hole of 2 x 1 lost nodes on a lattice: ten nodes, four of them corners."""
    outline = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (3, 2), (2, 2), (1, 2), (0, 2), (0, 1)]
    points = np.column_stack([np.array(outline, float), np.zeros(10)])
    triangles = triangulate_polygon(points, UP)
    assert triangles is not None
    areas = area(points, triangles)
    assert areas.min() == 0.5
    assert areas.sum() == 6.0
