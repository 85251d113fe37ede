"""What is exact is judged to have no error, what is off by a known amount by that amount."""

import numpy as np
import pytest
from ringdic.geometry.camera import Camera
from ringdic.results.results import Results
from ringdic_controller.studies.truth import TURN, SurfaceGrid, errors, face_centroids
from ringdic_node.virtual_rig.rig import paper_rig
from ringdic_node.virtual_rig.scenes import Cylinder, Damage, Limb, Specimen, SpoiltPatch

RIG = paper_rig(12, 0.25)


def lattice(columns: int, rows: int, low: float, high: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Material coordinates and triangles of a closed tube."""
    theta, z = np.meshgrid(np.arange(columns) * TURN / columns, np.linspace(low, high, rows), indexing="ij")
    i, j = np.meshgrid(np.arange(columns), np.arange(rows - 1), indexing="ij")
    a, b = i * rows + j, (i + 1) % columns * rows + j
    faces = np.concatenate([np.stack([a, b, b + 1], -1).reshape(-1, 3), np.stack([a, b + 1, a + 1], -1).reshape(-1, 3)])
    return theta.ravel(), z.ravel(), faces


def exact(surface: Cylinder | Limb, steps: int, columns: int = 90, rows: int = 40) -> Results:
    """Results without any error."""
    theta, z, faces = lattice(columns, rows, 10.0, 240.0)
    vertices = np.array([surface.position(theta, z, step) for step in range(steps)])
    F, N, M = steps, len(theta), len(faces)
    cameras = tuple(Camera(id_, np.eye(3, 4) + np.eye(3, 4, 3), (10, 10)) for id_ in ("a", "b"))
    return Results(
        "exact", tuple(f"step {k}" for k in range(F)), cameras, (("a", "b"),), vertices[0], vertices, faces,
        np.zeros(M, dtype=int), np.zeros(N, dtype=int), np.zeros((F, N)), np.zeros((F, N, 3)),
        np.zeros((F, N), dtype=np.int8),
    )  # fmt: skip


@pytest.mark.parametrize("surface", [Cylinder(), Limb()])
def test_exact_results_have_no_error(surface: Cylinder | Limb) -> None:
    found = errors(exact(surface, 3), surface)
    np.testing.assert_allclose(found.distance, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.displacement, 0.0, atol=1e-9)
    if isinstance(surface, Cylinder):
        np.testing.assert_allclose(found.stretches, 0.0, atol=1e-7)  # a root of round-off


def test_the_stretches_of_flat_triangles_approach_those_of_the_surface() -> None:
    coarse, fine = (
        np.abs(errors(exact(Limb(), 2, columns, rows), Limb()).stretches[1]).max()
        for columns, rows in ((45, 20), (180, 80))
    )
    assert fine < 0.3 * coarse  # four times finer; at least the first order


def test_known_errors_are_found() -> None:
    results, surface = exact(Limb(), 2), Limb()
    normals = results.vertices_ref * [1, 1, 0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    off = results.vertices.copy()
    off[1] += [0.03, 0.0, -0.04]
    found = errors(_with(results, off), surface)
    np.testing.assert_allclose(found.displacement[1], np.tile([0.03, 0.0, -0.04], (len(off[1]), 1)), atol=1e-9)
    lifted = results.vertices_ref + 0.2 * normals
    distance = errors(_with(results, np.array([lifted, off[1]])), surface).distance
    assert distance.min() > 0.17  # along the normal, which leans by the slope of the calf
    assert distance.max() < 0.2001


def test_steps_may_be_numbered_otherwise() -> None:
    surface = Limb()
    results = exact(surface, 4)
    picked = _with(results, results.vertices[[0, 3]])
    np.testing.assert_allclose(errors(picked, surface, (0, 3)).displacement, 0.0, atol=1e-9)
    assert np.abs(errors(picked, surface).displacement[1]).max() > 0.5


def test_the_middle_of_a_triangle_across_the_seam_lies_at_the_seam() -> None:
    theta, z = face_centroids(np.array([6.2, 0.1, 6.25]), np.array([1.0, 2.0, 6.0]), np.array([[0, 1, 2]]))
    assert np.cos(theta[0]) > 0.99
    assert z[0] == pytest.approx(3.0)


def test_a_closed_tube_covers_its_whole_height_and_a_hole_is_missed() -> None:
    specimen = Specimen(Limb(), 0)
    grid = SurfaceGrid.of(specimen)
    theta, z, faces = lattice(120, 60, *specimen.band)
    assert grid.covered(theta, z, faces).mean() > 0.999
    middle_theta, middle_z = face_centroids(theta, z, faces)
    hole = (np.abs(middle_z - 125) < 20) & (np.abs(middle_theta - 3.0) < 0.3)
    covered = grid.covered(theta, z, faces[~hole])
    gap = np.abs(grid.theta - 3.0) < 0.27
    assert not covered[gap & (np.abs(grid.z - 125) < 17)].any()
    assert covered[(np.abs(grid.theta - 3.0) > 0.36) | (np.abs(grid.z - 125) > 26)].all()


def test_the_cells_of_a_cylinder_have_its_area_and_two_cameras_see_them() -> None:
    specimen = Specimen(Cylinder(), 0)
    grid = SurfaceGrid.of(specimen)
    assert grid.area.sum() == pytest.approx(TURN * 57 * (238 - 12), rel=1e-9)
    seen, clean = grid.views(RIG.cameras)
    assert (seen.sum(axis=0) >= 2).all()
    np.testing.assert_array_equal(seen, clean)


def test_worn_cells_are_seen_but_not_clean() -> None:
    specimen = Specimen(Limb(), 0, 0, Damage(patches=(SpoiltPatch(1.0, 100.0, 10.0, 15.0),)))
    grid = SurfaceGrid.of(specimen)
    seen, clean = grid.views(RIG.cameras)
    worn = specimen.damage.worn(grid.theta, grid.z)
    assert seen[:, worn].any()
    assert not clean[:, worn].any()
    np.testing.assert_array_equal(seen[:, ~worn], clean[:, ~worn])


def _with(results: Results, vertices: np.ndarray) -> Results:
    F = len(vertices)
    return Results(
        "exact", results.steps[:F], results.cameras, results.pairs, vertices[0], vertices, results.faces,
        results.pair, results.vertex_pair, results.correlation[:F], results.sigma_xyz[:F], results.status[:F],
    )  # fmt: skip
