"""Distances along a mesh against geodesic distances on the surface that it approximates."""

import numpy as np
from ringdic.mesh.geodesic import DETOUR, reach, step_graph
from ringdic.mesh.mesh import Mesh
from scipy.sparse.csgraph import dijkstra


def sheet(n: int = 21) -> Mesh:
    x, y = np.meshgrid(np.arange(float(n)), np.arange(float(n)), indexing="ij")
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def test_paths_are_never_shorter_than_the_surface_and_hardly_longer() -> None:
    mesh = sheet()
    start = 10 * 21 + 10
    path = dijkstra(step_graph(mesh), indices=start)
    straight = np.linalg.norm(mesh.vertices - mesh.vertices[start], axis=1)
    away = straight > 0
    assert (path[away] >= straight[away] - 1e-12).all()
    assert (path[away] / straight[away]).max() <= 1 / np.cos(np.radians(22.5)) + 1e-12 < DETOUR


def test_both_diagonals_of_a_square_are_one_step() -> None:
    graph = step_graph(sheet(3))
    diagonal = graph[0, 4], graph[1, 3]
    np.testing.assert_allclose(diagonal, np.sqrt(2))
    np.testing.assert_array_equal((graph != graph.T).nnz, 0)


def test_a_step_across_a_folded_edge_is_measured_unfolded() -> None:
    vertices = np.array([[0.0, -1, 0], [0, 1, 0], [2, 0, 0], [0, 0, 3]])  # two triangles at a right angle
    graph = step_graph(Mesh(vertices, [[0, 2, 1], [0, 1, 3]]))
    assert graph[2, 3] == 5.0


def test_reach_is_the_same_as_one_search_from_every_vertex() -> None:
    mesh = sheet()
    mesh = Mesh(mesh.vertices, mesh.faces[mesh.centroids[:, 0] < 15])  # some vertices belong to no triangle
    rows = reach(mesh, 3.2)
    truth = dijkstra(step_graph(mesh), limit=3.2)
    np.testing.assert_array_equal(rows.toarray() > 0, np.isfinite(truth))


def test_lost_vertices_are_gone_round() -> None:
    mesh = sheet(5)
    vertices = mesh.vertices.copy()
    vertices[[11, 12, 13]] = np.nan  # a wall across the middle, open at both ends
    path = dijkstra(step_graph(Mesh(vertices, mesh.faces)), indices=7)
    assert np.isinf(path[12])
    assert path[17] > 4.0  # two rows on, but round the wall
    assert reach(Mesh(vertices, mesh.faces), 2.5)[12].nnz == 0
