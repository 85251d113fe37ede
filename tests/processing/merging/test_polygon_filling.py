"""Holes of a surface closed over the vertices round them."""

import numpy as np
import pytest
from ringdic.merging.fill import fill, simple_loops
from ringdic.mesh.mesh import Mesh

UP = np.array([0.0, 0.0, 1.0])


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
