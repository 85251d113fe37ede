"""A camera tracked on a grid of its own: what it shows, what lies between, what bends, moves far or is covered.

Images whose warp is a formula: sums of sine waves, no interpolation anywhere.
"""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from ringdic.charts.tracked_points import tracked_points
from ringdic.charts.tracking import (
    CameraMatches,
    CameraPixels,
    interpolate_matches,
    match_in_two_passes,
    surface_grid,
)
from ringdic.correlation import CorrelationSettings, Status, prepare_reference
from ringdic.correlation.lattice_field import interpolate_lattice

STEP = 10
SIZE = 260
SETTINGS = CorrelationSettings(radius=12, step=STEP)
RNG = np.random.default_rng(3)


def lattice(width: int = 120, height: int = 90) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(0, width, STEP), np.arange(0, height, STEP)), -1).reshape(-1, 2)


def field(xy: np.ndarray, bent: float = 1.0) -> np.ndarray:
    """The 12 numbers of a quadratic field, or where ``bent`` is 0 of an affine one, and a linear number, (n, 13)."""
    x, y = xy.T.astype(float)
    a, b, c = 3e-4 * bent, -2e-4 * bent, 5e-4 * bent
    u, v = 5.0 + 0.02 * x - 0.01 * y + a * x * x + b * x * y, -3.0 + 0.03 * y + c * y * y
    slopes = [0.02 + 2 * a * x + b * y, -0.01 + b * x, np.zeros_like(x), 0.03 + 2 * c * y]
    bends = [np.full_like(x, bend) for bend in (2 * a, b, 0.0, 0.0, 0.0, 2 * c)]
    return np.column_stack([u, v, *slopes, *bends, 0.1 * x + 0.2 * y])


def test_between_four_corners_a_quadratic_field_is_met_exactly() -> None:
    points = RNG.uniform(0, [110, 80], (200, 2))
    interpolated, weight = interpolate_lattice(lattice(), field(lattice()), STEP, points)
    np.testing.assert_allclose(interpolated, field(points), atol=1e-12)
    np.testing.assert_allclose(weight, 1.0)


def test_without_a_corner_a_quadratic_field_is_met_and_at_a_corner_its_own_value() -> None:
    known = lattice()[RNG.permutation(len(lattice()))[:60]]
    points = RNG.uniform(-5, [125, 95], (400, 2))
    interpolated, weight = interpolate_lattice(known, field(known), STEP, points)
    inside = weight > 0
    assert 0.2 < inside.mean() < 1.0
    np.testing.assert_allclose(interpolated[inside, :2], field(points[inside])[:, :2], atol=1e-12)
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
        xy, STEP, values[:, :2], values[:, 2:6].reshape(-1, 2, 2).astype(np.float32),
        values[:, 6:12].reshape(-1, 2, 3).astype(np.float32), zeros, zeros[:, 0],
        np.where(lost, Status.NO_CONVERGENCE, Status.GOOD).astype(np.int8),
    )  # fmt: skip
    at = np.array([[52.0, 41.0], [25.0, 43.0], [63.0, 40.0], [np.nan, 1.0], [500.0, 500.0]])
    seen = interpolate_matches(matches, at)
    assert seen.status.tolist() == [Status.NO_CONVERGENCE, 0, 0, Status.NOT_REACHED, Status.NOT_REACHED]
    np.testing.assert_array_equal(np.isfinite(seen.px).all(axis=1), seen.status == 0)
    # All four corners about the second place; beside the hole the two that are left go on with their curvature.
    np.testing.assert_allclose(seen.px[1:3] - at[1:3], field(at[1:3])[:, :2], atol=1e-5)


def test_the_grid_covers_what_the_charts_show_and_no_more() -> None:
    square = np.array([[20.0, 50.0], [119.0, 50.0], [119.0, 149.0], [20.0, 149.0]])
    corners = np.array([[100.3, 55.2], [190.7, 58.1], [188.2, 140.4], [np.nan, np.nan]])
    two = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    grid = surface_grid((300, 200), STEP, [(square, two), (corners, two)])
    assert grid.region[100, 60]
    assert grid.region[70, 170], "inside the triangle of the second chart's places"
    assert not grid.region[130, 150], "beyond its longest edge"
    assert not grid.region[100, 250]
    points = {tuple(point) for point in grid.xy.astype(int)}
    assert (20, 50) in points, "a place of a chart on the grid"
    assert (60, 100) not in points, "nobody asked for it"
    assert (190, 60) in points, "a corner of the cell about a place"
    assert all(grid.region[y, x] for x, y in points)
    assert (grid.xy % STEP == 0).all()


def test_places_outside_the_image_ask_for_no_points() -> None:
    around = np.array([[-30.0, -20.0], [400.0, -20.0], [400.0, 300.0], [100.4, 100.4]])
    grid = surface_grid((300, 200), STEP, [(around, np.array([[0, 1, 2]], np.int32))])
    assert {tuple(point) for point in grid.xy.astype(int)} <= {(100, 100), (110, 100), (100, 110), (110, 110)}


def motion(xy: np.ndarray) -> np.ndarray:
    x, y = (xy - 120.0).T
    return np.stack([2.3 + 0.02 * x + 2e-5 * x * y, -1.6 + 0.01 * y - 3e-5 * x * x], axis=-1)


def waves(xy: np.ndarray) -> np.ndarray:
    """A pattern known everywhere: many waves of 7 to 20 px."""
    rng = np.random.default_rng(8)
    length, towards, phase = rng.uniform(7, 20, 90), rng.uniform(0, np.pi, 90), rng.uniform(0, 2 * np.pi, 90)
    k = 2 * np.pi / length * np.stack([np.cos(towards), np.sin(towards)])
    return 128 + 5 * np.cos(xy @ k + phase).sum(axis=-1)


@pytest.mark.parametrize("curved", [False, True])
def test_places_between_the_points_are_found_as_well_as_the_points(curved: bool) -> None:
    pixels = np.stack(np.meshgrid(np.arange(260.0), np.arange(240.0)), axis=-1)
    noise = np.random.default_rng(1).normal(0, 1.0, (2, 240, 260))
    moved = pixels + motion(pixels.reshape(-1, 2)).reshape(pixels.shape)
    reference, current = (np.clip(waves(at), 0, 255) + n for at, n in zip((moved, pixels), noise, strict=True))
    settings = CorrelationSettings(radius=15, step=STEP)
    region = np.zeros(reference.shape, bool)
    region[30:-30, 30:-30] = True
    column, row = np.nonzero(region[::STEP, ::STEP].T)
    xy = STEP * np.stack([column, row], axis=1).astype(float)
    prepared = prepare_reference(reference, region, settings)
    points = tracked_points(prepared, xy, settings)
    matches = match_in_two_passes(prepared, current, points, settings, curved=curved)
    at = RNG.uniform(40, [220, 200], (500, 2))
    on, off = interpolate_matches(matches, xy), interpolate_matches(matches, at)
    assert (off.status == 0).all()
    errors = [np.sqrt(np.mean((seen.px - own - motion(own)) ** 2)) for seen, own in ((on, xy), (off, at))]
    assert errors[1] < 1.1 * errors[0]
    assert errors[0] < 3 * np.sqrt(np.mean(matches.sigma**2))
    np.testing.assert_array_equal(on.px, xy + matches.uv)


@pytest.mark.parametrize("stretch", [0.75, 1.35])
def test_the_stated_scatter_is_that_of_the_later_image_s_pixels(stretch: float) -> None:
    pixels = np.stack(np.meshgrid(np.arange(300.0), np.arange(300.0)), axis=-1)
    noise = np.random.default_rng(2).normal(0, 2.0, (2, 300, 300))
    back = (pixels - 150.0) / (stretch, 1.0) + 150.0
    reference, current = (waves(at) + n for at, n in zip((pixels, back), noise, strict=True))
    region = np.zeros(reference.shape, bool)
    region[50:-50, 50:-50] = True
    column, row = np.nonzero(region[::STEP, ::STEP].T)
    xy = STEP * np.stack([column, row], axis=1).astype(float)
    prepared = prepare_reference(reference, region, SETTINGS)
    matches = match_in_two_passes(prepared, current, tracked_points(prepared, xy, SETTINGS), SETTINGS)
    error = matches.uv - (xy - 150.0) * (stretch - 1.0, 0.0)
    ratio = np.sqrt(np.nanmean((error / matches.sigma) ** 2, axis=0))
    # 400 overlapping subsets tell each to about 7 %; in pixels of the reference they would differ by the stretch. Both
    # are larger where the later image has fewer pixels, and so fewer independent values.
    assert abs(ratio[0] / ratio[1] - 1.0) < 0.17
    np.testing.assert_allclose(ratio, np.sqrt(0.5 + 0.5 / min(stretch, 1.0)), atol=0.17)


Back = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def pattern(x: np.ndarray, y: np.ndarray, seed: int = 0, count: int = 100) -> np.ndarray:
    """Grey levels at positions x, y: band-limited (periods from 5 px), about 128 ± 40."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.broadcast(x, y).shape)
    for _ in range(count):
        k = rng.uniform(0.15, 2 * np.pi / 5)
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        total += np.cos(k * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return 128.0 + 40.0 * total / np.sqrt(count / 2)


def pixels() -> list[np.ndarray]:
    return np.meshgrid(np.arange(SIZE, dtype=float), np.arange(SIZE, dtype=float))


def points() -> np.ndarray:
    """Positions between the pixels, about 10 px apart."""
    x, y = np.meshgrid(np.arange(45.0, SIZE - 45, 10.0), np.arange(45.0, SIZE - 45, 10.0))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    return xy + np.random.default_rng(5).uniform(-0.5, 0.5, xy.shape)


def images_of(ways: Sequence[Back]) -> list[np.ndarray]:
    """The images of a series. ways : for each step, the displacement that leads back from it to the reference."""
    x, y = pixels()
    return [pattern(x + u, y + v) for u, v in (back(x, y) for back in ways)]


def way_back(u0: float, v0: float, bend: float = 0.0) -> Back:
    """The way back of a motion of u0, v0 with second derivatives of size ``bend``."""

    def back(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = x - SIZE / 2, y - SIZE / 2
        return -u0 + bend * (a * a - 0.5 * a * b) + 0.01 * a, -v0 + bend * (0.7 * b * b - a * a) - 0.008 * b

    return back


def forward(back: Back, xy: np.ndarray) -> np.ndarray:
    """Where the points xy (n, 2) of the reference are, by fixed-point iteration on the way back."""
    at = xy.copy()
    for _ in range(200):
        at = xy - np.stack(back(at[:, 0], at[:, 1]), axis=1)
    return at


def rest(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros_like(x), np.zeros_like(y)


def errors(seen: CameraPixels, truth: np.ndarray) -> np.ndarray:
    return np.hypot(*(seen.px - truth).T)


def test_a_bending_field_is_followed_exactly_with_curvature_and_not_without(track_camera: Callable) -> None:
    back = way_back(3.4, -2.3, 3e-4)
    images, x0 = images_of([rest, back]), points()
    truth = forward(back, x0)
    (curved,), (flat,) = (track_camera(images, x0, SETTINGS, curved=curved) for curved in (True, False))
    assert (curved.status == Status.GOOD).all()
    assert (flat.status == Status.GOOD).all()
    inner = (np.abs(x0 - SIZE / 2) < 60).all(axis=1)  # whole neighbourhoods
    assert np.median(errors(flat, truth)[inner]) > 5e-3
    assert np.median(errors(curved, truth)[inner]) < 1e-3  # the field's third derivatives are left


def test_what_has_not_moved_is_where_it_was_between_the_pixels_too(track_camera: Callable) -> None:
    x0 = points()
    (seen,) = track_camera(images_of([rest, rest]), x0, SETTINGS)
    assert (seen.status == Status.GOOD).all()
    assert errors(seen, x0).max() < 1e-4


def test_motions_of_tens_of_pixels_are_followed(track_camera: Callable) -> None:
    ways = [rest, way_back(9.0, 4.0), way_back(31.0, -14.0)]
    x0 = points()
    for back, seen in zip(ways[1:], track_camera(images_of(ways), x0, SETTINGS), strict=True):
        truth = forward(back, x0)
        stays = (np.abs(truth - SIZE / 2) < SIZE / 2 - 16).all(axis=1)
        assert (seen.status[stays] == Status.GOOD).all()
        assert errors(seen, truth)[stays].max() < 2e-3


def test_what_is_covered_is_lost_at_that_step_and_found_again_at_the_next(track_camera: Callable) -> None:
    ways = [rest, way_back(1.3, 0.7), way_back(2.6, 1.4)]
    images, x0 = images_of(ways), points()
    images[1][90:160, 80:170] = 128.0 + 0.5 * (pattern(*pixels(), seed=9)[90:160, 80:170] - 128.0)
    at_cover, after = track_camera(images, x0, SETTINGS)
    truth = forward(ways[1], x0)
    beyond = np.abs(truth - (124.5, 124.5)) - (45.0, 35.0)  # px beyond the cover's edges, negative within it
    covered = (beyond < -STEP / 2).all(axis=1)
    clear = np.hypot(*np.maximum(beyond, 0).T) > 13 + STEP * np.sqrt(2)  # the whole cell about a place
    assert covered.sum() > 40
    assert (at_cover.status[covered] != Status.GOOD).all()
    assert (at_cover.status[clear] == Status.GOOD).all()
    good = at_cover.status == Status.GOOD
    assert errors(at_cover, truth)[good].max() < 0.05  # a subset that overlaps by a row or two may pass
    assert (after.status == Status.GOOD).all()
    assert errors(after, forward(ways[2], x0)).max() < 1e-3
    (alone,) = track_camera([images[0], images[2]], x0, SETTINGS)
    np.testing.assert_array_equal(alone.px, after.px)  # a step owes nothing to those before it
