"""The Pi camera's logic against a stand-in for picamera2 that runs a sensor freely in a thread."""

from __future__ import annotations

import errno
import sys
import threading
import time
import types

import numpy as np
import pytest
from ringdic_node.cameras import pi
from ringdic_node.cameras.camera import CameraError, CameraGoneError, Shot
from ringdic_node.cameras.pi import PiCamera, frame_time
from ringdic_node.cameras.pi_metadata import Settling, frame_monotonic_ns, raw_format
from ringdic_node.clock import Instant, SystemClock

PERIOD_NS = 20_000_000
MS = 1_000_000
SECOND = 1_000_000_000


class SettableClock(SystemClock):
    """This machine's clocks, of which the wall clock may be set by `set`."""

    set = 0

    def now(self) -> Instant:
        true = super().now()
        return Instant(true.wall_ns + self.set, true.monotonic_ns)


class StandInRequest:
    """A completed frame; counts its owners as libcamera does."""

    def __init__(self, number: int, metadata: dict, ledger: dict) -> None:
        self.number, self.metadata, self.ledger = number, metadata, ledger

    def get_metadata(self) -> dict:
        return self.metadata

    def make_array(self, name: str) -> np.ndarray:
        assert self.ledger.get(self.number, 0) > 0, "a released buffer must not be read"
        padded = np.zeros((9, 16), np.uint8)  # the Y plane of 8 x 6, padded stride, then U and V
        padded[:6, :8] = self.number % 256
        return padded

    def acquire(self) -> None:
        self.ledger[self.number] = self.ledger.get(self.number, 0) + 1

    def release(self) -> None:
        self.ledger[self.number] -= 1


class StandInCamera:
    """Frames every 20 ms; controls reach the sensor three frames late; may go silent, or alter its metadata."""

    def __init__(self, tuning=None) -> None:
        self.pre_callback = None
        self.started = False
        self.silent = False
        self.starts = 0
        self.camera_properties = {"Model": "stand-in"}
        self.camera_controls = {"AfMode": (0, 2, 0)}
        self.held = {"ExposureTime": 9000, "AnalogueGain": 3.0, "ColourGains": (1.5, 1.7)}
        self.coming: list[tuple[int, dict]] = []
        self.number = 0
        self.ledger: dict[int, int] = {}
        self.alter = lambda metadata: None

    def create_still_configuration(self, **configuration) -> dict:
        return configuration

    def configure(self, configuration) -> None:
        self.configuration = configuration

    def set_controls(self, controls) -> None:
        self.coming.append((self.number + 3, dict(controls)))

    def start(self) -> None:
        self.started, self.starts = True, self.starts + 1
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self) -> None:
        while self.started:
            time.sleep(PERIOD_NS / 1e9)
            if self.silent:
                continue
            self.number += 1
            for due, controls in self.coming:
                if due <= self.number:
                    self.held.update((k, v) for k, v in controls.items() if k in self.held)
            wall = time.time_ns() // PERIOD_NS * PERIOD_NS
            metadata = {**self.held, "FrameWallClock": wall, "FrameDuration": PERIOD_NS // 1000, "SyncTimer": -3}
            self.alter(metadata)
            self.pre_callback(StandInRequest(self.number, metadata, self.ledger))

    def cancel_all_and_flush(self) -> None:
        self.silent = False

    def stop(self) -> None:
        self.started = False

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def make_camera(monkeypatch):
    module = types.ModuleType("picamera2")
    module.Picamera2 = StandInCamera
    monkeypatch.setitem(sys.modules, "picamera2", module)
    made = []

    def make(clock=None, **settings) -> PiCamera:
        made.append(
            PiCamera(clock or SystemClock(), size=(8, 6), **{"period_us": 20_000, "settle_frames": 3, **settings})
        )
        return made[-1]

    yield make
    for camera in made:
        camera.close()


@pytest.fixture
def camera(make_camera):
    return make_camera()


def test_armed_means_that_the_frames_show_the_settings(camera):
    lock = camera.lock({"exposure_us": 4000, "gain": 1.5})
    assert lock.metadata["ExposureTime"] == 4000
    assert lock.metadata["AnalogueGain"] == 1.5
    assert lock.frame_period_ns == PERIOD_NS


def test_without_settings_the_found_exposure_is_frozen(camera):
    camera.lock({"gain": 2.0})
    held = camera._camera.coming[-1][1]
    assert (held["ExposureTime"], held["AnalogueGain"]) == (9000, 2.0)
    assert (held["AwbEnable"], held["ColourGains"]) == (False, (1.5, 1.7))
    assert held["AfMode"] == 0


def test_the_frame_nearest_to_the_moment_is_kept(camera):
    lock = camera.lock({})
    for phase in (0.0, 0.3, -0.3):
        grid = lock.frame_time_ns + round((time.time_ns() - lock.frame_time_ns) / PERIOD_NS + 8) * PERIOD_NS
        moment = grid + round(phase * PERIOD_NS)
        frame = camera.capture(Shot(moment, "static", 0))
        # A busy machine may skip a frame, never more than one either way.
        assert abs(frame.time_ns - moment) <= PERIOD_NS
        assert frame.pixels.shape == (6, 8)
        assert len(np.unique(frame.pixels)) == 1
        assert frame.metadata["SyncTimer"] == -3
    assert set(camera._camera.ledger.values()) == {0}, "every buffer goes back to the camera"


def test_a_silent_camera_is_restarted_and_told(camera, monkeypatch):
    monkeypatch.setattr(pi, "SPARE_TIME", 0.1)
    camera.lock({})
    camera._camera.silent = True
    time.sleep(0.05)
    with pytest.raises(CameraError, match="no frame came"):
        camera.capture(Shot(time.time_ns(), "static", 0))
    assert camera._camera.starts == 2


def test_an_unknown_setting_is_refused_by_name(camera):
    with pytest.raises(CameraError, match="shutter"):
        camera.lock({"shutter": 1})


def test_a_stamp_on_the_boot_clock_is_carried_to_the_wall_clock():
    class Clock:
        def now(self) -> Instant:
            return Instant(wall_ns=5_000_000, monotonic_ns=1_000_000)

        def sleep(self, seconds: float) -> None: ...

    assert frame_time({"SensorTimestamp": 900_000}, Clock()) == 4_900_000
    assert frame_time({"SensorTimestamp": 900_000, "FrameWallClock": 7}, Clock()) == 7


def test_without_picamera2_the_sentence_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(CameraError, match="apt"):
        PiCamera(SystemClock())


# Times ------------------------------------------------------------------------------------------

NOW = Instant(wall_ns=1_764_500_000 * SECOND, monotonic_ns=5_000 * SECOND)


@pytest.mark.parametrize(
    ("metadata", "ago_ms"),
    [
        ({"FrameWallClock": NOW.wall_ns - 30 * MS}, 30),
        ({"FrameWallClock": (NOW.wall_ns - 30 * MS) // 1000}, 30),
        ({"FrameWallClock": NOW.wall_ns - 30 * MS, "SensorTimestamp": NOW.monotonic_ns - 31 * MS}, 30),
        ({"FrameWallClock": NOW.wall_ns - 330 * MS, "SensorTimestamp": NOW.monotonic_ns - 30 * MS}, 30),
        ({"FrameWallClock": 12345, "SensorTimestamp": NOW.monotonic_ns - 30 * MS}, 30),
        ({"FrameWallClock": NOW.wall_ns - 30 * MS, "SensorTimestamp": 17}, 30),
        ({"FrameWallClock": None, "SensorTimestamp": NOW.monotonic_ns - 30 * MS}, 30),
    ],
    ids=["ns", "µs", "both", "the clock was set", "nonsense", "another boot", "none"],
)
def test_a_frames_time_is_taken_from_the_stamp_that_is_plausible(metadata, ago_ms):
    assert frame_monotonic_ns(metadata, NOW) == pytest.approx(NOW.monotonic_ns - ago_ms * MS, abs=MS)


@pytest.mark.parametrize("metadata", [{}, {"FrameWallClock": 12345}, {"SensorTimestamp": "soon"}])
def test_a_frame_without_a_plausible_stamp_has_no_time(metadata):
    with pytest.raises(CameraError, match="no times near the present"):
        frame_monotonic_ns(metadata, NOW)


def test_the_frame_is_found_although_the_wall_clock_is_set_back_while_it_is_waited_for(make_camera):
    camera = make_camera(clock=(clock := SettableClock()))
    camera.lock({})
    moment = clock.now().wall_ns + 5 * PERIOD_NS

    def set_back(metadata: dict) -> None:
        metadata["SensorTimestamp"] = metadata["FrameWallClock"] - time.time_ns() + time.monotonic_ns()
        if camera._moment is not None:
            clock.set = -3600 * SECOND

    camera._camera.alter = set_back
    frame = camera.capture(Shot(moment, "static", 0))
    assert abs(frame.time_ns - moment) <= 2 * PERIOD_NS


# Locking ----------------------------------------------------------------------------------------


def settled(settling: Settling, *frames: dict) -> list[int]:
    counts = []
    for metadata in frames:
        settling.take(metadata)
        counts.append(settling.frames)
    return counts


def test_automatics_are_frozen_only_when_they_have_converged(camera):
    searching = iter([1] * 12)
    camera._camera.alter = lambda metadata: metadata.update(
        AeState=(state := next(searching, 2)), ExposureTime=9000 if state == 2 else 13_400
    )
    lock = camera.lock({"gain": 3.0, "colour_gains": [1.5, 1.7]})
    assert camera._camera.coming[-1][1]["ExposureTime"] == 9000
    assert lock.metadata["AeState"] == 2


def test_automatics_that_do_not_converge_are_told_in_a_bounded_time(camera, monkeypatch):
    monkeypatch.setattr(pi, "LOCK_TIMEOUT", 0.2)
    camera._camera.alter = lambda metadata: metadata.update(AeState=1)
    with pytest.raises(
        CameraError, match=r"search for ExposureTime and AnalogueGain has not converged; set exposure_us"
    ):
        camera.lock({})


def test_a_white_balance_that_still_moves_is_not_frozen():
    settling = Settling({}, ("ColourGains",))
    moving = [{"ColourGains": (1.5 + 0.1 * k, 1.7)} for k in range(4)]
    assert settled(settling, *moving) == [1, 1, 1, 1]
    assert "ColourGains moves" in settling.fault
    assert settled(settling, moving[-1], moving[-1]) == [2, 3]


@pytest.mark.parametrize(
    ("wanted", "metadata", "told"),
    [
        ({"ExposureTime": 4000}, {"ExposureTime": 4100}, "ExposureTime is 4100 in place of 4000"),
        ({"LensPosition": 2.0}, {"LensPosition": 2.5}, "LensPosition is 2.5"),
        ({"ColourGains": (1.5, 1.7)}, {"ColourGains": (1.5, 2.0)}, "ColourGains"),
    ],
)
def test_a_value_that_is_not_held_is_named(wanted, metadata, told):
    settling = Settling(wanted)
    assert settled(settling, metadata, metadata) == [0, 0]
    assert told in settling.fault


def test_a_digital_gain_that_moves_under_fixed_exposure_is_not_held():
    settling = Settling({"ExposureTime": 4000})
    frames = [{"ExposureTime": 4000, "DigitalGain": gain} for gain in (1.0, 1.0, 1.4, 1.4)]
    assert settled(settling, *frames) == [1, 2, 1, 2]


def test_a_short_exposure_is_rounded_to_a_line_and_held_all_the_same():
    assert settled(Settling({"ExposureTime": 300}), {"ExposureTime": 284}) == [1]


def test_the_lens_is_held_where_it_is(make_camera):
    camera = make_camera()
    camera._camera.camera_controls["LensPosition"] = (0.0, 32.0, 1.0)
    camera._camera.held["LensPosition"] = 2.5
    camera.lock({"exposure_us": 4000, "gain": 1.5, "colour_gains": [1.0, 1.0]})
    assert camera._camera.coming[-1][1]["LensPosition"] == 2.5


def test_a_frame_that_does_not_hold_the_locked_values_says_so(camera):
    camera.lock({"exposure_us": 4000, "gain": 1.5})
    camera._camera.alter = lambda metadata: metadata.update(AnalogueGain=2.5)
    frame = camera.capture(Shot(time.time_ns() + 2 * PERIOD_NS, "static", 0))
    assert frame.metadata["NotHeld"] == ["AnalogueGain 1.5 became 2.5"]


def test_an_earlier_lock_does_not_fix_what_a_later_one_leaves_to_the_automatics(make_camera):
    camera = make_camera()
    camera._camera.camera_controls["ExposureTimeMode"] = (0, 1, 0)
    camera.lock({"exposure_us": 4000, "gain": 1.5, "colour_gains": [1.0, 1.0]})
    before = len(camera._camera.coming)
    camera.lock({"gain": 1.5})
    asked, held = (controls for _, controls in camera._camera.coming[before:])
    assert (asked["ExposureTimeMode"], asked["AwbEnable"], "ExposureTime" in asked) == (0, True, False)
    assert (held["ExposureTimeMode"], held["AwbEnable"], "ExposureTime" in held) == (1, False, True)


# Synchronisation --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("metadata", "count", "told"),
    [
        ({"SyncReady": False}, 0, "nothing has come from the server"),
        ({"SyncReady": False, "SyncTimer": 50 * 20_000 + 120}, 1, ""),
        ({"SyncReady": True, "SyncTimer": -7 * 20_000 - 40}, 1, ""),
        ({"SyncReady": True, "SyncTimer": -7 * 20_000 - 4000}, 0, "-4.00 ms off"),
        ({"SyncReady": True, "SyncTimer": -10_000 * 20_000 - 4000}, 1, ""),
    ],
    ids=["no server", "locked before the start", "locked after it", "ready, but off since", "too long ago to tell"],
)
def test_a_client_is_judged_by_its_phase(metadata, count, told):
    settling = Settling({}, synchronised=True)
    assert settled(settling, {"FrameDuration": 20_000, **metadata}) == [count]
    assert told in settling.fault


def test_a_client_locks_long_before_the_servers_start_moment(make_camera):
    camera = make_camera(sync="client")
    camera._camera.alter = lambda metadata: metadata.update(SyncReady=False, SyncTimer=90 * 20_000)
    assert camera.lock({"exposure_us": 4000, "gain": 1.5}).sync == "client, locked"


# A camera that dies -----------------------------------------------------------------------------


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(pi, "RESTART_TIMEOUT", 0.2)
    monkeypatch.setattr(pi, "LOCK_TIMEOUT", 0.2)
    monkeypatch.setattr(pi, "SPARE_TIME", 0.1)


def test_a_camera_that_was_silent_while_it_was_locked_is_restarted(make_camera, impatient):
    camera = make_camera()
    camera._camera.silent = True
    with pytest.raises(CameraError, match="the camera was restarted: arm again"):
        camera.lock({})
    assert camera.lock({}).metadata["ExposureTime"] == 9000


@pytest.mark.parametrize("fault", ["deaf", "hangs", "broken", "out of memory"])
def test_a_camera_that_a_restart_does_not_revive_is_gone(make_camera, impatient, fault):
    camera = make_camera()
    camera.lock({})
    camera._camera.silent = True
    over = threading.Event()

    def stop() -> None:
        if fault == "hangs":
            over.wait(5)
        elif fault != "deaf":
            raise OSError(errno.ENOMEM if fault == "out of memory" else errno.EIO, "refused by the driver")

    camera._camera.cancel_all_and_flush, usual = stop, camera._camera.cancel_all_and_flush
    with pytest.raises(CameraGoneError, match="CMA" if fault == "out of memory" else "gives no frames"):
        camera.capture(Shot(time.time_ns(), "static", 0))
    over.set()
    usual()


def test_frames_that_stop_before_the_moment_restart_the_camera(camera, monkeypatch):
    monkeypatch.setattr(pi, "SPARE_TIME", 0.1)
    camera.lock({})
    moment = time.time_ns() + 8 * PERIOD_NS
    threading.Timer(3 * PERIOD_NS / 1e9, lambda: setattr(camera._camera, "silent", True)).start()
    with pytest.raises(CameraError, match=r"(stopped before the moment|no frame came).*restarted"):
        camera.capture(Shot(moment, "static", 0))
    assert set(camera._camera.ledger.values()) <= {0}
    assert camera._camera.starts == 2


@pytest.mark.parametrize("number", [errno.ENOMEM, errno.ENODEV])
def test_a_lack_of_contiguous_memory_is_no_ribbon_cable(make_camera, monkeypatch, number):
    def configure(self, configuration) -> None:
        raise OSError(number, "Cannot allocate memory" if number == errno.ENOMEM else "No such device")

    monkeypatch.setattr(StandInCamera, "configure", configure)
    with pytest.raises(CameraError) as caught:
        make_camera(buffers=3)
    memory = number == errno.ENOMEM
    assert ("contiguous memory (CMA) is too small for 3 buffers" in str(caught.value)) == memory
    assert ("ribbon cable" in str(caught.value)) != memory


# Frames and versions ----------------------------------------------------------------------------


def test_the_newest_frame_and_its_period_are_known_while_frames_come(camera):
    lock = camera.lock({})
    time_ns, period_ns = camera.newest_frame()
    assert period_ns == PERIOD_NS
    assert -MS < time_ns - lock.frame_time_ns < 5 * SECOND
    camera._camera.silent = True
    time.sleep(2 * PERIOD_NS / 1e9)
    camera._newest_ns = time.monotonic_ns() - 3 * SECOND
    assert camera.newest_frame() is None


def test_rows_are_read_over_at_most_the_shortest_period_of_the_mode(make_camera):
    for given, row_ns in ((0.0, 46_600 / 6 * 1000), (18.9, 18_900.0)):
        camera = make_camera(row_time_us=given)
        camera._camera.camera_controls["FrameDurationLimits"] = (46_600, 11_000_000, 100_000)
        camera.lock({})
        frame = camera.capture(Shot(time.time_ns() + PERIOD_NS, "static", 0))
        assert frame.row_time_ns == pytest.approx(row_ns)


@pytest.mark.parametrize(
    ("name", "sensor_bits", "expected"),
    [
        ("SBGGR10", 10, ("BGGR", 10, 0)),
        ("SRGGB12", None, ("RGGB", 12, 0)),
        ("SGRBG16", 10, ("GRBG", 10, 6)),
        ("SRGGB16", 12, ("RGGB", 12, 4)),
        ("R16", 10, ("mono", 10, 6)),
    ],
)
def test_raw_values_tell_their_order_and_shift(make_camera, monkeypatch, name, sensor_bits, expected):
    configuration = {"raw": {"format": name}, "sensor": {"bit_depth": sensor_bits} if sensor_bits else None}
    monkeypatch.setattr(StandInCamera, "camera_configuration", lambda self: configuration, raising=False)
    camera = make_camera(raw=True)
    camera.lock({})
    metadata = camera.capture(Shot(time.time_ns() + PERIOD_NS, "static", 0)).metadata
    assert (metadata["BayerOrder"], metadata["RawBits"], metadata["RawShift"]) == expected


@pytest.mark.parametrize("name", ["SBGGR10_CSI2P", "BGGR_PISP_COMP1", "MONO_PISP_COMP1"])
def test_packed_raw_values_are_refused(name):
    with pytest.raises(CameraError, match=f"{name}, which are packed or compressed"):
        raw_format(name, 10)


def test_the_versions_come_from_the_package_manager(camera, monkeypatch):
    monkeypatch.setattr(pi, "version", lambda distribution: {"picamera2": "0.3.38", "libcamera": "0.7.1"}[distribution])
    assert camera.versions() == {"camera": "pi stand-in", "picamera2": "0.3.38", "libcamera": "0.7.1"}
    monkeypatch.undo()
    assert pi.package_version("no-such-distribution", "no-such-package") == "unknown"


@pytest.mark.parametrize(
    "settings",
    [
        {"exposure_us": float("inf")}, {"exposure_us": float("nan")}, {"period_us": 10**400}, {"gain": True},
        {"colour_gains": [1.0]}, {"colour_gains": "red"}, {"colour_gains": [1.0, -1.0]}, {"exposure_us": 1e9},
    ],
)  # fmt: skip
def test_an_absurd_setting_is_refused_by_name(camera, settings):
    with pytest.raises(CameraError, match=next(iter(settings))):
        camera.lock(settings)
