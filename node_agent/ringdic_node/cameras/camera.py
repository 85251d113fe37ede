"""The protocol of a node's cameras, and the frames that they deliver.

A camera is locked to settings before it captures, so that all frames of a session have the same exposure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

SETTINGS = ("exposure_us", "gain", "colour_gains", "period_us", "tolerance_us")


LIMITS = {"exposure_us": 10e6, "gain": 1000.0, "period_us": 10e6, "tolerance_us": 3.6e9}  # largest sensible values


class CameraError(RuntimeError):
    """The camera cannot do what was asked; the text says what and why."""


class CameraGoneError(CameraError):
    """The camera delivers nothing even after it was restarted; only a new process can try again."""


@dataclass(frozen=True)
class Shot:
    """A request for the frame nearest to the moment `fire_at_ns` of this node's wall clock, ns since the Unix epoch.

    kind : of the capture. scene : number of captures of this kind before. Simulated cameras choose their scene by both.
    """

    fire_at_ns: int
    kind: str
    scene: int


@dataclass(frozen=True)
class Lock:
    """State of a camera whose exposure and gains are locked.

    metadata : of its frames. sync : state of the sensors' synchronisation. frame_time_ns, frame_period_ns : time of one
    frame, and the period, ns, of a sensor that takes frames continuously; None for a camera that exposes on demand.
    image_bytes : size of an image, without its header; None where only the images tell.
    """

    metadata: dict[str, Any] = field(default_factory=dict)
    sync: str = "none"
    frame_time_ns: int | None = None
    frame_period_ns: int | None = None
    image_bytes: int | None = None


@dataclass(frozen=True)
class Frame:
    """One image of one camera, with its measured time.

    Attributes
    ----------
    pixels : (height, width) uint8 or uint16
        The luminance plane, or raw values.
    time_ns : int
        Measured time of the frame on this node's wall clock, ns since the Unix epoch.
    exposure_us : float or None
    row_time_ns : float or None
        Time from one row of the image to the next, ns, of a sensor with a rolling shutter.
    """

    pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    time_ns: int
    exposure_us: float | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    row_time_ns: float | None = None

    def __post_init__(self) -> None:
        if self.pixels.ndim != 2 or 0 in self.pixels.shape:
            raise CameraError(f"a frame must be a plane of pixels, not an array of shape {self.pixels.shape}")
        if self.pixels.dtype not in (np.uint8, np.uint16):
            raise CameraError(f"a frame must be 8 or 16 bit, not {self.pixels.dtype}")

    @property
    def width(self) -> int:
        """Columns of the image, px."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """Rows of the image, px."""
        return int(self.pixels.shape[0])

    def pgm(self) -> tuple[bytes, bytes]:
        """The frame as a binary PGM file: header and pixels; 16 bit is big-endian as the format demands."""
        deepest = 255 if self.pixels.dtype == np.uint8 else 65535
        header = f"P5\n{self.width} {self.height}\n{deepest}\n".encode()
        plane = self.pixels if deepest == 255 else self.pixels.astype(">u2")
        return header, np.ascontiguousarray(plane).tobytes()


class NodeCamera(Protocol):
    """A source of frames. Used from one thread."""

    def lock(self, settings: Mapping[str, Any]) -> Lock:
        """Set exposure, gains and frame period and hold them; return when consecutive frames show them.

        settings : values by the names in `SETTINGS`. Raises CameraError.
        """
        ...

    def capture(self, shot: Shot) -> Frame:
        """The frame nearest to the shot's moment. Raises CameraError, after a bounded wait."""
        ...

    def versions(self) -> dict[str, str]:
        """Model of the camera and versions of its software, by name."""
        ...

    def close(self) -> None:
        """Release the camera; it is not used any more."""


@runtime_checkable
class FreeRunningCamera(Protocol):
    """A camera whose sensor takes frames continuously, whether or not they are asked for."""

    def newest_frame(self) -> tuple[int, int] | None:
        """Time on this node's wall clock and period of the newest frame, ns; None if there was none lately.

        Called from any thread, and returns at once.
        """
        ...


def check_settings(settings: Mapping[str, Any]) -> None:
    """Raise CameraError for a setting whose name is unknown or whose value is impossible."""
    for name, value in settings.items():
        if name not in SETTINGS:
            raise CameraError(f"unknown camera setting '{name}'; known are {', '.join(SETTINGS)}")
        if name in LIMITS and not _is_number(value, LIMITS[name]):
            raise CameraError(
                f"the camera setting '{name}' must be a positive number of at most {LIMITS[name]:g}, not {value!r}"
            )
        if name == "colour_gains" and not (
            isinstance(value, list | tuple) and len(value) == 2 and all(_is_number(gain, 100.0) for gain in value)
        ):
            raise CameraError(f"the camera setting 'colour_gains' must be two positive numbers, not {value!r}")


def _is_number(value: object, largest: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= largest
