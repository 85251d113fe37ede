"""Folders of images become sessions, or are refused with a sentence that names the file."""

from __future__ import annotations

import hashlib
import shutil

import cv2
import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.session.folder import open_session
from ringdic.session.importing import import_images, natural_order

SIZE = (24, 32)


def write_image(path, seed: int, size=SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.random.default_rng(seed).integers(0, 255, size, np.uint8)
    assert cv2.imwrite(str(path), image)


@pytest.fixture
def src(tmp_path, rig_toml):
    """Two cameras: 3 and 2 boards, a target, 11 steps; a mask for one."""
    folder = tmp_path / "src"
    folder.mkdir()
    (folder / "rig.toml").write_text(rig_toml("pair", ["201", "202"]))
    for n, camera in enumerate(("201", "202")):
        for k in range(3 - n):
            write_image(folder / "board" / camera / f"view{k}.png", 100 * n + k)
        write_image(folder / "target" / f"{camera}.jpg", 50 + n)
        for k in range(11):
            write_image(folder / "specimen" / camera / f"step{k}.jpg", 1000 * n + k)
    mask = np.zeros(SIZE, np.uint8)
    mask[4:9] = 255
    (folder / "mask").mkdir()
    cv2.imwrite(str(folder / "mask" / "201.png"), mask)
    return folder


def test_every_image_becomes_a_byte_copy_in_its_capture(src, tmp_path, differing_images):
    path = import_images(src, tmp_path / "made")
    session = open_session(path)
    assert [c.kind for c in session.captures] == ["board"] * 3 + ["target"] + ["specimen"] * 11
    assert set(session.captures[2].images) == {"201"}, "camera 202 has only two views of the board"
    # Natural order: the eleventh step is step10, not the one after step1.
    last = session.of_kind("specimen")[-1]
    original = src / "specimen" / "202" / "step10.jpg"
    assert last.images["202"].read_bytes() == original.read_bytes()
    entry = last.record.cameras["202"]
    assert entry.sha256 == hashlib.sha256(original.read_bytes()).hexdigest()
    assert (entry.width, entry.height) == (SIZE[1], SIZE[0])
    assert entry.original.endswith("step10.jpg")
    assert all(capture.record.state == "closed" for capture in session.captures)
    assert session.mask("201").read_bytes() == (src / "mask" / "201.png").read_bytes()
    assert session.mask("202") is None
    assert differing_images(path) == []


def at_rest(src):
    for n, camera in enumerate(("201", "202")):
        for k in range(2):
            write_image(src / "static" / camera / f"rest{k}.png", 5000 + 10 * n + k)


def spoil_captures_at_rest(src):
    at_rest(src)
    (src / "static" / "201" / "rest1.png").unlink()


def spoil_camera_at_rest(src):
    at_rest(src)
    shutil.rmtree(src / "static" / "202")


def test_captures_at_rest_are_taken_along(src, tmp_path):
    at_rest(src)
    session = open_session(import_images(src, tmp_path / "made"))
    assert [c.kind for c in session.captures[-3:]] == ["specimen", "static", "static"]
    rest = session.of_kind("static")[1].images
    assert rest["202"].read_bytes() == (src / "static" / "202" / "rest1.png").read_bytes()
    assert len(session.of_kind("specimen")) == 11


def spoil_truncate_jpeg(src):
    path = src / "specimen" / "202" / "step3.jpg"
    path.write_bytes(path.read_bytes()[:-40])


def spoil_truncate_png(src):
    path = src / "board" / "201" / "view1.png"
    path.write_bytes(path.read_bytes()[:-40])


def spoil_text(src):
    (src / "target" / "201.jpg").write_text("no image")


def spoil_size(src):
    write_image(src / "specimen" / "201" / "step4.jpg", 1, (24, 30))


def spoil_mask(src):
    cv2.imwrite(str(src / "mask" / "201.png"), np.zeros(SIZE, np.uint8))


def spoil_mask_size(src):
    cv2.imwrite(str(src / "mask" / "201.png"), np.full((5, 5), 255, np.uint8))


def spoil_rig(src):
    path = src / "rig.toml"
    path.write_text(path.read_text().replace("square_mm", "square_cm"))


def spoil_steps(src):
    (src / "specimen" / "202" / "step10.jpg").unlink()


def remove(*parts):
    def act(src):
        path = src.joinpath(*parts)
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return act


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (remove("rig.toml"), "rig.toml: no such file"),
        (remove("board", "202"), "board/202: the board folder of camera '202' is missing"),
        (remove("specimen", "201"), "specimen/201: the specimen folder of camera '201' is missing"),
        (remove("target", "202.jpg"), "no image of the calibration object for camera '202'"),
        (spoil_truncate_jpeg, "step3.jpg.*truncated"),
        (spoil_truncate_png, "view1.png.*truncated"),
        (spoil_text, "target/201.jpg"),
        (spoil_size, "step4.jpg: 30 x 24 px.*'201' has 32 x 24 px"),
        (spoil_mask, "mask/201.png: the mask marks no pixel"),
        (spoil_mask_size, "mask/201.png: the mask is 5 x 5 px but its image is 32 x 24 px"),
        (spoil_rig, "unknown key 'square_cm'"),
        (spoil_steps, "different numbers of steps .201 11, 202 10"),
        (spoil_captures_at_rest, "different numbers of captures .201 1, 202 2"),
        (spoil_camera_at_rest, "static/202: the static folder of camera '202' is missing"),
    ],
)
def test_a_bad_folder_is_refused_and_leaves_nothing(src, tmp_path, spoil, told):
    spoil(src)
    with pytest.raises(InputError, match=told) as caught:
        import_images(src, tmp_path / "made")
    assert caught.value.exit_code == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["src"]


def test_a_session_is_never_replaced(src, tmp_path):
    import_images(src, tmp_path / "made")
    with pytest.raises(InputError, match="exists already"):
        import_images(src, tmp_path / "made")


def test_natural_order_counts_like_a_person(tmp_path):
    names = ["a10.png", "a9.png", "a1.png", "b0.png", "10.png", "9.png"]
    ordered = [path.name for path in sorted((tmp_path / name for name in names), key=natural_order)]
    assert ordered == ["9.png", "10.png", "a1.png", "a9.png", "a10.png", "b0.png"]
