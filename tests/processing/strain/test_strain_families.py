"""Strain families: special cases, limits, order, and tensors that agree however they are computed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ringdic.results.fields import FIELDS, StepFields, compute_fields, field, seth_hill_fields
from ringdic.strain import families as strain
from ringdic.strain.deformation import deformation
from ringdic.strain.rigid_motion import motion_to_reference
from scipy.linalg import fractional_matrix_power, logm
from scipy.spatial.transform import Rotation

STRETCHES = np.linspace(0.3, 3.0, 50)


def seth_hill(stretch: np.ndarray, m: float) -> np.ndarray:
    return np.asarray(strain.seth_hill_of_log(np.log(stretch), m))


def test_the_named_families_are_members_of_seth_and_hill() -> None:
    np.testing.assert_allclose(seth_hill(STRETCHES, strain.GREEN_LAGRANGE), (STRETCHES**2 - 1) / 2, rtol=1e-13)
    np.testing.assert_allclose(seth_hill(STRETCHES, strain.BIOT), STRETCHES - 1, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(seth_hill(STRETCHES, strain.HENCKY), np.log(STRETCHES))
    np.testing.assert_allclose(seth_hill(STRETCHES, -0.5), 1 - 1 / STRETCHES, rtol=1e-12, atol=1e-15)
    almansi = (1 - STRETCHES**-2) / 2
    np.testing.assert_allclose(seth_hill(STRETCHES, strain.EULER_ALMANSI), almansi, rtol=1e-12, atol=1e-15)


@given(stretch=st.floats(0.2, 5.0), m=st.floats(-4.0, 4.0))
def test_every_member_rises_with_the_stretch_and_starts_with_slope_one(stretch: float, m: float) -> None:
    value = seth_hill(np.array([stretch, stretch * 1.01]), m)
    assert value[1] > value[0]
    assert seth_hill(np.array(1.0), m) == 0.0
    # ε(1 + h) = h + (2m - 1) h² / 2 + …, so the slope at 1 is 1 whatever m.
    assert seth_hill(np.array(1 + 1e-6), m) / 1e-6 == pytest.approx(1.0, abs=1e-5)
    # The strain of the inverse stretch is minus that of the opposite exponent.
    inverse = np.array(1 / stretch)
    assert seth_hill(inverse, m) == pytest.approx(-seth_hill(np.array(stretch), -m), rel=1e-9, abs=1e-12)


def test_small_strains_and_small_exponents_keep_their_digits() -> None:
    tiny = np.array(1 + 2.0**-40)
    for m in (1.0, 0.5, 1e-9, -1.0):
        assert seth_hill(tiny, m) == pytest.approx(2.0**-40, rel=1e-9)
    np.testing.assert_allclose(seth_hill(STRETCHES, 1e-12), np.log(STRETCHES), rtol=1e-11)


def one_triangle() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A tilted triangle, its place after a stretch of 1.3 × 0.8 about oblique axes in its plane and a turn."""
    corners = np.array([[0.0, 0.0, 0.0], [3.0, 0.5, 0.0], [0.7, 2.0, 0.0]])
    U = Rotation.from_rotvec([0, 0, 0.4]).as_matrix() @ np.diag([1.3, 0.8, 1.0])
    U = U @ Rotation.from_rotvec([0, 0, -0.4]).as_matrix()
    tilt, turn = Rotation.from_rotvec([0.3, -0.8, 0.2]).as_matrix(), Rotation.from_rotvec([1.0, 0.5, -2.0]).as_matrix()
    reference = corners @ tilt.T
    return reference, reference @ (turn @ tilt @ U @ tilt.T).T + [5.0, 6.0, 7.0], np.array([[0, 1, 2]])


@pytest.mark.parametrize("m", [1.0, 0.5, 0.25, 0.0, -1.0])
def test_the_tensor_is_the_matrix_function_of_the_right_stretch(m: float) -> None:
    result = deformation(*one_triangle())
    C = result.F[0].T @ result.F[0]
    truth = logm(C) / 2 if m == 0 else (fractional_matrix_power(C, m) - np.eye(3)) / (2 * m)
    first, second = seth_hill(result.lambda1, m), seth_hill(result.lambda2, m)
    N1, N2 = result.direction1_reference[0], result.direction2_reference[0]
    tensor = first * np.outer(N1, N1) + second * np.outer(N2, N2)
    np.testing.assert_allclose(tensor, np.real(truth), atol=1e-12)
    assert strain.magnitude(first, second)[0] == pytest.approx(np.linalg.norm(truth), rel=1e-11)
    deviator = truth - np.trace(truth) / 3 * np.eye(3)
    assert strain.equivalent(first, second)[0] == pytest.approx(np.sqrt(2 / 3) * np.linalg.norm(deviator), rel=1e-11)
    assert strain.shear(first, second)[0] == pytest.approx((np.linalg.eigvalsh(truth)[[0, 2]] @ [-0.5, 0.5]), rel=1e-9)


def test_linear_strain_is_that_of_theory_and_takes_a_rotation_for_strain() -> None:
    reference, _, faces = one_triangle()
    normal = deformation(reference, reference, faces).normal_reference
    H = 1e-6 * np.random.default_rng(3).normal(size=(3, 3))
    result = deformation(reference, reference @ (np.eye(3) + H).T, faces)
    plane = np.eye(3) - np.outer(normal[0], normal[0])
    linear = strain.infinitesimal_principal(result.F, result.normal_reference)
    theory = sorted(np.linalg.eigvalsh(plane @ (H + H.T) @ plane / 2), key=abs)[1:]  # the one along the normal is 0
    np.testing.assert_allclose(np.ravel(linear), sorted(theory), atol=1e-11)  # the second order is 1e-12
    np.testing.assert_allclose(np.ravel(linear), [result.E1[0], result.E2[0]], atol=1e-11)
    turned = deformation(reference, reference @ Rotation.from_rotvec(0.1 * normal[0]).as_matrix().T, faces)
    linear = strain.infinitesimal_principal(turned.F, turned.normal_reference)
    np.testing.assert_allclose(np.ravel(linear), np.cos(0.1) - 1, atol=1e-12)


def test_principal_linear_strains_are_those_after_the_rigid_motion() -> None:
    reference, _, faces = one_triangle()
    # A small stretch and a large turn of the whole: the field shows the stretch alone.
    turn = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix()
    moved = reference * 1.001 @ turn.T + [3.0, 4.0, 5.0]
    certainty = StepFields({"correlation": np.zeros(3), "sigma_xyz": np.zeros((3, 3))}, {})
    fields = compute_fields(
        reference, moved, faces, motion_to_reference(reference, moved), certainty, np.zeros(1, np.int64)
    )
    for name in ("linear1", "linear2"):
        np.testing.assert_allclose(fields.scalar(field(name)), 1e-3, rtol=1e-9)
    np.testing.assert_allclose(fields.scalar(field("linear_magnitude")), np.sqrt(2) * 1e-3, rtol=1e-9)


def test_every_field_of_strain_has_the_value_of_its_family() -> None:
    result = deformation(*one_triangle())
    arrays = {"E1": result.E1, "E2": result.E2}
    for family, m in (("E", 1.0), ("e", -1.0), ("hencky", 0.0), ("biot", 0.5), ("seth_hill", 0.25)):
        end = ":0.25" if family == "seth_hill" else ""
        principal = seth_hill(result.lambda1, m), seth_hill(result.lambda2, m)
        for suffix, truth in (
            ("1", principal[0]), ("2", principal[1]), ("_magnitude", strain.magnitude(*principal)),
            ("_equivalent", strain.equivalent(*principal)), ("_shear", strain.shear(*principal)),
        ):  # fmt: skip
            values = field(f"{family}{suffix}{end}").from_arrays(arrays.__getitem__)
            np.testing.assert_allclose(values, truth, rtol=1e-12, err_msg=family + suffix)
    bazant = (result.lambda2 - 1 / result.lambda2) / 2
    np.testing.assert_allclose(field("bazant2").from_arrays(arrays.__getitem__), bazant, rtol=1e-12)
    for name in ("e1", "e2", "e_magnitude", "e_equivalent", "e_shear", "E_magnitude", "E_equivalent", "E_shear"):
        np.testing.assert_allclose(field(name).from_arrays(arrays.__getitem__), getattr(result, name), rtol=1e-12)
    assert len({entry.name for entry in FIELDS}) == len(FIELDS)
    assert seth_hill_fields(2)[0].name == "seth_hill1:2"
    for name in ("seth_hill1", "seth_hill1:", "seth_hill9:1", "window_displacement", "E3"):
        with pytest.raises(KeyError):
            field(name)
