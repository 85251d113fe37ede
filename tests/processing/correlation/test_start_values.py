"""Start values by optical flow are those of the motion, for any number of points."""

import cv2
import numpy as np
from ringdic.correlation.prepared import prepare_current, prepare_reference
from ringdic.correlation.seeds import flow_start_values

SHIFT = (3, -2)  # px
MOST_ROWS = 32_766  # of an image that OpenCV samples


def test_a_shift_is_found_at_more_points_than_opencv_samples_rows() -> None:
    noise = np.random.default_rng(3).normal(size=(200, 240)).astype(np.float32)
    speckle = np.clip(128 + 400 * cv2.GaussianBlur(noise, (0, 0), 2.0), 0, 255).astype(np.uint8)
    reference = prepare_reference(speckle)
    current = prepare_current(np.roll(speckle, SHIFT, axis=(1, 0)))
    xy = np.stack(np.meshgrid(np.arange(40.0, 200.0, 0.8), np.arange(40.0, 160.0, 0.6)), axis=-1).reshape(-1, 2)
    assert len(xy) > MOST_ROWS
    found = flow_start_values(reference, current, xy, 10)
    np.testing.assert_allclose(found[:, [0, 6]], np.broadcast_to(SHIFT, xy.shape), atol=0.25)
    np.testing.assert_allclose(found[:, [1, 2, 7, 8]], 0.0, atol=0.05)
    for some in (slice(0, 0), slice(5, 6), slice(None, None, 7), slice(0, 2048)):
        np.testing.assert_array_equal(flow_start_values(reference, current, xy[some], 10), found[some])
