"""The catalogue says what the folders say, whatever became of them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from ringdic.session.records import CaptureRecord
from ringdic_controller.archive.catalogue import Catalogue


def a_session(root: Path, name: str, kinds: tuple[str, ...], created: str = "2026-01-01T00:00:00+00:00") -> Path:
    folder = root / name
    (folder / "captures").mkdir(parents=True)
    header = {"schema": 1, "session": name, "rig": "ring-12", "created": created, "source": "import"}
    (folder / "session.json").write_text(json.dumps(header))
    for number, kind in enumerate(kinds, 1):
        a_capture(folder, number, kind)
    return folder


def a_capture(folder: Path, number: int, kind: str) -> None:
    name = f"{number:04d}-{kind}"
    (folder / "captures" / name).mkdir()
    record = CaptureRecord(name, number, kind, folder.name, "closed")
    (folder / "captures" / name / "capture.json").write_text(json.dumps(record.to_json()))


def test_sessions_are_listed_newest_first_with_their_counts(tmp_path: Path) -> None:
    a_session(tmp_path, "older", ("board", "board", "target"))
    a_session(tmp_path, "newer", (), created="2026-02-01T00:00:00+00:00")
    sessions = Catalogue(tmp_path).sessions()
    assert [session["name"] for session in sessions] == ["newer", "older"]
    assert sessions[1]["captures"] == {"board": 2, "target": 1}


def test_folders_that_appear_grow_and_vanish_are_followed(tmp_path: Path) -> None:
    catalogue = Catalogue(tmp_path)
    assert catalogue.sessions() == []
    folder = a_session(tmp_path, "limb", ("board",))
    catalogue.sync()
    assert [record["capture_id"] for record in catalogue.captures("limb")] == ["0001-board"]
    a_capture(folder, 2, "target")
    catalogue.sync()
    assert [record["capture_id"] for record in catalogue.captures("limb")] == ["0001-board", "0002-target"]
    run = folder / "results" / "0001"
    run.mkdir(parents=True)
    (run / "results.h5").touch()
    (run / "summary.json").write_text('{"points": 7}')
    (folder / "results" / ".0002.partial").mkdir()
    catalogue.sync()
    assert [(run["run"], run["summary"]) for run in catalogue.runs("limb")] == [("0001", {"points": 7})]
    shutil.rmtree(folder)
    catalogue.sync()
    assert catalogue.sessions() == []
    with pytest.raises(KeyError):
        catalogue.path("limb")


def test_captures_come_by_number_beyond_four_digits(tmp_path: Path) -> None:
    folder = a_session(tmp_path, "long", ())
    for number in (10000, 9999, 2):
        a_capture(folder, number, "specimen")
    numbers = [record["number"] for record in Catalogue(tmp_path).captures("long")]
    assert numbers == [2, 9999, 10000]


def test_a_damaged_record_is_named_and_hides_nothing_else(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = a_session(tmp_path, "limb", ("board", "target"))
    (folder / "captures" / "0001-board" / "capture.json").write_text("{ torn")
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "session.json").write_bytes(b"\xff\xfe")
    (tmp_path / "no-session").mkdir()
    catalogue = Catalogue(tmp_path)
    limb, torn = catalogue.sessions()
    assert (limb["name"], torn["name"], torn["rig"]) == ("limb", "torn", None)
    assert "0001-board" in limb["damaged"][0]
    assert "session.json" in torn["damaged"][0]
    assert [record["capture_id"] for record in catalogue.captures("limb")] == ["0002-target"]
    assert "0001-board" in caplog.text


def test_one_capture_is_read_anew_without_the_others(tmp_path: Path) -> None:
    folder = a_session(tmp_path, "limb", ("board",))
    catalogue = Catalogue(tmp_path)
    a_capture(folder, 2, "target")
    a_capture(folder, 3, "specimen")
    assert catalogue.refresh_capture("limb", "0002-target") == catalogue.capture("limb", "0002-target")
    assert [record["number"] for record in catalogue.captures("limb")] == [1, 2], "the third was not looked at"
    assert catalogue.refresh_capture("limb", "0009-board") is None
    a_session(tmp_path, "later", ("board",))
    assert catalogue.refresh_capture("later", "0001-board") is not None, "a session made since the last look"
