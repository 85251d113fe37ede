"""Bad input to the correlation of two files: each a sentence that names the file, and nothing written."""

import cv2
import numpy as np
import pytest
from ringdic.correlation import CorrelationSettings
from ringdic.correlation.command import correlate_files
from ringdic.errors import ComputationError, InputError

SETTINGS = CorrelationSettings(radius=8, step=8, tolerance=1e-5)


@pytest.fixture
def images(tmp_path):
    rng = np.random.default_rng(0)
    speckle = cv2.GaussianBlur(rng.uniform(0, 255, (120, 140)), (0, 0), 2)
    speckle = cv2.normalize(speckle, None, 20, 230, cv2.NORM_MINMAX).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "ref.png"), speckle)
    cv2.imwrite(str(tmp_path / "cur.png"), np.roll(speckle, (2, 3), axis=(0, 1)))
    cv2.imwrite(str(tmp_path / "small.png"), speckle[:100])
    cv2.imwrite(str(tmp_path / "flat.png"), np.full_like(speckle, 90))
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros_like(speckle))
    corner = np.zeros_like(speckle)
    corner[3:6, 3:6] = 255
    cv2.imwrite(str(tmp_path / "between.png"), corner)
    whole = cv2.imencode(".jpg", speckle)[1].tobytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) - 40])
    (tmp_path / "text.jpg").write_text("not an image")
    return tmp_path


def test_without_a_mask_the_image_less_a_margin_is_matched(images):
    summary = correlate_files(images / "ref.png", images / "cur.png", images / "points.npz", SETTINGS)
    assert summary["points"] >= summary["good"] > 0.9 * summary["points"]
    with np.load(images / "points.npz") as points:
        good = points["status"] == 0
        np.testing.assert_allclose(points["uv"][good], np.broadcast_to([3.0, 2.0], (good.sum(), 2)), atol=1e-4)
        assert np.isnan(points["uv"][~good]).all()


@pytest.mark.parametrize(
    ("current", "mask", "words"),
    [
        ("small.png", None, "small.png is 140 x 100 px"),
        ("cut.jpg", None, "cut.jpg: the image file is truncated"),
        ("text.jpg", None, "text.jpg"),
        ("none.png", None, "none.png: cannot be read"),
        ("cur.png", "black.png", "black.png: the mask marks no pixel"),
        ("cur.png", "between.png", "between.png: the mask contains no point of the 8 px grid"),
        ("cur.png", "small.png", "small.png: the mask is 140 x 100 px"),
    ],
)
def test_bad_files_are_named(images, current, mask, words):
    out = images / "points.npz"
    with pytest.raises(InputError, match=words):
        correlate_files(
            images / "ref.png", images / current, out, SETTINGS, mask=None if mask is None else images / mask
        )
    assert not out.exists()


def test_a_folder_that_is_not_there_is_named(images):
    with pytest.raises(InputError, match="nowhere"):
        correlate_files(images / "ref.png", images / "cur.png", images / "nowhere" / "points.npz", SETTINGS)


def test_an_image_without_the_surface_cannot_be_computed(images):
    with pytest.raises(ComputationError, match=r"flat.png: none of the \d+ points"):
        correlate_files(images / "ref.png", images / "flat.png", images / "points.npz", SETTINGS)
    assert not (images / "points.npz").exists()


@pytest.mark.parametrize(
    "wrong",
    [
        {"radius": 1}, {"step": 0}, {"order": 3}, {"subset": "hexagon"}, {"interpolation": "linear"},
        {"tolerance": 0.0}, {"zncc_min": 1.5}, {"noise": -1.0}, {"max_iterations": 0},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(InputError, match=f"correlation: .*{str(next(iter(wrong.values()))).replace('.', '[.]')}"):
        CorrelationSettings(**wrong)
