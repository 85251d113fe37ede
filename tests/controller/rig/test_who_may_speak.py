"""Real Zenoh sessions against a controller with certificates: who is let in, and for whom each may speak."""

from __future__ import annotations

import hashlib
import json
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from ringdic.errors import InputError
from ringdic.session.writer import Archive, CaptureWriter, SessionWriter
from ringdic_controller.access.certificates import Authority, RigMachine, machines_of, open_authority
from ringdic_controller.rig.capture import MS, SECOND, Timing
from ringdic_controller.rig.link import RigLink
from ringdic_controller.rig.router import router_config
from ringdic_node.cameras.pattern import PatternCamera
from ringdic_node.clock import SystemClock
from ringdic_node.config import NodeConfig
from ringdic_node.endpoint import (
    AUTHORITY,
    CERTIFICATE,
    KEY,
    EndpointError,
    controller_name,
    handshake_fault,
    node_name,
)
from ringdic_node.link import NodeLink, node_config
from ringdic_node.service import NodeService
from ringdic_node.spool import Spool
from ringdic_node.wire import (
    NETWORK,
    Ack,
    Arm,
    CaptureKey,
    Failure,
    Inventory,
    Keys,
    Manifest,
    NodeStatus,
    Trigger,
    encode,
)

RIG = "ring"
KEYS = Keys(RIG)
VICTIM, ROGUE, THIRD = "01", "02", "03"
NOW = datetime.now(UTC)
IMAGE = b"P5\n2 1\n255\nab"
HASH = hashlib.sha256(IMAGE).hexdigest()
REMOTE = zenoh.Locality.REMOTE  # what others say; without it a session hears itself
SOON = 30.0  # seconds within which something that is allowed must have happened


@dataclass(frozen=True)
class Guarded:
    """A controller with certificates, with a capture of three cameras under way, and where it is found."""

    endpoint: str
    folder: Path
    link: RigLink
    session: SessionWriter
    capture: CaptureWriter

    def certificates(self, node: str) -> Path:
        return self.folder / "nodes" / node

    @property
    def key(self) -> CaptureKey:
        return CaptureKey("s", self.capture.path.name, 50)

    def node(self, id_: str) -> dict[str, Any]:
        return next(entry for entry in self.link.roster() if entry["id"] == id_)

    def status_of(self, camera: str) -> str:
        return self.capture.record().cameras[camera].status


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def until(condition: Callable[[], bool], timeout: float = SOON) -> bool:
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline and not condition():
        time.sleep(0.005)
    return condition()


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> tuple[Authority, Path]:
    """The rig's authority, and a folder with the certificates of the controller and of three nodes."""
    folder = tmp_path_factory.mktemp("certificates")
    authority = open_authority(folder, RIG, NOW)
    for machine in machines_of(RIG, [VICTIM, ROGUE, THIRD], ["127.0.0.1"], folder):
        authority.issue(machine, NOW)
    return authority, folder


@pytest.fixture(scope="module")
def guarded(
    authority: tuple[Authority, Path], tmp_path_factory: pytest.TempPathFactory, rig_toml: Callable[..., str]
) -> Iterator[Guarded]:
    folder = authority[1]
    endpoint = f"tls/127.0.0.1:{free_port()}"
    archive = Archive(tmp_path_factory.mktemp("archive"))
    cameras = [VICTIM, ROGUE, THIRD]
    with RigLink(
        RIG, cameras, endpoint, archive, lambda _: None, certificates=folder / "controller", reconcile_s=600.0
    ) as link:
        session = archive.create_session("s", rig_toml(RIG, cameras))
        yield Guarded(endpoint, folder, link, session, session.begin_capture("board", cameras, fire_at_ns=50))


@pytest.fixture(scope="module", params=["client", "peer", "router"])
def rogue(request: pytest.FixtureRequest, guarded: Guarded) -> Iterator[zenoh.Session]:
    """A session with the certificate of node 02; what it calls itself decides what the router passes on to others."""
    config = node_config(guarded.endpoint, guarded.certificates(ROGUE))
    config.insert_json5("mode", json.dumps(request.param))
    with zenoh.open(config) as session:
        assert until(lambda: bool(session.info.routers_zid()))
        yield session


@pytest.fixture(scope="module")
def victim(guarded: Guarded) -> Iterator[list[str]]:
    """Node 01 as it should be, and all that reaches it: verbs of questions, and ``ack``."""
    heard: list[str] = []
    link: list[NodeLink] = []

    def on_query(verb: str, _: bytes, question: int) -> None:
        if verb != "clock":  # which the controller asks for all the time
            heard.append(verb)
        link[0].decline(question, "busy")

    with NodeLink(
        KEYS, VICTIM, guarded.endpoint, on_query, lambda _: heard.append("ack"), "p1", guarded.certificates(VICTIM)
    ) as opened:
        link.append(opened)
        assert until(lambda: guarded.node(VICTIM)["alive"])
        yield heard


def manifest_of(guarded: Guarded, node: str) -> Manifest:
    return Manifest(node, guarded.key, "board", HASH, len(IMAGE), 2, 1, 60)


def status(node: str, spool_images: int) -> bytes:
    return encode(NodeStatus(node, "idle", False, 1, 1, spool_images))


def put_image(session: zenoh.Session, key: str, manifest: Manifest) -> None:
    session.put(key, IMAGE, attachment=encode(manifest), congestion_control=zenoh.CongestionControl.BLOCK)


# Who is let in


def open_as_client(endpoint: str, tls: dict[str, Any]) -> zenoh.Session:
    """A session of a client, which is connected when this returns, or zenoh.ZError."""
    config = zenoh.Config()
    settings = {"mode": "client", "connect/endpoints": [endpoint], "connect/timeout_ms": 0, "transport/link/tls": tls}
    for key, value in {**NETWORK, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def tls_of(folder: Path, authority: Path) -> dict[str, Any]:
    return {
        "root_ca_certificate": str(authority),
        "enable_mtls": True,
        "connect_certificate": str(folder / CERTIFICATE),
        "connect_private_key": str(folder / KEY),
    }


def forged(kind: str, authority: Authority, folder: Path) -> Path:
    """A folder with a certificate that names node 01, which the controller must not accept."""
    machine = RigMachine(kind, node_name(RIG, VICTIM), folder / kind)
    if kind == "expired":
        authority.issue(machine, NOW, life=timedelta(minutes=-1))
    elif kind == "not yet valid":
        authority.issue(machine, NOW + timedelta(days=365))
    elif kind == "another authority":
        Authority.create(RIG, NOW).issue(machine, NOW)
    else:  # signed by a node, whose certificate is no authority's
        authority.issue(machine, NOW)
        key = Authority.create(RIG, NOW).key
        Authority(machine.certificate(), key).issue(replace(machine, folder=folder / "leaf"), NOW)
        return folder / "leaf"
    return machine.folder


@pytest.mark.parametrize("kind", ["expired", "not yet valid", "another authority", "signed by a node"])
def test_a_certificate_that_is_not_sound_is_refused(
    guarded: Guarded, authority: tuple[Authority, Path], tmp_path: Path, kind: str
) -> None:
    folder = forged(kind, authority[0], tmp_path)
    with pytest.raises(zenoh.ZError):
        open_as_client(guarded.endpoint, tls_of(folder, guarded.folder / AUTHORITY))


@pytest.mark.parametrize(
    ("kind", "told"),
    [("expired", "machine's is refused .*expired"), ("another authority", "the controller's: .*issuer|self-signed")],
)
def test_the_nodes_check_says_why_there_is_no_connection(
    guarded: Guarded, authority: tuple[Authority, Path], tmp_path: Path, kind: str, told: str
) -> None:
    assert handshake_fault(guarded.endpoint, guarded.certificates(THIRD), 0.2) is None
    assert handshake_fault(f"tls/127.0.0.1:{free_port()}", guarded.certificates(THIRD), 0.2) is None
    assert re.search(told, handshake_fault(guarded.endpoint, forged(kind, authority[0], tmp_path)) or "")
    other_address = guarded.endpoint.replace("127.0.0.1", "127.0.0.2")
    assert handshake_fault(other_address, guarded.certificates(THIRD), 0.2) is None, "nobody listens there"


def test_without_a_certificate_nobody_is_let_in_and_with_one_a_node_is(guarded: Guarded) -> None:
    root = guarded.folder / AUTHORITY
    with pytest.raises(zenoh.ZError):
        open_as_client(guarded.endpoint, {"root_ca_certificate": str(root)})
    with pytest.raises(zenoh.ZError):
        open_as_client(guarded.endpoint.replace("tls/", "tcp/"), {})
    with open_as_client(guarded.endpoint, tls_of(guarded.certificates(THIRD), root)) as session:
        assert list(session.info.routers_zid())


def test_nobody_else_passes_for_the_controller(
    guarded: Guarded, authority: tuple[Authority, Path], tmp_path: Path
) -> None:
    """Neither a node, nor where the controller's certificate has expired or names another address."""
    expired = RigMachine("controller", controller_name(RIG), tmp_path, ("127.0.0.1",))
    authority[0].issue(expired, NOW, life=timedelta(minutes=-1))
    mine = tls_of(guarded.certificates(VICTIM), guarded.folder / AUTHORITY)
    own = guarded.folder / "controller"
    for folder, host in ((guarded.certificates(ROGUE), "127.0.0.1"), (expired.folder, "127.0.0.1"), (own, "127.0.0.2")):
        endpoint = f"tls/{host}:{free_port()}"
        with zenoh.open(router_config(endpoint, RIG, [VICTIM], folder)), pytest.raises(zenoh.ZError):
            open_as_client(endpoint, mine)


@pytest.mark.parametrize("name", ["other-ring/node/01", "ring/node/99", "ring/controller"])
def test_a_certificate_that_names_no_camera_of_the_rig_may_say_nothing(
    guarded: Guarded, rogue: zenoh.Session, authority: tuple[Authority, Path], tmp_path: Path, name: str
) -> None:
    machine = RigMachine("stranger", name, tmp_path)
    authority[0].issue(machine, NOW)
    before = guarded.node(THIRD)["spool_images"]
    heard: list[str] = []
    with open_as_client(guarded.endpoint, tls_of(machine.folder, guarded.folder / AUTHORITY)) as stranger:
        stranger.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)), allowed_origin=REMOTE)
        stranger.liveliness().declare_token(KEYS.alive(THIRD))
        stranger.put(KEYS.node(THIRD, "status"), status(THIRD, 77))
        put_image(stranger, KEYS.image(THIRD), manifest_of(guarded, THIRD))
        assert list(stranger.get(KEYS.node(VICTIM, "arm"), timeout=0.1)) == []
        say_and_wait(guarded, rogue)
    assert guarded.node(THIRD)["spool_images"] == before
    assert guarded.node(THIRD)["alive"] is False
    assert guarded.status_of(THIRD) == "pending"
    assert heard == []


# For whom a node may speak

counter = iter(range(100, 10**6))


def say_and_wait(guarded: Guarded, session: zenoh.Session) -> None:
    """Say something that is allowed and wait until the controller has heard it: what was said before has come too."""
    number = next(counter)
    session.put(KEYS.node(ROGUE, "status"), status(ROGUE, number), congestion_control=zenoh.CongestionControl.BLOCK)
    assert until(lambda: guarded.node(ROGUE)["spool_images"] == number)


@pytest.mark.parametrize("node", [VICTIM, "*", "0$*"])
def test_a_status_for_another_node_is_not_heard(guarded: Guarded, rogue: zenoh.Session, node: str) -> None:
    rogue.put(KEYS.node(node, "status"), status(VICTIM, 77), congestion_control=zenoh.CongestionControl.BLOCK)
    rogue.put(KEYS.node(ROGUE, "status"), status(VICTIM, 77), congestion_control=zenoh.CongestionControl.BLOCK)
    say_and_wait(guarded, rogue)
    assert guarded.node(VICTIM)["spool_images"] != 77


def test_an_image_of_another_node_is_not_taken(guarded: Guarded, rogue: zenoh.Session) -> None:
    forged = manifest_of(guarded, VICTIM)
    for key in (KEYS.image(VICTIM), KEYS.image("*"), KEYS.image(ROGUE), f"rig/{RIG}/**"):
        put_image(rogue, key, forged)
    put_image(rogue, KEYS.image(ROGUE), manifest_of(guarded, ROGUE))
    assert until(lambda: guarded.status_of(ROGUE) == "ok"), "its own image is archived"
    assert guarded.status_of(VICTIM) == "pending"


def test_a_failure_of_another_node_is_not_noted(guarded: Guarded, rogue: zenoh.Session) -> None:
    """Neither as a status nor in an answer to the question for the inventory."""
    closed = guarded.session.begin_capture("static", [VICTIM], fire_at_ns=70)
    closed.close({VICTIM: "no answer"})
    failure = Failure(VICTIM, CaptureKey("s", closed.path.name, 70), "forged")
    rogue.put(KEYS.node(ROGUE, "status"), encode(failure))
    asked = threading.Event()

    def answer(query: zenoh.Query) -> None:
        manifest = replace(manifest_of(guarded, VICTIM), key=failure.key)
        query.reply(query.key_expr, encode(Inventory(ROGUE, (manifest,), (failure,))))
        asked.set()

    queryable = rogue.declare_queryable(KEYS.node(ROGUE, "inventory"), answer)
    answers: list[Any] = []
    assert until(lambda: guarded.link.ask(ROGUE, None, answers.append, 1.0) or bool(answers) or time.sleep(0.05))
    queryable.undeclare()
    assert asked.is_set()
    assert answers[0] == Inventory(ROGUE)
    assert closed.record().cameras[VICTIM].reason == "no answer"


def test_a_node_is_alive_by_its_own_token_alone(guarded: Guarded, rogue: zenoh.Session) -> None:
    keys = [KEYS.alive(node) for node in (THIRD, f"{THIRD}/process", "*", "**", f"{ROGUE}/process", ROGUE)]
    tokens = [rogue.liveliness().declare_token(key) for key in keys]
    assert until(lambda: guarded.node(ROGUE)["alive"])
    assert guarded.node(THIRD)["alive"] is False
    seen = {str(reply.ok.key_expr) for reply in guarded.link._session.liveliness().get(f"rig/{RIG}/**") if reply.ok}
    assert {key for key in seen if f"/{VICTIM}" not in key} == {KEYS.alive(ROGUE), f"{KEYS.alive(ROGUE)}/process"}
    for token in tokens:
        token.undeclare()
    assert until(lambda: not guarded.node(ROGUE)["alive"])


def test_another_nodes_token_cannot_be_taken_away(guarded: Guarded, victim: list[str], rogue: zenoh.Session) -> None:
    rogue.liveliness().declare_token(KEYS.alive(VICTIM)).undeclare()
    rogue.delete(KEYS.alive(VICTIM))
    say_and_wait(guarded, rogue)
    assert guarded.node(VICTIM)["alive"] is True


QUESTIONS = {
    "arm": encode(Arm("s", "board", {}, "0" * 64, (VICTIM,))),
    "trigger": encode(Trigger(CaptureKey("s", "0001-board", 50), "board")),
    "inventory": b"",
    "fetch": b"",
    "clock": b"",
    "preview": b"",
    "status": b"",
}


def test_only_the_controller_arms_triggers_fetches_and_acknowledges(
    guarded: Guarded, victim: list[str], rogue: zenoh.Session
) -> None:
    victim.clear()
    for verb, payload in QUESTIONS.items():
        for node in (VICTIM, "*"):
            replies = rogue.get(KEYS.node(node, verb), payload=payload, timeout=0.1, target=zenoh.QueryTarget.ALL)
            assert list(replies) == [], verb
    ack = encode(Ack(VICTIM, guarded.key, HASH, "archived"))
    for key in (KEYS.node(VICTIM, "ack"), KEYS.node("*", "ack"), f"rig/{RIG}/**"):
        rogue.put(key, ack, congestion_control=zenoh.CongestionControl.BLOCK)
    say_and_wait(guarded, rogue)
    # The controller itself asks for status, clock and inventory from time to time.
    assert not {"arm", "trigger", "fetch", "preview", "ack"} & set(victim)
    # The controller is heard, so the silence above says something.
    guarded.link.ask(VICTIM, Arm("s", "board", {}, "0" * 64, (VICTIM,)), print, 1.0)
    guarded.link._acknowledge(manifest_of(guarded, VICTIM), "archived")
    assert until(lambda: {"ack", "arm"} <= set(victim)), victim


def test_a_node_does_not_answer_for_another_nor_hear_what_is_not_for_it(
    guarded: Guarded, victim: list[str], rogue: zenoh.Session
) -> None:
    heard: list[str] = []
    for key in (KEYS.image("*"), KEYS.image(VICTIM), KEYS.node(VICTIM, "ack"), KEYS.node("*", "*"), "**"):
        rogue.declare_subscriber(key, lambda sample: heard.append(str(sample.key_expr)), allowed_origin=REMOTE)
        rogue.declare_queryable(key, lambda query: heard.append(str(query.key_expr)))
    rogue.declare_queryable(KEYS.node(VICTIM, "status"), lambda query: query.reply(query.key_expr, status(VICTIM, 77)))
    tokens: list[str] = []
    rogue.liveliness().declare_subscriber("**", lambda sample: tokens.append(str(sample.key_expr)), history=True)
    say_and_wait(guarded, rogue)
    guarded.link._acknowledge(manifest_of(guarded, VICTIM), "archived")
    answers = list(guarded.link._answers(VICTIM, "status", NodeStatus))
    assert answers == [], "the victim declines, and nobody else is asked"
    assert heard == []
    assert tokens == []


# What honest nodes do, with certificates


def test_a_capture_with_certificates_is_archived_and_frees_the_spool(
    authority: tuple[Authority, Path], tmp_path: Path, rig_toml: Callable[..., str]
) -> None:
    endpoint, folder = f"tls/127.0.0.1:{free_port()}", authority[1]
    archive = Archive(tmp_path / "archive")
    session = archive.create_session("s", rig_toml(RIG, [THIRD, VICTIM]))
    timing = Timing(lead=300 * MS, collect=10 * SECOND)
    config = NodeConfig(RIG, THIRD, endpoint, tmp_path / "spool", "pattern", certificates=folder / "nodes" / THIRD)
    spool = Spool(config.spool)
    service = NodeService(config, PatternCamera(THIRD, SystemClock(), width=40, height=30), spool, SystemClock())
    thread = threading.Thread(target=service.run, daemon=True)
    with RigLink(
        RIG, [THIRD], endpoint, archive, lambda _: None, timing=timing, certificates=folder / "controller"
    ) as link:
        thread.start()
        try:
            assert link.wait_for_nodes(SOON) == []
            record = link.capture(session, "board")
            assert record.cameras[THIRD].status == "ok"
            assert link.preview(THIRD) is not None
            assert until(lambda: spool.manifests() == []), "the acknowledgement arrived"
        finally:
            service.stop()
            thread.join(10)


# Without certificates


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/0.0.0.0:7447",
        "tcp/192.168.1.10:7447",
        "tcp/[::]:7447",
        "tcp/127.0.0.1.example.org:7447",
        "tcp/:7447",
        "udp/0.0.0.0:7447",
        "TCP/0.0.0.0:7447",
        "quic/192.168.1.10:7447",
        "tcp/0.0.0.0:7447#iface=lo",
        "tcp/0.0.0.0:1#/127.0.0.1:1",
    ],
)
def test_an_endpoint_that_others_reach_is_refused_without_certificates(endpoint: str, tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="ringdic rig certificates"),
        RigLink(RIG, [VICTIM], endpoint, Archive(tmp_path), lambda _: None),
    ):
        pass
    with pytest.raises(EndpointError, match="ringdic rig certificates"):
        node_config(endpoint)


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:1", "tcp/[::1]:1", "tcp/localhost:1", "tcp/127.3.2.1:1#a=b"])
def test_on_loopback_no_certificates_are_needed(endpoint: str) -> None:
    assert node_config(endpoint) is not None


def test_certificates_that_cannot_be_used_are_named(authority: tuple[Authority, Path], tmp_path: Path) -> None:
    with pytest.raises(EndpointError, match=r"authority\.pem cannot be read"):
        node_config("tls/127.0.0.1:1", tmp_path)
    folder = authority[1] / "nodes"
    for name, source in ((AUTHORITY, VICTIM), (CERTIFICATE, VICTIM), (KEY, ROGUE)):
        (tmp_path / name).write_bytes((folder / source / name).read_bytes())
    with pytest.raises(EndpointError, match="cannot be used"):
        node_config("tls/127.0.0.1:1", tmp_path)


def test_a_message_that_speaks_for_another_is_logged(
    guarded: Guarded, rogue: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        rogue.put(KEYS.node(ROGUE, "status"), status(VICTIM, 77))
        say_and_wait(guarded, rogue)
    assert "speaks for node 01 and is ignored" in caplog.text
