"""The Raspberry Pi camera through picamera2; no other module imports picamera2.

The sensor runs freely in one still configuration for the whole session. Every completed request passes a
callback, which keeps the one whose measured time is nearest to the moment asked for: waiting until the moment
and capturing then would be wrong by up to a frame.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ringdic_node.cameras.camera import CameraError, Frame, Lock, Shot, check_settings
from ringdic_node.clock import Clock

log = logging.getLogger(__name__)

RECORDED = (
    "SensorTimestamp",
    "FrameWallClock",
    "ExposureTime",
    "AnalogueGain",
    "DigitalGain",
    "ColourGains",
    "FrameDuration",
    "Lux",
    "SensorTemperature",
    "LensPosition",
    "SyncReady",
    "SyncTimer",
)
FROZEN = ("ExposureTime", "AnalogueGain", "ColourGains")
SYNC_MODES = {"off": 0, "server": 1, "client": 2}
LOCK_TIMEOUT = 10.0  # s, for the locked values to reach the sensor
FRAMES_AFTER = 3  # frame periods to wait beyond the moment before the frame is given up
EXPOSURE_TOLERANCE = 0.01  # the sensor rounds exposures to whole lines


class PiCamera:
    """One camera module of a Raspberry Pi.

    Parameters
    ----------
    size : [width, height]
        Of the still, px.
    raw : bool
        Deliver the linear 10-bit Bayer values, 16 bit a pixel, in place of the 8-bit luminance.
    sync : str
        ``off``, ``server`` or ``client`` of libcamera's software synchronisation.
    tuning : str
        A libcamera tuning file, for instance with a multicast group of the rig's own; empty: the module's default.
    period_us : float
        Frame period unless the settings say otherwise; it must not be shorter than the sensor mode allows.
    settle_frames : int
        Consecutive frames that must show the locked values before the camera counts as locked.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        size: tuple[int, int] = (3280, 2464),
        raw: bool = False,
        sync: str = "off",
        tuning: str = "",
        period_us: float = 100_000.0,
        settle_frames: int = 5,
    ) -> None:
        if sync not in SYNC_MODES:
            raise CameraError(f"sync '{sync}' is none of {', '.join(SYNC_MODES)}")
        try:
            import picamera2
        except ImportError as error:
            raise CameraError(
                f"picamera2 cannot be loaded ({error}); install python3-picamera2 with apt and make the "
                "virtual environment with --system-site-packages"
            ) from error
        self._clock = clock
        self._size = int(size[0]), int(size[1])
        self._raw = raw
        self._sync = sync
        self._period_us = period_us
        self._settle_frames = settle_frames
        self._wanted: dict[str, Any] = {}
        self._frames = threading.Condition()
        self._matching = 0
        self._newest: dict[str, Any] = {}
        self._moment: int | None = None
        self._best: Any = None
        self._best_distance = 0
        self._passed = False
        self._version = str(getattr(picamera2, "__version__", "unknown"))
        try:
            loaded = picamera2.Picamera2.load_tuning_file(tuning) if tuning else None
            self._camera = picamera2.Picamera2(tuning=loaded)
            self._configure()
        except (RuntimeError, IndexError, OSError) as error:
            raise CameraError(f"no camera can be opened: {error}; check the ribbon cable and other programs") from error

    def _configure(self) -> None:
        raw = {"size": self._size, "format": "SBGGR10"} if self._raw else None
        configuration = self._camera.create_still_configuration(
            main={"size": self._size, "format": "YUV420"}, raw=raw, buffer_count=4, queue=False
        )
        self._camera.configure(configuration)
        self._camera.pre_callback = self._receive

    # picamera2 calls `_receive` for every completed request, under the camera's lock: keep or drop it, no more

    def _receive(self, request: Any) -> None:
        metadata = request.get_metadata()
        with self._frames:
            self._newest = metadata
            self._matching = self._matching + 1 if self._matches(metadata) else 0
            self._consider(request, metadata)
            self._frames.notify_all()

    def _matches(self, metadata: Mapping[str, Any]) -> bool:
        exposure, gain = self._wanted.get("ExposureTime"), self._wanted.get("AnalogueGain")
        held = metadata.get("ExposureTime"), metadata.get("AnalogueGain")
        if exposure is not None and not _near(held[0], exposure, EXPOSURE_TOLERANCE):
            return False
        if gain is not None and not _near(held[1], gain, 0.02):
            return False
        return self._sync != "client" or bool(metadata.get("SyncReady"))

    def _consider(self, request: Any, metadata: Mapping[str, Any]) -> None:
        if self._moment is None or self._passed:
            return
        time_ns = frame_time(metadata, self._clock)
        distance = abs(time_ns - self._moment)
        if self._best is None or distance < self._best_distance:
            request.acquire()
            if self._best is not None:
                self._best.release()
            self._best, self._best_distance = request, distance
        self._passed = time_ns >= self._moment

    # The camera's protocol

    def lock(self, settings: Mapping[str, Any]) -> Lock:
        """Set and hold exposure, gains and frame period, as `NodeCamera.lock` describes.

        Values that are not given are found by the automatics and then held.
        """
        check_settings(settings)
        self._period_us = float(settings.get("period_us", self._period_us))
        self._wanted = self._controls(settings)
        if not self._camera.started:
            self._start()
        metadata = self._hold()
        # The values that the automatics found become fixed ones, and the frames must show them like any other.
        frozen = {name: metadata[name] for name in FROZEN if name not in self._wanted and name in metadata}
        if frozen:
            self._wanted.update(frozen, AwbEnable=False)
            metadata = self._hold()
        sync = self._sync if self._sync != "client" else "client, locked"
        period_ns = round(1000 * float(metadata.get("FrameDuration", self._period_us)))
        image_bytes = self._size[0] * self._size[1] * (2 if self._raw else 1)
        return Lock(recorded(metadata), sync, frame_time(metadata, self._clock), period_ns, image_bytes)

    def _start(self) -> None:
        try:
            self._camera.start()
        except RuntimeError as error:
            raise CameraError(f"the camera does not start: {error}") from error

    def _hold(self) -> dict[str, Any]:
        """Set the wanted controls; return the metadata of the last of several frames in a row that show them."""
        try:
            self._camera.set_controls(self._wanted)
        except RuntimeError as error:
            raise CameraError(f"the camera does not take its settings: {error}") from error
        with self._frames:
            self._matching = 0
            self._newest = {}
            done = self._frames.wait_for(lambda: self._matching >= self._settle_frames, LOCK_TIMEOUT)
            metadata = dict(self._newest)
        if not metadata:
            raise CameraError(f"no frame came within {LOCK_TIMEOUT:g} s; check the camera's cable")
        if not done:
            raise CameraError(
                f"the camera did not hold its settings over {self._settle_frames} frames within {LOCK_TIMEOUT:g} s: "
                f"wanted {self._wanted}, newest frame {recorded(metadata)}"
            )
        return metadata

    def _controls(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        period = round(self._period_us)
        controls: dict[str, Any] = {
            "FrameDurationLimits": (period, period),
            "NoiseReductionMode": 0,
            "Sharpness": 0.0,
        }
        if "exposure_us" in settings:
            controls["ExposureTime"] = int(settings["exposure_us"])
        if "gain" in settings:
            controls["AnalogueGain"] = float(settings["gain"])
        if "colour_gains" in settings:
            red, blue = settings["colour_gains"]
            controls.update(AwbEnable=False, ColourGains=(float(red), float(blue)))
        if "AfMode" in self._camera.camera_controls:
            controls["AfMode"] = 0  # manual: the lens stays where it is
        if self._sync != "off":
            controls["SyncMode"] = SYNC_MODES[self._sync]
        return controls

    def capture(self, shot: Shot) -> Frame:
        """The frame nearest to the shot's moment, as `NodeCamera.capture` describes; restarts a stream that stopped."""
        period_s = self._period_us / 1e6
        wait = max((shot.fire_at_ns - self._clock.now().wall_ns) / 1e9, 0.0) + FRAMES_AFTER * period_s + 1.0
        with self._frames:
            self._moment, self._best, self._passed = shot.fire_at_ns, None, False
            self._frames.wait_for(lambda: self._passed, wait)
            request, passed = self._best, self._passed
            self._moment = self._best = None
        if request is None:
            self._revive()
            raise CameraError(f"no frame came within {wait:.1f} s of waiting; the camera was restarted")
        try:
            if not passed:
                raise CameraError(f"the frames stopped before the moment, within {wait:.1f} s of waiting")
            return self._frame(request)
        finally:
            request.release()

    def _frame(self, request: Any) -> Frame:
        metadata = request.get_metadata()
        width, height = self._size
        pixels: npt.NDArray[Any] = request.make_array("raw" if self._raw else "main")
        if self._raw and pixels.dtype == np.uint8:
            pixels = pixels.view(np.uint16)
        exposure = metadata.get("ExposureTime")
        return Frame(
            pixels=np.array(pixels[:height, :width]),  # a copy: the buffer goes back to the camera
            time_ns=frame_time(metadata, self._clock),
            exposure_us=float(exposure) if exposure is not None else None,
            metadata=recorded(metadata),
        )

    def _revive(self) -> None:
        log.error("the camera gives no frames and is restarted")
        try:
            self._camera.cancel_all_and_flush()
            self._camera.stop()
            self._camera.start()
        except RuntimeError as error:
            raise CameraError(f"the camera cannot be restarted: {error}") from error

    def versions(self) -> dict[str, str]:
        """Model of the sensor and version of picamera2."""
        model = self._camera.camera_properties.get("Model", "unknown")
        return {"camera": f"pi {model}", "picamera2": self._version}

    def close(self) -> None:
        """Stop the stream and release the camera."""
        self._camera.stop()
        self._camera.close()


def frame_time(metadata: Mapping[str, Any], clock: Clock) -> int:
    """Wall-clock time of a frame, ns since the Unix epoch, from libcamera's metadata.

    Without ``FrameWallClock`` it is ``SensorTimestamp``, on the boot clock, plus the present offset of the two clocks.
    """
    stamp = metadata.get("FrameWallClock")
    if stamp:
        return int(stamp)
    now = clock.now()
    return int(metadata["SensorTimestamp"]) + now.wall_ns - now.monotonic_ns


def recorded(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a frame's metadata that is archived (`RECORDED`), as JSON values."""
    return {name: _plain(metadata[name]) for name in RECORDED if name in metadata}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int | str | bool | type(None)) else str(value)


def _near(value: Any, wanted: float, tolerance: float) -> bool:
    return value is not None and abs(float(value) - wanted) <= tolerance * wanted
