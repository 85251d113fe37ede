"""Start values interpolated between the matches of a lattice."""

import numpy as np
from ringdic.correlation import CorrelationSettings, PointMatches
from ringdic.correlation.start_field import interpolate_start_values, lattice_spacing, on_lattice

SPACING = 40


def quadratic_field(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement (n, 2), gradient (n, 2, 2) and second derivatives (n, 2, 3) of a quadratic field."""
    x, y = xy.T
    a = np.array([[3.0, 0.02, -0.05, 4e-5, -3e-5, 2e-5], [-7.0, 0.04, 0.01, -1e-5, 5e-5, 6e-5]])
    uv = np.stack([c[0] + c[1] * x + c[2] * y + c[3] * x * x + c[4] * x * y + c[5] * y * y for c in a], 1)
    slope = np.stack([np.stack([c[1] + 2 * c[3] * x + c[4] * y, c[2] + c[4] * x + 2 * c[5] * y], 1) for c in a], 1)
    bend = np.stack([np.tile([2 * c[3], c[4], 2 * c[5]], (len(xy), 1)) for c in a], 1)
    return uv, slope, bend


def correlation_of(xy: np.ndarray, lost: np.ndarray) -> PointMatches:
    """Correlation of points (n, 2) that moved by the quadratic field; lost : (n,), 1 for points without a match."""
    uv, slope, bend = quadratic_field(xy)
    n = len(xy)
    return PointMatches(xy, uv, slope, bend, np.ones(n), np.zeros(n), np.ones(n, int), 2 * lost, np.zeros((n, 2)), {})


def grid(step: int) -> np.ndarray:
    """Points (n, 2) px of a grid."""
    return np.stack(np.meshgrid(np.arange(120, 480, step), np.arange(200, 680, step)), -1).reshape(-1, 2).astype(float)


def test_a_quadratic_field_is_interpolated_exactly() -> None:
    xy, coarse = grid(10), grid(SPACING)
    coarse = coarse[on_lattice(coarse, SPACING)]
    for order in (1, 2):
        start = interpolate_start_values(correlation_of(coarse, np.zeros(len(coarse), int)), xy, SPACING, order)
        uv, slope, bend = quadratic_field(xy)
        known = np.isfinite(start).all(axis=1)
        inside = (xy <= coarse.max(axis=0)).all(axis=1)
        np.testing.assert_array_equal(known, inside)
        np.testing.assert_allclose(start[known, :2], uv[known], atol=1e-11)
        np.testing.assert_allclose(start[known, 2:6], slope.reshape(-1, 4)[known], atol=1e-13)
        if order == 2:
            np.testing.assert_allclose(start[known, 6:], bend.reshape(-1, 6)[known], atol=1e-15)


def test_around_a_lost_lattice_point_there_is_no_start_value() -> None:
    xy, coarse = grid(10), grid(SPACING)
    lost = (coarse == (240, 320)).all(axis=1).astype(int)
    assert lost.sum() == 1
    start = interpolate_start_values(correlation_of(coarse, lost), xy, SPACING, 1)
    beside = (np.abs(xy - (240, 320)) < SPACING).all(axis=1)
    assert np.isnan(start[beside]).all()
    inside = (xy <= coarse.max(axis=0)).all(axis=1)
    assert np.isfinite(start[inside & ~beside]).all()


def test_the_lattice_is_a_multiple_of_the_step() -> None:
    for radius, step in ((20, 10), (20, 7), (12, 8), (5, 30)):
        spacing = lattice_spacing(CorrelationSettings(radius, step))
        assert spacing % step == 0
        assert spacing >= step
