"""An archive with damaged and hostile folders, or one that cannot be written: everything else goes on."""

from __future__ import annotations

import errno
import hashlib
import importlib.util
import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import pytest
from fastapi.testclient import TestClient
from ringdic.errors import InputError
from ringdic.results.reader import read_summary
from ringdic.results.writer import write_results
from ringdic.session import files
from ringdic.session.folder import open_session
from ringdic.session.writer import Archive
from ringdic_controller.jobs.jobs import Jobs
from ringdic_controller.service.app import create_app
from ringdic_controller.service.desk import Desk

API = "/api/v1"
DEEP = "[" * 100_000 + "]" * 100_000
RIG = '[rig]\nname = "ring-2"\n[[cameras]]\nid = "01"\n[[cameras]]\nid = "02"\n'
IMAGE = b"P5\n4 3\n255\n" + bytes(12)


def a_session(root: Path, name: str = "limb") -> Path:
    """A session with one capture of one camera, and the folder of it."""
    folder = root / name
    writer = Archive(root).create_session(name, RIG)
    capture = writer.begin_capture("board", ["01"])
    (folder / "image.pgm").write_bytes(IMAGE)
    capture.store_file("01", folder / "image.pgm", 4, 3)
    capture.close()
    return folder


def change(file: Path, **fields: Any) -> None:
    """Change fields of a JSON file."""
    file.write_text(json.dumps(json.loads(file.read_text()) | fields))


@pytest.fixture
def shown(tmp_path: Path):
    """Call it for a client of a desk over the archive, which is opened anew."""
    desks: list[Desk] = []

    def show(root: Path = tmp_path) -> TestClient:
        archive = Archive(root)
        archive.close_unfinished("the controller was restarted")
        desks.append(Desk(root, lambda _: []))
        desks[-1].connect(archive, None)
        return TestClient(create_app(desks[-1]), base_url="http://127.0.0.1", raise_server_exceptions=False)

    yield show
    for desk in desks:
        desk.close()


def tree_of(folder: Path) -> dict[str, str]:
    """Checksums of all files of a folder."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


CAPTURE = "captures/0001-board/capture.json"
DAMAGE: dict[str, tuple[str, bytes]] = {
    "torn": (CAPTURE, b'{"schema": 1, "captu'),
    "empty": (CAPTURE, b""),
    "no text": (CAPTURE, b"\xff\xfe\x00"),
    "deep": (CAPTURE, DEEP.encode()),
    "another form": (CAPTURE, b"[1, 2]"),
    "a number beyond all bounds": (CAPTURE, b'{"schema": 1, "number": ' + b"9" * 5000 + b"}"),
    "a torn header": ("session.json", b'{"schema": 1'),
    "a deep header": ("session.json", DEEP.encode()),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_named_and_stops_nothing(tmp_path: Path, shown, damage: str) -> None:
    a_session(tmp_path, "sound")
    folder = a_session(tmp_path)
    name, content = DAMAGE[damage]
    (folder / name).write_bytes(content)
    before = tree_of(folder)
    client = shown()
    sessions = {session["name"]: session for session in client.get(f"{API}/sessions").json()["sessions"]}
    assert sessions["sound"]["damaged"] == []
    (sentence,) = sessions["limb"]["damaged"]
    assert str(folder / name) in sentence
    assert "copy it back" in sentence
    assert client.get(f"{API}/sessions/limb").json()["damaged"] == [sentence]
    assert client.get(f"{API}/sessions/limb/captures").status_code == 200
    assert tree_of(folder) == before, "nothing is deleted or written"
    number = Archive(tmp_path).open("sound").begin_capture("board", ["01"]).record().number
    assert number == 2


def test_a_damaged_record_that_is_put_back_is_read_again(tmp_path: Path, shown) -> None:
    record = a_session(tmp_path) / CAPTURE
    whole = record.read_bytes()
    record.write_bytes(b"{")
    client = shown()
    assert client.get(f"{API}/sessions/limb").json()["damaged"] != []
    record.write_bytes(whole)
    os.utime(record, ns=(1, 1))  # whatever the clock's resolution
    assert (
        client.get(f"{API}/sessions/limb").json() | {"damaged": [], "captures": {"board": 1}}
        == client.get(f"{API}/sessions/limb").json()
    )


STRANGE: dict[str, Callable[[Path], None]] = {
    "numbers that are not finite": lambda folder: change(folder / CAPTURE, skew_ns=None, lux=float("nan"), far=1e999),
    "half a character": lambda folder: change(folder / CAPTURE, note="\ud800", **{"\udfff": "\udc00"}),
    "half a character in the header": lambda folder: change(folder / "session.json", rig="\ud800", created="\udfff"),
    "a checksum that is none": lambda folder: change(
        folder / CAPTURE,
        cameras={"01": {"status": "ok", "file": "01.pgm", "sha256": "a\r\nSet-Cookie: b=\u20ac"}},
    ),
    "a close at no time": lambda folder: change(folder / CAPTURE, closed_at="yesterday"),
    "a number of another folder": lambda folder: (folder / "captures" / ("9" * 30 + "-board")).mkdir(),
    "a folder in place of a file": lambda folder: (folder / "captures" / "0002-target" / "capture.json").mkdir(
        parents=True
    ),
    "a file in place of a folder": lambda folder: (folder / "results").write_text(""),
    "a name that is no text": lambda folder: os.mkdir(os.fsencode(folder) + b"/captures/\xff"),
}


@pytest.mark.parametrize("what", STRANGE)
def test_what_is_strange_in_a_folder_makes_no_page_fail(tmp_path: Path, shown, what: str) -> None:
    folder = a_session(tmp_path)
    STRANGE[what](folder)
    client = shown()
    for path in ("sessions", "sessions/limb", "sessions/limb/captures", "sessions/limb/results", "sessions/limb/live"):
        answer = client.get(f"{API}/{path}")
        assert answer.status_code in (200, 404), (path, answer.text)
        json.loads(answer.content)
    for path in ("", "/preview"):
        answer = client.get(f"{API}/sessions/limb/captures/0001-board/images/01{path}")
        assert answer.status_code in (200, 404)
        assert "Set-Cookie" not in answer.headers
    desk = client.app.state.desk
    json.dumps(desk.state.snapshot(), allow_nan=False).encode()


@pytest.mark.parametrize("record", ['{"id": "abc"}', DEEP, '{"id": "0007", "session": 5}', "\ud800", "[]"])
def test_a_damaged_job_is_left_out_and_its_number_is_not_taken_again(tmp_path: Path, record: str) -> None:
    (tmp_path / "0007").mkdir()
    (tmp_path / "0007" / "job.json").write_bytes(record.encode("utf-8", "surrogatepass"))
    (tmp_path / "1x").mkdir()
    (tmp_path / "1x" / "job.json").write_text("{}")
    jobs = Jobs(tmp_path, lambda _: ["/no/such/program"])
    assert jobs.list() == []
    assert jobs.submit("limb", tmp_path, reason="asked for").id == "0008"
    jobs.close()


# Links


def stand_in() -> ModuleType:
    """The stand-in of the processing, which makes results whose truth is known."""
    spec = importlib.util.spec_from_file_location("stand_in", Path(__file__).parents[1] / "stand_in_processing.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results file."""
    path = tmp_path_factory.mktemp("results") / "results.h5"
    write_results(path, stand_in().tube(("0001-specimen", "0002-specimen")))
    return path


@pytest.mark.skipif(os.name != "posix", reason="links need rights elsewhere")
def test_a_link_that_leads_out_of_the_archive_is_not_followed(tmp_path: Path, shown, results: Path) -> None:
    root, secret = tmp_path / "archive", tmp_path / "secret"
    folder = a_session(root)
    secret.mkdir()
    (secret / "image.pgm").write_bytes(IMAGE)
    (secret / "session.json").write_bytes((folder / "session.json").read_bytes())
    shutil.copytree(folder / "captures" / "0001-board", secret / "0002-target")
    change(secret / "0002-target" / "capture.json", capture_id="0002-target", number=2, kind="target")
    (secret / "report.html").write_text("<p>secret")
    shutil.copy(results, secret / "results.h5")
    for name, target in {
        "captures/0001-board/01.pgm": "image.pgm",
        "captures/0002-target": "0002-target",
        "results/0001/results.h5": "results.h5",
        "results/0002/report.html": "report.html",
        "results/0003": ".",
        "live/0001-specimen": ".",
        "../linked": ".",
    }.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(secret / target)
    shutil.copy(results, folder / "results" / "0002" / "results.h5")
    client = shown(root)
    address = f"{API}/sessions/limb"
    for path in (
        *("captures/0001-board/images/01", "captures/0001-board/images/01/preview", "captures/0002-target"),
        *("captures/0002-target/images/01", "results/0001", "results/0001/file", "results/0003/file"),
        *("results/0003/report", "live/0001-specimen", "live/0001-specimen/file"),
    ):
        assert client.get(f"{address}/{path}").status_code == 404, path
    assert "secret" not in client.get(f"{address}/results/0002/report").text
    assert client.get(f"{address}/results/0002").status_code == 200, "the others are shown"
    damaged = client.get(address).json()["damaged"]
    assert len(damaged) == 3
    assert all("out of the archive" in sentence for sentence in damaged)
    with pytest.raises(InputError, match=r"01\.pgm.*out of the archive"):
        open_session(folder)


@pytest.mark.parametrize("way", ["link", "storage", "virtual"])
def test_results_whose_numbers_lie_in_another_file_are_not_read(tmp_path: Path, results: Path, way: str) -> None:
    path, other = tmp_path / "results.h5", tmp_path / "other"
    shutil.copy(results, path)
    with h5py.File(other, "w") as file:
        file["a"] = [1.0, 2.0]
    with h5py.File(path, "r+") as file:
        if way == "link":
            file["ringdic/pair2"] = h5py.ExternalLink(str(other), "a")
        elif way == "storage":
            file.create_dataset("ringdic/pair2", (2,), "u1", external=[(str(other), 0, 2)])
        else:
            layout = h5py.VirtualLayout((2,), "f8")
            layout[:] = h5py.VirtualSource(str(other), "a", (2,))
            file.create_virtual_dataset("ringdic/pair2", layout)
    with pytest.raises(InputError, match="lies in another file"):
        read_summary(path)


@pytest.mark.parametrize("part", ["ringdic/summary", "ringdic/reference", "ringdic/faces", "VTKHDF/Points"])
def test_damaged_results_are_a_sentence(tmp_path: Path, shown, results: Path, part: str) -> None:
    path = a_session(tmp_path) / "results" / "0001" / "results.h5"
    path.parent.mkdir(parents=True)
    shutil.copy(results, path)
    with h5py.File(path, "r+") as file:
        del file[part]
    client = shown(tmp_path)
    statuses = set()
    for part in ("", "/faces", "/positions/1", "/fields/lambda1/1"):
        answer = client.get(f"{API}/sessions/limb/results/0001{part}")
        statuses.add(answer.status_code)
        if answer.status_code != 200:
            assert "process the session again" in answer.json()["detail"]
    assert statuses <= {200, 422}
    assert 422 in statuses


# A disk that is full, or cannot be written


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> Callable[[int | None], None]:
    """Call it with the number of an error: from then on no file can be written; with None they can."""
    state: list[int | None] = [None]
    write, sync = Path.write_text, os.fsync

    def refuse() -> None:
        if state[0] is not None:
            raise OSError(state[0], os.strerror(state[0]), "file")

    def write_text(self: Path, *arguments: Any, **more: Any) -> int:
        refuse()
        return write(self, *arguments, **more)

    def fsync(descriptor: int) -> None:
        refuse()
        sync(descriptor)

    monkeypatch.setattr(Path, "write_text", write_text)
    monkeypatch.setattr(files.os, "fsync", fsync)

    def set_error(number: int | None) -> None:
        state[0] = number

    return set_error


@pytest.mark.parametrize(("number", "status"), [(errno.ENOSPC, 507), (errno.EROFS, 503), (errno.EACCES, 503)])
def test_an_archive_that_cannot_be_written_is_told_and_leaves_nothing(
    client: TestClient, desk: Desk, full: Callable[[int | None], None], number: int, status: int
) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    full(number)
    answer = client.post(f"{API}/sessions", json={"name": "other"})
    assert answer.status_code == status, answer.text
    assert "then ask again" in answer.json()["detail"]
    with pytest.raises(OSError, match="file"):
        desk.jobs.submit("limb", desk.catalogue.path("limb"), reason="asked for")
    assert desk.jobs.list() == []
    begun = desk.rounds.begin("static")
    until(lambda: desk.rounds.running() is None)
    assert "then ask again" in (desk.rounds.get(begun.id).error or "")
    full(None)
    assert client.post(f"{API}/sessions", json={"name": "other"}).status_code == 201, "the name is free"
    assert [path.name for path in desk.catalogue.root.rglob("*") if ".partial" in path.name] == []
    assert client.get(f"{API}/sessions/limb").json()["damaged"] == []


def test_a_capture_that_a_full_disk_left_open_is_closed_when_there_is_room(
    desk_of: Callable[..., Desk], full: Callable[[int | None], None]
) -> None:
    desk = desk_of(lambda _: [], watch=0.05)
    nodes = desk.roster.nodes
    desk.create_session("limb")
    nodes.gate.clear()  # type: ignore[union-attr]
    begun = desk.rounds.begin("board")
    until(lambda: desk.rounds.get(begun.id).state == "open")
    full(errno.ENOSPC)
    nodes.gate.set()  # type: ignore[union-attr]
    until(lambda: desk.rounds.running() is None)
    ended = desk.rounds.get(begun.id)
    assert (ended.state, "full" in (ended.error or "")) == ("refused", True)
    assert desk.catalogue.capture("limb", "0001-board")["state"] == "open"
    full(None)
    until(lambda: desk.catalogue.capture("limb", "0001-board")["state"] == "closed")
    entries = desk.catalogue.capture("limb", "0001-board")["cameras"].values()
    assert {entry["reason"] for entry in entries} == {"the archive could not be written when the capture ended"}


def test_a_capture_that_an_earlier_controller_left_open_is_closed_when_there_is_room(
    tmp_path: Path, desk_of: Callable[..., Desk], full: Callable[[int | None], None]
) -> None:
    archive = Archive(tmp_path / "archive")
    archive.create_session("limb", RIG).begin_capture("board", ["01", "02"])
    full(errno.ENOSPC)
    assert archive.close_unfinished("the controller was restarted") == []
    desk = desk_of(lambda _: [], watch=0.05)
    full(None)
    until(lambda: desk.catalogue.capture("limb", "0001-board")["state"] == "closed")


def until(condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline, "it never came about"
        time.sleep(0.01)
