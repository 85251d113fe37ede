"""Images that are sums of sine waves: the reference is the current pattern at analytically warped positions."""

import numba
import numpy as np
import pytest
from ringdic.correlation import (
    CorrelationSettings,
    Status,
    correlate_points,
    grid,
    prepare_current,
    prepare_reference,
    search_warps,
)

SIZE = 220
SETTINGS = CorrelationSettings(radius=12, step=14)


def pattern(x, y, seed=0, waves=120):
    """Grey levels at positions x, y (any shape): band-limited (periods from 5 px), about 128 ± 40."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.broadcast(x, y).shape)
    for _ in range(waves):
        k = rng.uniform(0.15, 2 * np.pi / 5)
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        total += np.cos(k * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return 128.0 + 40.0 * total / np.sqrt(waves / 2)


def pixels(size=SIZE):
    """Pixel positions x and y of a square image."""
    return np.meshgrid(np.arange(size, dtype=float), np.arange(size, dtype=float))


def pair(displacement, seed=0):
    """Reference and current image such that reference(x) = current(x + displacement(x))."""
    x, y = pixels()
    u, v = displacement(x, y)
    return pattern(x + u, y + v, seed), pattern(x, y, seed)


def inner(margin=30):
    """Mask of the image less a margin."""
    mask = np.zeros((SIZE, SIZE), bool)
    mask[margin:-margin, margin:-margin] = True
    return mask


def match(reference, current, settings=SETTINGS, mask=None, **options):
    """Correlation of the grid points inside a mask."""
    xy, _ = grid(inner() if mask is None else mask, settings.step)
    prepared = prepare_reference(reference, mask, settings), prepare_current(current, None, settings)
    return correlate_points(*prepared, xy, settings, **options)


def affine(x, y):
    """Displacement u, v at positions x, y of an affine motion, px."""
    return 2.3 + 0.02 * (x - 110) - 0.03 * (y - 110), -1.7 + 0.04 * (x - 110) + 0.01 * (y - 110)


def quadratic(x, y):
    """Displacement u, v at positions x, y of a quadratic motion, px."""
    a, b = x - 110, y - 110
    return 1.2 + 0.01 * a + 4e-4 * a * a - 2e-4 * a * b, 0.4 - 0.02 * b + 3e-4 * b * b


@pytest.mark.parametrize(("interpolation", "limit"), [("quintic", 3e-4), ("cubic", 1e-3)])
@pytest.mark.parametrize("subset", ["circle", "square"])
def test_affine_motion_is_exact(interpolation, limit, subset):
    settings = CorrelationSettings(radius=12, step=14, interpolation=interpolation, subset=subset)
    result = match(*pair(affine), settings)
    assert result.good.all()
    truth = np.stack(affine(*result.xy.T), axis=1)
    assert np.abs(result.uv - truth).max() < limit
    np.testing.assert_allclose(
        result.gradient, np.broadcast_to([[0.02, -0.03], [0.04, 0.01]], (len(truth), 2, 2)), atol=limit / 4
    )  # a gradient is a difference of positions over some pixels of the subset
    assert result.zncc.min() > 0.9999


def test_second_order_follows_a_quadratic_and_first_order_does_not():
    images = pair(quadratic)
    largest = {}
    for order in (1, 2):
        result = match(*images, CorrelationSettings(radius=12, step=14, order=order))
        assert result.good.all()
        truth = np.stack(quadratic(*result.xy.T), axis=1)
        largest[order] = np.abs(result.uv - truth).max()
    assert largest[2] < 5e-4
    assert largest[1] > 5e-3
    curvature = np.broadcast_to([[8e-4, -2e-4, 0.0], [0.0, 0.0, 6e-4]], result.curvature.shape)
    np.testing.assert_allclose(result.curvature, curvature, atol=2e-5)


def test_first_order_keeps_the_curvature_of_its_start_values():
    result = match(*pair(quadratic))
    n = len(result.xy)
    start = np.zeros((n, 12))
    start[:, :2], start[:, 2:6] = result.uv, result.gradient.reshape(n, 4)
    start[:, 6:] = [8e-4, -2e-4, 0.0, 0.0, 0.0, 6e-4]
    corrected = match(*pair(quadratic), start=start)
    assert corrected.good.all()
    assert np.abs(corrected.uv - np.stack(quadratic(*corrected.xy.T), axis=1)).max() < 5e-4


def test_points_between_pixels_are_matched_as_well():
    reference, current = pair(affine)
    xy, _ = grid(inner(), 14)
    xy = xy + np.array([0.37, -0.61])
    prepared = prepare_reference(reference, None, SETTINGS), prepare_current(current, None, SETTINGS)
    result = correlate_points(*prepared, xy, SETTINGS)
    assert result.good.all()
    assert np.abs(result.uv - np.stack(affine(*xy.T), axis=1)).max() < 5e-4


@pytest.mark.parametrize("order", [1, 2])
def test_scatter_is_the_predicted_uncertainty(order):
    reference, current = pair(lambda x, y: (0.3 + 0 * x, -0.4 + 0 * y))
    rng = np.random.default_rng(1)
    settings = CorrelationSettings(radius=14, step=9, order=order)
    errors, predicted = [], []
    for _ in range(4):
        noisy = [image + rng.normal(0, 3.0, image.shape) for image in (reference, current)]
        result = match(*noisy, settings)
        errors.append(result.uv - [0.3, -0.4])
        predicted.append(result.sigma)
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(predicted)))
    assert 0.85 < ratio < 1.2
    # With the noise given, the same to the scatter of its estimate.
    given = match(*noisy, CorrelationSettings(radius=14, step=9, order=order, noise=3.0))
    np.testing.assert_allclose(np.median(given.sigma), np.median(result.sigma), rtol=0.1)


def test_first_order_uncertainty_is_the_bound_of_the_gradients():
    reference, current = pair(lambda x, y: (0.3 + 0 * x, -0.4 + 0 * y))
    settings = CorrelationSettings(radius=14, step=20, subset="square", noise=2.0)
    result = match(reference, current, settings)
    gy, gx = np.gradient(reference)
    for (x, y), sigma in zip(result.xy.astype(int), result.sigma, strict=True):
        window = np.s_[y - 14 : y + 15, x - 14 : x + 15]
        bound = np.sqrt(2) * 2.0 / np.sqrt([np.sum(gx[window] ** 2), np.sum(gy[window] ** 2)])
        assert np.all((sigma > 0.7 * bound) & (sigma < 1.2 * bound))


def test_contrast_and_offset_do_not_matter():
    reference, current = pair(affine)
    result, changed = match(reference, current), match(reference, 0.4 * current + 60.0)
    assert changed.good.all()
    np.testing.assert_allclose(changed.uv, result.uv, atol=1e-6)
    np.testing.assert_allclose(changed.zncc, result.zncc, atol=1e-6)  # single precision


def test_threads_do_not_change_a_bit():
    images = pair(quadratic)
    cores = numba.config.NUMBA_NUM_THREADS
    one, all_cores = match(*images, threads=1), match(*images, threads=cores)
    for name in ("uv", "gradient", "zncc", "iterations", "status", "sigma"):
        np.testing.assert_array_equal(getattr(one, name), getattr(all_cores, name))


def test_the_mask_cuts_the_subsets():
    reference, current = pair(affine)
    x, _ = pixels()
    strangers = x > 115  # not part of the body: another pattern there
    reference = np.where(strangers, pattern(*pixels(), seed=7), reference)
    mask = inner() & ~strangers
    fine = CorrelationSettings(radius=12, step=14, tolerance=1e-4)  # well below the bound: the images are exact
    result = match(reference, current, fine, mask=mask)
    at_rim = result.xy[:, 0] > 115 - 12
    assert at_rim.sum() >= 5
    assert result.good.all()
    truth = np.stack(affine(*result.xy.T), axis=1)
    assert np.abs(result.uv - truth).max() < 1e-3


def test_hidden_points_are_lost_and_none_is_wrong():
    reference, current = pair(affine)
    x, y = pixels()
    hidden = (abs(x - 120) < 35) & (abs(y - 100) < 35)
    current = np.where(hidden, pattern(x, y, seed=3), current)
    result = match(reference, current, CorrelationSettings(radius=10, step=6))
    truth = np.stack(affine(*result.xy.T), axis=1)
    to = result.xy + truth
    behind = (abs(to[:, 0] - 120) < 24) & (abs(to[:, 1] - 100) < 24)
    clear = (abs(to[:, 0] - 120) > 48) | (abs(to[:, 1] - 100) > 48)
    assert not result.good[behind].any()
    assert result.good[clear].all()
    assert np.isnan(result.uv[~result.good]).all()
    assert np.abs(result.uv - truth)[result.good].max() < 1.0


@pytest.mark.parametrize("shift", [(30.0, -24.0), (-11.0, 27.0)])
def test_large_motion_is_found_without_a_start_value(shift):
    reference, current = pair(lambda x, y: (shift[0] + 0.03 * (x - 110), shift[1] - 0.02 * (y - 110)))
    result = match(reference, 0.6 * current + 20, mask=inner(50))
    assert result.good.all()
    truth = np.stack([shift[0] + 0.03 * (result.xy[:, 0] - 110), shift[1] - 0.02 * (result.xy[:, 1] - 110)], axis=1)
    assert np.abs(result.uv - truth).max() < 1e-3


def test_few_seeds_reach_every_point():
    images = pair(affine)
    xy, _ = grid(inner(), 14)
    start = np.full((len(xy), 6), np.nan)
    start[0] = [*(np.array(affine(*xy[0])) + 0.5), 0.0, 0.0, 0.0, 0.0]
    result = match(*images, start=start)
    assert result.good.all()
    assert np.abs(result.uv - np.stack(affine(*xy.T), axis=1)).max() < 1e-3


def test_points_without_texture_or_outside_the_image_have_that_status():
    x, y = pixels()
    reference = np.where(x < 70, 100.0, pattern(x, y))
    current = np.where(x < 70, 100.0, pattern(x, y))
    xy = np.array([[30.0, 110.0], [120.0, 110.0], [134.0, 110.0]])
    start = np.zeros((3, 6))
    start[2, 0] = 80.0
    prepared = prepare_reference(reference, None, SETTINGS), prepare_current(current, None, SETTINGS)
    result = correlate_points(*prepared, xy[:2], SETTINGS, start=start[:2])
    assert list(result.status) == [Status.NO_TEXTURE, Status.GOOD]
    lone = correlate_points(*prepared, xy[2:], SETTINGS, start=start[2:])
    assert list(lone.status) == [Status.OUTSIDE]


def test_the_true_warp_wins_among_hypotheses():
    reference, current = pair(affine)
    prepared = prepare_reference(reference, None, SETTINGS), prepare_current(current, None, SETTINGS)
    xy, _ = grid(inner(), 14)
    shifts = np.arange(-20.0, 21.0, 1.0)
    warps = np.zeros((len(xy), len(shifts), 6))
    warps[:, :, :2] = np.stack(affine(*xy.T), axis=1)[:, None]
    warps[:, :, 0] += shifts
    warps[:, :, 2:] = [0.02, -0.03, 0.04, 0.01]
    best, zncc, second = search_warps(*prepared, xy, warps, 12)
    np.testing.assert_allclose(best[:, :2], np.stack(affine(*xy.T), axis=1))
    assert zncc.min() > 0.97
    assert second.max() < 0.8
    warps[:, :, 0] += 1000.0
    best, zncc, _ = search_warps(*prepared, xy, warps, 12)
    assert np.isnan(best).all()
    assert (zncc == -1).all()
