"""The width of an image's edges is that of its blur, whatever the size of the speckles and the light."""

import cv2
import numpy as np
import pytest
from ringdic.charts.sharpness import edge_width

XY = np.stack(np.meshgrid(np.arange(20.0, 236.0, 16.0), np.arange(20.0, 236.0, 16.0)), axis=-1).reshape(-1, 2)


def speckles(size: float, blur: float, contrast: float = 160.0) -> np.ndarray:
    """Black spots with sharp edges on white, of about a size (px), blurred, with the noise of a camera."""
    rng = np.random.default_rng(6)
    fine = cv2.GaussianBlur(rng.normal(size=(1024, 1024)), (0, 0), 1.2 * size)  # four pixels to one of the image
    sharp = cv2.resize((fine > 0).astype(float), (256, 256), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(sharp, (0, 0), blur) if blur else sharp
    return np.clip(np.rint(40.0 + contrast * image + rng.normal(0, 1.5, image.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("size", "contrast"), [(4.0, 60.0), (8.0, 160.0), (16.0, 60.0)])
def test_speckles_in_focus_have_edges_of_a_pixel_and_blurred_ones_wider(size: float, contrast: float) -> None:
    """The blur, the pixel (0.29 px) and the smoothing (0.7 px) add up in the squares."""
    assert 0.8 < edge_width(speckles(size, 0.0, contrast), XY) < 1.4
    assert edge_width(speckles(size, 2.0, contrast), XY) > 1.9


def test_an_image_without_places_has_no_edges() -> None:
    assert np.isnan(edge_width(speckles(8.0, 0.0), np.zeros((0, 2))))
