"""A camera without optics: a numbered test pattern, to try out the rig's network and storage."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ringdic_node.cameras.camera import CameraError, Frame, Lock, Shot, check_settings
from ringdic_node.clock import Clock, sleep_until


class PatternCamera:
    """A camera whose images are computed from camera id, kind and scene, so that a receiver can compute them too.

    Parameters
    ----------
    delay : float
        Seconds that a readout takes.
    jitter_us : float
        Standard deviation of the frame's time about the planned moment, µs.
    """

    def __init__(
        self,
        camera: str,
        clock: Clock,
        *,
        width: int = 320,
        height: int = 240,
        delay: float = 0.0,
        jitter_us: float = 30.0,
        seed: int = 0,
    ) -> None:
        if width < 1 or height < 1:
            raise CameraError(f"a pattern of {width} x {height} pixels has no pixels")
        self.camera = camera
        self._clock = clock
        self._size = width, height
        self._delay = delay
        self._exposure_us = 5000.0
        self._jitter_us = jitter_us
        self._random = np.random.default_rng([seed, zlib.crc32(camera.encode())])

    def lock(self, settings: Mapping[str, Any]) -> Lock:
        """Check the settings and note the exposure; the pattern does not depend on them."""
        check_settings(settings)
        self._exposure_us = float(settings.get("exposure_us", self._exposure_us))
        return Lock(metadata=dict(settings), sync="simulated", image_bytes=self._size[0] * self._size[1])

    def capture(self, shot: Shot) -> Frame:
        """The pattern of this capture, at the moment of the shot."""
        sleep_until(self._clock, shot.fire_at_ns)
        self._clock.sleep(self._delay)
        time_ns = shot.fire_at_ns + round(1000 * self._random.normal(0.0, self._jitter_us))
        return Frame(pattern(self.camera, shot.kind, shot.scene, *self._size), time_ns, self._exposure_us)

    def versions(self) -> dict[str, str]:
        """Name of this kind of camera."""
        return {"camera": "pattern"}

    def close(self) -> None:
        """Do nothing: this camera holds nothing open."""


def pattern(camera: str, kind: str, scene: int, width: int, height: int) -> npt.NDArray[np.uint8]:
    """Grey levels of a diagonal ramp x + 2 y, shifted by a checksum of camera, kind and scene, (height, width)."""
    shift = zlib.crc32(f"{camera}/{kind}/{scene}".encode())
    y, x = np.mgrid[0:height, 0:width]
    return ((x + 2 * y + shift) % 251).astype(np.uint8)
