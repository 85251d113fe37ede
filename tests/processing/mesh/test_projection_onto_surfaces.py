"""Projection of points onto a surface along given directions."""

import numpy as np
import pytest
import trimesh
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.projection import Projector


def test_radial_lines_hit_a_sphere_of_triangles_where_they_leave_it() -> None:
    body = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    mesh = Mesh(body.vertices, body.faces)
    random = np.random.default_rng(3)
    directions = random.standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    off = random.uniform(-0.4, 0.4, 300)
    hits = Projector(mesh, reach=1.0).hits((10.0 + off)[:, None] * directions, directions)
    np.testing.assert_array_equal(hits.point, np.arange(300))
    foot = np.einsum("nk,nki->ni", hits.weights, mesh.vertices[mesh.faces[hits.face]])
    np.testing.assert_allclose(np.linalg.norm(np.cross(foot, directions), axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(hits.height, 10.0 + off - np.linalg.norm(foot, axis=1), atol=1e-9)
    assert hits.weights.sum(axis=1) == pytest.approx(1.0)


def test_what_is_out_of_reach_or_faces_elsewhere_is_not_hit() -> None:
    plate = Mesh(np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0.0]]), np.array([[0, 1, 2]]))
    point, up = np.array([[1.0, 1.0, 0.5]]), np.array([[0.0, 0.0, 1.0]])
    assert Projector(plate, reach=1.0).hits(point, up).height == pytest.approx([0.5])
    assert len(Projector(plate, reach=0.4).hits(point, up).face) == 0
    assert len(Projector(plate, reach=1.0).hits(point, -up).face) == 0
    assert len(Projector(plate, reach=1.0).hits(point + np.array([2.5, 2.5, 0.0]), up).face) == 0
