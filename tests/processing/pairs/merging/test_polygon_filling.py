"""Holes closed over the vertices round them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ringdic.mesh.mesh import Mesh
from ringdic.pairs.merging.fill import fill, polygon, simple_loops

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
    triangles = polygon(points, UP, bridge=10.0, barred=np.zeros((n, n), bool))
    assert triangles is not None
    assert len(triangles) == n - 2
    areas = area(points, triangles)
    x, y = points[:, 0], points[:, 1]
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_the_shorter_diagonal_is_taken_unless_it_is_barred() -> None:
    points = np.array([[0, 0, 0], [2, -0.5, 0], [4, 0, 0], [2, 0.5, 0]], float)
    free = np.zeros((4, 4), bool)
    triangles = polygon(points, UP, 10.0, free)
    assert {1, 3} in [set(row) & {1, 3} for row in triangles.tolist()]
    assert all({1, 3} <= set(row) for row in triangles.tolist())
    barred = free.copy()
    barred[1, 3] = True
    assert all({0, 2} <= set(row) for row in polygon(points, UP, 10.0, barred).tolist())
    assert polygon(points, UP, 3.0, barred) is None


def test_a_loop_is_split_where_it_passes_a_vertex_twice() -> None:
    parts = simple_loops([1, 2, 3, 1, 4, 5])
    assert sorted(sorted(part) for part in parts) == [[1, 2, 3], [1, 4, 5]]


def test_holes_up_to_an_area_are_closed_and_the_rim_stays() -> None:
    y, x = np.mgrid[:12, :12].astype(float)
    index = np.arange(144).reshape(12, 12)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(144)], axis=1)
    opened = Mesh(vertices, faces[~(faces == 65).any(axis=1)])  # six triangles round one vertex: 3 of area
    nowhere = np.zeros(144, bool)
    assert len(fill(opened, 2.9, 5.0, nowhere, 100.0)) == 0
    new = fill(opened, 3.1, 5.0, nowhere, 100.0)
    assert Mesh(vertices, new).areas.sum() == pytest.approx(3.0)
    assert (Mesh(vertices, new).normals @ UP == 1).all()
    assert 65 not in new
    seam = nowhere.copy()
    seam[64] = True
    assert len(fill(opened, 0.0, 5.0, seam, 3.1)) == len(new)
