"""Standard deviations levelled over an image."""

import numpy as np
from ringdic.charts.weights import smooth_sigma


def test_what_scatters_from_point_to_point_is_levelled_and_what_is_smooth_is_kept() -> None:
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(0.0, 800.0, 10.0), np.arange(0.0, 600.0, 10.0))
    px = np.stack([x.ravel(), y.ravel()], axis=-1)
    true = np.column_stack([0.004 + 6e-6 * px[:, 0], np.full(len(px), 0.005)])
    smooth = smooth_sigma(px, true * rng.lognormal(0.0, 0.1, true.shape), 80.0)
    inner = (px > 100).all(axis=1) & (px < (700, 500)).all(axis=1)
    # Medians of 64 points over some eight squares: 10 % · 1.25 / √500 = 0.6 %.
    assert np.std(smooth[inner] / true[inner]) < 0.01
    np.testing.assert_allclose(smooth[inner], true[inner], rtol=0.04)
    # From one point to the next it changes less than what it is made of by far.
    field = smooth[:, 1].reshape(x.shape)
    assert np.abs(np.diff(field, axis=1)).max() < 0.003 * 0.005


def test_one_wild_value_and_lost_points_do_no_harm() -> None:
    px = np.random.default_rng(1).uniform(0.0, 300.0, (2000, 2))
    sigma = np.full((2000, 2), 0.005)
    sigma[10], sigma[20] = 0.5, np.nan
    smooth = smooth_sigma(px, sigma, 80.0)
    assert np.isnan(smooth[20]).all()
    np.testing.assert_allclose(np.delete(smooth, 20, axis=0), 0.005, rtol=1e-9)
    assert np.isnan(smooth_sigma(px, np.full((2000, 2), np.nan), 80.0)).all()
    np.testing.assert_allclose(smooth_sigma(px[:1], sigma[:1], 80.0), 0.005)
