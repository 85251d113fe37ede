"""Benchmark of live steps: seconds from a step's last image to its results, with steps at a steady pace.

Every node is a process with a real spool that plays back images of the simulated rig, rendered beforehand; controller
and warm processing are the real ones, driven over HTTP. The calibration and the reference are processed before the
steps come, as an operator would wait for them. All share this machine's processors, which a real rig's nodes do not.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ringdic.errors import ComputationError, InputError
from ringdic.session.images import read_gray
from ringdic.session.rig import parse_rig
from ringdic.settings import Settings

from ringdic_controller.studies.bench.capture import processor_seconds
from ringdic_controller.studies.demo.client import Client
from ringdic_controller.studies.demo.rig import check_alive, running_controller, running_nodes
from ringdic_controller.studies.demo.run import settings_for
from ringdic_controller.studies.validate.folders import make_session
from ringdic_controller.studies.validate.image_cache import ImageCache, RenderedShot
from ringdic_controller.studies.validate.scenery import Scenery

_START = 300.0  # seconds for the nodes to appear and for the kernels, which are compiled once
_REFERENCE = 1800.0  # seconds for calibrating and matching the reference
_SESSION = "bench"
_LOOK = 0.05  # seconds between two requests for the newest live step


def bench_live(
    folder: Path,
    *,
    cameras: int = 12,
    scale: float = 1.0,
    steps: int = 5,
    interval: float = 5.0,
    boards: int = 12,
    settings: Settings | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Time `steps` live steps, captured one every `interval` seconds after the reference.

    Returns JSON values, times in seconds.

    folder : where images and calibration are kept for the next time. boards : views of the checkerboard.
    settings : of the processing; None takes those of the demo at this size of the images.
    Raises ComputationError if a step could not be processed.
    """
    scenery = Scenery(scale, cameras, boards, limb=steps)
    cache = ImageCache(folder / "images")
    work = folder / f"live-{time.strftime('%Y-%m-%d-%H%M%S')}"
    shots = [shot for name in ("boards", "target", "limb") for each in scenery.shots(name) for shot in each.values()]
    say(f"{len(shots)} images of {cameras} cameras")
    cache.render_missing(shots)
    text = scenery.rig.rig_toml()
    calibration = [
        (kind, each) for kind, name in (("board", "boards"), ("target", "target")) for each in scenery.shots(name)
    ]
    make_session(work / "archive" / _SESSION, text, calibration, cache, calibration=folder / "calibrated")
    tables = _frames(work / "frames", scenery.shots("limb"), cache)
    with (
        running_controller(work, text, settings or settings_for(scale)) as running,
        running_nodes(work, parse_rig(text).name, tables, running.endpoint) as processes,
    ):
        client = Client(running.address)
        client.wait_for_nodes(list(tables), _START, lambda: check_alive(processes, work))
        client.put("/sessions/current", {"name": _SESSION})
        reference = client.capture("specimen")["capture_id"]
        client.wait_for_step(_SESSION, reference, _REFERENCE)
        _keep_calibration(work / "archive" / _SESSION, folder / "calibrated")
        say("the reference is processed; the steps come")
        worked = _processing_seconds(running.pid)
        shown, taken = _steps(client, steps, interval)
        worked = None if worked is None else (_processing_seconds(running.pid) or 0.0) - worked
        header = client.get(f"/sessions/{_SESSION}/live")
    for each in shown:
        say(f"{each['capture_id']}: {each['seconds']:.2f} s after its last image")
    seconds = [each["seconds"] for each in shown]
    return {
        "cameras": cameras,
        "scale": scale,
        "interval_s": interval,
        "points": header["points"],
        "steps": shown,
        "taken": taken,
        "skipped": len(taken) - len(shown),
        "seconds": {"median": float(np.median(seconds)), "largest": float(max(seconds))},
        "processing_cpu_s": None if worked is None else worked / len(shown),
    }


def live_ratios(new: dict[str, Any], old: dict[str, Any]) -> list[dict[str, Any]]:
    """Speed relative to an earlier result of the same rig: a ratio above 1 is better.

    Raises InputError if the rigs differ.
    """
    same = ("cameras", "scale", "interval_s")
    if any(new[name] != old.get(name) for name in same):
        raise InputError("the two results are of other live rigs; compare results of the same command")
    row = {"seconds": old["seconds"]["median"] / new["seconds"]["median"]}
    if new["processing_cpu_s"] and old.get("processing_cpu_s"):
        row["processing_cpu"] = old["processing_cpu_s"] / new["processing_cpu_s"]
    return [row]


def _frames(folder: Path, steps: Sequence[Mapping[str, RenderedShot]], cache: ImageCache) -> dict[str, str]:
    """Write the images that each node plays back; returns the camera table of each node's configuration."""
    for number, shots in enumerate(steps):
        for id_, shot in shots.items():
            grey = read_gray(cache.path(shot))
            (folder / id_).mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(folder / id_ / f"specimen-{number}.pgm"), grey):
                raise ComputationError(f"{folder / id_}: the images cannot be written; check the disk")
    name = "{kind}-{scene}.pgm"
    return {
        id_: f'camera = "playback"\n[playback]\nimage = "{(folder / id_).resolve().as_posix()}/{name}"\n'
        for id_ in steps[0]
    }


def _steps(client: Client, count: int, interval: float) -> tuple[list[dict[str, Any]], list[str]]:
    """Capture steps at a steady pace; returns the live steps that were ready in time, and ids of all captures."""
    shown: dict[str, dict[str, Any]] = {}
    taken: list[str] = []

    def look() -> None:
        with suppress(ComputationError):  # nothing is there yet
            newest = client.get(f"/sessions/{_SESSION}/live")
            if newest["capture_id"] in taken:
                shown[newest["capture_id"]] = {name: newest[name] for name in ("capture_id", "seconds")}

    due = time.monotonic()
    for _ in range(count):
        taken.append(client.capture("specimen")["capture_id"])
        due += interval
        while time.monotonic() < due:
            look()
            time.sleep(_LOOK)
    client.wait_for_step(_SESSION, taken[-1], _START, look)
    look()
    return list(shown.values()), taken


def _keep_calibration(session: Path, folder: Path) -> None:
    (folder / "calibration").mkdir(parents=True, exist_ok=True)
    for file in (session / "calibration").glob("*.json"):
        (folder / "calibration" / file.name).write_bytes(file.read_bytes())


def _processing_seconds(pid: int) -> float | None:
    """Processor time of the controller's child processes so far, s; None where the system does not report it."""
    if not sys.platform.startswith("linux"):
        return None
    children = Path(f"/proc/{pid}/task").glob("*/children")
    return sum(processor_seconds(int(child)) or 0.0 for file in children for child in file.read_text().split())
