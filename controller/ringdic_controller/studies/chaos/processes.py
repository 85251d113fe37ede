"""The processes of a rig in chaos: nodes and a controller that are killed, frozen, doubled and started anew."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from ringdic_controller.service.config import ControllerConfig
from ringdic_controller.service.service import free_endpoint
from ringdic_controller.studies.chaos.audit import waiting_images
from ringdic_controller.studies.chaos.controller import RIG
from ringdic_controller.studies.chaos.plan import READOUT
from ringdic_controller.studies.chaos.proxy import LinkProxy

CONTROLLER = ""  # its name among the processes
_END = 10.0  # s for a process to end by itself


class ChaosRig:
    """Processes of the nodes and of the controller by their names, in one folder; a context manager that ends them.

    Parameters
    ----------
    folder : receives logs, spools and the archive. `links` has the proxy that each node is connected through.
    cameras : ids of the nodes.
    session, captures : name of the session, and how many captures the controller takes.
    size : width and height of the images, px.
    """

    def __init__(self, folder: Path, cameras: list[str], session: str, captures: int, size: tuple[int, int]) -> None:
        self.folder = folder
        self.archive = folder / "archive"
        self.cameras = cameras
        self.endpoint = free_endpoint(ControllerConfig()).endpoint
        self._session = session
        self._captures = captures
        self._size = size
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self.links: dict[str, LinkProxy] = {}

    def __enter__(self) -> ChaosRig:
        self.links = {camera: LinkProxy(int(self.endpoint.rsplit(":", 1)[1])) for camera in self.cameras}
        for name in (CONTROLLER, *self.cameras):
            self.start(name)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self._processes.values():
            try:
                process.wait(_END)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for link in self.links.values():
            link.close()

    def spool(self, name: str) -> Path:
        """Folder of a node's spool."""
        return self.folder / f"spool-{name}"

    def start(self, name: str) -> None:
        """Start a node or the controller, unless it runs; a name like ``201+twin`` is a second node of the id 201."""
        if name in self._processes and self._processes[name].poll() is None:
            return
        if name == CONTROLLER:
            module = "ringdic_controller.studies.chaos.controller"
            words = [module, str(self.archive), self._session, self.endpoint, str(self._captures)]
        else:
            words = ["ringdic_node", "run", "--config", str(self._node_config(name))]
        with (self.folder / f"{name or 'controller'}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen([sys.executable, "-P", "-m", *words], stdout=log, stderr=log)

    def _node_config(self, name: str) -> Path:
        width, height = self._size
        endpoint = f"tcp/127.0.0.1:{self.links[name].port}" if name in self.links else self.endpoint
        path = self.folder / f"{name}.toml"
        path.write_text(
            f'rig = "{RIG}"\nid = "{name.split("+")[0]}"\ncontroller = "{endpoint}"\n'
            f'spool = "{self.spool(name).name}"\nspool_keep_mb = 1000000\ncamera = "pattern"\n'
            f"resend_s = 1.0\nstatus_s = 0.5\n[pattern]\nwidth = {width}\nheight = {height}\ndelay = {READOUT}\n",
            encoding="utf-8",
        )
        return path

    def kill(self, name: str) -> None:
        """End a process at once, as a power cut does; it has no time to put anything in order."""
        process = self._processes.get(name)
        if process is not None:
            process.kill()
            process.wait()

    def freeze(self, name: str) -> None:
        """Stop a process where it is; its connections stay open."""
        self._processes[name].send_signal(signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        """Let a frozen process go on."""
        if self._processes[name].poll() is None:
            self._processes[name].send_signal(signal.SIGCONT)

    def fill_disk(self, name: str) -> None:
        """Let no write of a process succeed, not even a part of a file."""
        self._limit_files(name, 0)

    def empty_disk(self, name: str) -> None:
        """Let the writes of a process succeed again."""
        self._limit_files(name, None)

    def _limit_files(self, name: str, length: int | None) -> None:
        if not sys.platform.startswith("linux"):
            return
        import resource

        process = self._processes[name]
        if process.poll() is None:
            _, hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (hard if length is None else length, hard))

    def change_release(self, name: str, change: Callable[[dict[str, object]], None]) -> None:
        """Start a node anew on manifests as another release would have written them.

        change : alters the fields of one manifest that is not delivered.
        """
        self.kill(name)
        for manifest in waiting_images(self.spool(name)):
            path = self.spool(name) / manifest
            fields = json.loads(path.read_bytes())
            change(fields)
            aside = path.with_suffix(".new")
            aside.write_text(json.dumps(fields), encoding="utf-8")
            os.replace(aside, path)
        self.start(name)

    def largest_memory(self) -> float:
        """Largest resident memory that one of the running processes has had, 1e6 bytes; 0 where nobody tells."""
        sizes = [0.0]
        for process in self._processes.values():
            status = Path(f"/proc/{process.pid}/status")
            if process.poll() is None and status.exists():
                lines = status.read_text(encoding="utf-8").splitlines()
                sizes += [int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM:")]
        return max(sizes)
