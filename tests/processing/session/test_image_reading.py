"""Image files: the exact grey rule, the depths and forms, and damage that is told."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ringdic.errors import InputError
from ringdic.session.image_headers import stated_size
from ringdic.session.images import LARGEST_IMAGE, gray, read_gray, read_mask


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


def png_of(width: int, height: int, depth: int = 16, colours: int = 6) -> bytes:
    """A PNG that states a size and holds no picture."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, depth, colours, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def tiff_of(order: str, entries: list[tuple[int, str, int]]) -> bytes:
    """A TIFF with these entries: tag, struct's code of the value, value."""
    kinds = {"B": 1, "H": 3, "I": 4}
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "IH", 8, len(entries))
    body = b"".join(
        struct.pack(order + "HHI", tag, kinds[code], 1) + struct.pack(order + code, value).ljust(4, b"\0")
        for tag, code, value in entries
    )
    return head + body + bytes(4)


LARGE = {
    "PNG": png_of(30_000, 30_000),
    "JPEG": b"\xff\xd8\xff\xe1\x00\x04ab\xff\xc2\x00\x11\x08\xff\xff\xff\xff\x03" + bytes(9) + b"\xff\xd9",
    "PGM": b"P5 # 10 10\n# a\r100000\n 100000 255\n",
    "bitmap": b"P4\n1000000 1000000\n",
    "PAM": b"P7\nWIDTH 9\nWIDTH 60000\nHEIGHT 60000\nDEPTH 1\nMAXVAL 255\nENDHDR\n",
    "floats": b"Pf\n60000 60000\n-1.0\n",
    "TIFF": tiff_of("<", [(256, "I", 60_000), (257, "H", 60_000), (258, "H", 16)]),
    "TIFF, a size stated twice": tiff_of(">", [(256, "I", 60_000), (256, "H", 8), (257, "H", 60_000)]),
    "TIFF, deep": tiff_of("<", [(256, "H", 12_000), (257, "H", 12_000), (258, "H", 64), (277, "H", 4)]),
    "BMP": b"BM" + bytes(12) + struct.pack("<Iii", 40, 60_000, -60_000) + bytes(40),
}


@pytest.mark.parametrize("kind", LARGE)
def test_an_image_that_would_take_gigabytes_is_refused_by_its_header(tmp_path, monkeypatch, kind):
    def decode(*_: object) -> None:
        raise AssertionError("it was decoded")

    monkeypatch.setattr(cv2, "imdecode", decode)
    path = tmp_path / "201.pgm"
    path.write_bytes(LARGE[kind])
    with pytest.raises(InputError, match=r"201\.pgm: .* px would take .* GB"):
        read_gray(path)


def test_an_image_of_today_s_largest_sensors_is_not_too_large():
    assert stated_size(png_of(14_204, 10_652, 16, 0)).bytes < LARGEST_IMAGE
    assert stated_size(png_of(9_152, 6_944, 16, 2)).bytes < LARGEST_IMAGE


@pytest.mark.parametrize("suffix", [".png", ".pgm", ".ppm", ".tif", ".jpg", ".bmp"])
def test_the_size_that_a_header_states_is_that_of_the_image(suffix):
    image = np.zeros((30, 50, 3) if suffix == ".ppm" else (30, 50), np.uint8)
    size = stated_size(cv2.imencode(suffix, image)[1].tobytes())
    assert (size.width, size.height) == (50, 30)


@given(st.sampled_from([*LARGE.values(), cv2.imencode(".tif", np.zeros((4, 5), np.uint16))[1].tobytes()]), st.data())
def test_no_damage_to_a_header_goes_unanswered(header, data):
    at = data.draw(st.integers(0, min(len(header), 120)))
    spoilt = header[:at] + data.draw(st.binary(max_size=12)) + header[at + data.draw(st.integers(0, 12)) :]
    size = stated_size(spoilt)
    assert size is None or size.bytes >= 0
