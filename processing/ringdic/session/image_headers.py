"""Size of an image as its file's header states it, read before anything is decoded.

A file of two megabytes can state an image of four gigabytes, and a decoder would take that memory. Where a header
states a value twice, the largest counts.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

# Inside compressed JPEG data 0xFF is followed by 0x00 or a restart marker; anything else ends the scan.
_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xd0-\xd7\xff])", re.DOTALL)
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_PNG_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 4, 6: 4}  # by colour type, as decoded: grey with opacity becomes colour
_PNM = re.compile(rb"P([1-6fF])" + 3 * rb"(?:\s|#[^\r\n]*[\r\n])+([0-9.+-]+)")
_BITMAP = re.compile(rb"P([14])" + 2 * rb"(?:\s|#[^\r\n]*[\r\n])+([0-9]+)")
_PAM = re.compile(rb"(WIDTH|HEIGHT)[ \t]+([0-9]+)")
# By the type of a TIFF value, the code of a whole number in struct.
_TIFF_VALUES = {1: "B", 3: "H", 4: "I", 16: "Q", 6: "b", 8: "h", 9: "i", 17: "q"}
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_CHANNELS = 256, 257, 258, 277
_LONGEST_IFD = 4096  # entries; a directory has some dozens


@dataclass(frozen=True)
class StatedSize:
    """Size of an image once it is decoded. width, height : px. pixel_bytes : bytes of one pixel, at most."""

    width: int
    height: int
    pixel_bytes: int

    @property
    def bytes(self) -> int:
        """Memory of the decoded image, bytes."""
        return self.width * self.height * self.pixel_bytes


def stated_size(data: bytes) -> StatedSize | None:
    """The size that the header of a PNG, JPEG, TIFF, BMP or PNM (PGM, PPM) file states; None for any other file.

    data : the file's bytes, of which the header is looked at alone.
    """
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return _png(data)
        if data.startswith(b"\xff\xd8"):
            return _jpeg(data)
        if data.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
            return _tiff(data)
        if data.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", data, 18)
            return StatedSize(abs(width), abs(height), 4)
        return _pnm(data)
    except (struct.error, OverflowError):  # it ends within its header, or points beyond all bounds
        return None


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Markers of a JPEG file in order, and where the segment of each begins; the last is 0xD9, unless it is truncated.

    data : the file's bytes. Raw sensor data may follow the end of the image.
    """
    at = 2
    while (match := _JPEG_MARKER.search(data, at)) is not None:
        marker, at = match[1][0], match.end()
        yield marker, at
        if marker == 0xD9:
            return
        if marker == 0x01:
            continue
        if at + 2 > len(data):
            return
        at += int.from_bytes(data[at : at + 2], "big")


def _png(data: bytes) -> StatedSize:
    width, height, depth, colours = struct.unpack_from(">4xIIBB", data, 12)
    return StatedSize(width, height, _PNG_CHANNELS.get(colours, 4) * (2 if depth == 16 else 1))


def _jpeg(data: bytes) -> StatedSize | None:
    frames = []
    for marker, at in jpeg_segments(data):
        if marker in _JPEG_FRAMES:
            depth, height, width, channels = struct.unpack_from(">2xBHHB", data, at)
            frames.append(StatedSize(width, height, (1 if channels == 1 else 4) * (1 if depth == 8 else 2)))
        if marker in (0xD9, 0xDA):  # the end, or a scan: sizes come before
            break
    return max(frames, key=lambda frame: frame.bytes, default=None)


def _pnm(data: bytes) -> StatedSize | None:
    head = data[:65536]
    if head.startswith(b"P7"):
        header = head.partition(b"ENDHDR")[0]
        sizes = {name: [int(n) for key, n in _PAM.findall(header) if key == name] for name in (b"WIDTH", b"HEIGHT")}
        return StatedSize(max(sizes[b"WIDTH"]), max(sizes[b"HEIGHT"]), 8) if all(sizes.values()) else None
    match = _BITMAP.match(head) or _PNM.match(head)
    if match is None or not (match[2].isdigit() and match[3].isdigit()) or len(match[2] + match[3]) > 30:
        return None
    channels = 3 if match[1] in b"36F" else 1
    depth = 4 if match[1] in b"fF" else 2
    return StatedSize(int(match[2]), int(match[3]), channels * depth)


def _tiff(data: bytes) -> StatedSize | None:
    """Size in the first directory of a TIFF file, of the usual form or of BigTIFF."""
    order = "<" if data.startswith(b"II") else ">"
    big = data[2:4] in (b"+\0", b"\0+")
    (at,) = struct.unpack_from(order + "Q", data, 8) if big else struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, at)
    at += 8 if big else 2
    found: dict[int, int] = {}
    for first in range(at, at + min(count, _LONGEST_IFD) * (20 if big else 12), 20 if big else 12):
        tag, kind, values = struct.unpack_from(order + ("HHQ" if big else "HHI"), data, first)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_CHANNELS) and kind in _TIFF_VALUES:
            place = first + (12 if big else 8)
            size = struct.calcsize(order + _TIFF_VALUES[kind])
            if values * size > (8 if big else 4):  # they lie elsewhere, and the entry says where
                (place,) = struct.unpack_from(order + ("Q" if big else "I"), data, place)
            (value,) = struct.unpack_from(order + _TIFF_VALUES[kind], data, place)
            found[tag] = max(value, found.get(tag, 0))
    if _TIFF_WIDTH not in found or _TIFF_HEIGHT not in found:
        return None
    channels = found.get(_TIFF_CHANNELS, 1)
    sample = (found.get(_TIFF_BITS, 1) + 7) // 8
    return StatedSize(found[_TIFF_WIDTH], found[_TIFF_HEIGHT], max(channels, 3 if sample == 1 else 1) * sample)
