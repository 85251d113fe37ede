"""The guard before the HTTP interface: foreign names, foreign pages, large and slow bodies, and headers of answers."""

from __future__ import annotations

import asyncio
import errno
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import uvicorn
from fastapi.testclient import TestClient
from ringdic_controller.service import connections, guard
from ringdic_controller.service.app import create_app
from ringdic_controller.service.connections import BoundedConnection
from ringdic_controller.service.desk import Desk
from ringdic_controller.service.events import EventStream
from ringdic_controller.service.guard import GuardRules, RequestGuard
from ringdic_controller.service.refusals import BusyError
from ringdic_controller.service.turns import Turns

API = "/api/v1"
OWN = "http://127.0.0.1"


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8000",
        "127.0.0.1.evil.example",
        "localhost.evil.example",
        "localhost@evil.example",
        "evil.example/127.0.0.1",
        "192.168.1.7",
        "0x7f.1",
        "",
    ],
)
def test_a_foreign_host_reads_and_changes_nothing(client: TestClient, host: str) -> None:
    for method, path, body in (("GET", "/", None), ("GET", f"{API}/rig", None), ("POST", f"{API}/sessions", {})):
        answer = client.request(method, path, json=body, headers={"Host": host})
        assert answer.status_code == 403, answer.text
        assert "'hosts'" in answer.json()["detail"]
    assert client.get(f"{API}/sessions").json()["sessions"] == []


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8000", "LOCALHOST", "localhost.:80", "[::1]:8000", "127.0.0.9", "lab-pc:80"]
)
def test_own_names_and_addresses_are_answered(desk: Desk, host: str) -> None:
    rules = GuardRules(hosts=frozenset({"lab-pc"}))
    with TestClient(create_app(desk, rules=rules)) as client:
        assert client.get(f"{API}/rig", headers={"Host": host}).status_code == 200


def test_a_page_is_asked_for_by_the_address_that_the_connection_arrives_at() -> None:
    async def ask(host: str, server: str) -> int:
        scope = {"type": "http", "method": "GET", "scheme": "http", "headers": [(b"host", host.encode())]}
        return await status_of(GuardRules(), scope | {"server": (server, 8000)})

    assert asyncio.run(ask("10.0.0.5:8000", "10.0.0.5")) == 200
    assert asyncio.run(ask("10.0.0.6:8000", "10.0.0.5")) == 403
    assert asyncio.run(ask("10.0.0.5:8000", "::ffff:10.0.0.5")) == 200, "the server listens on IPv6 and IPv4"
    assert asyncio.run(ask("lab", "lab")) == 403, "a name is none of the addresses"


FOREIGN = [
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://127.0.0.1:9999"},
    {"Origin": "https://127.0.0.1"},
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site", "Origin": OWN},
    {"Referer": "http://evil.example/127.0.0.1"},
    {"Origin": OWN, "Sec-Fetch-Site": "cross-site"},
]


@pytest.mark.parametrize("headers", FOREIGN)
def test_another_page_changes_nothing_with_or_without_a_body(client: TestClient, headers: dict[str, str]) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    for method, path, body in (
        ("POST", "/sessions", {"name": "other"}),
        ("POST", "/captures", {"kind": "board"}),
        ("POST", "/jobs", {"session": "limb"}),
        ("POST", "/jobs/0001/cancel", None),
        ("PUT", "/sessions/current", {"name": "limb"}),
    ):
        answer = client.request(method, f"{API}{path}", json=body, headers=headers)
        assert answer.status_code == 403, (method, path)
        assert "another page" in answer.json()["detail"]
    assert [session["name"] for session in client.get(f"{API}/sessions").json()["sessions"]] == ["limb"]


@pytest.mark.parametrize(
    "headers",
    [{}, {"Origin": OWN}, {"Origin": OWN, "Sec-Fetch-Site": "same-origin"}, {"Referer": f"{OWN}/"}],
)
def test_the_own_page_and_scripts_without_a_page_may_change(client: TestClient, headers: dict[str, str]) -> None:
    assert client.post(f"{API}/sessions", json={"name": "limb"}, headers=headers).status_code == 201


@pytest.mark.parametrize(
    ("dest", "mode", "status"),
    [("document", "navigate", 200), ("iframe", "navigate", 403), ("image", "no-cors", 403), ("empty", "cors", 403)],
)
def test_another_page_may_lead_to_this_one_but_embed_nothing(client: TestClient, dest, mode, status) -> None:
    headers = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": dest, "Sec-Fetch-Mode": mode}
    assert client.get(f"{API}/rig", headers=headers).status_code == status


def test_every_answer_says_that_nothing_in_it_runs_or_is_framed(client: TestClient) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    for path in ("/", "/assets/none.js", "/openapi.json", f"{API}/rig", f"{API}/nothing", f"{API}/sessions/limb"):
        headers = client.get(path).headers
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "unsafe" not in headers["Content-Security-Policy"]
        assert (headers["X-Content-Type-Options"], headers["X-Frame-Options"]) == ("nosniff", "DENY")


# Bodies


async def status_of(rules: GuardRules, scope: dict[str, Any], parts: list[bytes] | None = None, stall: bool = False):
    """Status of the guard's answer to a request with a body in parts; the application answers 200 after all of it."""
    taken = 0
    messages = list(parts or [])

    async def receive() -> dict[str, Any]:
        nonlocal taken
        if messages:
            taken += len(messages[0])
            return {"type": "http.request", "body": messages.pop(0), "more_body": bool(messages) or stall}
        if stall:
            await asyncio.sleep(60)
        return {"type": "http.disconnect"}

    async def application(scope, receive, send) -> None:
        if parts:
            message = await receive()
            assert (message["body"], message["more_body"]) == (b"".join(parts), False)
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    sent: list[dict[str, Any]] = []

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    await RequestGuard(application, rules)({"path": "/", **scope}, receive, send)
    assert sent[-1].get("more_body", False) is False
    return sent[0]["status"]


def post(*headers: tuple[bytes, bytes]) -> dict[str, Any]:
    named = [(b"host", b"localhost"), *headers]
    return {"type": "http", "method": "POST", "scheme": "http", "server": ("127.0.0.1", 80), "headers": named}


def test_a_body_is_passed_on_whole_up_to_the_limit_and_refused_beyond_however_it_comes() -> None:
    rules = GuardRules(body_limit=10)
    chunked = post((b"transfer-encoding", b"chunked"))
    assert asyncio.run(status_of(rules, post((b"content-length", b"10")), [b"12345", b"67890"])) == 200
    assert asyncio.run(status_of(rules, chunked, [b"12345", b"67890"])) == 200
    assert asyncio.run(status_of(rules, chunked, [b"12345", b"67890", b"1", b"23456"])) == 413
    assert asyncio.run(status_of(rules, post((b"content-length", b"838860800")), [b"x"])) == 413
    assert asyncio.run(status_of(rules, post((b"content-length", b"9" * 5000)), [b"x"])) == 413


def test_a_body_that_does_not_arrive_ends_with_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    rules = GuardRules(body_seconds=0.05)
    assert asyncio.run(status_of(rules, post((b"content-length", b"10")), [b"1"], stall=True)) == 408
    monkeypatch.setattr(guard, "LINGER", 0.05)
    assert asyncio.run(status_of(GuardRules(body_limit=2), post((b"content-length", b"9")), [b"1"], stall=True)) == 413


def test_a_client_that_reads_nothing_is_given_up() -> None:
    async def story() -> None:
        async def application(scope, receive, send) -> None:
            await send({"type": "http.response.start", "status": 200, "headers": []})

        async def never(*_: object) -> None:
            await asyncio.sleep(60)

        await RequestGuard(application, GuardRules(send_seconds=0.05))({**post(), "path": "/"}, never, never)

    with pytest.raises(OSError, match="read nothing"):
        asyncio.run(story())


@pytest.fixture
def server(desk: Desk) -> Iterator[Callable[[], socket.socket]]:
    """Call it for a connection to the desk's server."""
    config = uvicorn.Config(create_app(desk), http=BoundedConnection, log_level="critical", timeout_graceful_shutdown=1)
    served = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=served.run, args=([listener],))
        thread.start()
        yield lambda: socket.create_connection(listener.getsockname(), timeout=20)
        served.should_exit = True
        thread.join(10)


def read_to_the_end(connection: socket.socket) -> None:
    while connection.recv(4096):
        pass


def first_line(connection: socket.socket) -> str:
    with connection.makefile("rb") as lines:
        return lines.readline().decode()


def test_eight_hundred_megabytes_are_refused_at_their_first_line(server) -> None:
    with server() as connection:
        connection.sendall(
            f"POST {API}/sessions HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 838860800\r\n\r\n{'x' * 1000}".encode()
        )
        assert " 413 " in first_line(connection)


def test_a_stream_of_chunks_is_refused_at_the_limit_while_it_is_sent(server) -> None:
    with server() as connection:
        head = f"POST {API}/sessions HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n"
        connection.sendall(head.encode())
        for _ in range(40):
            connection.sendall(b"10000\r\n" + b"x" * 65536 + b"\r\n")
        assert " 413 " in first_line(connection), "all of it is taken, so that the client comes to read why"


# Many clients


def test_so_many_connections_are_taken_and_the_next_is_told(server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 3)
    taken = [server() for _ in range(4)]
    try:
        assert " 503 " in first_line(taken[3])
        taken[0].close()
        for _ in range(200):
            with server() as again:
                again.sendall(f"GET {API}/rig HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
                if " 200 " in first_line(again):
                    break
            time.sleep(0.05)
        else:
            pytest.fail("one that has gone makes no room")
    finally:
        for connection in taken:
            connection.close()


@pytest.mark.parametrize("begun", [b"", b"GET / HTTP/1.1\r\nHo"])
def test_a_connection_that_asks_for_nothing_is_closed(server, monkeypatch: pytest.MonkeyPatch, begun: bytes) -> None:
    monkeypatch.setattr(connections, "HEAD_SECONDS", 0.2)
    with server() as connection:
        connection.sendall(begun)
        read_to_the_end(connection)


def test_an_event_stream_is_no_idle_connection(server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "HEAD_SECONDS", 0.1)
    with server() as connection:
        connection.sendall(f"GET {API}/live HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        assert " 200 " in first_line(connection)
        connection.settimeout(0.4)
        with pytest.raises(TimeoutError):
            read_to_the_end(connection)


def test_so_many_follow_the_live_state_and_the_next_is_told(desk: Desk, server) -> None:
    desk.state.events = EventStream(desk.state.snapshot, limit=3)
    request = f"GET {API}/live HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
    followers = [server() for _ in range(4)]
    try:
        for connection in followers[:3]:
            connection.sendall(request)
            assert " 200 " in first_line(connection)
        followers[3].sendall(request)
        with followers[3].makefile("rb") as lines:
            assert b" 503 " in lines.readline()
            while lines.readline() != b"\r\n":
                pass
            assert "no more can" in json.loads(lines.read1())["detail"]
    finally:
        for connection in followers:
            connection.close()
    deadline = 200
    while desk.state.events._followers and deadline:  # a seat is free again when its client has gone
        threading.Event().wait(0.05)
        deadline -= 1
    assert not desk.state.events._followers


def test_one_that_has_followed_for_long_makes_room_for_a_new_one() -> None:
    async def story() -> None:
        stream = EventStream(dict, limit=2, seat_kept=0.0)
        first, second, third = (stream.follow() for _ in range(3))
        for events in (first, second, third):
            assert await anext(events) == ("snapshot", {})
        with pytest.raises(StopAsyncIteration):
            await asyncio.wait_for(anext(first), 5)
        stream.publish("tick", {})
        assert [await anext(events) for events in (second, third)] == [("tick", {})] * 2
        patient = EventStream(dict, limit=1)
        await anext(patient.follow())
        with pytest.raises(BusyError, match="no more can"):
            await anext(patient.follow())

    asyncio.run(story())


def test_so_many_wait_for_their_turn_and_the_next_is_refused() -> None:
    turns = Turns("pictures are asked for", at_once=1, waiting=1)
    begun, gate = threading.Event(), threading.Event()

    def work() -> None:
        with turns.take():
            begun.set()
            assert gate.wait(20)

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    assert begun.wait(20)
    while turns._inside.acquire(blocking=False):  # until the second waits
        turns._inside.release()
    with pytest.raises(BusyError, match="pictures"), turns.take():
        pass
    gate.set()
    for thread in threads:
        thread.join(20)
    with turns.take():
        pass


# Faults


@pytest.mark.parametrize(
    ("error", "status", "word"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "a/session.json"), 507, "full"),
        (OSError(errno.EROFS, "Read-only file system", "a/session.json"), 503, "cannot be written"),
        (OSError(errno.EIO, "Input/output error", "a"), 503, "Input/output error"),
        (RuntimeError("a secret"), 500, "controller's log"),
        (RecursionError(), 500, "controller's log"),
    ],
)
def test_an_error_of_the_disk_or_of_the_program_is_one_sentence(desk: Desk, monkeypatch, error, status, word) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(desk, "create_session", fail)
    with TestClient(create_app(desk), base_url=OWN, raise_server_exceptions=False) as client:
        answer = client.post(f"{API}/sessions", json={})
    assert answer.status_code == status
    assert word in answer.json()["detail"]
    assert "secret" not in answer.text
    assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]


def test_half_a_character_is_answered_with_a_sentence(client: TestClient) -> None:
    for path, method in (("/sessions", "POST"), ("/sessions/current", "PUT"), ("/jobs", "POST"), ("/captures", "POST")):
        body = b'{"name": "\\ud800", "session": "\\ud800", "kind": "\\ud800"}'
        answer = client.request(method, f"{API}{path}", content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code in (404, 422), (path, answer.text)
        assert isinstance(answer.json()["detail"], str)
