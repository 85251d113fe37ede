"""Nodes with clocks of their own on real Zenoh: every exposure is at its moment, and every time on one clock."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from ringdic.session.writer import Archive
from ringdic_controller.rig.capture import MS, SECOND, Timing
from ringdic_controller.rig.link import RigLink
from ringdic_node.cameras.pattern import PatternCamera
from ringdic_node.clock import Instant, SystemClock
from ringdic_node.config import NodeConfig
from ringdic_node.service import NodeService
from ringdic_node.spool import Spool

TIMING = Timing(arm=20 * SECOND, arm_retry=SECOND // 2, lead=700 * MS, collect=20 * SECOND)
# A loaded test machine answers slowly; what is shown is that the truth lies within whatever error is stated.
TOLERANCE = 50 * MS
HOUR = 3600 * SECOND


AHEAD = {"a": 0, "b": 200 * MS, "c": -HOUR}


class OwnClock(SystemClock):
    """This machine's clocks, the wall clock set by `ahead` and the monotonic one begun at another moment."""

    def __init__(self, ahead: int, monotonic_lead: int) -> None:
        self.ahead, self.monotonic_lead = ahead, monotonic_lead

    def now(self) -> Instant:
        true = super().now()
        return Instant(true.wall_ns + self.ahead, true.monotonic_ns + self.monotonic_lead)


class WatchedCamera(PatternCamera):
    """A camera that also keeps when it exposed, by this machine's clock, and claims no time but its own clock's."""

    def __init__(self, camera: str, clock: OwnClock) -> None:
        super().__init__(camera, clock, width=16, height=12, jitter_us=0.0)
        self.exposed: list[int] = []

    def capture(self, shot):
        frame = super().capture(shot)
        self.exposed.append(time.time_ns())
        return replace(frame, time_ns=self._clock.now().wall_ns)


class Rig:
    """Three nodes in threads of this process, with clocks as in `AHEAD`."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self.clocks, self.cameras, self.services, self.threads = {}, {}, [], []
        for k, (name, ahead) in enumerate(AHEAD.items()):
            self.clocks[name] = clock = OwnClock(ahead, k * HOUR)
            self.cameras[name] = camera = WatchedCamera(name, clock)
            config = NodeConfig("ring", name, self.endpoint, folder / f"spool-{name}", "pattern", status_s=0.3)
            self.services.append(NodeService(config, camera, Spool(config.spool), clock))

    def start(self) -> None:
        self.threads = [threading.Thread(target=service.run, daemon=True) for service in self.services]
        for thread in self.threads:
            thread.start()

    def stop(self) -> None:
        for service in self.services:
            service.stop()
        for thread in self.threads:
            thread.join(10)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    rig.start()
    yield rig
    rig.stop()


def test_clocks_that_are_off_or_set_fire_at_the_moment_and_are_told(rig: Rig, tmp_path: Path, rig_toml):
    archive = Archive(tmp_path / "archive")
    cameras = list(AHEAD)
    step = 300 * MS
    events: list[dict] = []

    def on_event(event: dict) -> None:
        events.append(event)
        if event.get("capture_id") == "0002-static" and event["state"] == "open" and rig.clocks["b"].ahead == 200 * MS:
            rig.clocks["b"].ahead += step  # between arming and trigger

    with RigLink("ring", cameras, rig.endpoint, archive, on_event, timing=TIMING, tolerance_ns=TOLERANCE) as link:
        assert link.wait_for_nodes(30) == []
        session = archive.create_session("s", rig_toml("ring", cameras))
        first, second = link.capture(session, "static"), link.capture(session, "static")
        roster = {node["id"]: node for node in link.roster()}

    for number, record in enumerate((first, second)):
        for name, entry in record.cameras.items():
            assert entry.status == "ok", entry.reason
            late = rig.cameras[name].exposed[number] - record.fire_at_ns
            assert -entry.clock_error_ns - MS < late < 400 * MS, "exposed when planned, whatever the node's clock shows"
            ahead = AHEAD[name] + (step if (name, number) == ("b", 1) else 0)
            assert abs(entry.clock_offset_ns - ahead) <= entry.clock_error_ns + MS
            assert abs(entry.time_ns - rig.cameras[name].exposed[number]) <= entry.clock_error_ns + 200 * MS
            assert record.exposed_late_ns(name) == entry.time_ns - record.fire_at_ns
            stepped = abs((entry.clock_step_ns or 0) - step) < TOLERANCE
            assert stepped == ((name, number) == ("b", 1)), "a clock that is set after arming is noted"
        assert record.skew_ns < 400 * MS
        assert record.skew_error_ns <= 2 * TOLERANCE
    for name, node in roster.items():
        assert 0 < node["clock_error_ms"] <= TOLERANCE / MS
        ahead = rig.clocks[name].ahead / MS
        assert abs(node["clock_offset_ms"] - ahead) <= node["clock_error_ms"] + 1.0 or name == "b"
