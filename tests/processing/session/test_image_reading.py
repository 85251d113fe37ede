"""Image files: the exact grey rule, the depths and forms, and damage that is told."""

import cv2
import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.session.images import gray, read_gray, read_mask


def test_colour_becomes_grey_by_the_exact_rule():
    rng = np.random.default_rng(0)
    bgr = rng.integers(0, 256, (50, 60, 3), dtype=np.uint8)
    exact = 0.114021 * bgr[..., 0] + 0.587043 * bgr[..., 1] + 0.298936 * bgr[..., 2]
    np.testing.assert_array_equal(gray(bgr), np.floor(exact + 0.5 + 1e-9))
    same = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2)
    np.testing.assert_array_equal(gray(same)[:, 0], np.arange(256))
    deep = rng.integers(0, 65536, (20, 20, 3), dtype=np.uint16)
    assert gray(deep).dtype == np.uint16
    assert np.abs(gray(deep) - deep.astype(float) @ [0.114021, 0.587043, 0.298936]).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("suffix", [".png", ".pgm", ".tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_lossless_files_come_back_as_they_are(tmp_path, suffix, dtype):
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (31, 47), dtype=dtype)
    path = tmp_path / f"image{suffix}"
    cv2.imwrite(str(path), image)
    found = read_gray(path)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, image)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".pgm", ".tif"])
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.97])
def test_a_truncated_file_is_refused_by_name(tmp_path, suffix, kept):
    image = np.random.default_rng(2).integers(0, 255, (80, 90), dtype=np.uint8)
    whole = cv2.imencode(suffix, image)[1].tobytes()
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(InputError, match=f"cut{suffix}"):
        read_gray(path)


def test_data_behind_the_end_of_a_jpeg_do_not_matter(tmp_path):
    whole = cv2.imencode(".jpg", np.full((64, 64), 90, np.uint8))[1].tobytes()
    path = tmp_path / "raw.jpg"
    path.write_bytes(whole + b"BRCM" + bytes(1000))
    assert read_gray(path).shape == (64, 64)


def test_a_mask_of_another_size_or_without_a_pixel_is_refused(tmp_path):
    path = tmp_path / "mask.png"
    cv2.imwrite(str(path), np.zeros((20, 30), np.uint8))
    with pytest.raises(InputError, match=r"mask.png: the mask is 30 x 20 px"):
        read_mask(path, (30, 20))
    with pytest.raises(InputError, match=r"mask.png: the mask marks no pixel"):
        read_mask(path, (20, 30))
