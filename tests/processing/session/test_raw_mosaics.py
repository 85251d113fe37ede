"""Raw images under colour filters are made as even as grey ones, and all others are left as they are."""

import numpy as np
import pytest
from numpy.typing import NDArray
from ringdic.session.mosaic import level_mosaic
from scipy.ndimage import gaussian_filter

GAINS = ((0.5, 1.0), (1.0, 0.6))  # red and green, green and blue


def light(seed: int = 1) -> NDArray:
    """A random pattern in linear light, 0.1 to 0.8, that falls off to the right."""
    pattern = gaussian_filter(np.random.default_rng(seed).normal(size=(400, 500)), 2.0)
    return (0.45 + 0.35 * np.tanh(5.0 * pattern / pattern.std())) * np.linspace(1.0, 0.7, 500)


def filtered(image: NDArray) -> NDArray:
    out = image.copy()
    for row in (0, 1):
        for column in (0, 1):
            out[row::2, column::2] *= GAINS[row][column]
    return out


def coded(image: NDArray, dtype: type) -> NDArray:
    """8 bits with a gamma of 2.2, or 10 bits, linear on a pedestal."""
    levels = 255.0 * image ** (1 / 2.2) if dtype is np.uint8 else 64.0 + 900.0 * image
    return np.rint(levels).astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_mosaic_of_a_grey_pattern_becomes_the_grey_image(dtype: type) -> None:
    plain, raw = coded(light(), dtype), coded(filtered(light()), dtype)
    levelled = level_mosaic(raw)
    assert levelled.dtype == plain.dtype
    before, after = (np.abs(each.astype(float) - plain).mean() / np.ptp(plain) for each in (raw, levelled))
    assert before > 0.05
    assert after < 0.01
    means = [levelled[row::2, column::2].mean() for row in (0, 1) for column in (0, 1)]
    assert max(means) < 1.01 * min(means)


def test_images_that_are_no_mosaic_are_left_as_they_are() -> None:
    for image in (coded(light(), np.uint8), np.zeros((300, 300), np.uint8), np.eye(8, dtype=np.uint8)):
        assert level_mosaic(image) is image
