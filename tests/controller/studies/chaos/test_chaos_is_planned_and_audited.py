"""The plan of chaos is that of its seed, the audit finds what is lost, and a short chaos loses nothing."""

from __future__ import annotations

import hashlib
import socket
from collections import Counter
from pathlib import Path

import pytest
from ringdic.session.records import ImageDescription
from ringdic.session.writer import Archive, SessionWriter
from ringdic_controller.studies.chaos import run_chaos
from ringdic_controller.studies.chaos.audit import audit_session
from ringdic_controller.studies.chaos.plan import KINDS, plan_mishaps
from ringdic_controller.studies.chaos.proxy import LinkProxy
from ringdic_node.spool import Spool
from ringdic_node.wire import CaptureKey, Manifest

IMAGE = b"P5\n1 1\n255\n!"
SHA256 = hashlib.sha256(IMAGE).hexdigest()


def test_a_seed_gives_its_plan_and_every_kind_has_its_turn() -> None:
    planned = plan_mishaps(7, ["a", "b"], 40)
    assert planned == plan_mishaps(7, ["a", "b"], 40)
    assert planned != plan_mishaps(8, ["a", "b"], 40)
    counts = Counter(mishap.kind for mishap in planned)
    assert set(counts) == set(KINDS)
    assert max(counts.values()) - min(counts.values()) <= 1
    assert {mishap.capture for mishap in planned} == set(range(2, 41)), "the first capture is calm"
    assert all((mishap.victim != "") == (KINDS[mishap.kind] == "node") for mishap in planned)


@pytest.fixture
def session(tmp_path: Path) -> SessionWriter:
    """A closed capture with the image of one camera, which its spool still holds; the other has its reason."""
    session = Archive(tmp_path / "archive").create_session("s", '[rig]\nname = "r"\n[[cameras]]\nid = "a"\n')
    capture = session.begin_capture("specimen", ["a", "b"], fire_at_ns=5)
    capture.store("a", ImageDescription(SHA256, 1, 1), IMAGE)
    capture.close({"b": "not armed: no light"})
    return session


def spool_with(folder: Path, capture_id: str, *, delivered: bool = True) -> Path:
    spool = Spool(folder)
    key = CaptureKey("s", capture_id, 5)
    spool.store(Manifest("a", key, "specimen", SHA256, len(IMAGE), 1, 1, 5), [IMAGE])
    if delivered:
        spool.deliver(key, SHA256)
    return folder


def test_the_audit_of_a_sound_archive_counts(session: SessionWriter, tmp_path: Path) -> None:
    audit = audit_session(session, [spool_with(tmp_path / "spool", "0001-specimen")])
    assert audit.faults == ()
    assert (audit.captures, audit.images, audit.spooled, audit.late, audit.conflicts) == (1, 1, 1, 0, 0)
    assert audit.named == {"not armed": 1}


def test_the_audit_finds_what_is_lost_changed_or_left_behind(session: SessionWriter, tmp_path: Path) -> None:
    spools = [spool_with(tmp_path / "spool", "0002-specimen"), spool_with(tmp_path / "other", "0001-specimen")]
    assert audit_session(session, spools).faults == ("the image of a in 0002-specimen is archived 0 times",)
    waiting = spool_with(tmp_path / "waiting", "0001-specimen", delivered=False)
    assert "not delivered" in audit_session(session, [waiting]).faults[0]
    (waiting / ".partial-x").write_bytes(b"")
    folder = session.path / "captures/0001-specimen"
    (folder / "a.pgm").write_bytes(b"changed")
    session.begin_capture("specimen", ["a"], fire_at_ns=6)
    faults = " ".join(audit_session(session, [waiting]).faults)
    for told in ("left behind", "bytes instead of", "0002-specimen is not closed", "a is pending without a reason"):
        assert told in faults


def test_a_short_chaos_loses_nothing(tmp_path: Path) -> None:
    """Seed 294 cuts a link, forges, kills the controller, fills a disk and doubles a node."""
    result = run_chaos(tmp_path, cameras=3, captures=5, size=(64, 48), seed=294)
    assert result["captures"] == 5
    assert len(result["mishaps"]) == 5
    assert result["spooled"] + sum(result["named"].values()) >= 15
    assert result["faults"] == ()


def test_a_link_that_is_cut_passes_nothing_and_then_everything() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = LinkProxy(server.getsockname()[1])
        with socket.create_connection(("127.0.0.1", link.port), timeout=5) as client:
            away = server.accept()[0]
            client.sendall(b"one")
            assert away.recv(9) == b"one"
            link.cut()
            client.sendall(b"two")
            away.settimeout(0.2)
            with pytest.raises(TimeoutError):
                away.recv(9)
            link.restore()
            away.settimeout(5)
            assert away.recv(9) == b"two"
            link.close()
            assert client.recv(9) == b"", "the end is passed on"
            away.close()
