"""Local quadratics are exact on quadratic fields, and their scatter is the stated uncertainty."""

import numpy as np
import pytest
from ringdic.correlation.quadratic import Neighbourhoods

GRADIENT = np.array([[0.3, -0.2], [0.05, 0.4]])
CURVATURE = np.array([[4e-3, -1e-3, 2e-3], [-3e-3, 5e-4, 1e-3]])


def random_points(n=400, size=200.0, seed=3):
    """Points (n, 2) px, random in a square."""
    return np.random.default_rng(seed).uniform(0, size, (n, 2))


def quadratic_values(xy):
    """A quadratic field of two components at points (n, 2). (n, 2)."""
    x, y = xy[:, 0, None], xy[:, 1, None]
    p, q, r = CURVATURE.T
    return 1.5 + xy @ GRADIENT.T + 0.5 * p * x**2 + q * x * y + 0.5 * r * y**2


def test_a_quadratic_field_is_its_own_fit_at_every_point_and_at_lost_ones():
    xy = random_points()
    values = quadratic_values(xy)
    measured = values.copy()
    measured[::7] = np.nan
    fit = Neighbourhoods(xy, 40.0).fit(measured)
    known = np.isfinite(fit.value).all(axis=1)
    assert known.mean() > 0.95
    assert known[::7].any()
    p, q, r = CURVATURE.T
    x, y = xy[:, 0, None], xy[:, 1, None]
    slope = np.stack([GRADIENT[:, 0] + p * x + q * y, GRADIENT[:, 1] + q * x + r * y], axis=-1)
    np.testing.assert_allclose(fit.value[known], values[known], atol=1e-6)
    np.testing.assert_allclose(fit.gradient[known], slope[known], atol=1e-6)
    np.testing.assert_allclose(fit.curvature[known], np.broadcast_to(CURVATURE, (known.sum(), 2, 3)), atol=1e-7)
    assert np.nanmax(np.abs(fit.leave_one_out)) < 1e-5
    assert np.isnan(fit.leave_one_out[::7]).all()


def test_second_derivatives_scatter_by_their_stated_uncertainty():
    x, y = np.meshgrid(np.arange(0.0, 300.0, 10.0), np.arange(0.0, 300.0, 10.0))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    around = Neighbourhoods(xy, 35.0)
    rng = np.random.default_rng(0)
    sigma = 0.01
    curvatures, stated = [], None
    for _ in range(40):
        fit = around.fit(rng.normal(0.0, sigma, (len(xy), 2)), np.full(len(xy), sigma))
        curvatures.append(fit.curvature[:, 0])
        stated = fit.curvature_sigma
    ratio = np.std(curvatures, axis=0) / stated
    assert np.sqrt((ratio**2).mean(axis=0)) == pytest.approx(1.0, abs=0.02)  # 36,000 samples


def test_the_leave_one_out_residual_of_an_outlier_is_its_error():
    xy = random_points()
    values = quadratic_values(xy)
    values[50] += (0.4, -0.3)
    fit = Neighbourhoods(xy, 40.0).fit(values)
    np.testing.assert_allclose(fit.leave_one_out[50], (0.4, -0.3), atol=1e-6)


def test_points_on_a_line_have_a_large_uncertainty_across_it():
    xy = np.stack([np.arange(0.0, 60.0), np.zeros(60)], axis=1)
    fit = Neighbourhoods(xy, 20.0).fit(xy * 0.1, np.full(60, 0.01))
    assert (fit.curvature_sigma[:, 2] > 1e3 * fit.curvature_sigma[:, 0]).all()


def test_too_few_neighbours_give_nan():
    xy = random_points(8)
    assert np.isnan(Neighbourhoods(xy, 300.0).fit(quadratic_values(xy)).value).all()


def test_the_lower_quartile_about_a_point_is_that_of_the_known_points_within_reach():
    xy = np.concatenate([random_points(300), [[1e4, 1e4]]])
    values = np.random.default_rng(1).normal(size=301)
    values[::5] = np.nan
    quartiles = Neighbourhoods(xy, 40.0).lower_quartile(values)
    for centre, quartile in zip(xy[:-1], quartiles[:-1], strict=True):
        about = np.sort(values[(np.hypot(*(xy - centre).T) <= 40.0) & np.isfinite(values)])
        assert len(about) > 2
        assert quartile == about[len(about) // 4]
    assert np.isnan(quartiles[-1]), "alone, and itself unknown"


def test_a_quadratic_field_is_extrapolated_exactly():
    xy = random_points()
    fit = Neighbourhoods(xy, 40.0).fit(quadratic_values(xy))
    inner = np.flatnonzero(((xy > 30) & (xy < 170)).all(axis=1))
    away = np.random.default_rng(2).uniform(-12, 12, (len(inner), 2))
    np.testing.assert_allclose(fit.extrapolate(inner, away), quadratic_values(xy[inner] + away), atol=1e-5)
