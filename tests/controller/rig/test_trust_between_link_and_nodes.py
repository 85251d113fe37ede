"""Node services and the controller's link over real Zenoh, with somebody else on the network, or with a full disk."""

from __future__ import annotations

import hashlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zenoh
from ringdic.errors import ComputationError
from ringdic.session import writer as session_writer
from ringdic.session.writer import Archive, SessionWriter
from ringdic_controller.rig.capture import MS, SECOND, Timing
from ringdic_controller.rig.link import RigLink
from ringdic_controller.rig.rounds import CaptureRefusedError
from ringdic_node.cameras.pattern import PatternCamera
from ringdic_node.clock import SystemClock
from ringdic_node.config import NodeConfig
from ringdic_node.service import NodeService
from ringdic_node.spool import Spool
from ringdic_node.wire import Ack, CaptureKey, Keys, Manifest, NodeStatus, decode_as, encode

CAMERAS = ["a", "b"]
KEYS = Keys("ring")
TIMING = Timing(arm=10 * SECOND, lead=600 * MS, pull_after=500 * MS, pull_every=300 * MS, collect=3 * SECOND)


class Rig:
    """A link, its archive with one session, and nodes that are threads of this process."""

    def __init__(self, folder: Path, rig_toml: str) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self.folder = folder
        self.events: list[dict[str, Any]] = []
        self.archive = Archive(folder / "archive")
        self.rig_toml = rig_toml
        self.session: SessionWriter
        self.link = RigLink(
            "ring", CAMERAS, self.endpoint, self.archive, self.events.append, timing=TIMING, tolerance_ns=50 * MS,
            reconcile_s=0.3,
        )  # fmt: skip
        self.nodes: dict[NodeService, threading.Thread] = {}

    def start(self, camera: str, spool: str = "", **more: Any) -> NodeService:
        folder = self.folder / (spool or f"spool-{camera}")
        config = NodeConfig("ring", camera, self.endpoint, folder, "pattern", resend_s=0.5, status_s=0.2, **more)
        clock = SystemClock()
        service = NodeService(config, PatternCamera(camera, clock, width=40, height=30), Spool(folder), clock)
        thread = threading.Thread(target=service.run, daemon=True)
        thread.start()
        self.nodes[service] = thread
        return service

    def stop(self, service: NodeService) -> None:
        service.stop()
        self.nodes.pop(service).join(10)

    def node(self, camera: str) -> NodeService:
        return next(service for service in self.nodes if service.config.id == camera)

    def begin(self, name: str) -> None:
        """A new session, and both nodes as they were."""
        self.session = self.archive.create_session(name, self.rig_toml)
        self.link._timing = TIMING
        for service in list(self.nodes):
            if service.config.arm_captures != NodeConfig.arm_captures:
                self.stop(service)
        for camera in set(CAMERAS) - {service.config.id for service in self.nodes}:
            self.start(camera)
        assert until(lambda: all(self.entry(camera)["alive"] for camera in CAMERAS), 20)
        self.events.clear()

    def entry(self, camera: str) -> dict[str, Any]:
        return next(entry for entry in self.link.roster() if entry["id"] == camera)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory, rig_toml: Callable[..., str]) -> Iterator[Rig]:
    """The rig of all tests here."""
    rig = Rig(tmp_path_factory.mktemp("rig"), rig_toml("ring", CAMERAS) + "[capture]\nexposure_us = 4000\n")
    with rig.link:
        try:
            yield rig
        finally:
            for service in list(rig.nodes):
                rig.stop(service)


@pytest.fixture
def rig(running: Rig, request: pytest.FixtureRequest) -> Rig:
    """The rig with a session of this test."""
    running.begin(request.node.name[:60])
    return running


def stranger(endpoint: str) -> zenoh.Session:
    """A session of somebody else on the rig's network."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def until(condition: Callable[[], bool], timeout: float = 10.0) -> bool:
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline and not condition():
        time.sleep(0.02)
    return condition()


def test_what_arm_measured_and_the_settings_are_archived_with_the_capture(rig: Rig) -> None:
    record = rig.link.capture(rig.session, "board")
    assert {entry.status for entry in record.cameras.values()} == {"ok"}
    document = json.loads((rig.session.path / "captures/0001-board/capture.json").read_text())
    assert document["settings"] == {"exposure_us": 4000}
    canonical = json.dumps(document["settings"], sort_keys=True, separators=(",", ":")).encode()
    assert document["settings_hash"] == hashlib.sha256(canonical).hexdigest()
    for entry in document["cameras"].values():
        assert entry["settings_hash"] == entry["armed"]["settings_hash"] == document["settings_hash"]
        assert entry["armed"]["locked"] == {"exposure_us": 4000}
        assert entry["armed"]["sync"] == "simulated"
        assert entry["armed"]["host"] == socket.gethostname()
        assert entry["armed"]["address"] == "127.0.0.1"
        assert "ringdic" in entry["armed"]["versions"]
    assert record.cameras["a"].armed["instance"] != record.cameras["b"].armed["instance"]


def test_a_forged_acknowledgement_loses_no_image(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody reads the hashes off the network and acknowledges, while the archive cannot take the images."""
    archived = threading.Event()
    store = session_writer.CaptureWriter.store

    def refuse(self, *arguments, **more):
        if archived.is_set():
            return store(self, *arguments, **more)
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(session_writer.CaptureWriter, "store", refuse)
    forged: list[str] = []
    with stranger(rig.endpoint) as rogue:

        def forge(sample: zenoh.Sample) -> None:
            manifest = decode_as(Manifest, sample.attachment.to_bytes())
            rogue.put(KEYS.node(manifest.node, "ack"), encode(Ack(manifest.node, manifest.key, manifest.sha256)))
            forged.append(manifest.node)

        subscriber = rogue.declare_subscriber(KEYS.image("*"), forge)
        record = rig.link.capture(rig.session, "board")
        assert {entry.status for entry in record.cameras.values()} == {"failed"}
        assert until(lambda: set(forged) == set(CAMERAS))
        assert until(lambda: not any(rig.entry(camera)["spool_images"] for camera in CAMERAS)), "they believed it"
        subscriber.undeclare()
    archived.set()
    records = rig.session.capture("0001-board").record
    assert until(lambda: {entry.status for entry in records().cameras.values()} == {"delivered-late"}), records()
    for camera in CAMERAS:
        content = (rig.session.path / f"captures/0001-board/{camera}.pgm").read_bytes()
        assert hashlib.sha256(content).hexdigest() == records().cameras[camera].sha256


def put_into_spool(rig: Rig, capture_id: str, fire_at_ns: int) -> tuple[Spool, Manifest]:
    """A small image of camera a, stored as if its node had taken it; the node sees it when it starts anew."""
    image = b"P5\n1 1\n255\n!"
    key = CaptureKey(rig.session.name, capture_id, fire_at_ns)
    manifest = Manifest("a", key, "board", hashlib.sha256(image).hexdigest(), len(image), 1, 1, 1)
    spool = Spool(rig.folder / "spool-a")
    spool.store(manifest, [image])
    return spool, manifest


def test_a_damaged_record_keeps_no_other_image_from_the_archive(rig: Rig) -> None:
    """The node lists an image of a capture whose record is unreadable before one that the archive lacks."""
    records = [rig.session.begin_capture("board", CAMERAS, fire_at_ns=n) for n in (1, 2)]
    (records[0].path / "capture.json").write_text("{")
    records[1].close()
    for number, capture in enumerate(records, start=1):
        spool, manifest = put_into_spool(rig, capture.capture_id, number)
        spool.deliver(manifest.key, manifest.sha256)
    rig.stop(rig.node("a"))
    rig.start("a")
    assert until(lambda: records[1].record().cameras["a"].status == "delivered-late")


def test_an_image_that_the_nodes_release_cannot_read_is_told_and_delivered_by_the_one_that_can(rig: Rig) -> None:
    capture = rig.session.begin_capture("board", CAMERAS, fire_at_ns=3)
    capture.close()
    _, manifest = put_into_spool(rig, capture.capture_id, 3)
    path = rig.folder / "spool-a" / f"{manifest.key.stem}.json"
    readable = path.read_bytes()
    path.write_bytes(readable.replace(b'"width"', b'"breadth"').replace(b'"schema":1', b'"schema":9'))
    for _ in range(2):
        rig.stop(rig.node("a"))
        rig.start("a")
        assert until(lambda: "'width' is missing" in rig.entry("a")["detail"])
    assert until(lambda: "stays in the node's spool" in (capture.record().cameras["a"].reason or ""))
    assert "schema 9" in (capture.record().cameras["a"].reason or "")
    path.write_bytes(readable)
    rig.stop(rig.node("a"))
    rig.start("a")
    assert until(lambda: capture.record().cameras["a"].status == "delivered-late")


def test_two_nodes_of_one_id_are_refused_and_shown_and_a_restarted_one_is_not(rig: Rig) -> None:
    first = rig.node("a")
    second = rig.start("a", "spool-cloned")
    assert until(lambda: "2 nodes have the id a" in rig.entry("a")["detail"])
    host = f"{socket.gethostname()} (127.0.0.1)"
    assert rig.entry("a")["detail"].count(host) == 2
    assert any("2 nodes" in event["node"]["detail"] for event in rig.events if event["type"] == "node")
    began = time.monotonic()
    with pytest.raises(CaptureRefusedError, match="not armed: 2 nodes have the id a") as refusal:
        rig.link.capture(rig.session, "board")
    assert list(refusal.value.reasons) == ["a"]
    assert time.monotonic() - began < 5, "at once, not after the time for arming"
    rig.stop(first)
    assert until(lambda: rig.entry("a")["detail"] == "")
    assert rig.entry("a")["alive"], "the other one is still there"
    rig.stop(second)
    assert until(lambda: not rig.entry("a")["alive"])
    rig.start("a")
    assert until(lambda: rig.entry("a")["alive"])
    record = rig.link.capture(rig.session, "board")
    assert {entry.status for entry in record.cameras.values()} == {"ok"}
    assert not any("2 nodes" in event["node"]["detail"] for event in rig.events[-5:] if event["type"] == "node")


def test_an_archive_that_was_full_closes_its_record_when_there_is_room(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = threading.Event()

    def limited(write):
        def act(path: Path, *arguments):
            if full.is_set():
                raise OSError(28, "No space left on device")
            return write(path, *arguments)

        return act

    for name in ("place", "replace_json"):
        monkeypatch.setattr(session_writer, name, limited(getattr(session_writer, name)))
    monkeypatch.setattr(rig.link, "_on_event", lambda event: full.set() if event.get("state") == "open" else None)
    with pytest.raises(ComputationError, match=r"0001-board could not be closed \(No space.*make room"):
        rig.link.capture(rig.session, "board")
    records = rig.session.capture("0001-board").record
    assert records().state == "open"
    with pytest.raises(ComputationError, match="archive takes no record"):
        rig.link.capture(rig.session, "board")
    full.clear()
    assert until(lambda: records().state == "closed")
    assert until(lambda: {entry.status for entry in records().cameras.values()} == {"delivered-late"}), (
        "the images come, too"
    )
    assert sorted(path.name for path in (rig.session.path / "captures").iterdir()) == ["0001-board"]


def test_a_spool_without_room_refuses_arming_with_a_sentence(rig: Rig) -> None:
    rig.stop(rig.node("b"))
    rig.start("b", arm_captures=10**12)
    rig.link._timing = replace(TIMING, arm=2 * SECOND, arm_retry=300 * MS)
    assert until(lambda: "has room for" in rig.entry("b")["detail"]), "the roster shows it before a capture"
    with pytest.raises(CaptureRefusedError, match=r"b: not armed: the spool \S+ has room for \d+ of 10{12} images"):
        rig.link.capture(rig.session, "board")
    assert rig.session.captures() == []


def test_whoever_speaks_for_another_node_is_not_heard(rig: Rig) -> None:
    with stranger(rig.endpoint) as rogue:
        status = NodeStatus("b", "capturing", True, 1, 7, 7, detail="forged")
        for payload in (encode(status), b'{"schema":1,"type":"status","node":' + b"[" * 200_000, b"\xff"):
            rogue.put(KEYS.node("a", "status"), payload)
        rogue.put(KEYS.node("a", "status"), encode(replace(status, node="a", detail="half \ud800")))
        assert until(lambda: any("half" in e["node"]["detail"] for e in rig.events if e["type"] == "node"))
    assert not any("forged" in event["node"]["detail"] for event in rig.events if event["type"] == "node")
    json.dumps(rig.events, ensure_ascii=False, allow_nan=False).encode()
