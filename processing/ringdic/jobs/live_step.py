"""One step of a session at once, while the capturing goes on: what is shown until the whole session is processed.

The step's matches are kept as those of a whole run are, so the run makes only what is missing. The surface that the
steps are shown on is that of the reference, merged once and the same at every step. It is made by pairs of cameras,
whatever the run is told: these alone need nothing of the steps between.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ringdic.calibration.calibrated_rig import CalibratedRig, calibrate_rig
from ringdic.errors import InputError
from ringdic.jobs.pipeline import match_session
from ringdic.pairs.merging import Merged, merge
from ringdic.pairs.surfaces import PairSurface
from ringdic.progress import Report, Stages, silent
from ringdic.results.writer import write_series
from ringdic.session.folder import Capture, Session, new_live, open_session
from ringdic.settings import CalibrationGroup, Settings
from ringdic.tasks import Executor, digest, kept

_RING_BYTES = 1 << 20  # about what the cameras and their control points take
_WEIGHTS = {"prepare": 0.01, "calibrate": 0.02, "correlate": 0.8, "triangulate": 0.1, "deform": 0.07}


def process_step(
    path: Path, capture_id: str, settings: Settings, report: Report = silent, executor: Executor | None = None
) -> Path:
    """Process the reference and one step of the specimen; the folder of what is shown of it.

    The reference itself may be the step: then its shape is shown, and what every step needs of it is found. Nothing
    becomes a run; matches in images, what calibration and scatter add to uncertainty, and the summary are left to it.
    Raises InputError or ComputationError.
    """
    began = time.monotonic()
    stages = Stages(_WEIGHTS, report)
    session = open_session(path)
    settings = settings.model_copy(update={"surface": settings.surface.model_copy(update={"method": "pairs"})})
    steps = _reference_and(session, capture_id)

    def merging(pairs: Sequence[PairSurface], heuristic: str) -> Merged:
        sheets = [pair.sheet_at_reference for pair in pairs]
        key = digest("live surface", heuristic, [(each.vertices, each.faces, each.correlation) for each in sheets])
        return kept.get(key, lambda: merge(sheets, heuristic), _bytes)

    tracked = match_session(session, settings, steps, stages, executor, _calibrated, merging)
    found = {"warnings": list(tracked.warnings), "seconds": round(time.monotonic() - began, 2)}
    stages.at("deform", 0.0)
    with new_live(path, capture_id) as folder:
        shown = tracked.series.without_matches()
        write_series(folder / "results.h5", shown, lambda done: stages.at("deform", done), {}, found)
    return session.path / "live" / capture_id


def _calibrated(session: Session, settings: CalibrationGroup, told: Callable[[float, str], None]) -> CalibratedRig:
    """The ring as calibrated, kept in memory while its images and settings stay."""
    captures = [capture for capture in session.captures if capture.kind in ("board", "target")]
    rig = (session.path / "rig.toml").read_text(encoding="utf-8")
    key = digest("live calibration", str(session.path), rig, settings, [each.record for each in captures])
    return kept.get(key, lambda: calibrate_rig(session, settings, told), lambda _: _RING_BYTES)


def _reference_and(session: Session, capture_id: str) -> tuple[Capture, ...]:
    specimen = session.of_kind("specimen")
    chosen = [capture for capture in specimen if capture.id == capture_id]
    if not chosen:
        there = ", ".join(capture.id for capture in specimen) or "none"
        raise InputError(f"{session.path}: no capture '{capture_id}' of the specimen; there are {there}")
    return (specimen[0], *chosen) if chosen[0] is not specimen[0] else (specimen[0],)


def _bytes(merged: Merged) -> int:
    return int(merged.vertex.nbytes + merged.faces.nbytes + merged.pair.nbytes)
