"""The measured size of speckles against patterns of disks of known diameter."""

import numpy as np
import pytest
from ringdic.report.speckle import speckle_size


def disks(diameter: float, seed: int, noise: float) -> np.ndarray:
    """Dark disks at random places, drawn four times as fine and averaged."""
    rng = np.random.default_rng(seed)
    size, fine = 320, 4
    canvas = np.zeros((size * fine, size * fine))
    r = diameter * fine / 2
    y, x = np.indices((int(2 * r) + 3,) * 2) - r - 1
    disk = np.hypot(x, y) <= r
    for u, v in rng.integers(0, size * fine - len(disk), (int(0.3 * size**2 / diameter**2), 2)):
        canvas[v : v + len(disk), u : u + len(disk)] += disk
    image = canvas.reshape(size, fine, size, fine).mean(axis=(1, 3))
    return 200.0 - 60.0 * image + rng.normal(0.0, noise, (size, size)) if noise else 200.0 - 60.0 * image


@pytest.mark.parametrize("diameter", [5.0, 8.0, 14.0])
@pytest.mark.parametrize("noise", [0.0, 10.0])
def test_the_peak_of_disks_is_four_fifths_of_their_diameter_wide_with_noise_and_without(
    diameter: float, noise: float
) -> None:
    image = disks(diameter, 3, noise)
    x, y = np.meshgrid(np.arange(40, 281, 24), np.arange(40, 281, 24))
    places = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    # Two disks of diameter d, s apart, overlap by half their area at s = 0.404 d; a pixel's own width adds to it.
    size = speckle_size(image, places, noise**2)
    assert size is not None
    assert 0.95 * 0.808 * diameter < size < 0.808 * diameter + 1.0


def test_no_patch_inside_the_image_is_no_size() -> None:
    assert speckle_size(np.zeros((50, 50)), np.array([[25.0, 25.0]])) is None
