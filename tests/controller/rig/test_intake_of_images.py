"""Images from the network: archived and then acknowledged, refused, or left with their node."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import pytest
from ringdic.session.writer import Archive
from ringdic_controller.rig.intake import Intake
from ringdic_node.wire import CaptureKey, Failure, Manifest

RIG = '[rig]\nname = "ring"\n[[cameras]]\nid = "201"\n[[cameras]]\nid = "202"\n'
IMAGE = b"P5\n2 1\n255\nab"


class RecordedIntake:
    """An intake into a session with one open capture, and all that it acknowledges and reports."""

    def __init__(self, root, limit: int = 1 << 20) -> None:
        self.archive = Archive(root)
        self.acks: list[tuple[str, str]] = []
        self.archived: list[str] = []
        self.events: list[dict] = []
        self.intake = Intake(
            self.archive,
            lambda manifest, verdict: self.acks.append((manifest.node, verdict)),
            lambda manifest: self.archived.append(manifest.node),
            self.events.append,
            limit=limit,
        )
        self.session = self.archive.create_session("s", RIG)
        self.capture = self.session.begin_capture("board", ["201", "202"], fire_at_ns=50)


@pytest.fixture
def recorded(tmp_path):
    return RecordedIntake(tmp_path)


def manifest_of(image: bytes = IMAGE, camera: str = "201", fire_at_ns: int = 50) -> Manifest:
    key = CaptureKey("s", "0001-board", fire_at_ns)
    return Manifest(camera, key, "board", hashlib.sha256(image).hexdigest(), len(image), 2, 1, 60)


def test_an_image_is_acknowledged_when_it_lies_in_the_archive(recorded):
    recorded.intake.take(manifest_of(), IMAGE)
    assert (recorded.capture.path / "201.pgm").read_bytes() == IMAGE
    assert recorded.acks == [("201", "archived")]
    assert recorded.archived == ["201"]
    assert recorded.events[-1]["cameras"]["201"]["status"] == "ok"


def test_a_repeat_is_acknowledged_again_because_the_first_may_have_been_lost(recorded):
    recorded.intake.take(manifest_of(), IMAGE)
    recorded.intake.take(manifest_of(), IMAGE)
    assert recorded.acks == [("201", "archived")] * 2
    assert len(recorded.events) == 1


def test_a_damaged_image_is_neither_archived_nor_acknowledged(recorded):
    recorded.intake.take(manifest_of(), IMAGE[:-1])
    recorded.intake.take(manifest_of(), IMAGE[:-1] + b"c")
    assert recorded.acks == []
    assert not (recorded.capture.path / "201.pgm").exists()


@pytest.mark.parametrize(
    "manifest",
    [
        manifest_of(fire_at_ns=51),
        manifest_of(camera="203"),
        replace(manifest_of(), key=CaptureKey("elsewhere", "0001-board", 50)),
        replace(manifest_of(), key=CaptureKey("s", "0002-board", 50)),
    ],
    ids=["another moment", "another camera", "another session", "another capture"],
)
def test_an_image_of_no_capture_here_is_told_to_be_unknown(recorded, manifest):
    recorded.intake.take(manifest, IMAGE)
    assert [verdict for _, verdict in recorded.acks] == ["unknown"]
    assert sorted(path.name for path in recorded.capture.path.iterdir()) == ["capture.json"]
    assert not recorded.intake.wants(manifest)


def test_a_second_image_of_a_camera_is_kept_aside_and_safe(recorded):
    recorded.intake.take(manifest_of(), IMAGE)
    recorded.intake.take(manifest_of(b"other"), b"other")
    assert recorded.acks == [("201", "archived")] * 2
    assert (recorded.capture.path / "201.pgm").read_bytes() == IMAGE
    assert (recorded.capture.path / "201.conflict-1.pgm").read_bytes() == b"other"


def test_a_second_image_of_a_camera_is_shown_in_record_and_event(recorded):
    recorded.intake.take(manifest_of(), IMAGE)
    for _ in range(2):
        recorded.intake.take(manifest_of(b"other"), b"other")
    entry = recorded.capture.record().cameras["201"]
    assert entry.conflicts == {"201.conflict-1.pgm": hashlib.sha256(b"other").hexdigest()}
    assert "201.conflict-1.pgm" in entry.reason
    assert recorded.events[-1]["cameras"]["201"] == {"status": "ok", "reason": entry.reason}
    recorded.intake.take(manifest_of(b"third"), b"third")
    assert recorded.capture.record().cameras["201"].reason.count("different image") == 1
    recorded.capture.close()
    recorded.acks.clear()
    assert not recorded.intake.wants(manifest_of(b"other")), "it is archived, though under another name"
    assert recorded.acks == [("201", "archived")]


def test_an_image_taken_with_other_settings_is_named_in_the_record(recorded):
    capture = recorded.session.begin_capture("board", ["201", "202"], fire_at_ns=70, settings_hash="a" * 64)
    for camera, settings_hash in (("201", "a" * 64), ("202", "b" * 64)):
        key = CaptureKey("s", capture.capture_id, 70)
        manifest = replace(
            manifest_of(camera=camera), key=key, settings_hash=settings_hash, exposure_us=77.0, unknown={"lens": 1}
        )
        recorded.intake.take(manifest, IMAGE)
    one, two = (capture.record().cameras[camera] for camera in ("201", "202"))
    assert (one.status, one.reason, one.settings_hash) == ("ok", None, "a" * 64)
    assert "other settings (bbbbbbbb…, exposure 77 µs) than the capture's (aaaaaaaa…)" in two.reason


def test_an_image_that_was_acknowledged_but_is_not_archived_is_wanted_again(recorded):
    recorded.capture.close()
    assert recorded.intake.wants(manifest_of(), delivered=True)
    recorded.intake.take(manifest_of(), IMAGE)
    recorded.acks.clear()
    assert not recorded.intake.wants(manifest_of(), delivered=True)
    assert recorded.acks == [], "it was acknowledged before"


def test_what_a_node_still_holds_is_wanted_only_if_the_closed_capture_lacks_it(recorded):
    assert not recorded.intake.wants(manifest_of()), "the open round pulls by itself"
    recorded.capture.close()
    assert recorded.intake.wants(manifest_of())
    recorded.intake.take(manifest_of(), IMAGE)
    recorded.acks.clear()
    assert not recorded.intake.wants(manifest_of())
    assert recorded.acks == [("201", "archived")], "the acknowledgement had been lost"
    assert recorded.capture.record().cameras["201"].status == "delivered-late"


def test_a_full_inbox_drops_and_a_worked_off_one_takes_again(tmp_path):
    recorded = RecordedIntake(tmp_path, limit=len(IMAGE))
    assert recorded.intake.put(manifest_of(), IMAGE)
    assert not recorded.intake.put(manifest_of(camera="202"), IMAGE)
    assert not recorded.intake.has_room(1)
    recorded.intake.start()
    recorded.intake.stop(timeout=10)
    assert recorded.intake.has_room(len(IMAGE))
    assert recorded.acks == [("201", "archived")]


def test_an_image_that_waits_already_takes_no_second_room(tmp_path):
    recorded = RecordedIntake(tmp_path, limit=len(IMAGE))
    assert not recorded.intake.holds(manifest_of())
    assert recorded.intake.put(manifest_of(), IMAGE)
    assert recorded.intake.holds(manifest_of())
    assert recorded.intake.put(manifest_of(), IMAGE), "pulled while it was being pushed"
    recorded.intake.start()
    recorded.intake.stop(timeout=10)
    assert recorded.acks == [("201", "archived")]
    assert not recorded.intake.holds(manifest_of())


def test_images_archived_side_by_side_are_all_in_the_record(tmp_path, differing_images):
    cameras = [f"cam_{k:02d}" for k in range(40)]
    recorded = RecordedIntake(tmp_path)
    capture = recorded.session.begin_capture("board", cameras, fire_at_ns=70)
    for camera in cameras:
        key = CaptureKey("s", capture.capture_id, 70)
        recorded.intake.put(replace(manifest_of(camera.encode(), camera), key=key), camera.encode())
    recorded.intake.start()
    recorded.intake.stop(timeout=30)
    assert sorted(recorded.acks) == [(camera, "archived") for camera in cameras]
    assert {entry.status for entry in capture.record().cameras.values()} == {"ok"}
    assert differing_images(recorded.session.path) == []


def test_whoever_watches_does_not_keep_the_node_waiting(recorded):
    recorded.intake = Intake(
        recorded.archive,
        lambda manifest, verdict: recorded.events.append({"ack": verdict}),
        lambda manifest: None,
        recorded.events.append,
    )
    recorded.intake.take(manifest_of(), IMAGE)
    assert [event.get("ack") for event in recorded.events] == ["archived", None]


def test_a_damaged_record_costs_no_image_and_does_not_end_the_archivist(recorded):
    (recorded.capture.path / "capture.json").write_text("{")
    second = recorded.session.begin_capture("board", ["201"], fire_at_ns=70)
    recorded.intake.put(manifest_of(), IMAGE)
    recorded.intake.put(replace(manifest_of(), key=CaptureKey("s", second.capture_id, 70)), IMAGE)
    recorded.intake.start()
    recorded.intake.stop(timeout=10)
    assert recorded.acks == [("201", "archived")], "the first stays with its node, the second is safe"


def test_a_nodes_own_reason_replaces_a_general_one(recorded):
    recorded.capture.close({"201": "no image arrived", "202": "no image arrived"})
    key = CaptureKey("s", "0001-board", 50)
    recorded.intake.note_failure(Failure("201", key, "the camera timed out"))
    recorded.intake.note_failure(Failure("202", replace(key, fire_at_ns=51), "of another session"))
    cameras = recorded.capture.record().cameras
    assert cameras["201"].reason == "the camera timed out"
    assert cameras["202"].reason == "no image arrived"


def test_a_bug_in_whoever_watches_ends_no_archivist(recorded):
    def fail(_):
        raise KeyError("somebody else's")

    recorded.intake._on_event = fail
    recorded.capture.close()
    for n in range(6):  # more than there are archivists
        capture = recorded.session.begin_capture("board", ["201"], fire_at_ns=70 + n)
        key = CaptureKey("s", capture.capture_id, 70 + n)
        recorded.intake.put(replace(manifest_of(), key=key), IMAGE)
    recorded.intake.start()
    recorded.intake.stop(timeout=10)
    assert recorded.acks == [("201", "archived")] * 6
