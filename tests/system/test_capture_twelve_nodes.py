"""Real node processes on loopback: captures, killed nodes, killed controllers. Nothing is lost, nothing is wrong."""

from __future__ import annotations

import hashlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.session.folder import open_session
from ringdic.session.writer import Archive, SessionWriter
from ringdic_controller.rig.capture import MS, SECOND, Timing
from ringdic_controller.rig.link import RigLink
from ringdic_controller.rig.rounds import CaptureRefusedError
from ringdic_node.cli import main as node_command

RigToml = Callable[[str, Sequence[str]], str]
Differing = Callable[[Path], list[str]]
WIDTH, HEIGHT = 640, 480
EXPOSURE = "[capture]\nexposure_us = 4000\n"
# A loaded test machine needs more lead than a rig; the other waits are short so that failures show soon.
TIMING = Timing(lead=1500 * MS, collect=25 * SECOND, pull_after=2 * SECOND, pull_every=1 * SECOND)


def expected_file(camera: str, kind: str, scene: int) -> bytes:
    """The PGM that a pattern camera must deliver, computed here from its definition."""
    shift = zlib.crc32(f"{camera}/{kind}/{scene}".encode())
    rows = [[(x + 2 * y + shift) % 251 for x in range(WIDTH)] for y in range(HEIGHT)]
    return f"P5\n{WIDTH} {HEIGHT}\n255\n".encode() + np.array(rows, np.uint8).tobytes()


class Ring:
    """Node processes that can be started and killed one by one."""

    def __init__(self, folder: Path, cameras: list[str], delay: float) -> None:
        self.folder, self.cameras, self.delay = folder, cameras, delay
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self.processes: dict[str, subprocess.Popen] = {}

    def start(self, camera: str) -> None:
        config = self.folder / f"{camera}.toml"
        config.write_text(
            f'rig = "test-ring"\nid = "{camera}"\ncontroller = "{self.endpoint}"\n'
            f'spool = "spool-{camera}"\ncamera = "pattern"\nresend_s = 2.0\nstatus_s = 0.5\n'
            f"[pattern]\nwidth = {WIDTH}\nheight = {HEIGHT}\ndelay = {self.delay}\n"
        )
        with open(self.folder / f"{camera}.log", "ab") as log:
            self.processes[camera] = subprocess.Popen(
                [sys.executable, "-P", "-m", "ringdic_node", "run", "--config", str(config)], stderr=log, stdout=log
            )

    def kill(self, camera: str) -> None:
        self.processes[camera].send_signal(signal.SIGKILL)
        self.processes[camera].wait(10)

    def spooled(self, camera: str) -> list[Path]:
        """Manifests of the images that are not delivered."""
        manifests = sorted((self.folder / f"spool-{camera}").glob("*.json"))
        return [path for path in manifests if not path.with_suffix(".freed").exists()]

    def log(self, camera: str) -> str:
        return (self.folder / f"{camera}.log").read_text()


def start_ring(folder: Path, cameras: list[str], delay: float) -> Iterator[Ring]:
    ring = Ring(folder, cameras, delay)
    try:
        for camera in cameras:
            ring.start(camera)
        yield ring
    finally:
        for process in ring.processes.values():
            if process.poll() is None:
                process.terminate()
        for process in ring.processes.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(10)


@pytest.fixture
def twelve(tmp_path: Path) -> Iterator[Ring]:
    yield from start_ring(tmp_path, [f"cam_{i:02d}" for i in range(1, 13)], delay=0.6)


@pytest.fixture
def three(tmp_path: Path) -> Iterator[Ring]:
    yield from start_ring(tmp_path, ["a", "b", "c"], delay=0.05)


def until(condition: Callable[[], bool], timeout: float) -> bool:
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.05)
    return condition()


def assert_archived(session: SessionWriter, capture_id: str, camera: str, kind: str, scene: int) -> None:
    """The file is the pattern, and its checksum is what the record says."""
    content = (session.path / "captures" / capture_id / f"{camera}.pgm").read_bytes()
    assert content == expected_file(camera, kind, scene)
    entry = session.capture(capture_id).record().cameras[camera]
    assert entry.sha256 == hashlib.sha256(content).hexdigest()
    assert (entry.bytes, entry.width, entry.height) == (len(content), WIDTH, HEIGHT)
    assert entry.exposure_us == 4000.0, "the cameras hold what rig.toml asks for"


def test_a_node_killed_in_the_middle_of_a_capture(
    twelve: Ring, tmp_path: Path, rig_toml: RigToml, differing_images: Differing
):
    archive = Archive(tmp_path / "archive")
    victim, others = "cam_05", [camera for camera in twelve.cameras if camera != "cam_05"]
    events: list[dict] = []

    with RigLink(
        "test-ring", twelve.cameras, twelve.endpoint, archive, events.append, timing=TIMING, reconcile_s=1.0
    ) as rig:
        assert rig.wait_for_nodes(60) == []
        session = archive.create_session("kill", rig_toml("test-ring", twelve.cameras) + EXPOSURE)

        whole = rig.capture(session, "board")
        assert {c: e.status for c, e in whole.cameras.items()} == dict.fromkeys(twelve.cameras, "ok")
        # Each simulated frame is off by 30 µs (one sigma): the spread of twelve is positive and far below 1 ms.
        assert 0 < whole.skew_ns < 1_000_000
        assert whole.skew_exceeded is False

        # The victim dies after its trigger, while its sensor reads out; nothing is in its spool yet.
        fired = threading.Event()

        def assassin() -> None:
            opened = until(lambda: any(e.get("capture_id") == "0002-target" for e in list(events)), 20)
            fire_at_ns = session.capture("0002-target").record().fire_at_ns if opened else 0
            while opened and time.time_ns() < fire_at_ns + 200 * MS:
                time.sleep(0.005)
            twelve.kill(victim)
            fired.set()

        thread = threading.Thread(target=assassin)
        thread.start()
        record = rig.capture(session, "target")
        thread.join(30)
        assert fired.is_set()
        assert record.state == "closed"
        failed = {c: e.reason for c, e in record.cameras.items() if e.status != "ok"}
        assert list(failed) == [victim]
        assert "disappeared" in failed[victim]
        for camera in others:
            assert_archived(session, "0002-target", camera, "target", 0)
        assert not (session.path / "captures/0002-target" / f"{victim}.pgm").exists()
        assert differing_images(session.path) == []

        roster = {node["id"]: node for node in rig.roster()}
        assert roster[victim]["alive"] is False
        assert all(roster[camera]["alive"] for camera in others)
        assert until(lambda: not any(twelve.spooled(camera) for camera in others), 10), (
            "acknowledged images may be removed"
        )

        # Started anew, the node takes part again.
        twelve.start(victim)
        assert rig.wait_for_nodes(30) == []
        again = rig.capture(session, "specimen")
        assert {e.status for e in again.cameras.values()} == {"ok"}
    read = open_session(session.path)
    assert [len(capture.images) for capture in read.captures] == [12, 11, 12]


CONTROLLER = """
import sys
from pathlib import Path
from ringdic.session.writer import Archive
from ringdic_controller.rig.capture import MS, SECOND, Timing
from ringdic_controller.rig.link import RigLink
from ringdic_controller.rig.rounds import CaptureRefusedError

root, endpoint = Path(sys.argv[1]), sys.argv[2]
archive = Archive(root)
timing = Timing(lead=800 * MS, collect=25 * SECOND)
with RigLink("test-ring", ["a", "b", "c"], endpoint, archive, lambda event: None, timing=timing) as rig:
    assert rig.wait_for_nodes(30) == []
    session = archive.open("burst")
    while True:
        rig.capture(session, "specimen")
"""


def test_a_controller_and_a_node_killed_in_a_burst_lose_nothing(
    three: Ring, tmp_path: Path, rig_toml: RigToml, differing_images: Differing
):
    root = tmp_path / "archive"
    session = Archive(root).create_session("burst", rig_toml("test-ring", three.cameras) + EXPOSURE)
    # Nodes come up first, try in vain for a while, and must find the controller when it appears.
    assert until(lambda: all("serves" in three.log(camera) for camera in three.cameras), 30)
    time.sleep(1.5)
    process = subprocess.Popen([sys.executable, "-c", CONTROLLER, str(root), three.endpoint], env=os.environ)
    try:
        # Dead in the middle of the third capture: its record is open and its cameras are about to fire.
        assert until(lambda: (session.path / "captures/0003-specimen/capture.json").exists(), 40)
        fire_at_ns = session.capture("0003-specimen").record().fire_at_ns
        assert until(lambda: time.time_ns() > fire_at_ns, 5)
    finally:
        process.kill()
        process.wait(10)
    # The image of b is on its disk and nowhere else when b dies too; it delivers after its next start.
    held = "burst~0003-specimen"
    assert until(lambda: any(path.name.startswith(held) for path in three.spooled("b")), 10)
    three.kill("b")
    three.start("b")
    with RigLink("test-ring", three.cameras, three.endpoint, Archive(root), lambda event: None, reconcile_s=0.5) as rig:
        assert rig.wait_for_nodes(30) == []
        assert until(lambda: all(e.file for record in session.captures() for e in record.cameras.values()), 30), (
            session.captures()
        )
        assert until(lambda: not any(three.spooled(camera) for camera in three.cameras), 10)
    # Killed in the third capture; the fourth had at most begun.
    assert [record.capture_id for record in session.captures()][:3] == [f"000{n}-specimen" for n in (1, 2, 3)]
    assert all(record.state == "closed" for record in session.captures())
    for record in session.captures():
        for camera in three.cameras:
            assert_archived(session, record.capture_id, camera, "specimen", record.number - 1)
    assert differing_images(session.path) == []


def test_a_capture_is_refused_while_a_camera_is_absent_unless_the_operator_overrides(
    three: Ring, tmp_path: Path, rig_toml: RigToml
):
    archive = Archive(tmp_path / "archive")
    cameras = [*three.cameras, "ghost"]
    timing = replace(TIMING, arm=5 * SECOND, arm_retry=1 * SECOND)
    with RigLink("test-ring", cameras, three.endpoint, archive, lambda event: None, timing=timing) as rig:
        assert rig.wait_for_nodes(0.1) != []
        assert until(lambda: sum(node["alive"] for node in rig.roster()) == 3, 30)
        session = archive.create_session("gap", rig_toml("test-ring", cameras) + EXPOSURE)
        with pytest.raises(CaptureRefusedError, match="ghost: not armed: the node is not connected") as caught:
            rig.capture(session, "board")
        assert list(caught.value.reasons) == ["ghost"]
        assert session.captures() == [], "a refused capture leaves no folder"

        record = rig.capture(session, "board", override=True)
        assert record.override is True
        assert record.cameras["ghost"].status == "failed"
        assert "not connected" in record.cameras["ghost"].reason
        assert [record.cameras[camera].status for camera in three.cameras] == ["ok"] * 3

        # Settings that no camera knows are refused by every node, with the name.
        with pytest.raises(CaptureRefusedError, match="unknown camera setting 'iso'"):
            rig.capture(session, "board", override=True, settings={"iso": 100})

        # One host, one clock: the offsets seen are the errors of the measurement.
        offsets = [node["clock_offset_ms"] for node in rig.roster() if node["alive"]]
        assert len(offsets) == 3
        assert max(map(abs, offsets)) < 500
        assert node_command(["check", "--config", str(three.folder / "a.toml")]) == 0
        assert rig.preview("a") is not None
        assert rig.preview("ghost", timeout=0.5) is None
    for camera in three.cameras:
        three.processes[camera].terminate()
        assert three.processes[camera].wait(10) == 0, three.log(camera)


def test_an_endpoint_in_use_is_refused_by_name(tmp_path: Path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        rig = RigLink("test-ring", ["a"], endpoint, Archive(tmp_path), lambda event: None)
        with pytest.raises(InputError, match=f"cannot listen on '{endpoint}' .*in use"):
            rig.__enter__()
