"""Points followed through images whose warp is a formula: sums of sine waves, no interpolation anywhere."""

import numpy as np
import pytest
from ringdic.correlation import CorrelationSettings, Status
from ringdic.errors import InputError
from ringdic.multiview.tracking import CameraTrack, Tracking, TrackState, at_reference, track_block

SIZE = 260
SETTINGS = CorrelationSettings(radius=12, step=10)


def pattern(x, y, seed=0, waves=100):
    """Grey levels at positions x, y: band-limited (periods from 5 px), about 128 ± 40."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.broadcast(x, y).shape)
    for _ in range(waves):
        k = rng.uniform(0.15, 2 * np.pi / 5)
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        total += np.cos(k * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return 128.0 + 40.0 * total / np.sqrt(waves / 2)


def pixels():
    return np.meshgrid(np.arange(SIZE, dtype=float), np.arange(SIZE, dtype=float))


def points(seed=5):
    """Positions between the pixels, about 10 px apart."""
    x, y = np.meshgrid(np.arange(45.0, SIZE - 45, 10.0), np.arange(45.0, SIZE - 45, 10.0))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    return xy + np.random.default_rng(seed).uniform(-0.5, 0.5, xy.shape)


def series(displacements, patterns=None):
    """The images of a series, step 0 being where ``pattern`` is as it is.

    displacements : for each step, the displacement (u, v) that leads BACK from (x, y) of that step to the reference.
    """
    x, y = pixels()
    images = []
    for k, back in enumerate(displacements):
        u, v = back(x, y)
        images.append((patterns[k] if patterns else pattern)(x + u, y + v))
    return images


def back_of(centre, u0, v0, bend):
    """A motion of u0, v0 with second derivatives of size ``bend``; its way back, and the truth by Newton's method."""

    def back(x, y):
        a, b = x - centre, y - centre
        return -u0 + bend * (a * a - 0.5 * a * b) + 0.01 * a, -v0 + bend * (0.7 * b * b - a * a) - 0.008 * b

    return back


def forward(back, xy):
    """Where the points xy (n, 2) of the reference are, by fixed-point iteration on the way back."""
    at = xy.copy()
    for _ in range(200):
        at = xy - np.stack(back(at[:, 0], at[:, 1]), axis=1)
    return at


def rest(x, y):
    return np.zeros_like(x), np.zeros_like(y)


@pytest.fixture
def track_all(track_camera):
    def track(images, x0, options=None) -> CameraTrack:
        return track_camera(images, x0, SETTINGS, options)

    return track


def errors(result, step, truth):
    return np.hypot(*(result.px[step] - truth).T)


def test_a_bending_field_is_followed_exactly_by_two_passes_and_not_by_one(track_all):
    back = back_of(SIZE / 2, 3.4, -2.3, 3e-4)
    images, x0 = series([rest, back]), points()
    truth = forward(back, x0)
    two = track_all(images, x0)
    one = track_all(images, x0, options=Tracking(two_pass=False))
    assert (two.status == Status.GOOD).all()
    assert (one.status == Status.GOOD).all()
    inner = (np.abs(x0 - SIZE / 2) < 60).all(axis=1)  # whole neighbourhoods
    assert np.median(errors(one, 1, truth)[inner]) > 5e-3
    assert np.median(errors(two, 1, truth)[inner]) < 1e-3  # the field's third derivatives are left


def test_the_reference_is_the_points_themselves(track_all):
    x0 = points()
    x0[3], x0[4] = np.nan, (-4.0, 50.0)
    result = track_all(series([rest, rest]), x0)
    expected = x0.copy()
    expected[4] = np.nan
    np.testing.assert_array_equal(result.px[0], expected)
    np.testing.assert_array_equal(result.status[0, [0, 3, 4]], [Status.GOOD, Status.NOT_REACHED, Status.OUTSIDE])
    inside = np.delete(np.arange(len(x0)), [3, 4])
    assert (result.sigma[0, inside] == 0).all()
    assert np.isnan(result.px[1, [3, 4]]).all()
    assert np.abs(result.px[1, inside] - x0[inside]).max() < 1e-4  # nothing moved, between the pixels either


def test_motions_of_tens_of_pixels_between_steps_are_followed(track_all):
    ways = [rest, back_of(SIZE / 2, 9.0, 4.0, 0.0), back_of(SIZE / 2, 31.0, -14.0, 0.0)]
    images, x0 = series(ways), points()
    result = track_all(images, x0)
    for step in (1, 2):
        truth = forward(ways[step], x0)
        stays = (np.abs(truth - SIZE / 2) < SIZE / 2 - 16).all(axis=1)
        assert (result.status[step, stays] == Status.GOOD).all()
        assert errors(result, step, truth)[stays].max() < 2e-3


def worn(steps):
    """The pattern after so many steps, in each of which a part of it gives way to a new one: ZNCC 0.84 each."""

    def mixed(x, y):
        grey = pattern(x, y) - 128.0
        for k in range(1, steps + 1):
            grey = 0.84 * grey + 0.543 * (pattern(x, y, seed=k) - 128.0)
        return 128.0 + grey

    return mixed


def test_where_the_surface_has_changed_the_last_image_takes_the_references_place(track_all):
    ways = [rest, *(back_of(SIZE / 2, 2.0 * k, -1.0 * k, 0.0) for k in (1, 2, 3))]
    images, x0 = series(ways, [worn(k) for k in range(4)]), points()  # ZNCC with the reference to 0.84³ = 0.59
    x0 = x0[(np.abs(x0 - SIZE / 2) < 50).all(axis=1)]
    alone = track_all(images, x0, options=Tracking(update_reference=False))
    result = track_all(images, x0)
    assert (alone.status[3] == Status.GOOD).mean() < 0.3
    assert (result.status[1:] == Status.GOOD).mean() > 0.97
    assert not result.updated[1].any()
    assert result.updated[3].mean() > 0.5
    scatter = [np.sqrt(np.nanmean(errors(result, k, forward(ways[k], x0)) ** 2)) for k in (1, 2, 3)]
    # Each image adds a change of its own: errors add up like the steps of a random walk, or less. Subsets overlap: the
    # hundred points are some ten independent ones, so a ratio of scatters is known to about a fifth.
    assert (np.array(scatter) < 1.4 * scatter[0] * np.sqrt([1, 2, 3])).all()
    came = result.updated[3] & result.updated[2]
    assert (result.sigma[3, came] > result.sigma[2, came]).all()  # variances add up
    assert (result.c_ls[3, came] >= result.c_ls[2, came]).all()


def test_what_is_covered_for_a_while_is_lost_and_found_again(track_all):
    ways = [rest, *(back_of(SIZE / 2, 1.3 * k, 0.7 * k, 0.0) for k in (1, 2))]
    images, x0 = series(ways), points()
    images[1][100:150, 90:160] = 128.0 + 0.5 * (pattern(*pixels(), seed=9)[100:150, 90:160] - 128.0)
    result = track_all(images, x0)
    truth = forward(ways[1], x0)
    covered = (truth[:, 0] > 92) & (truth[:, 0] < 157) & (truth[:, 1] > 102) & (truth[:, 1] < 147)
    clear = (np.hypot(*np.maximum(np.abs(truth - (124.5, 124.5)) - (35.0, 25.0), 0).T)) > 13
    assert covered.sum() > 15
    assert (result.status[1, covered] != Status.GOOD).all()
    assert (result.status[1, clear] == Status.GOOD).all()
    good = result.status[1] == Status.GOOD
    assert errors(result, 1, truth)[good].max() < 0.05  # a subset that overlaps by a row or two may pass
    assert (result.status[2] == Status.GOOD).all()
    assert not result.updated[2].any()
    assert errors(result, 2, forward(ways[2], x0)).max() < 1e-3


def test_a_step_without_an_image_loses_that_step_alone(track_all):
    ways = [rest, rest, back_of(SIZE / 2, 1.5, 0.5, 0.0)]
    images, x0 = series(ways), points()
    images[1] = None
    result = track_all(images, x0)
    assert np.isnan(result.px[1]).all()
    assert (result.status[1] == Status.NOT_REACHED).all()
    assert errors(result, 2, forward(ways[2], x0)).max() < 1e-3


def test_images_of_two_sizes_are_refused_with_the_step(track_all):
    images = series([rest, rest])
    images[1] = images[1][:-4]
    with pytest.raises(InputError, match=r"step 1: the image is 260 x 256 px .* 260 x 260 px"):
        track_all(images, points())


def test_a_camera_that_sees_no_point_gives_none(track_all):
    result = track_all(series([rest, rest]), np.full((3, 2), np.nan))
    assert result.px.shape == (2, 3, 2)
    assert np.isnan(result.px).all()


def test_options_that_contradict_are_refused():
    with pytest.raises(InputError, match="one pass"):
        Tracking(order=2)
    with pytest.raises(InputError, match="window"):
        Tracking(window=0.0)


def test_blocks_of_steps_continue_as_one_series(track_all):
    ways = [rest, *(back_of(SIZE / 2, 1.2 * k, -0.8 * k, 2e-5 * k) for k in (1, 2, 3))]
    images, x0 = series(ways), points()
    images[2][100:150, 90:160] = 128.0 + 0.5 * (pattern(*pixels(), seed=9)[100:150, 90:160] - 128.0)
    whole = track_all(images, x0)

    def block(steps, state=None):
        return track_block(images[0], lambda k: images[k], steps, x0, None, SETTINGS, state=state)

    first, state = block(range(1, 3))
    stored = TrackState(**{name: values.copy() for name, values in state.arrays().items()})  # as if from a file
    second, _ = block(range(3, 4), stored)
    joined = CameraTrack.joined([at_reference(x0, images[0].shape), first, second])
    for name, values in whole.arrays().items():
        np.testing.assert_array_equal(joined.arrays()[name], values, err_msg=name)
