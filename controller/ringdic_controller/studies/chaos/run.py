"""Chaos: captures of a rig whose nodes, controller, disks and network fail as planned, and what is left of them."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from ringdic.errors import ComputationError
from ringdic.session.records import SessionError
from ringdic.session.writer import Archive, SessionWriter

from ringdic_controller.studies.chaos.audit import ChaosAudit, audit_session, waiting_images
from ringdic_controller.studies.chaos.controller import RIG
from ringdic_controller.studies.chaos.plan import PlannedMishap, plan_mishaps
from ringdic_controller.studies.chaos.processes import CONTROLLER, ChaosRig
from ringdic_controller.studies.chaos.rogue import RoguePeer

_SESSION = "chaos"
_SLOW = 500_000.0  # bytes a second that pass a slow link
_STALLED = 180.0  # s without a new capture
_SETTLED = 120.0  # s from the last mishap until everything is archived


def run_chaos(
    out: Path,
    *,
    cameras: int = 12,
    captures: int = 300,
    size: tuple[int, int] = (3280, 2464),
    seed: int = 0,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Capture with a rig in chaos and audit what it leaves.

    Parameters
    ----------
    out : folder for archive, spools and logs; what an earlier run has left in it is removed.
    cameras, captures : number of nodes, and of captures.
    size : width and height of the images, px; one byte a pixel.
    seed : of the plan of mishaps.
    say : called with one line for each mishap and for the result.

    Returns JSON values: the fields of the audit, the plan, seconds and the largest memory of a process. Raises
    ComputationError, with the first faults, if an image was lost or anything was left undone.
    """
    folder = out / f"chaos-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    ids = [f"cam_{number:02d}" for number in range(1, cameras + 1)]
    entries = "".join(f'[[cameras]]\nid = "{camera}"\n' for camera in ids)
    session = Archive(folder / "archive").create_session(_SESSION, f'[rig]\nname = "{RIG}"\n{entries}')
    planned = plan_mishaps(seed, ids, captures)
    began = time.monotonic()
    with ChaosRig(folder, ids, _SESSION, captures, size) as rig, ExitStack() as rogues:
        mischief = _Mischief(rig, rogues, say)
        for number in range(1, captures + 1):
            fire_at_ns = _await_capture(session, number)
            mischief.plan([mishap for mishap in planned if mishap.capture == number], fire_at_ns)
        mischief.finish()
        audit = _settled(rig, session, mischief.twins)
        memory = rig.largest_memory()
    result = {
        **asdict(audit),
        "seed": seed,
        "cameras": cameras,
        "mishaps": [asdict(mishap) for mishap in planned],
        "seconds": time.monotonic() - began,
        "memory_mb": memory,
    }
    (folder / "chaos.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    say(
        f"seed {seed}: {len(planned)} mishaps in {audit.captures} captures of {cameras} nodes: {audit.spooled} images "
        f"stored by the nodes, {audit.images} archived ({audit.late} after the close, {audit.conflicts} beside "
        f"another), {sum(audit.named.values())} not taken, each with its reason; {memory:.0f} MB at most"
    )
    if audit.faults:
        raise ComputationError(f"{len(audit.faults)} faults with seed {seed}: " + "; ".join(audit.faults[:5]))
    return result


def _await_capture(session: SessionWriter, number: int) -> int:
    """The planned moment of a capture, ns since the Unix epoch, as soon as it has a record."""
    deadline = time.monotonic() + _STALLED
    record = session.path / "captures" / f"{number:04d}-specimen"
    while time.monotonic() < deadline:
        try:
            return session.capture(record.name).record().fire_at_ns or 0
        except SessionError:
            time.sleep(0.02)
    raise ComputationError(
        f"{record}: no such capture within {_STALLED:.0f} s; see the logs in {session.path.parents[1]}"
    )


def _settled(rig: ChaosRig, session: SessionWriter, twins: Sequence[str]) -> ChaosAudit:
    """The audit once nothing is missing, or when the time for that is over."""
    for twin in twins:  # what a second node holds, it delivers when the first is switched off
        if waiting_images(rig.spool(twin)):
            camera = twin.split("+")[0]
            rig.kill(camera)
            rig.start(twin)
            _until(partial(_is_delivered, rig.spool(twin)))
            rig.kill(twin)
            rig.start(camera)
    spools = [rig.spool(name) for name in (*rig.cameras, *twins)]
    _until(lambda: not audit_session(session, spools).faults)
    return audit_session(session, spools)


def _is_delivered(spool: Path) -> bool:
    return not waiting_images(spool)


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + _SETTLED
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.5)


class _Mischief:
    """Does what is planned at its moment and undoes it after its rest, each in a thread of its own."""

    def __init__(self, rig: ChaosRig, rogues: ExitStack, say: Callable[[str], None]) -> None:
        self.twins: list[str] = []
        self._rig = rig
        self._rogues = rogues
        self._say = say
        self._lock = threading.Lock()  # one thing is done at a time, so that no process is started twice
        self._threads: list[threading.Thread] = []

    def plan(self, mishaps: Sequence[PlannedMishap], fire_at_ns: int) -> None:
        """Let mishaps happen at their moments about the planned moment of a capture."""
        for mishap in mishaps:
            thread = threading.Thread(target=self._happen, args=(mishap, fire_at_ns), daemon=True)
            thread.start()
            self._threads.append(thread)

    def finish(self) -> None:
        """Wait until all that was planned has happened and is undone."""
        for thread in self._threads:
            thread.join(_SETTLED)

    def _happen(self, mishap: PlannedMishap, fire_at_ns: int) -> None:
        time.sleep(max(fire_at_ns / 1e9 + mishap.after - time.time(), 0.0))
        self._say(f"capture {mishap.capture}, {mishap.after:+.2f} s: {mishap.kind} {mishap.victim}".rstrip())
        with self._lock:
            undo = self._do(mishap)
        time.sleep(mishap.rest)
        with self._lock:
            undo()

    def _do(self, mishap: PlannedMishap) -> Callable[[], None]:
        """Do something to a process; returns what undoes it."""
        rig, name = self._rig, mishap.victim or CONTROLLER
        if mishap.kind.startswith("kill"):
            rig.kill(name)
            return lambda: rig.start(name)
        if mishap.kind.startswith("freeze"):
            rig.freeze(name)
            return lambda: rig.thaw(name)
        if mishap.kind.startswith("full disk"):
            rig.fill_disk(name)
            return lambda: rig.empty_disk(name)
        if mishap.kind.startswith("cut link"):
            rig.links[name].cut()
            return rig.links[name].restore
        if mishap.kind.startswith("slow link"):
            rig.links[name].slow_down(_SLOW)
            return rig.links[name].restore
        if mishap.kind.startswith("two nodes"):
            twin = f"{name}+twin"
            self.twins += [twin] if twin not in self.twins else []
            rig.start(twin)
            return lambda: rig.kill(twin)
        if mishap.kind.startswith("manifests"):
            rig.change_release(
                name, lambda fields: fields.update(schema=99, width_of_a_later_release=fields.pop("width"))
            )
            return lambda: rig.change_release(name, _back)
        rogue = RoguePeer(RIG, rig.endpoint, rig.cameras)
        try:
            self._rogues.enter_context(rogue)
        except ConnectionError as error:  # the controller is dead or frozen, by another mishap
            self._say(f"capture {mishap.capture}: {error}")
        return rogue.close


def _back(fields: dict[str, Any]) -> None:
    """Make a manifest again as this release writes it."""
    if "width_of_a_later_release" in fields:
        fields.update(schema=1, width=fields.pop("width_of_a_later_release"))
