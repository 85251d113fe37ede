"""The noise of images whose noise was put in."""

import numpy as np
import pytest
from ringdic.uncertainty.noise import camera_noise, flat_noise, rest_noise
from ringdic.uncertainty.texture import Texture, texture_map


def blots(noise: float, seed: int = 0, size: int = 400) -> np.ndarray:
    """Dark round blots of 14 px on a bright ground with soft edges, and white noise."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:size, :size].astype(float)
    image = np.full((size, size), 210.0)
    for cx, cy in rng.uniform(0, size, (250, 2)):
        image -= 70.0 * (1.0 - np.tanh(np.hypot(x - cx, y - cy) - 7.0))
    return np.clip(image, 60.0, 210.0) + np.random.default_rng([seed, 1]).normal(0.0, noise, image.shape)


@pytest.mark.parametrize("noise", [1.0, 2.0, 5.0])
def test_the_noise_of_a_speckled_image_is_found_between_its_edges(noise: float) -> None:
    grey = np.rint(blots(noise)).astype(np.uint8)
    # Rounding adds 1/12; the share of curved places among the flattest fifth may add a little.
    assert np.sqrt(flat_noise(grey)) == pytest.approx(np.sqrt(noise**2 + 1 / 12), rel=0.08)


def test_white_noise_alone_is_measured_as_it_is() -> None:
    grey = np.random.default_rng(0).normal(128.0, 5.0, (400, 400))
    assert np.sqrt(flat_noise(grey)) == pytest.approx(5.0, rel=0.02)  # 32,000 pixels


def test_an_image_without_noise_still_has_the_rounding() -> None:
    assert flat_noise(np.full((64, 64), 100, np.uint8)) == pytest.approx(1 / 12)


def test_a_scene_at_rest_gives_its_noise_whatever_its_pattern() -> None:
    pattern = np.random.default_rng(3).uniform(20.0, 230.0, (200, 200))  # nothing is flat
    images = [pattern + np.random.default_rng([4, k]).normal(0.0, 1.5, pattern.shape) for k in range(4)]
    assert np.sqrt(rest_noise(images)) == pytest.approx(1.5, rel=0.015)  # 120,000 degrees of freedom
    assert flat_noise(images[0]) > rest_noise(images)


def test_a_camera_is_no_noisier_than_its_matches_in_time_show_and_not_much_quieter() -> None:
    contrast = np.full(50, 40.0)
    shown = 1.85 * 4.0 / contrast**2  # of a variance of 4, the interpolation letting 0.85 of the second image's through
    c_ls = np.stack([np.full(50, 9.0 * shown), np.full(50, shown), np.full(50, np.nan)])
    assert camera_noise(100.0, c_ls, contrast) == pytest.approx(4.0)
    assert 3.0 < camera_noise(3.0, c_ls, contrast) < 4.0
    assert 0.55 * 4.0 < camera_noise(0.1, c_ls, contrast) < 4.0
    assert camera_noise(3.0, c_ls[2:], contrast) == 3.0  # nothing to judge by


def test_noise_needs_something_to_look_at() -> None:
    with pytest.raises(ValueError, match="two images"):
        rest_noise([np.zeros((20, 20))])
    with pytest.raises(ValueError, match="16 x 16"):
        flat_noise(np.zeros((8, 40)))


def test_the_texture_of_a_wave_is_that_of_its_formula() -> None:
    y, x = np.mgrid[:200, :200].astype(float)
    a, b = 2 * np.pi / 12.0, 2 * np.pi / 18.0
    image = 128.0 + 30.0 * np.sin(a * x) + 20.0 * np.sin(b * y)
    found = texture_map(image, radius=20).at(np.array([[100.0, 90.0], [100.3, 89.8], [-3.0, 50.0], [np.nan, 1.0]]))
    # Over 37 px the squares of the waves are not quite averaged: sin(37 a)/(37 a) and the like.
    np.testing.assert_allclose(found.contrast[:2], np.sqrt((30.0**2 + 20.0**2) / 2), rtol=0.05)
    np.testing.assert_allclose(found.slopes[:2, [0, 2]], [[(30 * a) ** 2 / 2, (20 * b) ** 2 / 2]] * 2, rtol=0.1)
    np.testing.assert_allclose(found.inverse_diagonal(0.0)[:2], [[2 / (30 * a) ** 2, 2 / (20 * b) ** 2]] * 2, rtol=0.1)
    # Mean of (A cos² + B cos²)² by that of A cos² + B cos² squared, with ⟨cos⁴⟩ = 3/8.
    A, B = (30 * a) ** 2, (20 * b) ** 2
    expected = (3 / 8 * (A**2 + B**2) + A * B / 2) / (A / 2 + B / 2) ** 2
    np.testing.assert_allclose(found.peakedness[:2], expected, rtol=0.1)
    assert np.isnan(found.contrast[2:]).all()
    assert np.isnan(found.inverse_diagonal(0.0)[2:]).all()
    np.testing.assert_array_equal(found.slopes[0], found.slopes[1])  # the nearest place of the map


def test_the_slopes_of_the_noise_are_taken_off() -> None:
    y, x = np.mgrid[:300, :300].astype(float)
    image = 128.0 + 10.0 * np.sin(x / 3.0) + 10.0 * np.sin(y / 4.0)
    at = np.array([[150.0, 150.0]])
    noisy = texture_map(image + np.random.default_rng(0).normal(0.0, 3.0, image.shape), radius=130).at(at)
    clean = texture_map(image, radius=130).at(at)
    np.testing.assert_allclose(noisy.clean_slopes(9.0), clean.clean_slopes(0.0), rtol=0.06)  # 13,000 pixels: 0.02
    assert (noisy.clean_slopes(0.0) > 1.5 * clean.clean_slopes(0.0)).all()


def test_a_pattern_of_one_direction_does_not_tell_where_it_is() -> None:
    _, x = np.mgrid[:100, :100].astype(float)
    found = texture_map(100.0 + 30.0 * np.sin(x), radius=10).at(np.array([[50.0, 50.0]]))
    assert np.isnan(found.inverse_diagonal(0.0)).all()


def test_textures_of_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="a contrast"):
        Texture(np.zeros(3), np.zeros((4, 3)), np.zeros(3))
