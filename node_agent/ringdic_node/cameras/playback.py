"""A camera that delivers images from files: images of full size without a sensor or a renderer."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ringdic_node.cameras.camera import CameraError, Frame, Lock, Shot, check_settings
from ringdic_node.clock import Clock, sleep_until

_HEADER = re.compile(rb"P5\s+(\d+)\s+(\d+)\s+(\d+)\s")


class PlaybackCamera:
    """A camera whose frames are one image file, or a file for each capture.

    Parameters
    ----------
    image : str
        A binary PGM file (P5, no comments), 8 or 16 bit; CameraError is raised for any other. ``{kind}`` and
        ``{scene}`` in its name are replaced by the capture's kind and by the number of captures of that kind before.
    """

    def __init__(self, clock: Clock, *, image: str = "") -> None:
        self._clock = clock
        self._image = image
        self._pixels = None if "{" in image else read_pgm(Path(image))

    def lock(self, settings: Mapping[str, Any]) -> Lock:
        """Check the settings; they do not change the images."""
        check_settings(settings)
        size = None if self._pixels is None else self._pixels.nbytes
        return Lock(metadata=dict(settings), sync="simulated", image_bytes=size)

    def capture(self, shot: Shot) -> Frame:
        """The image for this shot, returned at its moment. Raises CameraError if its file cannot be read."""
        pixels = self._pixels
        if pixels is None:
            pixels = read_pgm(Path(self._image.replace("{kind}", shot.kind).replace("{scene}", str(shot.scene))))
        sleep_until(self._clock, shot.fire_at_ns)
        return Frame(pixels, shot.fire_at_ns)

    def versions(self) -> dict[str, str]:
        """Name of this kind of camera."""
        return {"camera": "playback"}

    def close(self) -> None:
        """Do nothing: this camera holds nothing open."""


def read_pgm(path: Path) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """Grey levels (height, width) of a binary PGM file without comments. Raises CameraError."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CameraError(f"{path}: cannot be read ({error.strerror}); name a PGM file") from error
    header = _HEADER.match(content)
    if header is None:
        raise CameraError(f"{path}: not a binary PGM file; the camera plays back PGM only")
    width, height, deepest = (int(number) for number in header.groups())
    bytes_each = 1 if deepest < 256 else 2
    if len(content) - header.end() != width * height * bytes_each:
        raise CameraError(f"{path}: the file is cut off or too long for {width} x {height} pixels; write it anew")
    if bytes_each == 1:
        return np.frombuffer(content, np.uint8, offset=header.end()).reshape(height, width)
    return np.frombuffer(content, ">u2", offset=header.end()).reshape(height, width).astype(np.uint16)
