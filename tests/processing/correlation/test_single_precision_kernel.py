"""The vectorised kernels against plain arithmetic in double precision, and against the bound that image noise sets."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.correlation import CorrelationSettings, correlate_points, grid, prepare_current, prepare_reference
from ringdic.correlation.refinement import refine
from ringdic.correlation.spline import PAD, coefficients, gradients

_SPEC = importlib.util.spec_from_file_location("double_precision", Path(__file__).with_name("double_precision.py"))
double_precision = importlib.util.module_from_spec(_SPEC)
sys.modules["double_precision"] = double_precision  # where numba looks for it
_SPEC.loader.exec_module(double_precision)

SIZE = 200
COLUMNS = [0, 6, 1, 2, 7, 8]


@pytest.fixture(scope="module")
def speckle():
    """Speckle about 4 px wide, 120 ± 45 grey levels. (SIZE, SIZE)."""
    noise = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(SIZE, SIZE)), (0, 0), 1.6)
    return 120.0 + 45.0 * noise / noise.std()


def warped(image, gradient, shift, curvature=0.0):
    """The image deformed about its middle, whole grey levels with a noise of 1.5."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    middle = (SIZE - 1) / 2
    back = np.linalg.inv(np.eye(2) + gradient)
    dx, dy = x - middle - shift[0], y - middle - shift[1]
    at_x = back[0, 0] * dx + back[0, 1] * dy + middle + curvature * dx * dx
    at_y = back[1, 0] * dx + back[1, 1] * dy + middle - curvature * dx * dy
    moved = cv2.remap(
        image, at_x.astype(np.float32), at_y.astype(np.float32), cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT_101
    )
    return np.rint(moved + np.random.default_rng(4).normal(0, 1.5, moved.shape))


def in_double_precision(reference, current, mask, xy, start, settings):
    """Status, ZNCC, parameters and sigma of the same points, matched in plain double precision."""
    degree = settings.degree
    trim = PAD - 3
    cut = np.s_[trim:-trim, trim:-trim]
    gx, gy = gradients(reference, degree)
    coefs = [np.ascontiguousarray(coefficients(i, degree)[cut]) for i in (reference, current)]
    n, p = len(xy), start.copy()
    status, zncc, iterations, sigma = np.zeros(n, np.int64), np.zeros(n), np.zeros(n, np.int64), np.zeros((n, 2))
    double_precision.refine(
        reference, gx, gy, coefs[0], mask, np.zeros(2), coefs[1], np.zeros(2), xy, p, np.ones(n, bool),
        settings.radius, settings.subset == "circle", 3 * settings.order, degree == 5, settings.tolerance,
        settings.max_iterations, settings.texture_min, 0.0, status, zncc, iterations, sigma,
    )  # fmt: skip
    return status, zncc, p, sigma


def in_the_middle(settings):
    """Grid points (n, 2) px, by the step of the settings, whose subsets lie well inside the image."""
    mask = np.zeros((SIZE, SIZE), bool)
    mask[40:160, 40:160] = True
    return grid(mask, settings.step)[0]


def residual_of_the_tolerance(speckle, settings, xy, start):
    """Distance (n, 2) px of points from where they converge to, at the tolerance of the settings, and mean iterations.

    speckle : reference image, matched to a gently deformed one. xy : (n, 2) px. start : (n, 12).
    """
    reference, current = np.rint(speckle), warped(speckle, GENTLE, (3.3, -1.7))
    positions, iterations = [], []
    for tolerance in (settings.tolerance, 1e-6):
        finer = replace(settings, tolerance=tolerance)
        prepared = prepare_reference(reference, None, finer), prepare_current(current, None, finer)
        status, _, count, _, parameters = refine(*prepared, xy, start, finer)
        assert (status == 0).all()
        positions.append(parameters[:, [0, 6]])
        iterations.append(count.mean())
    return positions[0] - positions[1], iterations[0]


GENTLE = np.array([[0.012, -0.02], [0.015, 0.008]])
STEEP = np.array([[-0.35, 0.12], [0.06, 0.1]])
STEEP_ALONG_ROWS = np.array([[0.3, 0.02], [0.06, 0.03]])


@pytest.mark.parametrize("gradient", [GENTLE, STEEP, STEEP_ALONG_ROWS], ids=["gentle", "steep", "steep along rows"])
@pytest.mark.parametrize(
    ("interpolation", "order", "subset"),
    [("cubic", 1, "circle"), ("cubic", 2, "circle"), ("quintic", 1, "square"), ("quintic", 2, "circle")],
)
def test_single_precision_gives_the_matches_of_double(speckle, gradient, interpolation, order, subset):
    settings = CorrelationSettings(14, 11, order, subset, interpolation, tolerance=1e-6)
    reference, current = np.rint(speckle), warped(speckle, gradient, (3.3, -1.7), 2e-4)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[40:160, 40:160] = True
    mask[90:110, 70:95] = False
    xy = grid(mask, settings.step)[0]
    xy[::3] += [0.3, -0.45]  # between the pixels too
    start = np.zeros((len(xy), 12))
    start[:, [1, 2, 7, 8]] = gradient.ravel()
    start[:, [0, 6]] = (xy - (SIZE - 1) / 2) @ gradient.T + [3.5, -1.5]
    whole = np.ones((SIZE, SIZE), bool)
    whole[90:110, 70:95] = False
    prepared = prepare_reference(reference, whole, settings), prepare_current(current, None, settings)
    status, zncc, _, sigma, positions = refine(*prepared, xy, start, settings)
    truth = in_double_precision(reference, current, whole, xy, start, settings)
    good = truth[0] == 0
    assert good.mean() > 0.9
    np.testing.assert_array_equal(status == 0, good)
    difference = np.abs(positions - truth[2])[good]
    print(f"{interpolation}, order {order}, {subset}: {difference[:, [0, 6]].max():.1e} px")
    assert difference[:, [0, 6]].max() < 1e-5
    assert difference[:, [1, 2, 7, 8]].max() < 1e-6
    np.testing.assert_allclose(zncc[good], truth[1][good], atol=1e-6)
    np.testing.assert_allclose(sigma[good], truth[3][good], rtol=1e-3)


@pytest.mark.parametrize("order", [1, 2])
def test_steep_images_are_matched_as_their_transposes_are(speckle, order):
    """Images stretched along their rows give, to the last digit, the matches of the transposed images along their
    columns.
    """
    settings = CorrelationSettings(14, 11, order)
    reference, current = np.rint(speckle), warped(speckle, STEEP_ALONG_ROWS, (3.3, -1.7), 2e-4)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[50:160, 40:140] = True
    xy = grid(mask, settings.step)[0]
    xy[::3] += [0.3, -0.45]
    start = np.zeros((len(xy), 12))
    start[:, [1, 2, 7, 8]] = STEEP_ALONG_ROWS.ravel()
    start[:, [0, 6]] = (xy - (SIZE - 1) / 2) @ STEEP_ALONG_ROWS.T + [3.5, -1.5]
    exchanged = [6, 8, 7, 11, 10, 9, 0, 2, 1, 5, 4, 3]
    prepared = prepare_reference(reference, mask, settings), prepare_current(current, None, settings)
    turned = prepare_reference(reference.T.copy(), mask.T, settings), prepare_current(current.T.copy(), None, settings)
    one = refine(*prepared, xy, start, settings)
    other = refine(*turned, xy[:, ::-1], start[:, exchanged], settings)
    assert (one[0] == 0).mean() > 0.9
    for mine, theirs in zip(one[:3], other[:3], strict=True):
        np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(one[3], other[3][:, ::-1])
    np.testing.assert_array_equal(one[4], other[4][:, exchanged])


@pytest.mark.parametrize("order", [1, 2])
def test_the_default_tolerance_leaves_an_error_of_a_tenth_of_itself(speckle, order, figures):
    """Convergence is predicted from the last two steps; start values are 0.3 px off."""
    settings = CorrelationSettings(14, 9, order)
    xy = in_the_middle(settings)
    start = np.zeros((len(xy), 12))
    start[:, [0, 6]] = (xy - (SIZE - 1) / 2) @ GENTLE.T + [3.5, -1.5]
    residual, _ = residual_of_the_tolerance(speckle, settings, xy, start)
    figures(f"left by the default tolerance, order {order}: 1e-3 px", f"{1e3 * residual.std():.3f}", "0.1")
    assert np.abs(residual).max() < settings.tolerance
    assert np.sqrt(np.mean(residual**2)) < 0.1 * settings.tolerance


@pytest.mark.parametrize("order", [1, 2])
def test_points_that_start_near_their_match_need_one_iteration_less(speckle, order, figures):
    """Convergence is then predicted from how the steps of other points shrink; their own steps alone would need two."""
    settings = CorrelationSettings(20, 4, order)
    xy = in_the_middle(settings)
    start = np.zeros((len(xy), 12))
    start[:, [0, 6]] = (xy - (SIZE - 1) / 2) @ GENTLE.T + [3.3, -1.7]
    start[:, [1, 2, 7, 8]] = GENTLE.ravel()
    start[:, [0, 6]] += np.random.default_rng(0).normal(0.0, 0.01, (len(xy), 2))
    residual, iterations = residual_of_the_tolerance(speckle, settings, xy, start)
    figures(f"left after {iterations:.2f} iterations, order {order}: 1e-3 px", f"{1e3 * residual.std():.3f}", "0.1")
    assert iterations < (1.3 if order == 1 else 1.8)
    assert np.abs(residual).max() < settings.tolerance
    assert np.sqrt(np.mean(residual**2)) < 0.1 * settings.tolerance


@pytest.mark.parametrize(("order", "off"), [(1, 0.0), (2, 0.0), (1, 0.25)])
def test_a_reference_used_again_gives_the_same_matches_to_the_last_digit(speckle, order, off):
    settings = CorrelationSettings(14, 5, order)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[20:180, 20:180] = True
    mask[60:75, 60:75] = False
    xy = grid(mask, settings.step)[0] + off
    images = [warped(speckle, GENTLE, shift) for shift in ((3.3, -1.7), (-2.2, 0.4))]
    shared = prepare_reference(np.rint(speckle), mask, settings)
    for image in images:
        current = prepare_current(image, None, settings)
        again = correlate_points(shared, current, xy, settings)
        fresh = correlate_points(prepare_reference(np.rint(speckle), mask, settings), current, xy, settings)
        assert again.good.mean() > 0.95
        for name in ("uv", "gradient", "curvature", "zncc", "sigma", "status", "iterations"):
            np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))


def test_points_without_a_match_are_given_up_after_few_iterations(speckle):
    other = np.random.default_rng(9).normal(size=(SIZE, SIZE))
    other = np.rint(120.0 + 450.0 * cv2.GaussianBlur(other, (0, 0), 1.6))
    settings = CorrelationSettings(14, 5, 1)
    prepared = prepare_reference(np.rint(speckle), None, settings), prepare_current(other, None, settings)
    xy = in_the_middle(settings)
    status, zncc, iterations, _, _ = refine(*prepared, xy, np.zeros((len(xy), 12)), settings)
    assert not ((status == 0) & (zncc > settings.zncc_min)).any()
    assert iterations.mean() < 0.3 * settings.max_iterations


SCENES = 8  # one alone would leave 0.2e-3 px of its noise in the bias


@pytest.mark.parametrize("interpolation", ["cubic", "quintic"])
@pytest.mark.parametrize("radius", [10, 16, 20])
def test_bias_and_scatter_of_shifts_stay_at_the_bound(radius, interpolation, figures):
    """Shifts exact by Fourier's theorem; noise 1.5 grey levels; bound √2 σ √(H⁻¹)."""
    size = 800
    k = np.fft.fftfreq(size)
    low_pass = np.exp(-2.0 * (np.pi * 2.0) ** 2 * (k[:, None] ** 2 + np.fft.rfftfreq(size)[None] ** 2))
    settings = CorrelationSettings(radius, 16, 1, interpolation=interpolation, tolerance=1e-3, noise=1.5)
    mask = np.zeros((size, size), bool)
    mask[32:-32, 32:-32] = True
    xy = grid(mask, settings.step)[0]
    shifts = np.arange(0.0, 1.01, 0.125)
    biases, scatters, least = np.empty((3, SCENES, len(shifts)))
    for scene in range(SCENES):
        rng = np.random.default_rng([radius, scene])
        spectrum = np.fft.rfft2(rng.normal(size=(size, size))) * low_pass
        spectrum *= 45.0 / np.fft.irfft2(spectrum, (size, size)).std()
        for at, shift in enumerate(shifts):
            turn = np.exp(-2j * np.pi * np.fft.rfftfreq(size)[None] * shift)
            images = [
                128.0 + np.fft.irfft2(s, (size, size)) + rng.normal(0, 1.5, (size, size))
                for s in (spectrum, spectrum * turn)
            ]
            start = np.tile([shift, 0.0, 0.0, 0.0, 0.0, 0.0], (len(xy), 1))
            result = correlate_points(
                prepare_reference(images[0], mask, settings), prepare_current(images[1], None, settings), xy, settings,
                start=start,
            )  # fmt: skip
            error = result.uv[:, 0] - shift
            biases[scene, at], scatters[scene, at] = np.nanmean(error), np.nanstd(error)
            least[scene, at] = np.sqrt(np.nanmean(result.sigma[:, 0] ** 2))
    # The bound that the six free parameters leave; without the gradients it would be √2 σ / √Σ f_x², less by 2-10 %.
    bound = np.sqrt(np.mean(np.square(least)))
    largest, ratio = np.abs(biases.mean(axis=0)).max(), np.sqrt(np.mean(np.square(scatters))) / bound
    figures(f"shifts, radius {radius}, {interpolation}: bias, 1e-3 px", f"{1e3 * largest:.2f}", "0.6")
    figures(f"shifts, radius {radius}, {interpolation}: scatter / bound", f"{ratio:.3f}", "1.06")
    assert largest < 0.6e-3
    assert ratio < 1.06
