"""Centroids of dark dots on white: without bias, in linear light, not affected by a gradient of the light."""

import cv2
import numpy as np
import pytest
from ringdic.calibration.dots import find_dots
from ringdic.session.rig import Target

TARGET = Target("dot-cylinder", 57.0, 20, 12.0, 10.0, 30, 12.0, 4.0)


def scene(centres: np.ndarray, size: float, shape: str, tilt: float = 0.0) -> np.ndarray:
    """Linear light of dots on white, averaged over each pixel and blurred by 0.6 px, 400 x 300 px."""
    height, width = 400, 300
    covered = np.zeros((height, width))
    fine = (np.arange(32) + 0.5) / 32 - 0.5
    for cx, cy in centres:
        x, y = np.arange(round(cx) - 8, round(cx) + 9), np.arange(round(cy) - 8, round(cy) + 9)
        if shape == "square":  # exactly: overlap of pixel and square, axis by axis
            overlap = [np.clip(size / 2 + 0.5 - np.abs(a - c), 0, 1) for a, c in ((x, cx), (y, cy))]
            part = np.outer(overlap[1], overlap[0])
        else:
            dx, dy = (x[:, None] + fine - cx).ravel(), (y[:, None] + fine - cy).ravel()
            inside = dx[None] ** 2 + dy[:, None] ** 2 < (size / 2) ** 2
            part = inside.reshape(len(y), 32, len(x), 32).mean(axis=(1, 3))
        covered[np.ix_(y, x)] += part
    light = 0.6 * (1 + tilt * (np.arange(width) - width / 2) / width) * (1 - 0.95 * covered)
    return cv2.GaussianBlur(light, (0, 0), 0.6)


def srgb(light: np.ndarray) -> np.ndarray:
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * coded).astype(np.uint8)


@pytest.fixture
def centres() -> np.ndarray:
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(np.arange(30, 290, 20), np.arange(30, 390, 20))
    return np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.5, 0.5, (x.size, 2))


def errors(image: np.ndarray, centres: np.ndarray) -> np.ndarray:
    dots = find_dots(image, TARGET)
    assert len(dots) == len(centres)
    distance = np.linalg.norm(dots.px[:, None] - centres, axis=-1)
    assert sorted(distance.argmin(axis=1)) == list(range(len(centres)))
    return dots.px - centres[distance.argmin(axis=1)]


@pytest.mark.parametrize("shape", ["square", "circle"])
def test_centroids_are_true_to_a_hundredth_of_a_pixel(centres, shape):
    error = errors(srgb(scene(centres, 7.0, shape)), centres)
    assert np.abs(error.mean(axis=0)).max() < 0.004
    assert np.sqrt(np.mean(error**2)) < 0.012
    assert np.abs(error).max() < 0.03


def test_uneven_light_does_not_draw_the_centroids(centres):
    error = errors(srgb(scene(centres, 7.0, "square", tilt=1.2)), centres)
    assert np.abs(error.mean(axis=0)).max() < 0.004
    assert np.abs(error).max() < 0.03


def test_an_image_may_have_sixteen_bits(centres):
    image = 257 * srgb(scene(centres, 7.0, "square")).astype(np.uint16)
    assert np.abs(errors(image, centres)).max() < 0.03


def test_noise_costs_hundredths_of_a_pixel(centres):
    rng = np.random.default_rng(3)
    image = srgb(scene(centres, 7.0, "square")).astype(float)
    error = errors(np.clip(image + rng.normal(0, 2, image.shape), 0, 255), centres)
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_a_plain_image_has_no_dots():
    assert len(find_dots(np.full((400, 300), 200, np.uint8), TARGET)) == 0
    assert len(find_dots(np.zeros((400, 300), np.uint8), TARGET)) == 0
