"""Processing of a single step during the capture, for display until a run processes the whole session.

The matches of the step are stored like those of a run, so that a later run computes only what is missing. All steps
are shown on the surface of the reference, which is measured once.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ringdic.calibration.calibrated_rig import CalibratedRig, calibrate_rig
from ringdic.errors import InputError
from ringdic.findings import verdict_figures
from ringdic.jobs.pipeline import match_session
from ringdic.progress import Report, Stages, silent
from ringdic.results.writer import write_steps
from ringdic.session.folder import Capture, Session, new_live, open_session
from ringdic.settings import CalibrationGroup, Settings
from ringdic.tasks import Executor, digest, process_memory

_RIG_BYTES = 1 << 20  # approximate size of the calibrated cameras and their control points
_WEIGHTS = {"prepare": 0.01, "calibrate": 0.02, "correlate": 0.8, "triangulate": 0.1, "deform": 0.07}


def process_step(
    path: Path, capture_id: str, settings: Settings, report: Report = silent, executor: Executor | None = None
) -> Path:
    """Process the reference and one specimen step of a session, and write their results to its live folder.

    The results have neither 2D matches, nor standard deviations of displacements and strains, nor a full summary.

    path : the session folder. capture_id : the step; for the reference itself only its shape is computed.
    report : called with the stage, the share done, the rate and the time left.
    executor : runs the tasks; None runs them in this process.
    Returns the folder with results.h5. Raises InputError or ComputationError with a sentence for the operator.
    """
    began = time.monotonic()
    stages = Stages(_WEIGHTS, report)
    session = open_session(path)
    steps = _with_reference(session, capture_id)

    matches = match_session(session, settings, steps, stages, executor, _calibrated)
    summary = {**verdict_figures(matches.findings, settings.accept), "seconds": round(time.monotonic() - began, 2)}
    stages.at("deform", 0.0)
    with new_live(path, capture_id) as folder:
        write_steps(
            folder / "results.h5", matches.series.names, lambda k: replace(matches.series.at(k), matches=()),
            lambda done: stages.at("deform", done), {}, summary,
        )  # fmt: skip
    return session.path / "live" / capture_id


def _calibrated(session: Session, settings: CalibrationGroup, progress: Callable[[float, str], None]) -> CalibratedRig:
    """The calibrated rig, cached in memory as long as its images and settings stay the same."""
    captures = [capture for capture in session.captures if capture.kind in ("board", "target")]
    rig = (session.path / "rig.toml").read_text(encoding="utf-8")
    key = digest(
        "live calibration", str(session.path), rig, settings, [(each.id, each.record.cameras) for each in captures]
    )
    return process_memory.get(key, lambda: calibrate_rig(session, settings, progress), lambda _: _RIG_BYTES)


def _with_reference(session: Session, capture_id: str) -> tuple[Capture, ...]:
    """The captures of the reference and of a step, or of the reference alone where it is the step."""
    specimen = session.of_kind("specimen")
    chosen = [capture for capture in specimen if capture.id == capture_id]
    if not chosen:
        there = ", ".join(capture.id for capture in specimen) or "none"
        raise InputError(f"{session.path}: no capture '{capture_id}' of the specimen; there are {there}")
    return (specimen[0], *chosen) if chosen[0] is not specimen[0] else (specimen[0],)
