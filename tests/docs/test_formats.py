"""The format pages name exactly what real files hold, and the readers keep the promise of compatibility."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.results.fields import OPTIONAL_ARRAYS
from ringdic.results.reader import read_results, read_summary
from ringdic.results.unmeasured import UnmeasuredPlaces
from ringdic.results.writer import write_results
from ringdic.session.folder import open_session
from ringdic.session.load import load_document
from ringdic_node import wire

Named = Callable[[str, str], list[str]]
Table = Callable[[str, str], list[list[str]]]


@pytest.fixture
def session(tutorial: Any, tmp_path: Path) -> Path:
    """A copy of the tutorial's session, without runs."""
    return shutil.copytree(
        tutorial.session, tmp_path / "session", ignore=shutil.ignore_patterns("results", "work", "calibration")
    )


@pytest.fixture
def results(tutorial: Any, tmp_path: Path) -> Path:
    """A copy of the tutorial's results."""
    return shutil.copyfile(tutorial.results, tmp_path / "results.h5")


def change(path: Path, **fields: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text(encoding="utf-8")), **fields}), encoding="utf-8")


# The session ------------------------------------------------------------------------------------


def test_the_tables_name_the_fields_of_session_records(session: Path, named: Named, table: Table) -> None:
    header = json.loads((session / "session.json").read_text(encoding="utf-8"))
    assert named("formats/session.md", "session.json") == list(header)
    often = {row[0].strip("`") for row in table("formats/session.md", "capture.json") if "optional" in row[1]}
    of_cameras = {row[0].strip("`") for row in table("formats/session.md", "Entry of a camera") if "optional" in row[1]}
    captures = sorted((session / "captures").glob("*/capture.json"))
    assert len(captures) == 6 + 1 + 3
    for path in captures:
        record = json.loads(path.read_text(encoding="utf-8"))
        listed = [name for name in named("formats/session.md", "capture.json") if name in record or name not in often]
        assert listed == list(record), path
        for entry in record["cameras"].values():
            wanted = set(named("formats/session.md", "Entry of a camera"))
            assert wanted - of_cameras <= set(entry) <= wanted, path


def test_the_table_names_the_fields_of_a_load(named: Named) -> None:
    assert named("formats/session.md", "load.json") == list(load_document(()))


@pytest.mark.parametrize("name", ["session.json", "captures/0001-board/capture.json"])
def test_a_session_of_a_newer_schema_is_refused(session: Path, name: str) -> None:
    change(session / name, schema=99)
    with pytest.raises(InputError) as refusal:
        open_session(session)
    assert str(session / name) in str(refusal.value)
    assert "schema 99" in str(refusal.value)
    assert "update RingDIC" in str(refusal.value)
    assert "99" in str(refusal.value)


@pytest.mark.parametrize("name", ["session.json", "captures/0001-board/capture.json"])
def test_fields_of_a_session_that_are_not_known_are_ignored(session: Path, name: str) -> None:
    before = open_session(session)
    change(session / name, operator="somebody")
    after = open_session(session)
    assert [capture.images for capture in after.captures] == [capture.images for capture in before.captures]


# Results ----------------------------------------------------------------------------------------


def stored(path: Path, group: str) -> set[str]:
    """The datasets below a group, cameras and what they did not measure under ID, matches under K."""
    names: set[str] = set()

    def take(name: str, item: h5py.Group | h5py.Dataset) -> None:
        parts = name.split("/")
        if parts[0] in ("cameras", "matches", "unmeasured") and len(parts) > 1:
            parts[1] = "K" if parts[0] == "matches" else "ID"
        if isinstance(item, h5py.Dataset):
            names.add("/".join(parts))

    with h5py.File(path) as file:
        file[group].visititems(take)
    return names


@pytest.fixture(scope="module")
def complete(tutorial: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tutorial's results with everything that a run can know, and a strain window."""
    results = read_results(tutorial.results)
    F, N, M = len(results.steps), len(results.vertices_ref), len(results.faces)
    shapes = {"point": (F, N), "vector": (F, N, 3), "face": (F, M, 2)}
    known = {name: np.full(shapes[kind], 1e-3) for name, kind in OPTIONAL_ARRAYS.items()}
    settings = results.settings.replace("window_mm = 0.0", "window_mm = 12.0")
    path = tmp_path_factory.mktemp("complete") / "results.h5"
    bare = UnmeasuredPlaces(results.cameras[0].id, np.zeros((1, 2)), 15.0, np.ones(1, np.int8), np.ones(1))
    write_results(path, dataclasses.replace(results, settings=settings, unmeasured=(bare,), **known))
    return path


@pytest.mark.parametrize("heading", ["PointData", "CellData"])
def test_the_tables_name_the_arrays_of_results(tutorial: Any, complete: Path, heading: str, table: Table) -> None:
    rows = table("formats/results.md", heading)
    names = {row[0].strip("`") for row in rows}
    always = {row[0].strip("`") for row in rows if row[3] == "always"}
    found = stored(tutorial.results, f"VTKHDF/{heading}")
    assert always <= found <= names
    assert stored(complete, f"VTKHDF/{heading}") == names


def test_the_tables_name_the_rest_of_results(complete: Path, named: Named) -> None:
    assert stored(complete, "ringdic") == set(named("formats/results.md", "Datasets"))
    with h5py.File(complete) as file:
        assert set(file["ringdic"].attrs) == set(named("formats/results.md", "Attributes"))


@pytest.mark.parametrize("read", [read_results, read_summary])
def test_results_of_another_schema_are_refused(results: Path, read: Callable[[Path], Any]) -> None:
    with h5py.File(results, "r+") as file:
        file["ringdic"].attrs["schema"] = 99
    with pytest.raises(InputError, match="schema 99") as refusal:
        read(results)
    assert str(results) in str(refusal.value)


def test_what_is_not_known_in_results_is_ignored(results: Path) -> None:
    before = read_results(results)
    with h5py.File(results, "r+") as file:
        file["ringdic"].attrs["operator"] = "somebody"
        file["ringdic/extra"] = np.arange(3)
        file["VTKHDF/PointData/extra"] = np.zeros(len(file["VTKHDF/PointData/measured"]))
    np.testing.assert_array_equal(read_results(results).vertices, before.vertices)


# The wire ---------------------------------------------------------------------------------------

KEY = wire.CaptureKey("first", "0001-board", 1)
HASH = "0" * 64
MANIFEST = wire.Manifest("a", KEY, "board", HASH, 10, 2, 2, 1)
MESSAGES: tuple[wire.Message, ...] = (
    wire.Arm("first", "board", {}, HASH, ("a",)),
    wire.ArmReply("a", True, HASH),
    wire.Trigger(KEY, "board"),
    wire.TriggerReply("a", KEY, "accepted"),
    MANIFEST,
    wire.Failure("a", KEY, "no frame"),
    wire.Inventory("a", (MANIFEST,)),
    wire.Fetch(KEY),
    wire.Ack("a", KEY, HASH),
    wire.NodeStatus("a", "idle", False, 1, 0, 0),
    wire.ClockReading("a", 1, 2, 3),
)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.TYPE)
def test_the_tables_name_the_fields_of_messages(message: wire.Message, table: Table) -> None:
    document = json.loads(wire.encode(message))
    rows = {row[0].strip("`"): row[1] for row in table("formats/wire.md", message.TYPE)}
    assert ["schema", "type", *rows] == list(document)
    without = {name: value for name, value in document.items() if "optional" not in rows.get(name, "")}
    assert wire.decode(json.dumps(without).encode()).TYPE == message.TYPE
    for name in set(without) & set(rows):
        less = {each: value for each, value in document.items() if each != name}
        with pytest.raises(wire.WireError, match=name):
            wire.decode(json.dumps(less).encode())


def test_the_page_describes_every_message(pages: Path) -> None:
    section = (pages / "formats/wire.md").read_text(encoding="utf-8").split("## Messages")[1].split("## Delivery")[0]
    described = [line.removeprefix("### ") for line in section.splitlines() if line.startswith("### ")]
    assert described == [message.TYPE for message in MESSAGES]


def test_messages_of_another_schema_and_with_unknown_fields_are_understood() -> None:
    document = json.loads(wire.encode(wire.Fetch(KEY)))
    assert wire.decode(json.dumps({**document, "schema": 99, "operator": "somebody"}).encode()) == wire.Fetch(KEY)


def test_the_page_names_the_schemas(table: Table) -> None:
    from ringdic.results.layout import SCHEMA as RESULTS
    from ringdic.session.records import SCHEMA as RECORDS

    schemas = [row[1] for row in table("formats/index.md", "Formats and compatibility")]
    assert schemas == [str(RECORDS), str(RESULTS), str(wire.SCHEMA), "–"]
