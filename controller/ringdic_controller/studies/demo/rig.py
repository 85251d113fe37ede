"""The processes of the simulated rig: a node for each camera, with a spool of its own, and the controller."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ringdic.errors import ComputationError
from ringdic.settings import Settings

from ringdic_controller.service.config import ControllerConfig
from ringdic_controller.service.service import free_endpoint

_START = 60.0  # seconds for the controller to say where its page is
_END = 10.0  # seconds for a process to end by itself


@dataclass(frozen=True)
class Setting:
    """The simulated rig: number of cameras, image scale, seed, and the folder that everything is written to."""

    folder: Path
    cameras: int
    scale: float
    seed: int = 0

    @property
    def archive(self) -> Path:
        """Folder of the sessions."""
        return self.folder / "archive"

    def node_tables(self, ids: list[str]) -> dict[str, str]:
        """The part of each node's configuration file that describes its camera, by camera id."""
        table = f'camera = "virtual"\n\n[virtual]\ncameras = {self.cameras}\nscale = {self.scale}\nseed = {self.seed}\n'
        return dict.fromkeys(ids, table)


@dataclass(frozen=True)
class Running:
    """A running controller: the address of its page, its Zenoh endpoint, its process id."""

    address: str
    endpoint: str
    pid: int


@contextmanager
def running_controller(folder: Path, rig_toml: str, settings: Settings) -> Iterator[Running]:
    """Run a controller in a process of its own for the time of a ``with`` block; its archive is ``folder/archive``."""
    (folder / "rig.toml").write_text(rig_toml, encoding="utf-8")
    (folder / "settings.toml").write_text(settings.to_toml(), encoding="utf-8")
    endpoint = free_endpoint(ControllerConfig()).endpoint
    config = folder / "controller.toml"
    config.write_text(
        f'archive = "archive"\nrig = "rig.toml"\nsettings = "settings.toml"\n\n[http]\nport = 0\n\n'
        f'[zenoh]\nendpoint = "{endpoint}"\n',
        encoding="utf-8",
    )
    with (folder / "controller.log").open("w", encoding="utf-8") as log:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "ringdic", "controller", "--config", str(config)],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        try:
            yield Running(_address(process, folder / "controller.log"), endpoint, process.pid)
        finally:
            _end([process])


@contextmanager
def running_nodes(
    parent: Path, rig: str, tables: Mapping[str, str], endpoint: str
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Run a node process for each camera for the time of a ``with`` block, in ``parent/nodes/<camera>``.

    tables : by camera, the end of the node's configuration: ``camera = …`` and that camera's table.
    """
    processes: list[subprocess.Popen[bytes]] = []
    logs = []
    try:
        for id_, table in tables.items():
            folder = parent / "nodes" / id_
            folder.mkdir(parents=True)
            config = folder / "node.toml"
            config.write_text(
                f'rig = "{rig}"\nid = "{id_}"\ncontroller = "{endpoint}"\nspool = "spool"\n{table}', encoding="utf-8"
            )
            log = (folder / "node.log").open("w", encoding="utf-8")
            logs.append(log)
            command = [sys.executable, "-P", "-m", "ringdic_node", "run", "--config", str(config)]
            processes.append(subprocess.Popen(command, stdout=log, stderr=log))
        yield processes
    finally:
        _end(processes)
        for log in logs:
            log.close()


def check_alive(processes: list[subprocess.Popen[bytes]], folder: Path) -> None:
    """Raise ComputationError if a node's process has ended."""
    for process in processes:
        if process.poll() is not None:
            raise ComputationError(f"a node ended with code {process.returncode}; see the logs in {folder / 'nodes'}")


def _address(process: subprocess.Popen[str], log: Path) -> str:
    """Address of the page, which the controller prints when it is ready."""
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
