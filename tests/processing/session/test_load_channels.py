"""Load channels: archived beside a capture, never replaced unasked, and read at the capture's moment."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ringdic.cli.app import application
from ringdic.errors import InputError
from ringdic.session.folder import open_session
from ringdic.session.load import LoadChannel, LoadConflictError, load_series, read_load
from ringdic.session.records import ImageDescription, SessionError
from ringdic.session.verification import verify_session
from ringdic.session.writer import Archive
from typer.testing import CliRunner

RigText = Callable[[str, Sequence[str]], str]
MOMENTS = (1000, 2000, 3000)


@pytest.fixture
def session(tmp_path: Path, rig_toml: RigText) -> Path:
    """Three specimen captures, exposed at `MOMENTS` ± 100 ns; the last has no image, and only its planned moment."""
    writer = Archive(tmp_path).create_session("pull", rig_toml("ring", ["201", "202"]))
    for moment in MOMENTS:
        capture = writer.begin_capture("specimen", ["201", "202"], fire_at_ns=moment if moment == 3000 else 5)
        for camera, apart in (("201", -100), ("202", 100)) if moment < 3000 else ():
            content = f"P5 4 3 255 {camera} {moment}".encode()
            sha256 = hashlib.sha256(content).hexdigest()
            capture.store(camera, ImageDescription(sha256, 4, 3, moment + apart), content)
        capture.close({})
    return tmp_path / "pull"


def load(*words: object):
    return CliRunner().invoke(application(), ["load", *map(str, words)])


def table(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@given(st.integers(0, 1000), st.integers(1, 1000), st.integers(1, 1000), st.floats(-1e6, 1e6), st.floats(-10, 10))
def test_a_straight_line_is_read_exactly_inside_and_not_at_all_outside(start, span, more, offset, slope) -> None:
    origin = 1_700_000_000_000_000_000
    times = [origin + start, origin + start + span, origin + start + span + more]
    channel = LoadChannel("force", "N", tuple((time, offset + slope * (time - origin)) for time in times))
    for time in range(times[0], times[-1] + 1, max(1, (span + more) // 20)):
        assert channel.at(time) == pytest.approx(offset + slope * (time - origin), rel=1e-9, abs=1e-6)
    assert channel.at(times[-1]) == channel.values[-1][1]
    assert all(math.isnan(channel.at(time)) for time in (times[0] - 1, times[-1] + 1, None))
    assert LoadChannel.from_json(json.loads(json.dumps(channel.to_json()))) == channel


@pytest.mark.parametrize(
    ("name", "unit", "values"),
    [
        ("a b", "N", 1.0),
        ("f", "N]", 1.0),
        ("f", "N", math.nan),
        ("f", "N", True),
        ("f", "N", ()),
        ("f", "N", ((2, 1.0), (2, 1.0))),
        ("f", "N", ((-1, 1.0),)),
        ("f", "N", ((1, math.inf),)),
        ("f", "N", ((1.5, 1.0),)),
        ("f", "N", (1.0,)),
    ],
)
def test_a_channel_that_says_nothing_usable_is_refused(name, unit, values) -> None:
    with pytest.raises(InputError):
        LoadChannel(name, unit, values)


def test_a_line_is_read_at_the_median_of_the_measured_times_else_at_the_planned_moment(session: Path) -> None:
    folders = [capture.folder for capture in open_session(session).captures]
    writer = Archive(session.parent).open("pull")
    line = LoadChannel("force", "N", ((500, 5.0), (2500, 25.0)))
    for folder in folders:
        writer.capture(folder.name).store_load(line)
    writer.capture(folders[2].name).store_load(LoadChannel("force", "N", ((2000, 20.0), (4000, 40.0))), replace=True)
    writer.capture(folders[1].name).store_load(LoadChannel("travel", "mm", 0.25))
    force, travel = load_series(folders)
    assert (force.heading, force.values) == ("force [N]", pytest.approx((10.0, 20.0, 30.0)))
    assert (travel.heading, travel.values) == ("travel [mm]", pytest.approx((math.nan, 0.25, math.nan), nan_ok=True))
    assert open_session(session).captures[1].load == (line, LoadChannel("travel", "mm", 0.25))
    writer.capture(folders[2].name).store_load(LoadChannel("travel", "m", 1.0))
    with pytest.raises(SessionError, match=r"'travel' is in 'm', in an earlier capture in 'mm'"):
        load_series(folders)


def test_other_values_of_a_channel_are_kept_unless_they_are_to_be_replaced(session: Path) -> None:
    capture = Archive(session.parent).open("pull").capture("0001-specimen")
    first = LoadChannel("force", "N", 1.0)
    capture.store_load(first)
    written = (capture.path / "load.json").stat().st_mtime_ns
    capture.store_load(first)
    with pytest.raises(LoadConflictError, match="force"):
        capture.store_load(LoadChannel("force", "N", 2.0))
    assert read_load(capture.path) == (first,)
    assert (capture.path / "load.json").stat().st_mtime_ns == written
    assert capture.store_load(LoadChannel("force", "N", 2.0), replace=True) == (LoadChannel("force", "N", 2.0),)


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"schema": 2, "channels": []}', '{"schema": 1, "channels": [{"name": 1}]}']
)
def test_the_verification_knows_the_file_and_names_a_damaged_one(session: Path, text: str) -> None:
    capture = Archive(session.parent).open("pull").capture("0001-specimen")
    capture.store_load(LoadChannel("force", "N", 1.0))
    assert (verify_session(session).faults, verify_session(session).notes) == ({}, ())
    file = capture.path / "load.json"
    file.write_text(text)
    assert list(verify_session(session).faults) == [file]
    with pytest.raises(SessionError, match=r"load\.json"):
        capture.store_load(LoadChannel("force", "N", 2.0), replace=True)
    assert file.read_text() == text


def test_a_table_is_archived_by_step_or_by_capture(session: Path, tmp_path: Path) -> None:
    steps = table(tmp_path / "steps.csv", "\ufeffstep,force [N],count", "0,1.5,7", "2,3.5,")
    assert load(session, steps).exit_code == 0
    assert read_load(session / "captures" / "0001-specimen") == (
        LoadChannel("force", "N", 1.5),
        LoadChannel("count", "", 7.0),
    )
    assert read_load(session / "captures" / "0002-specimen") == ()
    assert read_load(session / "captures" / "0003-specimen") == (LoadChannel("force", "N", 3.5),)
    named = table(
        tmp_path / "named.csv", "capture,time_ns,travel [mm]", *(f"0002-specimen,{t},{t / 10}" for t in (1, 3))
    )
    assert load(session, named, "--json").exit_code == 0
    assert read_load(session / "captures" / "0002-specimen") == (LoadChannel("travel", "mm", ((1, 0.1), (3, 0.3))),)


def test_a_table_that_contradicts_the_archive_changes_nothing_unless_it_may(session: Path, tmp_path: Path) -> None:
    load(session, table(tmp_path / "first.csv", "step,force [N]", "1,1"))
    other = table(tmp_path / "other.csv", "step,force [N]", "0,5", "1,2")
    refused = load(session, other)
    assert isinstance(refused.exception, InputError)
    assert "0002-specimen" in str(refused.exception)
    assert "--replace" in str(refused.exception)
    assert read_load(session / "captures" / "0001-specimen") == ()
    assert load(session, other, "--replace").exit_code == 0
    assert read_load(session / "captures" / "0002-specimen") == (LoadChannel("force", "N", 2.0),)


@pytest.mark.parametrize(
    ("lines", "fault"),
    [
        (("force [N]", "1"), "'step' or 'capture'"),
        (("step,force [N]", "3,1"), "line 2: no step '3'; the session has 3"),
        (("step,force [N]", "-1,1"), "no step"),
        (("capture,force [N]", "0009-specimen,1"), "no capture '0009-specimen'"),
        (("step,force [N]", "0,1", "0,2"), "line 3: 0001-specimen has a row already, in line 2"),
        (("step,force [N]", "0,strong"), "'strong'"),
        (("step,force [N]", "0,nan"), "no number"),
        (("step,force [N]", "0,1,2"), "3 cells under 2 headings"),
        (("step,the force [N]", "0,1"), "'the force' is not a name"),
        (("step", "0"), "no column with a channel"),
        (("step,f,f", "0,1,2"), "same heading"),
        (("step,f",), "no row"),
        ((), "first line"),
    ],
)
def test_what_is_wrong_with_a_table_is_named(session: Path, tmp_path: Path, lines, fault: str) -> None:
    refused = load(session, table(tmp_path / "load.csv", *lines))
    assert isinstance(refused.exception, InputError)
    assert fault in str(refused.exception)
    assert "load.csv" in str(refused.exception)
    assert not list(session.glob("captures/*/load.json"))
