"""A camera followed on a grid of its own, and what that says of places between the grid's points."""

import numpy as np
import pytest
from ringdic.charts.tracking import CameraMatches, interpolate_matches
from ringdic.correlation import CorrelationSettings, Status, prepare_reference
from ringdic.correlation.lattice_field import interpolate_lattice
from ringdic.pairs.tracking import camera_grid, match_camera

STEP = 10
RNG = np.random.default_rng(3)


def lattice(width: int = 120, height: int = 90) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(0, width, STEP), np.arange(0, height, STEP)), -1).reshape(-1, 2)


def field(xy: np.ndarray, bent: float = 1.0) -> np.ndarray:
    """u v ux uy vx vy (n, 6) of a quadratic field, or where ``bent`` is 0 of an affine one, and a linear number."""
    x, y = xy.T.astype(float)
    a, b, c = 3e-4 * bent, -2e-4 * bent, 5e-4 * bent
    u, v = 5.0 + 0.02 * x - 0.01 * y + a * x * x + b * x * y, -3.0 + 0.03 * y + c * y * y
    slopes = [0.02 + 2 * a * x + b * y, -0.01 + b * x, np.zeros_like(x), 0.03 + 2 * c * y]
    return np.column_stack([u, v, *slopes, 0.1 * x + 0.2 * y])


def test_between_four_corners_a_quadratic_field_is_met_exactly() -> None:
    points = RNG.uniform(0, [110, 80], (200, 2))
    interpolated, weight = interpolate_lattice(lattice(), field(lattice()), STEP, points)
    np.testing.assert_allclose(interpolated, field(points), atol=1e-12)
    np.testing.assert_allclose(weight, 1.0)


def test_without_a_corner_an_affine_field_is_met_and_at_a_corner_its_own_value() -> None:
    known = lattice()[RNG.permutation(len(lattice()))[:60]]
    points = RNG.uniform(-5, [125, 95], (400, 2))
    interpolated, weight = interpolate_lattice(known, field(known, 0.0), STEP, points)
    inside = weight > 0
    assert 0.2 < inside.mean() < 1.0
    np.testing.assert_allclose(interpolated[inside, :6], field(points[inside], 0.0)[:, :6], atol=1e-12)
    assert np.isnan(interpolated[~inside]).all()
    own, weight = interpolate_lattice(known, field(known), STEP, known.astype(float))
    np.testing.assert_array_equal(own, field(known))
    np.testing.assert_array_equal(weight, 1.0)


def test_a_place_is_lost_with_the_points_about_it_and_says_why() -> None:
    xy = lattice().astype(np.int32)
    lost = (np.abs(xy - (50, 40)) <= STEP).all(axis=1)
    values = field(xy)
    values[lost] = np.nan
    zeros = np.zeros((len(xy), 2), np.float32)
    matches = CameraMatches(
        xy, STEP, values[:, :2], values[:, 2:6].reshape(-1, 2, 2).astype(np.float32), zeros, zeros[:, 0],
        np.where(lost, Status.NO_CONVERGENCE, Status.GOOD).astype(np.int8),
    )  # fmt: skip
    at = np.array([[52.0, 41.0], [25.0, 43.0], [63.0, 40.0], [np.nan, 1.0], [500.0, 500.0]])
    seen = interpolate_matches(matches, at)
    assert seen.status.tolist() == [Status.NO_CONVERGENCE, 0, 0, Status.NOT_REACHED, Status.NOT_REACHED]
    np.testing.assert_array_equal(np.isfinite(seen.px).all(axis=1), seen.status == 0)
    # All four corners about the second place; beside the hole the two that are left go on as straight lines.
    np.testing.assert_allclose(seen.px[1] - at[1], field(at[1:2])[0, :2], atol=1e-5)
    np.testing.assert_allclose(seen.px[2] - at[2], field(at[2:3])[0, :2], atol=0.05)


def test_the_grid_covers_what_both_pairs_see_and_no_more() -> None:
    mask = np.zeros((200, 300), bool)
    mask[50:150, 20:120] = True
    own = np.array([[30.0, 60.0], [110.0, 140.0]])
    corners = np.array([[100.3, 55.2], [190.7, 58.1], [188.2, 140.4], [np.nan, np.nan]])
    grid = camera_grid((300, 200), STEP, [(mask, own)], [(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))])
    assert grid.region[100, 60]
    assert grid.region[70, 170], "inside the triangle of the second camera's places"
    assert not grid.region[130, 130], "beyond its longest edge"
    assert not grid.region[100, 250]
    points = {tuple(point) for point in grid.xy.astype(int)}
    assert {(30, 60), (110, 140)} <= points
    assert (60, 100) not in points, "nobody asked for it"
    assert {(190, 60)} <= points, "a corner of the cell about a place"
    assert all(grid.region[y, x] for x, y in points)


def motion(xy: np.ndarray) -> np.ndarray:
    x, y = (xy - 120.0).T
    return np.stack([2.3 + 0.02 * x + 2e-5 * x * y, -1.6 + 0.01 * y - 3e-5 * x * x], axis=-1)


def waves(xy: np.ndarray) -> np.ndarray:
    """A pattern known everywhere: many waves of 7 to 20 px."""
    rng = np.random.default_rng(8)
    length, towards, phase = rng.uniform(7, 20, 90), rng.uniform(0, np.pi, 90), rng.uniform(0, 2 * np.pi, 90)
    k = 2 * np.pi / length * np.stack([np.cos(towards), np.sin(towards)])
    return 128 + 5 * np.cos(xy @ k + phase).sum(axis=-1)


@pytest.mark.parametrize("order", [1, 2])
def test_places_between_the_points_are_found_as_well_as_the_points(order: int) -> None:
    pixels = np.stack(np.meshgrid(np.arange(260.0), np.arange(240.0)), axis=-1)
    noise = np.random.default_rng(1).normal(0, 1.0, (2, 240, 260))
    moved = pixels + motion(pixels.reshape(-1, 2)).reshape(pixels.shape)
    reference, current = (np.clip(waves(at), 0, 255) + n for at, n in zip((moved, pixels), noise, strict=True))
    settings = CorrelationSettings(radius=15, step=STEP, order=order)
    region = np.zeros(reference.shape, bool)
    region[30:-30, 30:-30] = True
    column, row = np.nonzero(region[::STEP, ::STEP].T)
    own = STEP * np.stack([column, row], axis=1).astype(float)
    grid = camera_grid((260, 240), STEP, [(region, own)], [])
    np.testing.assert_array_equal(grid.xy, own)
    matches = match_camera(prepare_reference(reference, grid.region, settings), current, grid, settings)
    at = RNG.uniform(40, [220, 200], (500, 2))
    on, off = interpolate_matches(matches, grid.xy), interpolate_matches(matches, at)
    assert (off.status == 0).all()
    errors = [np.sqrt(np.mean((seen.px - xy - motion(xy)) ** 2)) for seen, xy in ((on, grid.xy), (off, at))]
    assert errors[1] < 1.1 * errors[0]
    assert errors[0] < 3 * np.sqrt(np.mean(matches.sigma**2))
    np.testing.assert_array_equal(on.px, grid.xy + matches.uv)
