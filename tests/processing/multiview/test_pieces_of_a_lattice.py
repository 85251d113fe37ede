"""A lattice about an axis and the smooth pieces fitted on it: exact where the surface is a piece."""

import numpy as np
import pytest
from ringdic.multiview.lattice import TURN, SurfaceLattice, evaluate, fit_pieces, robust_pieces

LATTICE = SurfaceLattice(radius=50.0, columns=160, z=np.arange(0.0, 121.0, 2.0))
ANGLE, HEIGHT = 1.0, 60.0


def cubic(a, b):
    """A radius in mm of arc and height about one place, third degree, with its derivatives by a and b."""
    value = 50 + 0.1 * a - 0.2 * b + 0.01 * a * a - 0.004 * a * b + 0.02 * b * b + 3e-4 * a**3 - 2e-4 * a * b * b
    by_a = 0.1 + 0.02 * a - 0.004 * b + 9e-4 * a * a - 2e-4 * b * b
    return value, by_a, -0.2 - 0.004 * a + 0.04 * b - 4e-4 * a * b


def test_a_cubic_is_found_exactly_inside_and_a_quadratic_up_to_the_rim() -> None:
    theta, z = LATTICE.coordinates
    a, b = LATTICE.arc(theta, np.array(ANGLE)), z - HEIGHT
    near = np.hypot(a, b) < 30
    value, by_a, by_b = cubic(a, b)
    found = fit_pieces(LATTICE, value, reach=10.0).coefficients
    inside = np.hypot(a, b) < 15
    assert np.abs(found[..., 0] - value)[inside].max() < 1e-6
    assert np.abs(found[..., 1] - by_a)[inside].max() < 1e-6
    assert np.abs(found[..., 2] - by_b)[inside].max() < 1e-6
    quadratic = 50 + 0.1 * a + 0.01 * a * a + 0.02 * b * b
    partly = fit_pieces(LATTICE, np.where(near, quadratic, np.nan), reach=10.0)
    known = near & np.isfinite(partly.radius)
    assert known.sum() == near.sum()
    assert np.abs(partly.radius - quadratic)[known].max() < 2e-6
    beyond = ~near & np.isfinite(partly.radius)  # the surface is carried on a little beyond its rim
    assert beyond.sum() > 50
    assert np.abs(partly.radius - quadratic)[beyond].max() < 1e-4
    assert np.hypot(a, b)[beyond].max() < 40  # and not beyond its reach


def test_a_piece_is_evaluated_with_its_derivatives() -> None:
    a, b = np.random.default_rng(0).uniform(-5, 5, (2, 40))
    coefficients = np.array([50, 0.1, -0.2, 0.01, -0.004, 0.02, 3e-4, 0, -2e-4, 0])
    for found, true in zip(evaluate(coefficients, a, b), cubic(a, b), strict=True):
        np.testing.assert_allclose(found, true, rtol=0, atol=1e-12)


def test_the_lattice_closes_round_the_axis() -> None:
    theta, z = LATTICE.coordinates
    radius = 50 + 2 * np.cos(theta + 0.3) + 0.01 * z
    turned = np.roll(radius, 37, axis=0)
    first, second = fit_pieces(LATTICE, radius, 10.0).coefficients, fit_pieces(LATTICE, turned, 10.0).coefficients
    np.testing.assert_allclose(np.roll(first, 37, axis=0), second, rtol=0, atol=1e-9)
    column, row, inside = LATTICE.nearest(np.array([TURN - 1e-6, 0.0, -1e-6]), np.array([0.0, 119.1, 200.0]))
    assert column.tolist() == [0, 0, 0]
    assert row.tolist()[:2] == [0, 60]
    assert inside.tolist() == [True, True, False]


def test_normals_are_those_of_a_cylinder_whose_axis_lies_off() -> None:
    theta, _ = LATTICE.coordinates
    off = np.array([3.0, -2.0])
    along = off[0] * np.cos(theta) + off[1] * np.sin(theta)
    radius = along + np.sqrt(45.0**2 - off @ off + along**2)
    pieces = fit_pieces(LATTICE, radius, 8.0)
    true = (pieces.xyz - np.array([*off, 0.0])) * np.array([1, 1, 0]) / 45.0
    assert np.degrees(np.arccos(np.clip(np.sum(true * pieces.normals, axis=-1), -1, 1))).max() < 0.05
    assert np.abs(np.hypot(*(pieces.xyz[..., :2] - off).transpose(2, 0, 1)) - 45.0).max() < 1e-4


def test_nodes_that_lie_off_are_left_out_and_no_other() -> None:
    theta, z = LATTICE.coordinates
    rng = np.random.default_rng(1)
    true = 50 + 3 * np.cos(2 * theta) * np.sin(z / 30)
    radius = true + 0.01 * rng.standard_normal(true.shape)
    wrong = rng.random(true.shape) < 0.03
    radius[wrong] += rng.choice([-1, 1], wrong.sum()) * rng.uniform(0.3, 6.0, wrong.sum())
    pieces, agreeing = robust_pieces(LATTICE, radius, 8.0)
    assert not agreeing[wrong].any()
    assert agreeing[~wrong].mean() > 0.999
    assert np.sqrt(np.mean((pieces.radius - true) ** 2)) < 0.01  # smoother than what it was fitted to


@pytest.mark.parametrize("bad", [{"radius": 0.0}, {"columns": 4}, {"z": np.array([1.0])}])
def test_a_lattice_needs_a_size(bad: dict) -> None:
    with pytest.raises(ValueError, match="lattice"):
        SurfaceLattice(**{"radius": 50.0, "columns": 100, "z": np.arange(10.0), **bad})
