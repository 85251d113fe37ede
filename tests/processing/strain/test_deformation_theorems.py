"""Deformation and rigid motion against exact solutions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ringdic.strain.deformation import Deformation, deformation, isotropy
from ringdic.strain.rigid_motion import kabsch, motion_to_reference
from scipy.spatial.transform import Rotation


def cylinder_patch(n: int, radius: float = 57.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A curved patch on a grid of n × n squares: surface coordinates (N, 2), points (N, 3) and triangles."""
    theta, z = np.meshgrid(np.linspace(-0.6, 0.6, n + 1), np.linspace(0.0, 60.0, n + 1), indexing="ij")
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    surface = np.stack([theta.ravel(), z.ravel()], axis=1)
    xyz = np.stack([radius * np.cos(surface[:, 0]), radius * np.sin(surface[:, 0]), surface[:, 1]], axis=1)
    return surface, xyz, faces


def plane_patch() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    _, _, faces = cylinder_patch(6)
    x, y = np.meshgrid(np.arange(7.0), np.arange(7.0), indexing="ij")
    xy = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-0.2, 0.2, (49, 2))
    return np.column_stack([xy, np.zeros(49)]), faces


@settings(max_examples=30, deadline=None)
@given(
    vector=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    shift=st.tuples(*[st.floats(-200.0, 200.0)] * 3),
)
def test_a_rigid_motion_gives_no_strain_to_round_off(vector: tuple, shift: tuple) -> None:
    _, xyz, faces = cylinder_patch(8)
    R = Rotation.from_rotvec(vector).as_matrix()
    fields = deformation(xyz, xyz @ R.T + np.array(shift), faces)
    for name in ("E", "e", "E1", "E2", "e1", "e2", "E_equivalent", "E_shear"):
        np.testing.assert_allclose(getattr(fields, name), 0.0, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(fields.F, np.broadcast_to(R, fields.F.shape), atol=1e-12)
    np.testing.assert_allclose(fields.J, 1.0, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(G=st.lists(st.floats(-0.3, 0.3), min_size=4, max_size=4), vector=st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_a_homogeneous_deformation_of_a_plane_is_exact(G: list[float], vector: tuple) -> None:
    xyz, faces = plane_patch()
    F_plane = np.eye(3)
    F_plane[:2, :2] += np.reshape(G, (2, 2))
    R = Rotation.from_rotvec(vector).as_matrix()
    F = R @ F_plane
    fields = deformation(xyz, xyz @ F.T + np.array([4.0, -5.0, 6.0]), faces)
    C = F.T @ F
    stretch = np.linalg.svd(F_plane[:2, :2], compute_uv=False)
    np.testing.assert_allclose(fields.F, np.broadcast_to(F, fields.F.shape), atol=1e-12)
    np.testing.assert_allclose(fields.E, np.broadcast_to((C - np.eye(3)) / 2, fields.F.shape), atol=1e-12)
    almansi = (np.eye(3) - np.linalg.inv(F @ F.T)) / 2
    np.testing.assert_allclose(fields.e, np.broadcast_to(almansi, fields.F.shape), atol=1e-11)
    np.testing.assert_allclose(fields.lambda1, stretch[1], atol=1e-12)
    np.testing.assert_allclose(fields.lambda2, stretch[0], atol=1e-12)
    np.testing.assert_allclose(fields.J, np.linalg.det(F_plane), atol=1e-12)
    np.testing.assert_allclose(fields.e2, (1 - stretch[0] ** -2) / 2, atol=1e-12)


def test_uniaxial_tension_has_the_textbook_numbers() -> None:
    xyz, faces = plane_patch()
    fields = deformation(xyz, xyz * [1.2, 1.0, 1.0], faces)
    E = (1.2**2 - 1) / 2
    np.testing.assert_allclose(fields.E_magnitude, E, atol=1e-13)
    np.testing.assert_allclose(fields.E_equivalent, 2 / 3 * E, atol=1e-13)
    np.testing.assert_allclose(fields.E_shear, E / 2, atol=1e-13)
    np.testing.assert_allclose(np.abs(fields.direction2_reference[:, 0]), 1.0, atol=1e-13)
    np.testing.assert_allclose(np.abs(fields.normal_current[:, 2]), 1.0, atol=1e-13)


def inflated_and_twisted(surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A smooth map of the cylinder, and its exact in-plane stretches at surface points (θ, z)."""
    theta, z = surface.T
    r = 57.0 + 4.0 * np.sin(z / 20.0) + 2.0 * np.cos(2 * theta)
    angle, height = theta + 0.004 * z, 1.1 * z
    xyz = np.stack([r * np.cos(angle), r * np.sin(angle), height], axis=1)
    r_theta, r_z = -4.0 * np.sin(2 * theta), 0.2 * np.cos(z / 20.0)
    radial = np.stack([np.cos(angle), np.sin(angle), 0 * z], axis=1)
    hoop = np.stack([-np.sin(angle), np.cos(angle), 0 * z], axis=1)
    d_theta = (r_theta[:, None] * radial + r[:, None] * hoop) / 57.0
    d_z = r_z[:, None] * radial + 0.004 * r[:, None] * hoop + np.array([0.0, 0.0, 1.1])
    tangents = np.stack([d_theta, d_z], axis=2)
    return xyz, np.linalg.svd(tangents, compute_uv=False)[:, ::-1]


def test_the_stretch_of_a_curved_body_converges_at_the_expected_rates() -> None:
    """First order in the size of a triangle; second for the mean of a square's two, whose first orders cancel."""
    single, paired = [], []
    for n in (10, 20, 40):
        surface, xyz, faces = cylinder_patch(n)
        current, _ = inflated_and_twisted(surface)
        _, truth = inflated_and_twisted(surface[faces].mean(axis=1))
        fields = deformation(xyz, current, faces)
        error = np.stack([fields.lambda1, fields.lambda2], axis=1) - truth
        single.append(np.sqrt((error**2).mean()))
        paired.append(np.sqrt((error.reshape(2, -1, 2).mean(axis=0) ** 2).mean()))
    assert np.log2(single[0] / single[2]) / 2 == pytest.approx(1.0, abs=0.05)
    assert np.log2(paired[0] / paired[2]) / 2 == pytest.approx(2.0, abs=0.1)
    assert paired[2] < 1e-4


def test_a_lost_vertex_loses_its_triangles_and_no_other() -> None:
    _, xyz, faces = cylinder_patch(5)
    current = 1.1 * xyz
    current[7] = np.nan
    fields = deformation(xyz, current, faces)
    lost = (faces == 7).any(axis=1)
    assert 0 < lost.sum() < len(faces)
    follow = [name for name in vars(Deformation) if not name.startswith("_")]
    assert "e" in follow
    of_reference = ("area", "normal_reference", "directors_reference")
    for name in (*Deformation.__dataclass_fields__, *follow):
        values = getattr(fields, name)
        whole = np.isfinite(values.reshape(len(faces), -1)).all(axis=1)
        expected = np.ones(len(faces), bool) if name in of_reference else ~lost
        assert (whole == expected).all(), name


def test_steps_stack_in_front_without_changing_a_number() -> None:
    _, xyz, faces = cylinder_patch(4)
    steps = np.stack([xyz, 1.05 * xyz, xyz + 3.0])
    together = deformation(xyz, steps, faces)
    for k, step in enumerate(steps):
        np.testing.assert_array_equal(together.E[k], deformation(xyz, step, faces).E)


def test_isotropy_of_known_triangles() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0], [0.5, 1e-9, 0]])
    fields = isotropy(vertices, np.array([[0, 1, 2], [0, 1, 3]]))
    np.testing.assert_allclose(fields, [1.0, 0.0], atol=1e-7)


@settings(max_examples=40, deadline=None)
@given(vector=st.tuples(*[st.floats(-3.0, 3.0)] * 3), shift=st.tuples(*[st.floats(-200.0, 200.0)] * 3))
def test_a_rigid_motion_is_found_even_with_lost_points(vector: tuple, shift: tuple) -> None:
    source = np.random.default_rng(1).uniform(-50, 50, (30, 3))
    R = Rotation.from_rotvec(vector).as_matrix()
    destination = source @ R.T + np.array(shift)
    destination[3] = np.nan
    source[5, 1] = np.nan
    motion = kabsch(source, destination)
    np.testing.assert_allclose(motion.R, R, atol=1e-12)
    np.testing.assert_allclose(motion.t, shift, atol=1e-10)
    assert motion.angle == pytest.approx(Rotation.from_rotvec(vector).magnitude(), abs=1e-7)


def test_mirrored_points_do_not_make_a_reflection() -> None:
    source = np.random.default_rng(1).uniform(-50, 50, (30, 3))
    assert np.linalg.det(kabsch(source, source * [1, 1, -1]).R) == pytest.approx(1.0)


def test_too_few_common_points_are_an_error_and_no_motion_is_removed() -> None:
    lost = np.full((4, 3), np.nan)
    with pytest.raises(ValueError, match="three points"):
        kabsch(lost, lost)
    np.testing.assert_array_equal(motion_to_reference(lost, lost).R, np.eye(3))
