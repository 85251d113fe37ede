"""The Pi camera's logic against a stand-in for picamera2 that runs a sensor freely in a thread."""

from __future__ import annotations

import sys
import threading
import time
import types

import numpy as np
import pytest
from ringdic_node.cameras.camera import CameraError, Shot
from ringdic_node.cameras.pi import PiCamera, frame_time
from ringdic_node.clock import Instant, SystemClock

PERIOD_NS = 20_000_000
MS = 1_000_000


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
    """Frames every 20 ms; controls reach the sensor three frames late; may go silent."""

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
            self.pre_callback(StandInRequest(self.number, metadata, self.ledger))

    def cancel_all_and_flush(self) -> None:
        self.silent = False

    def stop(self) -> None:
        self.started = False

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def camera(monkeypatch):
    module = types.ModuleType("picamera2")
    module.Picamera2 = StandInCamera
    monkeypatch.setitem(sys.modules, "picamera2", module)
    camera = PiCamera(SystemClock(), size=(8, 6), period_us=20_000, settle_frames=3)
    yield camera
    camera.close()


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


def test_a_silent_camera_is_restarted_and_told(camera):
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
