"""The web server on a real socket: the event stream, a free port, and an end within the limit."""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
import pytest
import uvicorn
from ringdic.errors import InputError
from ringdic.session.writer import Archive
from ringdic_controller.service.app import create_app
from ringdic_controller.service.config import ControllerConfig
from ringdic_controller.service.desk import Desk
from ringdic_controller.service.service import SHUTDOWN_LIMIT, open_desk, serve_page

RIG = '[rig]\nname = "ring-2"\n[[cameras]]\nid = "01"\n'


@pytest.fixture
def served(desk: Desk):
    """The desk served on a free port, and the server."""
    server = uvicorn.Server(
        uvicorn.Config(create_app(desk), port=0, log_level="warning", timeout_graceful_shutdown=SHUTDOWN_LIMIT)
    )
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    yield f"http://127.0.0.1:{listener.getsockname()[1]}", server, thread
    server.should_exit = True
    thread.join(10)
    listener.close()


def read_events(stream: httpx.Response, into: queue.Queue) -> None:
    """Put (event, payload) of a stream into a queue until it ends."""
    name = ""
    try:
        for line in stream.iter_lines():
            if line.startswith("event: "):
                name = line.removeprefix("event: ")
            elif line.startswith("data: "):
                into.put((name, json.loads(line.removeprefix("data: "))))
    except httpx.HTTPError:
        return


def test_the_event_stream_tells_a_capture_from_arming_to_the_close_and_does_not_hold_up_the_end(served) -> None:
    address, server, thread = served
    events: queue.Queue = queue.Queue()
    with httpx.stream("GET", f"{address}/api/v1/live", timeout=20) as stream:
        reader = threading.Thread(target=read_events, args=(stream, events))
        reader.start()
        name, snapshot = events.get(timeout=10)
        assert name == "snapshot"
        assert [node["id"] for node in snapshot["rig"]["nodes"]] == ["01", "02", "03", "04"]
        httpx.post(f"{address}/api/v1/sessions", json={"name": "limb"})
        httpx.post(f"{address}/api/v1/captures", json={"kind": "board"})
        rounds, statuses = [], []
        while "closed" not in rounds:
            name, payload = events.get(timeout=10)
            if name == "round":
                rounds.append(payload["state"])
            if name == "capture":
                statuses.append(sorted(entry["status"] for entry in payload["record"]["cameras"].values()))
        assert rounds[0] == "arming"
        assert statuses[0] == ["pending"] * 4
        assert statuses[-1] == ["ok"] * 4
        started = time.monotonic()
        server.should_exit = True
        thread.join(SHUTDOWN_LIMIT + 5)
        assert not thread.is_alive()
        assert time.monotonic() - started < SHUTDOWN_LIMIT + 4
    reader.join(10)


def test_a_session_that_another_program_makes_is_shown(tmp_path: Path) -> None:
    desk = Desk(tmp_path, lambda _: [], watch=0.05)
    shown: queue.Queue = queue.Queue()
    desk.state.events.publish_snapshot = lambda: shown.put(desk.state.snapshot())  # type: ignore[method-assign]
    Archive(tmp_path).create_session("imported", RIG, source="import")
    assert [session["name"] for session in shown.get(timeout=10)["sessions"]] == ["imported"]
    desk.close()


PROGRAM = """
import sys
from pathlib import Path
from ringdic_controller.service.config import ControllerConfig
from ringdic_controller.service.service import open_desk, serve_page

child = "import os, sys, time; open(sys.argv[1] + '/pid', 'w').write(str(os.getpid())); time.sleep(60)"
config = ControllerConfig(archive=Path(sys.argv[1]), port=0)
with open_desk(config, lambda session: [sys.executable, "-c", child, str(session)]) as desk:
    desk.jobs.submit("limb", Path(sys.argv[1]), reason="asked for")
    serve_page(desk, config, lambda address: print(address, flush=True))
print("closed in order", flush=True)
"""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_controller_with_its_streams_and_jobs(tmp_path: Path, number: signal.Signals) -> None:
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        deadline = time.monotonic() + 20
        while not ((tmp_path / "pid").is_file() and (tmp_path / "pid").read_text()):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        child = int((tmp_path / "pid").read_text())
        with httpx.stream("GET", f"{address}/api/v1/live", timeout=20) as stream:
            assert next(stream.iter_lines()) == "event: snapshot"
            process.send_signal(number)
            output, _ = process.communicate(timeout=20)
        assert process.returncode == 0
        assert output.strip() == "closed in order"
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait(10)


def test_without_a_rig_the_controller_shows_and_captures_nothing(tmp_path: Path) -> None:
    with open_desk(ControllerConfig(archive=tmp_path / "archive")) as desk:
        assert desk.roster.cameras() == []
        assert "without a rig" in (desk.rounds.refusal() or "")
        assert desk.state.snapshot()["sessions"] == []


def test_a_port_that_is_taken_is_named(desk: Desk) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InputError, match=str(port)):
            serve_page(desk, ControllerConfig(port=port))


@pytest.mark.parametrize("name", ["rig", "settings"])
def test_a_file_of_the_configuration_that_is_not_there_is_named(tmp_path: Path, name: str) -> None:
    config = ControllerConfig(archive=tmp_path / "archive", **{name: tmp_path / "absent.toml"})
    with pytest.raises(InputError, match=r"absent\.toml"), open_desk(config):
        pass
