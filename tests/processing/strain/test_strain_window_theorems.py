"""Strain over a window: exact on affine deformations, zero in rigid motion, with noise of the predicted size."""

import numpy as np
import pytest
from ringdic.mesh.mesh import Mesh
from ringdic.strain.deformation import deformation
from ringdic.strain.window import Gauge, StrainWindow, strain_window
from scipy.spatial.transform import Rotation

RADIUS = 57.0
WIDTH = 6.0


def tube(around: int = 240, along: int = 24, radius: float = RADIUS) -> Mesh:
    """A closed tube, its points about 1.5 mm apart, a little irregular, normals outwards."""
    rng = np.random.default_rng(8)
    angle, z = np.meshgrid(np.arange(around) * 2 * np.pi / around, 1.5 * np.arange(along), indexing="ij")
    angle, z = angle + rng.uniform(-0.15, 0.15, angle.shape) * 2 * np.pi / around, z + rng.uniform(-0.2, 0.2, z.shape)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1).reshape(-1, 3)
    n = np.arange(around * along).reshape(around, along)
    m = np.roll(n, -1, axis=0)
    a, b, c, d = (part.ravel() for part in (n[:, :-1], m[:, :-1], m[:, 1:], n[:, 1:]))
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


@pytest.fixture(scope="module")
def windows() -> StrainWindow:
    return strain_window(tube(), WIDTH)


def test_a_window_holds_what_lies_in_its_ball_on_this_side(windows: StrainWindow) -> None:
    mesh, rng = windows.mesh, np.random.default_rng(0)
    for face in rng.choice(len(mesh.faces), 50, replace=False):
        held = windows.members[face].indices
        distance = np.linalg.norm(mesh.vertices - mesh.centroids[face], axis=1)
        assert distance[held].max() <= WIDTH / 2
        # The tube is far from itself: nothing within the ball is left out.
        assert set(held) == set(np.flatnonzero(distance <= WIDTH / 2))
    np.testing.assert_array_equal(windows.points, windows.members.getnnz(axis=1))


def test_another_part_that_is_close_in_space_is_not_in_the_window() -> None:
    x, y = np.meshgrid(np.arange(12.0), np.arange(12.0), indexing="ij")
    sheet = np.column_stack([x.ravel(), y.ravel(), np.zeros(144)])
    n = np.arange(144).reshape(12, 12)
    a, b, c, d = (part.ravel() for part in (n[:-1, :-1], n[1:, :-1], n[1:, 1:], n[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    two = Mesh(np.concatenate([sheet, sheet + np.array([0, 0, 0.5])]), np.concatenate([faces, faces + 144]))
    members = strain_window(two, 5.0).members
    assert members[: len(faces), 144:].nnz == members[len(faces) :, :144].nnz == 0
    alone = strain_window(Mesh(sheet, faces), 5.0).members
    assert (members[: len(faces), :144] != alone).nnz == 0


def test_a_rigid_motion_gives_no_strain_to_round_off(windows: StrainWindow) -> None:
    for vector in ([0.4, 1.0, -2.0], [0.0, 0.0, 3.0]):
        R = Rotation.from_rotvec(vector).as_matrix()
        fields = windows.deformation(windows.mesh.vertices @ R.T + [300.0, -20.0, 8.0])
        for name in ("E", "e", "E1", "E2", "E_equivalent"):
            np.testing.assert_allclose(getattr(fields, name), 0.0, atol=1e-10, err_msg=name)
        np.testing.assert_allclose(fields.F, np.broadcast_to(R, fields.F.shape), atol=1e-9)


def test_an_affine_deformation_is_exact_in_the_plane_of_the_window(windows: StrainWindow) -> None:
    A = np.eye(3) + np.random.default_rng(1).normal(0, 0.2, (3, 3))
    fields = windows.deformation(windows.mesh.vertices @ A.T + [1.0, 2.0, 3.0])
    n = fields.normal_reference
    first = np.cross(n, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    plane = np.stack([first, np.cross(n, first)], axis=-1)  # (M, 3, 2)
    stretches = np.linalg.svd(A @ plane, compute_uv=False)
    np.testing.assert_allclose(fields.lambda2, stretches[:, 0], atol=1e-10)
    np.testing.assert_allclose(fields.lambda1, stretches[:, 1], atol=1e-10)
    np.testing.assert_allclose(fields.F @ plane, A @ plane, atol=1e-10)
    # The fitted plane is the tangent plane, as exactly as a few points give it.
    tangent = windows.mesh.centroids * [1, 1, 0] / np.linalg.norm(windows.mesh.centroids[:, :2], axis=1)[:, None]
    interior = windows.points > 8
    assert np.einsum("mi,mi->m", n, tangent)[interior].min() > np.cos(np.radians(2.0))


def test_an_inflated_and_drawn_tube_has_its_stretches_everywhere(windows: StrainWindow) -> None:
    fields = windows.deformation(windows.mesh.vertices * [1.1, 1.1, 1.25])
    # Heights above the plane lean the fit by at most (slope of the plane), whose square enters.
    np.testing.assert_allclose(fields.lambda1, 1.1, atol=2e-4)
    np.testing.assert_allclose(fields.lambda2, 1.25, atol=2e-4)
    np.testing.assert_allclose(np.abs(fields.direction2_reference[:, 2]), 1.0, atol=2e-3)


def test_the_noise_falls_as_least_squares_says(windows: StrainWindow) -> None:
    mesh, sigma = windows.mesh, 1e-3
    noisy = mesh.vertices + np.random.default_rng(2).normal(0, sigma, mesh.vertices.shape)
    fields = windows.deformation(noisy)
    z = mesh.vertices[:, 2]
    count = windows.points
    spread = windows.members @ z**2 - (windows.members @ z) ** 2 / count  # Σ (z - mean)²
    # On a tube, z lies in the plane of every window: E_zz is the slope of u_z over z.
    ratio = fields.E[:, 2, 2] * np.sqrt(spread) / sigma
    assert ratio.std() == pytest.approx(1.0, abs=0.1)  # 11,040 windows of 12 points: some 900 independent ones
    assert abs(ratio.mean()) < 0.1
    alone = deformation(mesh.vertices, noisy, mesh.faces)
    assert fields.E[:, 2, 2].std() < 0.35 * alone.E[:, 2, 2].std()


def test_lost_points_leave_the_rest_exact_and_their_own_triangles_lost(windows: StrainWindow) -> None:
    mesh = windows.mesh
    lost = np.random.default_rng(5).choice(len(mesh.vertices), 600, replace=False)
    current = mesh.vertices @ np.diag([1.2, 0.9, 1.1]).T
    R = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    moved = mesh.vertices @ R.T
    current[lost] = moved[lost] = np.nan
    touched = np.isin(mesh.faces, lost).any(axis=1)
    rigid = windows.deformation(moved)
    assert np.isnan(rigid.J[touched]).all()
    known = np.isfinite(rigid.J)
    assert known[~touched].mean() > 0.9  # those of the rim with many losses may not span a plane
    np.testing.assert_allclose(rigid.E[known], 0.0, atol=1e-10)
    stretched = windows.deformation(current)
    np.testing.assert_array_equal(np.isfinite(stretched.J), known)


def test_from_one_step_to_the_next_deformations_multiply(windows: StrainWindow) -> None:
    X = windows.mesh.vertices
    A, B = np.diag([1.1, 1.1, 1.2]), Rotation.from_rotvec([0, 0, 0.5]).as_matrix() @ np.diag([1.0, 1.0, 0.9])
    first, second = X @ A.T, X @ (B @ A).T
    total, one, two = (windows.deformation(x, ref) for x, ref in ((second, X), (first, X), (second, first)))
    np.testing.assert_allclose(two.J * one.J, total.J, atol=1e-10)
    np.testing.assert_allclose(two.F @ one.F, total.F, atol=1e-9)


def test_a_window_of_hardly_more_than_the_triangle_has_no_strain() -> None:
    narrow = strain_window(tube(60, 6, 20.0), 0.5)
    assert narrow.points.max() < 4
    assert np.isnan(narrow.deformation(narrow.mesh.vertices).J).all()
    with pytest.raises(ValueError, match="above 0 mm"):
        strain_window(tube(60, 6, 20.0), 0.0)


def test_the_gauge_length_counts_window_and_subset() -> None:
    window = Gauge(width=5.0, step=1.0, subset=4.1)
    assert window.points_across == 6.0
    assert window.length == pytest.approx((6 - 1) * 1.0 + 4.1)
    assert Gauge(width=0.0, step=1.0, subset=4.1).length == pytest.approx((2 - 1) * 1.0 + 4.1)
