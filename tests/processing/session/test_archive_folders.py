"""The archive: folders that never lose or replace an image, and records that tell the truth about them."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace

import pytest
from ringdic.errors import InputError
from ringdic.session.records import ImageDescription, SessionError
from ringdic.session.writer import Archive

SECOND = 1_000_000_000
RIG = '[rig]\nname = "ring"\n[[cameras]]\nid = "201"\nazimuth_deg = 0\n[[cameras]]\nid = "202"\nazimuth_deg = 30\n'


@pytest.fixture
def archive(tmp_path):
    return Archive(tmp_path / "archive", wall_ns=lambda: 1_700_000_000 * SECOND)


@pytest.fixture
def capture(archive):
    session = archive.create_session("first", RIG)
    return session.begin_capture("board", ["201", "202"], fire_at_ns=50, tolerance_ns=1000)


def described(image: bytes, time_ns: int = 60) -> ImageDescription:
    return ImageDescription(hashlib.sha256(image).hexdigest(), 4, 3, time_ns, 5000.0, {"Lux": 7})


def test_a_session_begins_with_its_rig_and_its_header(archive):
    session = archive.create_session("first", RIG)
    assert (session.path / "rig.toml").read_text() == RIG
    header = json.loads((session.path / "session.json").read_text())
    assert header == {
        "schema": 1,
        "session": "first",
        "rig": "ring",
        "created": "2023-11-14T22:13:20.000+00:00",
        "source": "capture",
    }
    assert session.cameras == ("201", "202")
    assert archive.sessions() == ["first"]


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".hidden", "a b", "x" * 65])
def test_a_session_name_that_could_leave_the_archive_is_refused(archive, name):
    with pytest.raises(InputError, match="session name"):
        archive.create_session(name, RIG)
    with pytest.raises(InputError, match="session name"):
        archive.open(name)


def test_a_session_is_never_made_twice(archive):
    archive.create_session("first", RIG)
    with pytest.raises(FileExistsError, match="'first' exists already"):
        archive.create_session("first", RIG)


def test_a_session_that_is_not_there_is_named(archive):
    with pytest.raises(SessionError, match="'second'"):
        archive.open("second")


def test_captures_are_numbered_through_the_session(archive):
    session = archive.create_session("first", RIG)
    made = [session.begin_capture(kind, ["201"]).capture_id for kind in ("board", "board", "target", "specimen")]
    assert made == ["0001-board", "0002-board", "0003-target", "0004-specimen"]
    assert session.count("board") == 2
    assert [record.capture_id for record in session.captures()] == made
    with pytest.raises(InputError, match="film"):
        session.begin_capture("film", ["201"])


def test_an_image_is_stored_as_it_came_and_the_record_says_so(capture):
    assert capture.store("201", described(b"pixels"), b"pixels").verdict == "archived"
    assert (capture.path / "201.pgm").read_bytes() == b"pixels"
    entry = json.loads((capture.path / "capture.json").read_text())["cameras"]["201"]
    assert entry == {
        "status": "ok",
        "reason": None,
        "file": "201.pgm",
        "sha256": hashlib.sha256(b"pixels").hexdigest(),
        "bytes": 6,
        "width": 4,
        "height": 3,
        "time_ns": 60,
        "exposure_us": 5000.0,
        "metadata": {"Lux": 7},
        "original": None,
    }
    assert capture.record().cameras["202"].status == "pending"


def test_a_repeat_changes_nothing(capture):
    capture.store("201", described(b"pixels"), b"pixels")
    before = (capture.path / "capture.json").read_bytes()
    assert capture.store("201", described(b"pixels"), b"pixels").verdict == "repeat"
    assert (capture.path / "capture.json").read_bytes() == before
    assert sorted(p.name for p in capture.path.iterdir()) == ["201.pgm", "capture.json"]


def test_another_image_is_kept_aside_and_the_first_stays(capture):
    capture.store("201", described(b"pixels"), b"pixels")
    for _ in range(2):
        assert capture.store("201", described(b"other"), b"other").file == "201.conflict-1.pgm"
    assert capture.store("201", described(b"third"), b"third").file == "201.conflict-2.pgm"
    assert (capture.path / "201.pgm").read_bytes() == b"pixels"
    assert capture.record().cameras["201"].sha256 == hashlib.sha256(b"pixels").hexdigest()


def test_a_wrong_checksum_is_never_stored(capture):
    with pytest.raises(ValueError, match="checksum"):
        capture.store("201", described(b"pixels"), b"pixelz")
    assert not (capture.path / "201.pgm").exists()


def test_a_crash_between_image_and_record_is_healed_by_the_repeat(capture, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            capture.store("201", described(b"pixels"), b"pixels")
    assert capture.record().cameras["201"].file is None
    capture.store("201", described(b"pixels"), b"pixels")
    assert capture.record().cameras["201"].status == "ok"


def test_the_close_names_every_missing_camera_and_measures_the_skew(capture):
    capture.store("201", described(b"pixels"), b"pixels")
    record = capture.close({"202": "the node disappeared"})
    assert record.state == "closed"
    assert record.cameras["202"].status == "failed"
    assert record.cameras["202"].reason == "the node disappeared"
    assert record.skew_ns is None, "one frame has no spread"

    # The late image counts in the skew: 1060 - 60 = 1000 is not beyond the tolerance of 1000.
    capture.store("202", described(b"late", 1060), b"late")
    record = capture.record()
    assert record.cameras["202"].status == "delivered-late"
    assert (record.skew_ns, record.skew_exceeded) == (1000, False)


def test_a_skew_beyond_the_tolerance_is_flagged(capture):
    capture.store("201", described(b"a", 0), b"a")
    capture.store("202", described(b"b", 1001), b"b")
    assert capture.close().skew_exceeded is True


def test_an_archived_image_is_not_overruled_by_a_failure(capture):
    capture.store("201", described(b"pixels"), b"pixels")
    capture.fail("201", "too slow")
    assert capture.record().cameras["201"].status == "ok"


def test_captures_left_open_are_closed_with_the_reason(archive, capture):
    capture.store("201", described(b"pixels"), b"pixels")
    (capture.path / ".partial-202.pgm-1-2").write_bytes(b"half")
    again = Archive(archive.root)
    assert again.close_unfinished("the controller was restarted") == ["first/0001-board"]
    record = capture.record()
    assert record.state == "closed"
    assert record.cameras["201"].status == "ok"
    assert record.cameras["202"].reason == "the controller was restarted"
    assert not list(capture.path.glob(".partial*"))
    assert again.close_unfinished("once more") == []


def test_a_damaged_record_is_named(capture):
    (capture.path / "capture.json").write_text("{")
    with pytest.raises(SessionError, match=r"capture\.json"):
        capture.record()


def test_delivered_late_and_exposed_late_are_two_things(capture):
    fire = capture.record().fire_at_ns
    capture.store("201", described(b"a", fire + 700), b"a")
    capture.close()
    capture.store("202", described(b"b", fire), b"b")
    record = capture.record()
    assert (record.cameras["201"].status, record.exposed_late_ns("201")) == ("ok", 700)
    assert (record.cameras["202"].status, record.exposed_late_ns("202")) == ("delivered-late", 0)


def test_the_error_of_the_clocks_and_the_rolling_shutter_are_stated_beside_the_skew(capture):
    slow = replace(described(b"a", 0), height=101, row_time_ns=20.0, clock_offset_ns=-7, clock_error_ns=300)
    capture.store("201", slow, b"a")
    capture.store("202", replace(described(b"b", 100), clock_offset_ns=5, clock_error_ns=400), b"b")
    record = capture.close()
    assert (record.skew_ns, record.skew_error_ns, record.skew_exceeded) == (100, 700, False)
    assert record.readout_ns == 2000
    assert record.cameras["201"].clock_offset_ns == -7


def test_a_clock_that_is_not_known_to_within_the_tolerance_is_flagged(capture):
    capture.store("201", replace(described(b"a", 0), clock_error_ns=1001), b"a")
    capture.store("202", described(b"b", 0), b"b")
    assert capture.close().skew_exceeded is True
