"""A controller without a network: a real archive and desk with stand-in nodes."""

from __future__ import annotations

import hashlib
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from ringdic.errors import ComputationError
from ringdic.session.records import CaptureRecord, ImageDescription
from ringdic.session.writer import Archive, SessionWriter
from ringdic_controller.jobs.children import WarmChild
from ringdic_controller.service.app import create_app
from ringdic_controller.service.desk import Desk

CAMERAS = ("01", "02", "03", "04")
STAND_IN = [sys.executable, str(Path(__file__).with_name("stand_in_processing.py"))]


class StandInNodes:
    """Cameras that deliver small images at once. ``gate`` holds a capture up, ``absent`` nodes are not there."""

    def __init__(self, on_event: Callable[[dict[str, Any]], None]) -> None:
        self.absent: set[str] = set()
        self.gate = threading.Event()
        self.gate.set()
        self.unarmed: str | None = None
        self._on_event = on_event

    def roster(self) -> list[dict[str, Any]]:
        """The nodes."""
        return [
            {"id": name, "alive": name not in self.absent, "armed": False, "state": "idle", "spool_images": 0}
            for name in CAMERAS
        ]

    def capture(self, session: SessionWriter, kind: str, *, override: bool = False) -> CaptureRecord:
        """One image a camera that is there, fired 10 µs after each other."""
        if self.unarmed and not override:
            raise ComputationError(f"not captured: camera {self.unarmed} is not armed")
        writer = session.begin_capture(kind, CAMERAS, fire_at_ns=10**18, tolerance_ns=10**6, override=override)
        self._tell(writer.record())
        assert self.gate.wait(20)
        for i, name in enumerate(CAMERAS):
            if name not in self.absent:
                writer.store(name, *image_of(name, 10**18 + i * 10_000))
                self._tell(writer.record())
        record = writer.close(dict.fromkeys(self.absent, "the node is not there"))
        self._tell(record)
        return record

    def _tell(self, record: CaptureRecord) -> None:
        names = ("session", "capture_id", "kind", "state")
        self._on_event({"type": "capture", **{name: getattr(record, name) for name in names}})


def image_of(camera: str, time_ns: int) -> tuple[ImageDescription, bytes]:
    """A ramp of 40 × 30 px that begins with the camera's number."""
    ramp = (np.arange(1200, dtype=np.uint32) + int(camera)).astype(np.uint8)
    pgm = b"P5\n40 30\n255\n" + ramp.tobytes()
    return ImageDescription(hashlib.sha256(pgm).hexdigest(), 40, 30, time_ns), pgm


@pytest.fixture
def desk_of(tmp_path: Path, rig_toml: Callable[[str, Sequence[str]], str]) -> Iterator[Callable[..., Desk]]:
    """Call it with what carries out the jobs, and more arguments of a desk: a desk over stand-in cameras."""
    desks: list[Desk] = []

    def make(processing: Any, **more: Any) -> Desk:
        desk = Desk(tmp_path / "archive", processing, rig_toml("test-ring", CAMERAS), **more)
        desks.append(desk)
        desk.connect(Archive(tmp_path / "archive"), StandInNodes(desk.on_event))
        return desk

    yield make
    for desk in desks:
        desk.close()


@pytest.fixture
def desk(desk_of: Callable[..., Desk]) -> Desk:
    """A desk whose processing is the stand-in, a child for every job."""
    return desk_of(lambda session: [*STAND_IN, str(session)])


@pytest.fixture
def warm_stand_in() -> WarmChild:
    """The stand-in as a warm child."""
    return WarmChild([*STAND_IN, "--serve"])


@pytest.fixture
def nodes(desk: Desk) -> StandInNodes:
    """The stand-in nodes that the desk is connected to."""
    assert isinstance(desk.roster.nodes, StandInNodes)
    return desk.roster.nodes


@pytest.fixture
def client(desk: Desk) -> Iterator[TestClient]:
    """The HTTP interface over the desk."""
    with TestClient(create_app(desk), base_url="http://127.0.0.1") as client:
        yield client
