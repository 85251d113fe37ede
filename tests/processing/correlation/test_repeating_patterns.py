"""A pattern that repeats itself is named, since its matches can be wrong by its period; a random one never is."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import ringdic
from numpy.typing import NDArray
from ringdic.correlation import grid
from ringdic.correlation.repetition import Repetition, find_repetition
from ringdic.correlation.status import Status
from ringdic.session.images import read_gray, read_mask
from scipy.ndimage import gaussian_filter

SIDE = 500
ROWS, COLUMNS = (axis.astype(float) for axis in np.mgrid[:SIDE, :SIDE])


def photographed(grey: NDArray, noise: float = 1.5, seed: int = 0) -> NDArray[np.uint8]:
    """An image in 8 bits with noise of a standard deviation in grey levels."""
    return np.clip(np.rint(grey + np.random.default_rng(seed).normal(0, noise, grey.shape)), 0, 255).astype(np.uint8)


def speckle(size: float, seed: int = 0, side: int = SIDE) -> NDArray:
    """A random pattern of black and white whose patches are about five times ``size`` px wide."""
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=(side, side)), size, mode="wrap")
    return 120.0 + 70.0 * np.sign(smooth)


def dots(period: float, jitter: float, seed: int = 0) -> NDArray:
    """Equal dots on a grid, each moved at random by up to ``jitter`` periods in x and in y."""
    image, random = np.full((SIDE, SIDE), 220.0), np.random.default_rng(seed)
    for x in np.arange(-period, SIDE + period, period):
        for y in np.arange(-period, SIDE + period, period):
            at = np.rint(16 * (np.array([x, y]) + jitter * period * random.uniform(-1, 1, 2))).astype(int)
            cv2.circle(image, at.tolist(), int(16 * 0.28 * period), 30.0, -1, cv2.LINE_AA, 4)
    return gaussian_filter(image, 0.7)


def searched(image: NDArray, radius: int = 15) -> Repetition:
    return find_repetition(image, grid(np.ones(image.shape, bool), 10)[0], radius)


@pytest.mark.parametrize("period", [4.0, 6.5, 17.0, 24.0, 60.0, 130.0])
def test_a_grid_repeats_everywhere_at_its_period(period: float) -> None:
    wave = 2 * np.pi / period
    found = searched(photographed(120 + 70 * np.sign(np.sin(wave * COLUMNS) * np.sin(wave * ROWS))))
    assert found.share == 1.0
    assert found.ambiguous(np.array([[20.0, 30.0], [400.0, 250.0]])).all()
    # A grid of squares is like itself at half a period along both axes at once.
    at = found.period / (0.5 * period)
    np.testing.assert_allclose(at, np.rint(at), atol=0.1 + 1.0 / period)


@pytest.mark.parametrize("slant", [0.0, 0.7])
@pytest.mark.parametrize("period", [6.0, 24.0, 60.0])
def test_stripes_repeat_across(period: float, slant: float) -> None:
    assert (
        searched(photographed(120 + 70 * np.sign(np.sin(2 * np.pi * (COLUMNS + slant * ROWS) / period)))).share == 1.0
    )


def test_a_woven_textile_repeats_though_its_threads_are_not_straight() -> None:
    along = COLUMNS / 9 + 0.3 * np.sin(COLUMNS / 60)
    across = ROWS / 12 + 0.4 * np.sin(ROWS / 80 + COLUMNS / 100)
    woven = photographed(120 + 60 * np.sin(2 * np.pi * along) * np.sin(2 * np.pi * across), 4.0)
    assert searched(woven).share > 0.9


def test_noise_that_drowns_half_of_the_pattern_does_not_hide_that_it_repeats() -> None:
    wave = 2 * np.pi / 24.0
    assert searched(photographed(120 + 15 * np.sign(np.sin(wave * COLUMNS) * np.sin(wave * ROWS)), 12.0)).share > 0.9


def test_a_random_pattern_printed_in_equal_tiles_repeats_at_the_tile() -> None:
    found = searched(photographed(np.tile(speckle(2.0, side=150), (4, 4))[:SIDE, :SIDE]))
    assert found.share > 0.9
    np.testing.assert_allclose(np.abs(found.period) % 150.0, 0.0, atol=1.0)


@pytest.mark.parametrize("radius", [5, 10, 20, 40])
@pytest.mark.parametrize("size", [0.6, 1.0, 2.0, 4.0, 8.0, 12.0, 20.0])
def test_a_random_pattern_never_repeats_be_it_as_coarse_as_it_may(size: float, radius: int) -> None:
    for seed in range(2):
        found = searched(photographed(speckle(size, seed)), radius)
        assert found.share == 0.0
        assert not found.ambiguous(np.array([[200.0, 200.0]])).any()


def test_light_that_falls_off_hairs_and_edges_do_not_repeat() -> None:
    pattern = speckle(2.0) * (0.2 + 0.8 * COLUMNS / SIDE)
    for k in range(12):
        cv2.line(pattern, (40 * k, 0), (40 * k + 90 - 13 * k, SIDE), 20.0, 2, cv2.LINE_AA)
    pattern[:, :90], pattern[:, 400:] = 4.0, 250.0
    assert searched(photographed(pattern)).share == 0.0


def test_what_lies_outside_the_region_does_not_count() -> None:
    wave = 2 * np.pi / 20.0
    image = np.where(COLUMNS < 250, speckle(2.0), 120 + 70 * np.sign(np.sin(wave * COLUMNS) * np.sin(wave * ROWS)))
    region = COLUMNS < 240
    xy = grid(np.ones(image.shape, bool), 10)[0]
    assert find_repetition(photographed(image), xy[xy[:, 0] < 240], 15, region).share == 0.0
    whole = find_repetition(photographed(image), xy, 15)
    assert whole.share == pytest.approx(0.5, abs=0.1)
    ambiguous = whole.ambiguous(xy)
    assert ambiguous[xy[:, 0] > 300].all()
    assert not ambiguous[xy[:, 0] < 200].any()


def test_places_without_any_pattern_are_no_likeness(monkeypatch: pytest.MonkeyPatch) -> None:
    """The correlation with an empty window is a quotient of rounding errors, which may be anything up to 1."""
    computed = cv2.matchTemplate

    def unlucky(image: NDArray, window: NDArray, method: int) -> NDArray:
        values = computed(image, window, method)
        half = len(window) // 2
        empty = cv2.blur(image * image, window.shape) < 1e-6
        values[empty[half:-half, half:-half]] = 1.0
        return values

    region = (COLUMNS - 100) ** 2 + (ROWS - 100) ** 2 < 90**2
    xy = grid(region, 10)[0]
    image = photographed(speckle(2.0))
    assert find_repetition(image, xy, 15, region).share == 0.0
    monkeypatch.setattr(cv2, "matchTemplate", unlucky)
    assert find_repetition(image, xy, 15, region).share == 0.0


@pytest.mark.parametrize(
    ("period", "jitter", "radius"), [(12.0, 0.1, 10), (12.0, 0.2, 10), (12.0, 0.3, 10), (24.0, 0.15, 20)]
)
def test_dots_moved_from_a_grid_repeat_where_matches_are_wrong(period: float, jitter: float, radius: int) -> None:
    """Whenever one in a hundred kept matches is wrong by more than 1 px, the finding is there."""
    pattern = dots(period, jitter)
    for times in (0.6, 1.25, 2.5):
        shift = round(times * period)
        images = (
            photographed(pattern[100:400, 100:400], 1.0),
            photographed(pattern[100 - shift // 2 : 400 - shift // 2, 100 - shift : 400 - shift], 1.0, 1),
        )
        matches = ringdic.correlate(*images, radius=radius, accept=["repeating-pattern"], progress=False)
        off = np.linalg.norm(matches.displacement - (shift, shift // 2), axis=1)[matches.good]
        assert np.mean(off > 1.0) < 0.01 or matches.findings


def test_dots_at_random_enough_places_do_not_repeat() -> None:
    for period in (10.0, 30.0):
        for seed in range(2):
            assert searched(photographed(dots(period, 0.4, seed))).share == 0.0


def test_ambiguous_matches_are_lost_unless_the_finding_is_accepted(shared_cases: Path) -> None:
    """A grid of 24 px that moved by 30 px: its matches are wrong by whole periods."""
    paths = [shared_cases / "periodic_pattern" / f"periodic_{which}.png" for which in ("ref", "cur")]
    matches = ringdic.correlate(*paths, step=20, progress=False)
    assert [finding.code for finding in matches.findings] == ["repeating-pattern"]
    assert matches.verdict == "do not use"
    assert not matches.good.any()
    assert (matches.status == Status.AMBIGUOUS).sum() > 200
    assert np.isnan(matches.displacement).all()
    kept = ringdic.correlate(*paths, step=20, accept=["repeating-pattern"], progress=False)
    assert kept.verdict == "look at this"
    assert kept.good.sum() == (matches.status == Status.AMBIGUOUS).sum()


def test_real_patterns_do_not_repeat(shared_data: Path) -> None:
    """Printed squares moved from a grid, sprayed dots, and ribs that a chemical reaction would draw."""
    speckled = shared_data / "multidic_rig"
    image = read_gray(speckled / "speckle" / "201_1.jpg")
    mask = read_mask(speckled / "roi_mask.png", image.shape)
    for radius in (10, 21, 30):
        assert find_repetition(image, grid(mask, 12)[0], radius, mask).share == 0.0
    assert searched(read_gray(shared_data / "dic_challenge/2d_static_noise_floor/cam0_00.png")).share == 0.0
    assert searched(read_gray(shared_data / "dic_challenge/stereo_rigid_plate_rendered/cam0_50.png")).share == 0.0
