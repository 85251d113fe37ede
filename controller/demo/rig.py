"""The processes of the simulated rig: one node a camera, each with a spool of its own, and the controller."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from controller.config import ControllerConfig
from controller.service import free_endpoint
from processing.errors import ComputationError

_START = 60.0  # seconds for the controller to say where its page is
_END = 10.0  # seconds for a process to end by itself


@dataclass(frozen=True)
class Setting:
    """What the simulated rig is: cameras, image scale, seed, and the folder of everything it writes."""

    folder: Path
    cameras: int
    scale: float
    seed: int = 0

    @property
    def archive(self) -> Path:
        """Folder of the sessions."""
        return self.folder / "archive"


@contextmanager
def running_controller(setting: Setting, rig_toml: str, settings_toml: str) -> Iterator[tuple[str, str]]:
    """The controller as a process of its own; its page's address and its Zenoh endpoint."""
    folder = setting.folder
    (folder / "rig.toml").write_text(rig_toml, encoding="utf-8")
    (folder / "settings.toml").write_text(settings_toml, encoding="utf-8")
    endpoint = free_endpoint(ControllerConfig()).endpoint
    config = folder / "controller.toml"
    config.write_text(
        f'archive = "archive"\nrig = "rig.toml"\nsettings = "settings.toml"\n\n[http]\nport = 0\n\n'
        f'[zenoh]\nendpoint = "{endpoint}"\n',
        encoding="utf-8",
    )
    with (folder / "controller.log").open("w", encoding="utf-8") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "controller", "controller", "--config", str(config)],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        try:
            yield _address(process, folder / "controller.log"), endpoint
        finally:
            _end([process])


@contextmanager
def running_nodes(setting: Setting, rig: str, ids: list[str], endpoint: str) -> Iterator[list[subprocess.Popen[bytes]]]:
    """One node process a camera."""
    processes: list[subprocess.Popen[bytes]] = []
    logs = []
    try:
        for id_ in ids:
            folder = setting.folder / "nodes" / id_
            folder.mkdir(parents=True)
            config = folder / "node.toml"
            config.write_text(
                f'rig = "{rig}"\nid = "{id_}"\ncontroller = "{endpoint}"\nspool = "spool"\ncamera = "virtual"\n\n'
                f"[virtual]\ncameras = {setting.cameras}\nscale = {setting.scale}\nseed = {setting.seed}\n",
                encoding="utf-8",
            )
            log = (folder / "node.log").open("w", encoding="utf-8")
            logs.append(log)
            command = [sys.executable, "-m", "node_agent", "run", "--config", str(config)]
            processes.append(subprocess.Popen(command, stdout=log, stderr=log))
        yield processes
    finally:
        _end(processes)
        for log in logs:
            log.close()


def check_alive(processes: list[subprocess.Popen[bytes]], folder: Path) -> None:
    """ComputationError if a node has ended."""
    for process in processes:
        if process.poll() is not None:
            raise ComputationError(f"a node ended with code {process.returncode}; see the logs in {folder / 'nodes'}")


def _address(process: subprocess.Popen[str], log: Path) -> str:
    """The address that the controller prints when it serves."""
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line)
        lines.put("")

    threading.Thread(target=read, daemon=True, name="controller's output").start()
    try:
        while line := lines.get(timeout=_START):
            if line.startswith("http"):
                return line.strip()
    except queue.Empty:
        pass
    raise ComputationError(f"the controller did not start; see {log}")


def _end(processes: list) -> None:
    for process in processes:
        if process.poll() is None:
            process.terminate()
    for process in processes:
        try:
            process.wait(_END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
