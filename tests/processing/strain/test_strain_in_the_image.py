"""Strain from displacements in the image: exact for what is exactly known, quieter the wider the window."""

import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.strain.image_plane import ImageStrain, plane_gradients

X, Y = np.meshgrid(np.arange(0.0, 200.0, 10.0), np.arange(0.0, 150.0, 10.0))
XY = np.stack([X.ravel(), Y.ravel()], axis=1)
GOOD = np.ones(len(XY), bool)
GRADIENT = np.array([[0.02, -0.01], [0.03, -0.005]])


def test_a_plane_is_fitted_exactly_up_to_the_border() -> None:
    gradient = plane_gradients(XY, XY @ GRADIENT.T + [3.0, -2.0], GOOD, 45.0)
    np.testing.assert_allclose(gradient, np.broadcast_to(GRADIENT, gradient.shape), atol=1e-12)


def test_strain_of_a_rotation_is_zero_and_of_a_stretch_is_green_lagrange() -> None:
    c, s = np.cos(0.3), np.sin(0.3)
    turn, stretch = np.array([[c, -s], [s, c]]), np.diag([1.1, 0.9])
    strain = ImageStrain(np.stack([turn - np.eye(2), turn @ stretch - np.eye(2)]), 0.0)
    np.testing.assert_allclose(strain.E[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(strain.field("Exx")[1], (1.1**2 - 1) / 2)
    np.testing.assert_allclose(strain.principal[1], [(0.9**2 - 1) / 2, (1.1**2 - 1) / 2])
    np.testing.assert_allclose(strain.field("E2"), strain.principal[:, 1])
    np.testing.assert_allclose(strain.field("Exy")[1], 0.0, atol=1e-15)


def test_principal_strains_are_eigenvalues() -> None:
    gradients = np.random.default_rng(0).normal(0.0, 0.1, (20, 2, 2))
    strain = ImageStrain(gradients, 0.0)
    np.testing.assert_allclose(strain.principal, np.linalg.eigvalsh(strain.E), atol=1e-15)


def test_noise_falls_with_the_window_as_least_squares_says() -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.01, XY.shape)
    centre = np.flatnonzero((abs(XY - [100.0, 70.0]) < 30.0).all(axis=1))
    for window in (41.0, 81.0):
        inside = np.hypot(*(XY - XY[centre[0]]).T) <= window / 2
        expected = 0.01 / np.sqrt(((XY[inside] - XY[inside].mean(axis=0)) ** 2).sum(axis=0))
        scatter = plane_gradients(XY, noise, GOOD, window)[centre].std(axis=0)
        assert scatter == pytest.approx(np.broadcast_to(expected, (2, 2)), rel=0.6)


def test_lost_points_are_not_used_and_points_on_a_line_fix_no_plane() -> None:
    good = (XY[:, 1] == 20.0) | (XY[:, 0] > 100.0)
    displacement = np.where(good[:, None], XY @ GRADIENT.T, np.nan)
    gradient = plane_gradients(XY, displacement, good, 35.0)
    on_line = (XY[:, 1] == 20.0) & (XY[:, 0] < 70.0)
    assert np.isnan(gradient[~good]).all()
    assert np.isnan(gradient[on_line]).all()
    np.testing.assert_allclose(gradient[XY[:, 0] > 100.0] - GRADIENT, 0.0, atol=1e-12)


def test_what_is_asked_for_wrongly_is_refused() -> None:
    with pytest.raises(InputError, match="px above 0"):
        plane_gradients(XY, XY, GOOD, 0.0)
    with pytest.raises(InputError, match="there are Exx, Eyy, Exy, E1, E2"):
        ImageStrain(np.zeros((1, 2, 2)), 0.0).field("Ezz")
