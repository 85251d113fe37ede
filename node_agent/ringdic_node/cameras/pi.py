"""The Raspberry Pi camera through picamera2; no other module imports picamera2.

The sensor runs freely in one still configuration for the whole session. Every completed request passes a
callback, which keeps the one whose measured time is nearest to the moment asked for: waiting until the moment
and capturing then would be wrong by up to a frame.
"""

from __future__ import annotations

import logging
import shutil
import subprocess
import threading
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import numpy.typing as npt

from ringdic_node.cameras.camera import CameraError, CameraGoneError, Frame, Lock, Shot, check_settings
from ringdic_node.cameras.pi_metadata import (
    Settling,
    frame_monotonic_ns,
    frame_time,
    lacks_memory,
    moved,
    raw_format,
    recorded,
)
from ringdic_node.clock import Clock

__all__ = ["PiCamera", "frame_time"]

log = logging.getLogger(__name__)

FROZEN = ("ExposureTime", "AnalogueGain", "ColourGains", "LensPosition")
SYNC_MODES = {"off": 0, "server": 1, "client": 2}
MODES = {"ExposureTime": "ExposureTimeMode", "AnalogueGain": "AnalogueGainMode"}  # 0 automatic, 1 manual
LOCK_TIMEOUT = 10.0  # s, for the automatics to converge, and for the locked values to reach the sensor
SYNC_FRAMES = 60  # periods that a client is given beyond that: the server tells its grid every 30 of its frames
RESTART_TIMEOUT = 10.0  # s, for a camera to stop and start
SPARE_TIME = 1.0  # s beyond that, for a busy machine
FRAMES_AFTER = 3  # frame periods to wait beyond the moment before the frame is given up


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
    buffers : int
        Frames in the contiguous memory, from 2 on: one is held for the capture, the others keep the sensor running.
    row_time_us : float
        Time from one row of the image to the next of the rolling shutter; 0: what the shortest frame period of the
        sensor's mode allows at most.
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
        buffers: int = 4,
        row_time_us: float = 0.0,
    ) -> None:
        if buffers < 2:
            raise CameraError(f"a camera needs at least 2 buffers, not {buffers}: one frame is held, one is filled")
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
        self._buffers = buffers
        self._row_time_us = row_time_us
        self._raw_format: dict[str, Any] = {}
        self._fixed: set[str] = set()  # controls that a lock has taken from the automatics
        self._locked: dict[str, Any] = {}
        self._frames = threading.Condition()  # guards what follows
        self._settling = Settling({})
        self._newest: dict[str, Any] = {}
        self._newest_ns: int | None = None  # by the monotonic clock, like the next two
        self._moment: int | None = None
        self._best: Any = None
        self._best_ns = 0
        self._passed = False
        try:
            loaded = picamera2.Picamera2.load_tuning_file(tuning) if tuning else None
            self._camera = picamera2.Picamera2(tuning=loaded)
            self._configure()
        except (RuntimeError, IndexError, OSError, MemoryError) as error:
            remedy = self._memory_remedy(error) or "check the ribbon cable and other programs"
            raise CameraError(f"no camera can be opened: {error}; {remedy}") from error

    def _configure(self) -> None:
        raw = {"size": self._size, "format": "SBGGR10"} if self._raw else None
        configuration = self._camera.create_still_configuration(
            main={"size": self._size, "format": "YUV420"}, raw=raw, buffer_count=self._buffers, queue=False
        )
        self._camera.configure(configuration)
        self._camera.pre_callback = self._receive
        if self._raw:
            actual = self._camera.camera_configuration()  # the sensor's own order of colours, and its depth
            bits = (actual.get("sensor") or {}).get("bit_depth")
            self._raw_format = raw_format(str(actual["raw"]["format"]), bits)

    def _memory_remedy(self, error: Exception) -> str:
        """What to do against a lack of contiguous memory; nothing for another error."""
        if not lacks_memory(error):
            return ""
        width, height = self._size
        megabytes = self._buffers * width * height * (3.5 if self._raw else 1.5) / 1e6
        return (
            f"the contiguous memory (CMA) is too small for {self._buffers} buffers of {width} x {height}, about "
            f"{megabytes:.0f} MB: lower buffers or size in node.toml, or enlarge it (cma= in "
            "/boot/firmware/cmdline.txt), and restart the node if another program has used it up"
        )

    # picamera2 calls `_receive` for every completed request, under the camera's lock: keep or drop it, no more

    def _receive(self, request: Any) -> None:
        metadata = request.get_metadata()
        try:
            time_ns = frame_monotonic_ns(metadata, self._clock.now())
        except CameraError as error:
            log.error("%s", error)
            time_ns = None
        with self._frames:
            self._newest, self._newest_ns = metadata, time_ns
            self._settling.take(metadata)
            if time_ns is not None:
                self._consider(request, time_ns)
            self._frames.notify_all()

    def _consider(self, request: Any, time_ns: int) -> None:
        if self._moment is None or self._passed:
            return
        distance = abs(time_ns - self._moment)
        if self._best is None or distance < abs(self._best_ns - self._moment):
            request.acquire()
            if self._best is not None:
                self._best.release()
            self._best, self._best_ns = request, time_ns
        self._passed = time_ns >= self._moment

    # The camera's protocol

    def lock(self, settings: Mapping[str, Any]) -> Lock:
        """Set and hold exposure, gains and frame period, as `NodeCamera.lock` describes.

        Values that are not given are found by the automatics and then held.
        """
        check_settings(settings)
        self._period_us = float(settings.get("period_us", self._period_us))
        if not self._camera.started:
            self._start()
        given = self._controls(settings)
        automatic = tuple(name for name in FROZEN[:3] if name not in given)
        metadata = self._hold({**given, **self._automatics(automatic)}, automatic)
        # The values that the automatics found become fixed ones, and the frames must show them like any other.
        frozen = {name: metadata[name] for name in FROZEN if name not in given and self._can_freeze(name, metadata)}
        if frozen:
            fixed = {MODES[name]: 1 for name in MODES if MODES[name] in self._camera.camera_controls}
            metadata = self._hold({**given, **frozen, **fixed, "AwbEnable": False})
        self._locked = dict(metadata)
        self._fixed.update(name for name in MODES if name in given or name in frozen)
        period_ns = round(1000 * float(metadata.get("FrameDuration", self._period_us)))
        image_bytes = self._size[0] * self._size[1] * (2 if self._raw else 1)
        sync = self._sync if self._sync != "client" else "client, locked"
        return Lock(recorded(metadata), sync, frame_time(metadata, self._clock), period_ns, image_bytes)

    def _can_freeze(self, name: str, metadata: Mapping[str, Any]) -> bool:
        return name in metadata and (name != "LensPosition" or name in self._camera.camera_controls)

    def _automatics(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Controls that let the automatics find values, which an earlier lock may have fixed."""
        controls: dict[str, Any] = {"AwbEnable": True} if "ColourGains" in names else {}
        for name, mode in MODES.items():
            if mode in self._camera.camera_controls:
                controls[mode] = 0 if name in names else 1
            elif name in names and name in self._fixed:
                controls[name] = 0  # how libcamera asked for the automatics before it had these modes
        return controls

    def _start(self) -> None:
        try:
            self._camera.start()
        except (RuntimeError, OSError, MemoryError) as error:
            remedy = self._memory_remedy(error) or "another program may use it"
            raise CameraError(f"the camera does not start: {error}; {remedy}") from error

    def _hold(self, wanted: dict[str, Any], automatic: tuple[str, ...] = ()) -> dict[str, Any]:
        """Set controls; return the metadata of the last of several frames in a row that show them, all at rest.

        automatic : names of the values that the automatics are to find meanwhile.
        """
        client = self._sync == "client"
        wait = LOCK_TIMEOUT + (SYNC_FRAMES * self._period_us / 1e6 if client else 0.0)
        shown = {name: value for name, value in wanted.items() if name not in automatic}
        try:
            self._camera.set_controls(wanted)
        except RuntimeError as error:
            raise CameraError(f"the camera does not take its settings: {error}") from error
        with self._frames:
            self._settling = settling = Settling(shown, automatic, client)
            self._newest = {}
            done = self._frames.wait_for(lambda: settling.frames >= self._settle_frames, wait)
            metadata, fault = dict(self._newest), settling.fault
        if not metadata:
            self._revive()
            raise CameraError(f"no frame came within {wait:g} s; the camera was restarted: arm again, check its cable")
        if not done:
            aid = "; set exposure_us, gain and colour_gains under [capture] in rig.toml" if automatic else ""
            raise CameraError(
                f"the camera did not hold its settings over {self._settle_frames} frames within {wait:g} s: "
                f"{fault}{aid} (newest frame {recorded(metadata)})"
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
            controls["AfMode"] = 0  # manual: the lens stays where it is, and is held there
        if self._sync != "off":
            controls["SyncMode"] = SYNC_MODES[self._sync]
        return controls

    def capture(self, shot: Shot) -> Frame:
        """The frame nearest to the shot's moment, as `NodeCamera.capture` describes; restarts a stream that stopped.

        The wait and the frames' times are by the monotonic clock: a wall clock that is set meanwhile changes neither.
        """
        period_s = self._period_us / 1e6
        start = self._clock.now()
        wait = max((shot.fire_at_ns - start.wall_ns) / 1e9, 0.0) + FRAMES_AFTER * period_s + SPARE_TIME
        offset_ns = start.wall_ns - start.monotonic_ns
        with self._frames:
            self._moment, self._best, self._passed = shot.fire_at_ns - offset_ns, None, False
            self._frames.wait_for(lambda: self._passed, wait)
            request, passed, time_ns = self._best, self._passed, self._best_ns + offset_ns
            self._moment = self._best = None
        try:
            if not passed:
                self._revive()
                came = "no frame came" if request is None else "the frames stopped before the moment"
                raise CameraError(f"{came}, within {wait:.1f} s of waiting; the camera was restarted")
            return self._frame(request, time_ns)
        finally:
            if request is not None:
                request.release()

    def _frame(self, request: Any, time_ns: int) -> Frame:
        metadata = request.get_metadata()
        width, height = self._size
        pixels: npt.NDArray[Any] = request.make_array("raw" if self._raw else "main")
        if self._raw and pixels.dtype == np.uint8:
            pixels = pixels.view(np.uint16)
        exposure = metadata.get("ExposureTime")
        changes = moved(self._locked, metadata)
        if changes:
            log.warning("the camera does not hold its settings: %s", ", ".join(changes))
        return Frame(
            pixels=np.array(pixels[:height, :width]),  # a copy: the buffer goes back to the camera
            time_ns=time_ns,
            exposure_us=float(exposure) if exposure is not None else None,
            metadata={**recorded(metadata), **self._raw_format, **({"NotHeld": changes} if changes else {})},
            row_time_ns=self._row_time_ns(),
        )

    def _row_time_ns(self) -> float | None:
        """Time from one row of the image to the next, ns: as configured, else from the mode's shortest frame period."""
        if self._row_time_us > 0:
            return 1000 * self._row_time_us
        limits = self._camera.camera_controls.get("FrameDurationLimits")
        return 1000 * float(limits[0]) / self._size[1] if limits else None

    def newest_frame(self) -> tuple[int, int] | None:
        """Time on the wall clock and period of the newest frame, ns, as `FreeRunningCamera.newest_frame` describes."""
        now = self._clock.now()
        with self._frames:
            time_ns, period_us = self._newest_ns, self._newest.get("FrameDuration", self._period_us)
        period_ns = round(1000 * float(period_us))
        if time_ns is None or now.monotonic_ns - time_ns > FRAMES_AFTER * period_ns + 1_000_000_000:
            return None
        return time_ns + now.wall_ns - now.monotonic_ns, period_ns

    def _revive(self) -> None:
        """Restart a camera that gives no frames. Raises CameraGoneError if it gives none even then, or hangs."""
        log.error("the camera gives no frames and is restarted")
        failures: list[Exception] = []

        def restart() -> None:
            try:
                self._camera.cancel_all_and_flush()
                self._camera.stop()
                self._camera.start()
            except (RuntimeError, OSError, MemoryError) as error:
                failures.append(error)

        with self._frames:
            self._newest_ns = None
        worker = threading.Thread(target=restart, name="restart", daemon=True)  # a driver that hangs hangs it alone
        worker.start()
        worker.join(RESTART_TIMEOUT)
        if worker.is_alive():
            raise CameraGoneError(f"the camera gives no frames and does not stop within {RESTART_TIMEOUT:g} s")
        if failures:
            remedy = self._memory_remedy(failures[0]) or "check its cable"
            raise CameraGoneError(f"the camera gives no frames and cannot be restarted: {failures[0]}; {remedy}")
        wait = RESTART_TIMEOUT + FRAMES_AFTER * self._period_us / 1e6
        with self._frames:
            if not self._frames.wait_for(lambda: self._newest_ns is not None, wait):
                raise CameraGoneError(
                    f"the camera gives no frames, not even {wait:g} s after a restart; check its cable"
                )

    def versions(self) -> dict[str, str]:
        """Model of the sensor and versions of picamera2 and libcamera, which must fit each other."""
        model = self._camera.camera_properties.get("Model", "unknown")
        return {
            "camera": f"pi {model}",
            "picamera2": package_version("picamera2", "python3-picamera2"),
            "libcamera": package_version("libcamera", "python3-libcamera"),
        }

    def close(self) -> None:
        """Stop the stream and release the camera."""
        self._camera.stop()
        self._camera.close()


def package_version(distribution: str, package: str) -> str:
    """Version of a Python distribution or, where Python knows none, of a Debian package; ``unknown`` without either."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        pass
    query = shutil.which("dpkg-query")
    if query is None:
        return "unknown"
    command = [query, "-W", "-f", "${Version}", package]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=5.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return answer.stdout.strip() or "unknown"
