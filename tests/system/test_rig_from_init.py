"""A rig as ``ringdic rig init`` writes it, in real processes: certificates, HTTPS, a token, and a capture archived."""

from __future__ import annotations

import json
import queue
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
import yaml
from ringdic.cli.app import application
from ringdic.session.folder import open_session
from typer.testing import CliRunner

CAMERAS = ("01", "02")
WAIT = 60  # seconds; a loaded machine is slow


def ringdic(*arguments: str) -> str:
    done = CliRunner().invoke(application(), list(arguments))
    assert done.exit_code == 0, (done.output, done.exception)
    return done.stdout.strip()


def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < deadline, f"{what} never came about"
        time.sleep(0.1)


@pytest.fixture
def processes() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Call it with a command and its log: a process that ends with the test."""
    with ExitStack() as stack:

        def start(log: Path, *command: str) -> subprocess.Popen[str]:
            output = stack.enter_context(log.open("w"))
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", *command], stdout=subprocess.PIPE, stderr=output, text=True
            )
            stack.callback(process.wait, WAIT)
            stack.callback(process.terminate)
            return process

        yield start


def install_card(user_data: Path, folder: Path, port: int) -> Path:
    """What cloud-init and install.sh do with a card's files, below a folder; the node's configuration."""
    for entry in yaml.safe_load(user_data.read_text())["write_files"]:
        path = folder / Path(entry["path"]).relative_to("/etc/ringdic")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(entry["content"])
    node = folder / "node.toml"
    text = node.read_text().replace(":7447", f":{port}").replace("/var/lib/ringdic/spool", str(folder / "spool"))
    node.write_text(f'certificates = "certificates"\nstatus_s = 0.2\n{text}[pattern]\nwidth = 64\nheight = 48\n')
    return node


def test_a_rig_from_init_captures_over_certificates_and_login(
    tmp_path: Path, processes: Callable[..., subprocess.Popen[str]]
) -> None:
    folder, key = tmp_path / "ring", tmp_path / "key.pub"
    key.write_text("ssh-ed25519 " + "A" * 68 + " anna@lab\n")
    options = ["--name", "ring-2", "--ids", ",".join(CAMERAS), "--host", "127.0.0.1", "--camera", "pattern"]
    ringdic("rig", "init", str(folder), *options, "--ssh-key", str(key))
    token = ringdic("users", "token", "script", "--role", "operator", "--file", str(folder / "users.json"))
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    config = folder / "controller.toml"
    text = config.read_text().replace("# users", "users").replace(":7447", f":{port}").replace("8000", "0")
    config.write_text("live = false\n" + text.replace('host = "127.0.0.1"', 'host = "0.0.0.0"'))

    controller = processes(tmp_path / "controller.log", "ringdic", "controller", "--config", str(config))
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=lambda: lines.put(controller.stdout.readline()), daemon=True).start()
    for camera in CAMERAS:
        node = install_card(folder / "cards" / camera / "user-data", tmp_path / camera, port)
        processes(tmp_path / f"{camera}.log", "ringdic_node", "run", "--config", str(node))
    address = lines.get(timeout=WAIT).strip()
    assert address.startswith("https://0.0.0.0:")

    trusted = ssl.create_default_context(cafile=str(folder / "certificates" / "authority.pem"))
    page = address.replace("0.0.0.0", "127.0.0.1")
    with httpx.Client(base_url=page, verify=trusted, timeout=WAIT) as client:
        assert client.get("/").headers["location"] == "/login"
        assert client.get("/api/v1/rig").status_code == 401
        client.headers["Authorization"] = f"Bearer {token}"
        until(lambda: client.get("/api/v1/rig").json()["missing"] == [], "the nodes")
        client.post("/api/v1/sessions", json={"name": "first"}).raise_for_status()
        begun = client.post("/api/v1/captures", json={"kind": "static"}).json()["id"]
        until(lambda: client.get(f"/api/v1/rounds/{begun}").json()["state"] != "arming", "the arming")
        until(lambda: client.get(f"/api/v1/rounds/{begun}").json()["state"] != "open", "the close")
        record = client.get("/api/v1/sessions/first/captures").json()[0]
    assert {camera: entry["status"] for camera, entry in record["cameras"].items()} == dict.fromkeys(CAMERAS, "ok")
    assert len(open_session(folder / "archive" / "first").captures[0].images) == len(CAMERAS)
    audited = [json.loads(line) for line in (folder / "archive" / "audit.jsonl").read_text().splitlines()]
    assert [(line["who"], line["what"]) for line in audited] == [
        ("token script", "POST /api/v1/sessions"), ("token script", "POST /api/v1/captures"),
    ]  # fmt: skip
