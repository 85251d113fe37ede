"""The triangle mesh: areas, borders and orientation of known bodies."""

import numpy as np
import pytest
import trimesh
from ringdic.mesh.mesh import Mesh


def sphere() -> Mesh:
    body = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    return Mesh(body.vertices, body.faces)


def test_area_vectors_of_a_closed_surface_sum_to_zero_and_it_has_no_border() -> None:
    mesh = sphere()
    np.testing.assert_allclose(mesh.area_vectors.sum(axis=0), 0.0, atol=1e-10)
    assert len(mesh.boundary_edges()) == 0
    assert mesh.areas.sum() == pytest.approx(4 * np.pi * 100, rel=0.02)
    vertices, edges, faces = len(mesh.vertices), len(mesh.edges()[0]), len(mesh.faces)
    assert vertices - edges + faces == 2  # Euler


def test_normals_of_vertices_are_those_of_the_body() -> None:
    mesh = sphere()
    np.testing.assert_allclose(mesh.vertex_normals, mesh.vertices / 10.0, atol=0.03)


def test_a_lost_vertex_opens_a_border_round_it() -> None:
    mesh = sphere()
    vertices = mesh.vertices.copy()
    vertices[100] = np.nan
    around = (mesh.faces == 100).any(axis=1).sum()
    opened = Mesh(vertices, mesh.faces).without_lost()
    assert len(opened.faces) == len(mesh.faces) - around
    border = opened.boundary_edges()
    assert len(border) == around
    assert sorted(border[:, 0]) == sorted(border[:, 1])  # a closed loop, each vertex entered and left once
    small, old_indices = opened.compact()
    assert 100 not in old_indices
    np.testing.assert_array_equal(small.vertices[small.faces], opened.vertices[opened.faces])


def test_a_face_without_its_vertex_is_refused() -> None:
    with pytest.raises(ValueError, match="beyond"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 3]]))
