"""Spline filters against exact properties, and the grid with its triangles."""

import numpy as np
import pytest
from ringdic.correlation import grid
from ringdic.correlation.spline import PAD, coefficients, gradients
from ringdic.correlation.warps import compose_inverse, compose_inverse_affine
from scipy import ndimage


@pytest.mark.parametrize("degree", [3, 5])
def test_coefficients_are_those_of_the_recursive_filter(degree):
    image = np.random.default_rng(0).uniform(0, 255, (60, 47))
    inner = coefficients(image, degree)[PAD:-PAD, PAD:-PAD]
    np.testing.assert_allclose(inner, ndimage.spline_filter(image, degree, mode="mirror"), atol=1e-6)


@pytest.mark.parametrize("degree", [3, 5])
def test_a_box_has_the_coefficients_and_slopes_of_the_whole_image_in_single_precision_too(degree):
    image = np.random.default_rng(0).integers(0, 256, (160, 190)).astype(np.uint8)
    whole, slopes = coefficients(image, degree, None, np.float64), gradients(image, degree, None, np.float64)
    for x0, y0, x1, y1 in ((0, 0, 190, 160), (50, 40, 121, 143), (0, 150, 8, 160), (181, 0, 190, 9)):
        for kind, within in ((np.float64, 1e-10), (np.float32, 1e-6)):
            inner = coefficients(image, degree, (x0, y0, x1, y1), kind)
            expected = whole[y0 : y1 + 2 * PAD, x0 : x1 + 2 * PAD]
            assert np.abs(inner - expected).max() < within * np.abs(whole).max()
            for slope, along in zip(gradients(image, degree, (x0, y0, x1, y1), kind), slopes, strict=True):
                assert slope.dtype == kind
                assert np.abs(slope - along[y0:y1, x0:x1]).max() < within * 255.0


def test_a_coefficient_depends_on_no_box_to_the_last_digit():
    image = np.random.default_rng(0).integers(0, 256, (160, 190)).astype(np.uint8)
    one = coefficients(image, 5, (50, 40, 121, 143), np.float32)
    other = coefficients(image, 5, (61, 30, 150, 151), np.float32)
    np.testing.assert_array_equal(one[:, 11:], other[10 : 10 + one.shape[0], : one.shape[1] - 11])


@pytest.mark.parametrize(("degree", "order"), [(3, 4), (5, 6)])
def test_gradients_converge_at_the_order_of_the_spline(degree, order):
    x = np.arange(400.0)[None, :] * np.ones((9, 1))
    errors = []
    for period in (12.0, 24.0):
        k = 2 * np.pi / period
        gx, gy = gradients(np.sin(k * x), degree)
        errors.append(np.abs(gx - k * np.cos(k * x))[:, 100:300].max() / k)
        assert np.abs(gy).max() < 1e-9
    assert np.log2(errors[0] / errors[1]) > order - 0.5


def test_grid_is_listed_column_by_column_and_triangles_face_the_viewer():
    mask = np.zeros((35, 45), bool)
    mask[5:31, 5:41] = True
    mask[5:15, 5:15] = False  # the corner point (10, 10) is missing
    xy, faces = grid(mask, 10)
    expected = [(x, y) for x in (10, 20, 30, 40) for y in (10, 20, 30) if (x, y) != (10, 10)]
    np.testing.assert_array_equal(xy, expected)
    p = xy[faces]
    a, b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    np.testing.assert_allclose(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], -100.0)
    assert len(faces) == 5 * 2 + 1  # five whole squares, and the half of the cut one


def warp(p, x, y):
    powers = np.array([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2])
    return x + p[:6] @ powers, y + p[6:] @ powers


def test_inverse_composition_undoes_the_increment():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-20, 20, (2, 50))
    p = np.concatenate([[3.0, 0.05, -0.02, 0, 0, 0], [-2.0, 0.03, 0.04, 0, 0, 0]])
    d = np.concatenate([[0.1, 0.01, 0.02, 0, 0, 0], [-0.2, -0.01, 0.015, 0, 0, 0]])
    truth = warp(p, x, y)
    for compose in (compose_inverse_affine, lambda q, e: compose_inverse(q, e, np.empty((6, 6)), np.empty((6, 6)))):
        q = p.copy()
        assert compose(q, d)
        np.testing.assert_allclose(warp(q, *warp(d, x, y)), truth, atol=1e-9)


def test_second_order_composition_is_right_to_the_third_power():
    rng = np.random.default_rng(3)
    p, d = 1e-3 * rng.normal(size=12), 1e-3 * rng.normal(size=12)
    q = p.copy()
    assert compose_inverse(q, d, np.empty((6, 6)), np.empty((6, 6)))
    misses = []
    for reach in (2.0, 1.0):
        x, y = rng.uniform(-reach, reach, (2, 200))
        misses.append(np.abs(np.subtract(warp(q, *warp(d, x, y)), warp(p, x, y))).max())
    assert misses[0] < 1e-4
    assert misses[1] < misses[0] / 2
