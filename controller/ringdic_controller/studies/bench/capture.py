"""Benchmark of captures: time from the planned moment until every image is archived, acknowledged and freed.

Every node is a process with a real spool that plays back a prepared image over loopback; the controller is the real
one, driven over HTTP. Nodes and controller share this machine's processors and disk, which a real rig's do not, so
the figures are an upper bound for the controller's part. Times come from the record and from the files themselves.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from ringdic.errors import ComputationError, InputError
from ringdic.session.rig import parse_rig
from ringdic.settings import Settings
from ringdic_node.virtual_rig.rig import paper_rig

from ringdic_controller.studies.demo.client import Client
from ringdic_controller.studies.demo.rig import check_alive, running_controller, running_nodes

_START = 120.0  # seconds for all nodes to appear on a busy machine
_FREED = 60.0  # seconds after the close until every node has freed its image
_MB = 1e6
_SESSION = "bench"


def bench_capture(
    nodes: Sequence[int] = (12, 30),
    rounds: int = 3,
    size: tuple[int, int] = (2464, 3280),
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Time `rounds` captures, one after the other, on simulated rigs of several numbers of nodes.

    nodes : numbers of nodes, one rig for each. size : width and height of the images, px; one byte a pixel.
    say : called with one line about each rig.

    Returns JSON values; times in seconds, rates in 1e6 bytes a second. Raises ComputationError if an image was lost or
    changed on its way.
    """
    with tempfile.TemporaryDirectory(prefix="ringdic-bench-", ignore_cleanup_errors=True) as folder:
        runs = []
        for count in nodes:
            run = _measure(Path(folder) / str(count), count, rounds, size)
            say(_told(run))
            runs.append(run)
        return {"image_bytes": runs[0]["bytes"] // runs[0]["nodes"], "machine": _limits(Path(folder)), "runs": runs}


def capture_ratios(new: dict[str, Any], old: dict[str, Any]) -> list[dict[str, Any]]:
    """Speed relative to an earlier result, for each rig that both results have: a ratio above 1 is better.

    Raises InputError if they have no rig in common.
    """
    before = {(run["nodes"], run["bytes"]): run for run in old.get("runs", [])}
    rows = [
        {
            "nodes": run["nodes"],
            "archived": earlier["archived_s"]["median"] / run["archived_s"]["median"],
            "acknowledged": earlier["acknowledged_s"]["median"] / run["acknowledged_s"]["median"],
            **_ratios_told(earlier, run),
        }
        for run in new["runs"]
        if (earlier := before.get((run["nodes"], run["bytes"]))) is not None
    ]
    if not rows:
        raise InputError("the two results have no capture run in common; compare results of the same command")
    return rows


def _measure(folder: Path, count: int, rounds: int, size: tuple[int, int]) -> dict[str, Any]:
    """Figures of one rig of `count` nodes that is started, triggered `rounds` times and stopped."""
    rig = paper_rig(count)
    ids = [camera.id for camera in rig.cameras]
    images = folder / "images"
    images.mkdir(parents=True)
    expected = {id_: _prepare(images / f"{id_}.pgm", seed, size) for seed, id_ in enumerate(ids)}
    tables = {id_: f'camera = "playback"\n[playback]\nimage = "{(images / id_).as_posix()}.pgm"\n' for id_ in ids}
    with (
        running_controller(folder, rig.rig_toml(), Settings()) as running,
        running_nodes(folder, parse_rig(rig.rig_toml()).name, tables, running.endpoint) as processes,
    ):
        client = Client(running.address)
        client.wait_for_nodes(ids, _START, lambda: check_alive(processes, folder))
        client.post("/sessions", {"name": _SESSION})
        parts = {"controller_cpu_s": [running.pid], "nodes_cpu_s": [process.pid for process in processes]}
        before = {name: _worked(pids) for name, pids in parts.items()}
        captures = []
        for _ in range(rounds):
            captures.append(_capture(client, folder, expected))
            check_alive(processes, folder)
        worked = {name: (_worked(pids) - before[name]) / rounds for name, pids in parts.items()}
        return {**_figures(expected, captures, images), **worked, "controller_memory_mb": _peak_memory(running.pid)}


def _prepare(path: Path, seed: int, size: tuple[int, int]) -> str:
    """Write an image of noise, which no compression can make smaller; returns its SHA-256."""
    width, height = size
    pixels = np.random.default_rng(seed).integers(0, 256, width * height, np.uint8)
    content = f"P5\n{width} {height}\n255\n".encode() + pixels.tobytes()
    path.write_bytes(content)
    return hashlib.sha256(content).hexdigest()


def _capture(client: Client, folder: Path, expected: dict[str, str]) -> dict[str, float]:
    """Seconds of one capture from its moment to the close, and to the last freed image from moment and press."""
    pressed_ns = time.time_ns()
    record = client.capture("static")
    stem = f"{_SESSION}~{record['capture_id']}~{record['fire_at_ns']}"
    freed_ns = [_freed_ns(folder / "nodes" / id_ / "spool" / f"{stem}.freed", id_) for id_ in expected]
    captured = folder / "archive" / _SESSION / "captures" / record["capture_id"]
    for id_, sha256 in expected.items():
        entry = record["cameras"][id_]
        if entry["status"] != "ok":
            raise ComputationError(f"{record['capture_id']}: the image of {id_} {entry['status']}: {entry['reason']}")
        if not sha256 == entry["sha256"] == hashlib.sha256((captured / entry["file"]).read_bytes()).hexdigest():
            raise ComputationError(f"{captured / entry['file']}: not the image that the node played back")
    moment_ns = record["fire_at_ns"]
    return {
        "archived": datetime.fromisoformat(record["closed_at"]).timestamp() - moment_ns / 1e9,
        "acknowledged": (max(freed_ns) - moment_ns) / 1e9,
        "pressed": (max(freed_ns) - pressed_ns) / 1e9,
    }


def _freed_ns(tombstone: Path, id_: str) -> int:
    """Time at which a node freed its acknowledged image, ns: that of the file (tombstone) that it then leaves."""
    deadline = time.monotonic() + _FREED
    while not tombstone.exists():
        if time.monotonic() > deadline:
            raise ComputationError(f"node {id_} did not free its image within {_FREED:.0f} s; see its log")
        time.sleep(0.02)
    return tombstone.stat().st_mtime_ns


def _figures(expected: dict[str, str], taken: list[dict[str, float]], images: Path) -> dict[str, Any]:
    volume = sum((images / f"{id_}.pgm").stat().st_size for id_ in expected)
    acknowledged = _spread(one["acknowledged"] for one in taken)
    return {
        "nodes": len(expected),
        "bytes": volume,
        "rounds": len(taken),
        "verified": len(taken) * len(expected),
        "archived_s": _spread(one["archived"] for one in taken),
        "acknowledged_s": acknowledged,
        "pressed_s": _spread(one["pressed"] for one in taken),
        "mb_per_second": volume / _MB / acknowledged["median"],
    }


def _spread(values: Iterable[float]) -> dict[str, float]:
    array = np.array(list(values))
    return {"median": float(np.median(array)), "largest": float(array.max())}


def _told(run: dict[str, Any]) -> str:
    """The figures of one rig in one line of text."""
    cpu, nodes, memory = run["controller_cpu_s"], run["nodes_cpu_s"], run["controller_memory_mb"]
    return (
        f"{run['nodes']} nodes, {run['bytes'] / _MB:.0f} MB a capture: from the moment to archived "
        f"{run['archived_s']['median']:.2f} s (largest {run['archived_s']['largest']:.2f}), to acknowledged "
        f"{run['acknowledged_s']['median']:.2f} s (largest {run['acknowledged_s']['largest']:.2f}), "
        f"{run['mb_per_second']:.0f} MB/s; {run['verified']} checksums match"
        + (f"; processor time {cpu:.2f} s of the controller, {nodes:.2f} s of the nodes" if cpu else "")
        + (f", peak memory {memory:.0f} MB" if memory is not None else "")
    )


def _limits(folder: Path, volume: int = 64 << 20) -> dict[str, float]:
    """Limits of this machine, 1e6 bytes a second: SHA-256 on one core, and writing flushed to the disk."""
    content = bytes(volume)
    began = time.process_time()
    hashlib.sha256(content).hexdigest()
    hashed = time.process_time() - began
    began = time.perf_counter()
    with open(folder / "disk", "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    written = time.perf_counter() - began
    return {"sha256_mb_per_second": volume / _MB / hashed, "disk_mb_per_second": volume / _MB / written}


def _worked(pids: Sequence[int]) -> float:
    """Processor time of some processes so far, s; 0 where the system does not report it."""
    return sum(processor_seconds(pid) or 0.0 for pid in pids)


def processor_seconds(pid: int) -> float | None:
    """Processor time of a process so far, s; None where the system does not report it."""
    if not sys.platform.startswith("linux"):
        return None
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _peak_memory(pid: int) -> float | None:
    """Largest resident set of a process so far, 1e6 bytes; None where the system does not report it."""
    if not sys.platform.startswith("linux"):
        return None
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / _MB
    return None


def _ratios_told(old: dict[str, Any], new: dict[str, Any]) -> dict[str, float]:
    """Ratios of processor times and memory, which only some systems report, where both results have them."""
    names = {"controller_cpu": "controller_cpu_s", "nodes_cpu": "nodes_cpu_s", "memory": "controller_memory_mb"}
    return {name: old[key] / new[key] for name, key in names.items() if old.get(key) and new.get(key)}
