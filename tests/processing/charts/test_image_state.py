"""What an image shows beside its reference: a known blur with its direction, a known gain, known shares of clipping."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from ringdic.charts.image_state import ImageState, image_state, pixel_digest
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter1d

SIDE = 400
XY = np.stack(np.meshgrid(np.arange(40.0, 360.0, 10.0), np.arange(40.0, 360.0, 10.0)), axis=-1).reshape(-1, 2)
REST = np.zeros((len(XY), 6))


def speckle(size: float, seed: int = 0) -> NDArray:
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), size)
    return 120.0 + 80.0 * np.tanh(3.0 * smooth / smooth.std())


def photographed(grey: NDArray, noise: float = 1.5, seed: int = 1) -> NDArray[np.uint8]:
    return np.clip(np.rint(grey + np.random.default_rng(seed).normal(0, noise, grey.shape)), 0, 255).astype(np.uint8)


def beside(pattern: NDArray, image: NDArray, warp: NDArray = REST) -> ImageState:
    return image_state(photographed(pattern, seed=2), image, XY, warp)


@pytest.mark.parametrize("size", [1.2, 2.0, 4.0])
@pytest.mark.parametrize("blur", [0.6, 1.0])
def test_a_blur_of_a_lens_is_known_to_a_tenth_of_a_pixel(size: float, blur: float) -> None:
    state = beside(speckle(size), photographed(gaussian_filter(speckle(size), blur)))
    assert (state.blur, state.across) == pytest.approx((blur, blur), abs=0.1)
    assert state.contrast == pytest.approx(1.0, abs=0.05)
    sharper = image_state(photographed(gaussian_filter(speckle(size), blur)), photographed(speckle(size)), XY, REST)
    assert (sharper.blur, sharper.across) == pytest.approx((-blur, -blur), abs=0.1)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_smear_is_known_by_length_and_direction(axis: int) -> None:
    """A motion over three pixels has the variance of three equal weights, 2/3 px²."""
    state = beside(speckle(2.0), photographed(uniform_filter1d(speckle(2.0), 3, axis=axis)))
    assert state.blur == pytest.approx(np.sqrt(2.0 / 3.0), abs=0.2)
    assert abs(state.across) < 0.3
    off = (state.along - (90.0 if axis == 0 else 0.0) + 90.0) % 180.0 - 90.0
    assert abs(off) < 10.0


@pytest.mark.parametrize("gain", [0.5, 0.8, 1.2])
def test_another_exposure_is_a_gain_and_no_blur(gain: float) -> None:
    state = beside(speckle(2.0), photographed(gain * speckle(2.0)))
    assert state.contrast == pytest.approx(gain, abs=0.03)
    assert max(abs(state.blur), abs(state.across)) < 0.25
    assert state.level == pytest.approx(gain * 120.0, rel=0.05)
    assert state.bright == state.dark == 0.0


def test_noise_and_jpeg_are_no_blur() -> None:
    noisy = beside(speckle(2.0), photographed(speckle(2.0), 4.5))
    coded = cv2.imencode(".jpg", photographed(speckle(2.0)), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    jpeg = beside(speckle(2.0), np.asarray(cv2.imdecode(coded, 0)))
    for state in (noisy, jpeg):
        assert max(abs(state.blur), abs(state.across)) < 0.25


def test_a_stretch_of_one_half_is_no_blur() -> None:
    rows, columns = np.mgrid[:SIDE, :SIDE].astype(float)
    stretched = map_coordinates(speckle(2.0), [200.0 + (rows - 200.0) / 1.5, columns], order=3)
    warp = REST.copy()
    warp[:, 1], warp[:, 5] = 0.5 * (XY[:, 1] - 200.0), 0.5
    state = beside(speckle(2.0), photographed(stretched), warp)
    assert max(abs(state.blur), abs(state.across)) < 0.3


def test_clipped_shares_are_those_of_the_pattern() -> None:
    pattern = speckle(2.0)
    bright = beside(pattern, photographed(2.0 * pattern))
    assert bright.bright == pytest.approx(float((2.0 * pattern > 254.0).mean()), abs=0.05)
    dark = beside(pattern, photographed(pattern - 120.0))
    assert dark.dark == pytest.approx(float((pattern - 120.0 < 1.0).mean()), abs=0.05)
    deep = (np.clip(2.0 * pattern, 0, 255) * 16).astype(np.uint16)  # 12 bits in 16
    assert image_state(deep, deep, XY, REST).bright == pytest.approx(float((2.0 * pattern > 255.0).mean()), abs=0.05)


def test_lost_points_are_counted_and_an_image_that_was_not_matched_is_looked_at_all_the_same() -> None:
    warp = REST.copy()
    warp[: len(warp) // 4] = np.nan
    assert beside(speckle(2.0), photographed(speckle(2.0)), warp).lost == pytest.approx(0.25, abs=0.01)
    smeared = photographed(uniform_filter1d(speckle(2.0), 7, axis=1))
    state = beside(speckle(2.0), smeared, np.full_like(warp, np.nan))
    assert state.lost == 1.0
    assert state.blur > 1.0
    assert abs((state.along + 90.0) % 180.0 - 90.0) < 10.0


def test_only_the_same_pixels_have_the_same_digest() -> None:
    image = photographed(speckle(2.0))
    assert pixel_digest(image) == pixel_digest(image.copy())
    assert pixel_digest(image) != pixel_digest(photographed(speckle(2.0), seed=5))
    assert pixel_digest(image) != pixel_digest(image[:, ::-1])
