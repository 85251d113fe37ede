"""What the metadata of libcamera's frames mean: times, whether settings are held, formats of raw values.

Facts about libcamera on a Raspberry Pi:

- ``SensorTimestamp`` is on the monotonic clock, ns. ``FrameWallClock`` is the same moment on the wall clock, in ns, but
  in µs before August 2025; after the wall clock was set it follows slowly only.
- ``AeState`` is 0 where exposure and gain are fixed, 1 while they are searched for, 2 once they have converged. The
  white balance reports no state on most versions: its gains must have come to rest.
- ``SyncTimer`` (µs) counts down to the start moment of the synchronised sensors, which lies on the server's frame grid,
  and on below zero: its remainder by the frame period is the phase of this sensor. Far from zero the error of the
  period adds up. ``SyncReady`` stays true once it was set, and tells nothing later.
"""

from __future__ import annotations

import errno
import math
import re
from collections.abc import Mapping
from typing import Any

from ringdic_node.cameras.camera import CameraError
from ringdic_node.clock import Clock, Instant

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
    "AeState",
    "AwbState",
    "SyncReady",
    "SyncTimer",
)
LINE_US = 20.0  # the sensor rounds exposures to whole lines
TOLERANCES = {  # relative, of a value that is held
    "ExposureTime": 0.01,
    "AnalogueGain": 0.02,
    "ColourGains": 0.02,
    "LensPosition": 0.02,
    "DigitalGain": 0.01,
}
SEARCHING = 1  # of AeState and AwbState
PLAUSIBLE_NS = 60_000_000_000  # a frame is no older and no newer than this
AGREEING_NS = 5_000_000  # the two stamps of a frame differ by less, unless the wall clock was set
SYNC_REACH = 300  # frame periods from the start moment within which the phase is known
SYNC_PHASE_US = 1000.0  # largest phase of a sensor that is synchronised


def frame_monotonic_ns(metadata: Mapping[str, Any], now: Instant) -> int:
    """Time of a frame on this machine's monotonic clock, ns.

    Of the two stamps the one that is plausible beside the present moment ``now``; where the wall clock was set, so that
    they disagree, the one of the monotonic clock. Raises CameraError if neither is plausible.
    """
    sensor = metadata.get("SensorTimestamp")
    if not isinstance(sensor, int) or abs(sensor - now.monotonic_ns) > PLAUSIBLE_NS:
        sensor = None
    wall = metadata.get("FrameWallClock")
    for unit in (1, 1000):
        if isinstance(wall, int) and abs(unit * wall - now.wall_ns) <= PLAUSIBLE_NS:
            stamp = unit * wall - (now.wall_ns - now.monotonic_ns)
            return stamp if sensor is None or abs(stamp - sensor) <= AGREEING_NS else sensor
    if sensor is not None:
        return sensor
    raise CameraError(
        f"the frame's time stamps are no times near the present (SensorTimestamp {metadata.get('SensorTimestamp')}, "
        f"FrameWallClock {wall}); check this node's clock and the version of libcamera"
    )


def frame_time(metadata: Mapping[str, Any], clock: Clock) -> int:
    """Wall-clock time of a frame, ns since the Unix epoch; `frame_monotonic_ns` by the present offset of the clocks."""
    now = clock.now()
    return frame_monotonic_ns(metadata, now) + now.wall_ns - now.monotonic_ns


def sync_phase_us(metadata: Mapping[str, Any]) -> float | None:
    """Distance of a synchronised sensor from the server's frame grid, µs; None where the metadata do not tell it."""
    timer, period = metadata.get("SyncTimer"), metadata.get("FrameDuration")
    if timer is None or not period or abs(timer) > SYNC_REACH * period:
        return None
    return float((timer + period / 2) % period - period / 2)


class Settling:
    """Counts consecutive frames that show the wanted values at rest.

    Parameters
    ----------
    wanted
        Values that the frames must show, by the names of libcamera's controls.
    automatic
        Names of values that the automatics are to find: they must have converged and be at rest.
    synchronised
        Whether the sensor must be on the frame grid of the server of the synchronisation.
    """

    def __init__(self, wanted: Mapping[str, Any], automatic: tuple[str, ...] = (), synchronised: bool = False) -> None:
        self._wanted = {name: wanted[name] for name in TOLERANCES if name in wanted}
        self._resting = (*automatic, "DigitalGain")
        self._automatic = automatic
        self._synchronised = synchronised
        self._first: Mapping[str, Any] = {}
        self.frames = 0
        self.fault = ""  # why the newest frame did not count

    def take(self, metadata: Mapping[str, Any]) -> None:
        """Count a frame, or begin anew with it."""
        self.fault = self._not_shown(metadata)
        if self.fault:
            self._first, self.frames = {}, 0
            return
        self.fault = self._moving(metadata)
        if self.fault or self.frames == 0:
            self._first, self.frames = metadata, 1
        else:
            self.frames += 1

    def _moving(self, metadata: Mapping[str, Any]) -> str:
        for name in self._resting:
            before, value = self._first.get(name), metadata.get(name)
            if before is not None and value is not None and not _held(name, value, before):
                return f"{name} moves, from {_plain(before)} to {_plain(value)}"
        return ""

    def _not_shown(self, metadata: Mapping[str, Any]) -> str:
        for name, wanted in self._wanted.items():
            value = metadata.get(name)
            if value is None and name in ("ColourGains", "LensPosition"):
                continue  # not every sensor and lens reports it
            if value is None or not _held(name, value, wanted):
                return f"{name} is {_plain(value)} in place of {_plain(wanted)}"
        for state, locked, names in (
            ("AeState", "AeLocked", ("ExposureTime", "AnalogueGain")),
            ("AwbState", "AwbLocked", ("ColourGains",)),
        ):
            searching = metadata.get(state) == SEARCHING or metadata.get(locked) is False
            if searching and any(name in self._automatic for name in names):
                return f"the automatic search for {' and '.join(names)} has not converged"
        return self._off_grid(metadata) if self._synchronised else ""

    @staticmethod
    def _off_grid(metadata: Mapping[str, Any]) -> str:
        phase = sync_phase_us(metadata)
        if phase is not None and abs(phase) > SYNC_PHASE_US:
            return f"its frames lie {phase / 1000:+.2f} ms off those of the server of the synchronisation"
        if phase is None and not metadata.get("SyncReady"):
            return "nothing has come from the server of the synchronisation"
        return ""


def _held(name: str, value: Any, wanted: Any) -> bool:
    """Whether a value, or each of a pair, is that wanted, within its tolerance."""
    if isinstance(wanted, tuple | list):
        return len(value) == len(wanted) and all(_held(name, *pair) for pair in zip(value, wanted, strict=True))
    least = LINE_US if name == "ExposureTime" else 1e-6
    return abs(float(value) - wanted) <= max(TOLERANCES[name] * abs(wanted), least)


def moved(locked: Mapping[str, Any], metadata: Mapping[str, Any]) -> list[str]:
    """Values of a frame that are not those of the locked camera any more, each as a short sentence."""
    return [
        f"{name} {_plain(locked[name])} became {_plain(metadata[name])}"
        for name in TOLERANCES
        if locked.get(name) is not None and metadata.get(name) is not None
        if not _held(name, metadata[name], locked[name])
    ]


def raw_format(name: str, sensor_bits: int | None) -> dict[str, Any]:
    """Meaning of raw values as they are archived: Bayer order, significant bits, and shift to the left.

    name : libcamera's format, such as ``SBGGR10``. sensor_bits : of the sensor, where it is known. A Pi 5 delivers 16
    bits with the sensor's value in the upper ones. Raises CameraError for a packed or compressed format.
    """
    match = re.fullmatch(r"S?(BGGR|GBRG|GRBG|RGGB|R)(\d+)", name)
    if match is None:
        raise CameraError(f"the camera delivers raw values as {name}, which are packed or compressed; set raw = false")
    bits = int(match[2])
    significant = sensor_bits if bits == 16 and sensor_bits else bits
    order = "mono" if match[1] == "R" else match[1]
    return {"RawFormat": name, "BayerOrder": order, "RawBits": significant, "RawShift": bits - significant}


def recorded(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a frame's metadata that is archived (`RECORDED`), as JSON values."""
    return {name: _plain(metadata[name]) for name in RECORDED if name in metadata}


def lacks_memory(error: Exception) -> bool:
    """Whether an error of the camera is that of the contiguous memory, which is too small for its buffers."""
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    return bool(
        re.search(r"cannot allocate memory|ENOMEM|allocation fail|failed to allocate|out of memory", str(error), re.I)
    )


def _plain(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int | str | bool | type(None)) else str(value)
