"""The records of a session: JSON in, JSON out, unchanged; what is unknown is kept, what is wrong is named."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ringdic.session.names import CAPTURE_KINDS, capture_id, split_capture_id
from ringdic.session.records import CaptureRecord, SessionError, SessionRecord, read_capture_record
from ringdic.session.writer import Archive

ENTRY = {
    "status": "ok", "reason": None, "file": "201.pgm", "sha256": "ab", "bytes": 6, "width": 4, "height": 3,
    "time_ns": 60, "exposure_us": 5000.0, "metadata": {"Lux": 7}, "original": None,
}  # fmt: skip
CAPTURE = {
    "schema": 1, "capture_id": "0001-board", "number": 1, "kind": "board", "session": "first", "state": "closed",
    "opened_at": "2023-11-14T22:13:20.000+00:00", "closed_at": "2023-11-14T22:13:21.000+00:00", "fire_at_ns": 50,
    "skew_ns": None, "tolerance_ns": 1000, "skew_exceeded": None, "override": False, "cameras": {"201": ENTRY},
}  # fmt: skip
SESSION = {"schema": 1, "session": "first", "rig": "ring", "created": "2023", "source": "import"}

values = st.none() | st.booleans() | st.integers() | st.text(max_size=5) | st.lists(st.integers(), max_size=2)
more = st.dictionaries(st.text(max_size=8).filter(lambda name: name not in {*CAPTURE, *ENTRY, *SESSION}), values)


@given(more, more)
def test_a_record_is_written_as_it_was_read_with_the_fields_of_a_later_version(own: Any, of_camera: Any) -> None:
    document = {**CAPTURE, **own, "cameras": {"201": {**ENTRY, **of_camera}}}
    assert json.dumps(CaptureRecord.from_json(document).to_json()) == json.dumps(
        {**CAPTURE, "cameras": document["cameras"], **own}
    )
    assert SessionRecord.from_json({**SESSION, **own}).to_json() == {**SESSION, **own}


def test_fields_of_a_later_version_survive_what_the_writer_changes(tmp_path) -> None:
    session = Archive(tmp_path).create_session("first", '[rig]\nname = "ring"\n[[cameras]]\nid = "201"\n')
    capture = session.begin_capture("board", ["201"])
    file = capture.path / "capture.json"
    document = json.loads(file.read_text())
    document["weather"], document["cameras"]["201"]["lens"] = "fair", 7
    file.write_text(json.dumps(document))
    capture.fail("201", "no light")
    capture.close()
    record = json.loads(file.read_text())
    assert (record["weather"], record["cameras"]["201"]["lens"]) == ("fair", 7)
    assert (record["state"], record["cameras"]["201"]["reason"]) == ("closed", "no light")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema": None}, "schema None"),
        ({"number": 1.0}, "'number' must be a whole number, not 1.0"),
        ({"cameras": {"201": {**ENTRY, "conflicts": {"../x": "ab"}}}}, "'conflicts' must have a checksum"),
        ({"cameras": {"201": {**ENTRY, "conflicts": {"x": 7}}}}, "'conflicts' must have a checksum"),
        ({"number": 2}, "'capture_id' '0001-board' is not that of number 2"),
        ({"override": 1}, "'override' must be true or false, not 1"),
        ({"state": "ajar"}, "'state' is 'open' or 'closed', not 'ajar'"),
        ({"cameras": []}, "'cameras' must have one record a camera"),
        ({"cameras": {"201": 3}}, "camera '201': a table of fields is wanted, not 3"),
        (
            {"cameras": {"201": {"status": "lost"}}},
            "camera '201': 'status' is one of pending, ok, delivered-late, failed",
        ),
        ({"cameras": {"201": {"file": "../202.pgm"}}}, "camera '201': 'file' must be a name in the capture's folder"),
        ({"cameras": {"201": {"bytes": True}}}, "'bytes' must be a whole number or null, not True"),
    ],
)
def test_a_wrong_field_is_named_with_its_file(tmp_path, change: dict[str, Any], words: str) -> None:
    file = tmp_path / "capture.json"
    file.write_text(json.dumps({**CAPTURE, **change}))
    with pytest.raises(SessionError) as refusal:
        read_capture_record(file)
    assert str(refusal.value).startswith(f"{file}: ")
    assert words in str(refusal.value)
    assert str(refusal.value).endswith("; copy it back, or import the session again")


def test_a_record_of_a_newer_schema_asks_for_an_update(tmp_path) -> None:
    file = tmp_path / "capture.json"
    file.write_text(json.dumps({**CAPTURE, "schema": 2}))
    with pytest.raises(SessionError) as refusal:
        read_capture_record(file)
    assert str(refusal.value) == f"{file}: a record of schema 2, but this version reads schema 1; update RingDIC"


def test_a_missing_field_is_named() -> None:
    with pytest.raises(SessionError, match="'state' is missing"):
        CaptureRecord.from_json({name: value for name, value in CAPTURE.items() if name != "state"})


@given(st.integers(0, 10**6), st.sampled_from(CAPTURE_KINDS))
def test_a_captures_name_holds_its_number_and_kind(number: int, kind: str) -> None:
    assert split_capture_id(capture_id(number, kind)) == (number, kind)


def test_records_and_their_writer_load_without_the_packages_of_the_processing() -> None:
    code = (
        "import sys, ringdic.session.folder, ringdic.session.writer;"
        "print([name for name in ('numpy', 'cv2', 'scipy', 'h5py', 'numba', 'zenoh') if name in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"


def test_what_was_armed_and_asked_for_is_written_where_there_is_something_to_say(tmp_path) -> None:
    session = Archive(tmp_path).create_session("first", '[rig]\nname = "ring"\n[[cameras]]\nid = "201"\n')
    plain = session.begin_capture("board", ["201"])
    assert not {"settings", "settings_hash"} & set(json.loads((plain.path / "capture.json").read_text()))
    armed = {"201": {"settings_hash": "ab", "locked": {"ExposureTime": 4000}, "sync": "client, locked"}}
    capture = session.begin_capture("board", ["201"], settings={"exposure_us": 4000}, settings_hash="ab", armed=armed)
    capture.fail("201", "no light")
    capture.close()
    document = json.loads((capture.path / "capture.json").read_text())
    assert document["settings"] == {"exposure_us": 4000}
    assert document["cameras"]["201"]["armed"] == armed["201"]
    assert CaptureRecord.from_json(document).to_json() == document


def test_a_disk_without_room_leaves_neither_half_a_capture_nor_half_a_session(tmp_path, monkeypatch) -> None:
    archive = Archive(tmp_path)
    rig = '[rig]\nname = "ring"\n[[cameras]]\nid = "201"\n'
    session = archive.create_session("first", rig)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            session.begin_capture("board", ["201"])
        with pytest.raises(OSError, match="No space"):
            archive.create_session("second", rig)
    assert list((session.path / "captures").iterdir()) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first"]
    archive.create_session("second", rig)
    assert session.begin_capture("board", ["201"]).capture_id == "0001-board"


def test_a_damaged_record_keeps_no_other_capture_open(tmp_path) -> None:
    archive = Archive(tmp_path)
    session = archive.create_session("first", '[rig]\nname = "ring"\n[[cameras]]\nid = "201"\n')
    damaged, sound = (session.begin_capture("board", ["201"]) for _ in range(2))
    (damaged.path / "capture.json").write_text("{")
    assert archive.close_unfinished("restarted") == ["first/0002-board"]
    assert sound.record().state == "closed"


def test_the_word_of_earlier_releases_for_an_image_delivered_late_is_read(tmp_path) -> None:
    file = tmp_path / "capture.json"
    file.write_text(json.dumps({**CAPTURE, "cameras": {"201": {"status": "late", "reason": "after the close"}}}))
    entry = read_capture_record(file).cameras["201"]
    assert (entry.status, entry.reason, entry.lacks_image) == ("delivered-late", "after the close", False)


def test_a_note_is_kept_with_what_else_the_record_holds_and_an_empty_one_leaves_no_trace(tmp_path) -> None:
    session = Archive(tmp_path).create_session("first", '[rig]\nname = "ring"\n[[cameras]]\nid = "201"\n')
    capture = session.begin_capture("board", ["201"])
    before = (capture.path / "capture.json").read_bytes()
    capture.annotate("  lamp moved, µ\nsecond line ")
    capture.fail("201", "no light")
    assert read_capture_record(capture.path / "capture.json").note == "lamp moved, µ\nsecond line"
    with pytest.raises(SessionError, match="2001 characters; shorten it to 2000"):
        capture.annotate("x" * 2001)
    assert capture.record().note == "lamp moved, µ\nsecond line"
    other = session.begin_capture("board", ["201"])
    other.annotate("one")
    other.annotate(" ")
    assert (other.path / "capture.json").read_bytes().count(b"note") == before.count(b"note") == 0
