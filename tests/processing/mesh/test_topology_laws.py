"""Borders, holes and double cover of surfaces whose topology is known."""

import numpy as np
import pytest
import trimesh
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.topology import (
    Kind,
    borders,
    doubly_covered,
    holes,
    inconsistent_edges,
    is_closed_tube,
    non_manifold_edges,
    overlap_area,
    pieces,
    without_pinches,
)


def sheet(rows: int = 20, columns: int = 30, spacing: float = 1.0) -> Mesh:
    """A flat rectangle of right triangles, normals along +z; its vertices run row by row."""
    y, x = np.mgrid[:rows, :columns] * spacing
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Mesh(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1), faces)


def tube(radius: float = 20.0, turn: float = 2 * np.pi, columns: int = 60, rows: int = 20) -> Mesh:
    """A cylinder about z from a sheet, normals outwards, closed for a whole turn."""
    flat = sheet(rows, columns + 1)
    theta = flat.vertices[:, 0] / columns * turn
    vertices = np.stack([radius * np.cos(theta), radius * np.sin(theta), flat.vertices[:, 1]], axis=1)
    faces = flat.faces
    if turn == 2 * np.pi:
        last = np.arange(len(vertices)) % (columns + 1) == columns
        faces = np.where(last[faces], faces - columns, faces)
    return Mesh(vertices, faces)


def without(mesh: Mesh, *vertices: int) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[~np.isin(mesh.faces, vertices).any(axis=1)])


def flipped(mesh: Mesh, which: np.ndarray) -> Mesh:
    return Mesh(mesh.vertices, np.where(which[:, None], mesh.faces[:, ::-1], mesh.faces))


def test_a_sound_closed_body_has_no_border_and_is_covered_once() -> None:
    body = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    mesh = Mesh(body.vertices, body.faces)
    assert borders(mesh) == ()
    assert len(non_manifold_edges(mesh)) == len(inconsistent_edges(mesh)) == 0
    assert without_pinches(mesh).all()
    assert pieces(mesh).max() == 0
    assert overlap_area(mesh, reach=3.0) == 0.0
    assert not is_closed_tube(mesh)


def test_a_rim_a_hole_and_an_end_are_told_apart_by_their_turning() -> None:
    (rim,) = borders(sheet())
    assert rim.kind is Kind.RIM
    assert rim.turning == pytest.approx(1.0)
    assert rim.area == pytest.approx(19 * 29)
    ends = borders(tube())
    assert [end.kind for end in ends] == [Kind.END, Kind.END]
    assert [end.turning for end in ends] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert ends[0].area == pytest.approx(np.pi * 400, rel=0.003)


def test_ragged_ends_are_ends_and_a_nearly_closed_sheet_has_a_rim() -> None:
    ragged = without(tube(), *np.random.default_rng(1).choice(61, 20, replace=False))
    assert len(ragged.faces) < len(tube().faces) - 20
    assert is_closed_tube(ragged)
    (rim,) = borders(tube(turn=np.radians(330)))
    assert rim.kind is Kind.RIM
    assert rim.turning == pytest.approx(1.0)
    assert not is_closed_tube(tube(turn=np.radians(330)))


def test_the_area_of_a_hole_is_that_of_the_triangles_taken_out() -> None:
    vertex = 10 * 61 + 30
    for mesh in (sheet(20, 61), tube()):
        opened = without(mesh, vertex)
        removed = mesh.areas.sum() - opened.areas.sum()
        (hole,) = holes(opened)
        assert hole.area == pytest.approx(removed, rel=0.01)
        assert hole.turning == pytest.approx(-1.0, abs=0.01)
        assert holes(opened, above=1.1 * removed) == ()
    assert is_closed_tube(without(tube(), vertex), largest_hole=1.1 * removed)
    assert not is_closed_tube(without(tube(), vertex))


def test_holes_that_touch_in_a_vertex_are_one_border_and_the_vertex_is_named() -> None:
    """Two missing triangles opposite one another at a vertex leave it with two fans."""
    mesh = sheet()
    middle = 10 * 30 + 15
    around = np.flatnonzero((mesh.faces == middle).any(axis=1))
    angle = np.arctan2(*(mesh.centroids[around] - mesh.vertices[middle]).T[1::-1])
    around = around[np.argsort(angle)]
    opened = Mesh(mesh.vertices, np.delete(mesh.faces, around[[0, 3]], axis=0))
    dropped = opened.faces[~without_pinches(opened)]
    assert len(dropped)
    assert (dropped == middle).any(axis=1).all()
    (hole,) = holes(opened)
    assert hole.area == pytest.approx(1.0)
    assert (hole.loop == middle).sum() == 2


def test_defects_are_named_and_their_borders_refused() -> None:
    mesh = sheet()
    fin = Mesh(np.vstack([mesh.vertices, [15.5, 10.0, 3.0]]), np.vstack([mesh.faces, [315, 316, 600]]))
    np.testing.assert_array_equal(non_manifold_edges(fin), [[315, 316]])
    turned = flipped(mesh, np.arange(len(mesh.faces)) == 40)
    assert len(inconsistent_edges(turned)) == 3
    for bad in (fin, turned):
        with pytest.raises(ValueError, match="no borders in order"):
            borders(bad)
        assert not is_closed_tube(bad)


def test_area_in_two_layers_is_counted_once_and_the_other_side_of_a_plate_is_not() -> None:
    """A second sheet, shifted by a fraction of the spacing and half a spacing above, covers a known rectangle."""
    mesh = sheet(20, 30)
    shift = np.array([10.37, 5.41, 0.5])
    both = Mesh(np.vstack([mesh.vertices, mesh.vertices + shift]), np.vstack([mesh.faces, mesh.faces + 600]))
    true = (29 - shift[0]) * (19 - shift[1])
    assert overlap_area(both, reach=1.0) == pytest.approx(true, rel=0.05)
    assert overlap_area(both, reach=0.4) == 0.0
    assert doubly_covered(mesh, reach=1.0).max() == 0.0
    assert pieces(both).max() == 1
    plate = flipped(both, np.arange(len(both.faces)) >= len(mesh.faces))
    assert overlap_area(plate, reach=1.0) == 0.0
