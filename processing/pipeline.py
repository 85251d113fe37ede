"""The straight line from a session folder to results: calibrate, correlate, triangulate, deform, keep.

This is the only place where the stages meet.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing import noise_floor, summary
from processing.calibration.quality import ReconstructionError
from processing.correlation import CorrelationSettings
from processing.correlation.correlate import load_kernels
from processing.errors import ComputationError, InputError
from processing.pair_tasks import PairJob, in_order, pair_jobs
from processing.pairs_surface import Merging, merge_surfaces, pairs_surface
from processing.progress import Report, Stages, silent
from processing.results import Results, write_results
from processing.ring import Ring, calibrate_ring, control_points
from processing.session import Capture, Session, new_run, read_session
from processing.settings import CalibrationGroup, Settings
from processing.stated_uncertainty import camera_covariance, with_uncertainty
from processing.surface import PairSurface, pair_surface
from processing.sweep import Search
from processing.tasks import Executor, LocalExecutor, Ran, Task, tidy, work_folder

if TYPE_CHECKING:
    from processing.ring_surface import RingSurface

Calibrate = Callable[[Session, CalibrationGroup, Callable[[float, str], None]], Ring]

log = logging.getLogger(__name__)

_WEIGHTS = {"prepare": 0.03, "calibrate": 0.25, "correlate": 0.62, "triangulate": 0.04, "deform": 0.06}


@dataclass(frozen=True)
class Tracked:
    """A surface at some steps, and what is told of it. errors : of the pairs' reconstruction of the control points."""

    results: Results
    ring: Ring
    errors: dict[tuple[str, str], ReconstructionError]
    drift: dict[str, NDArray[np.float64]]
    agreement: dict[str, Any]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Measured:
    """What a run found before anything is written. errors : of the pairs' reconstruction of the control points."""

    results: Results
    ring: Ring
    errors: dict[tuple[str, str], ReconstructionError]
    found: dict[str, Any]

    @property
    def calibration(self) -> dict[str, Any]:
        """The cameras and how well they agree, as JSON values."""
        return {
            "cameras": [camera.to_dict() for camera in self.ring.cameras.values()],
            "pairs": [
                {"pair": list(pair), "mean_mm": error.mean, "rms_mm": error.rms, "points": error.points}
                for pair, error in self.errors.items()
            ],
            "bundle": None if self.ring.bundle is None else self.ring.bundle.to_dict(),
        }


def process_session(path: Path, settings: Settings, report: Report = silent, executor: Executor | None = None) -> Path:
    """Process a session and return the folder of the new run; earlier runs stay as they are.

    path : the session folder. report : is told the stage, the share done, the rate and the time left. executor : of
    the tasks; None runs them in this process. What an interrupted run has matched is not matched again.
    Raises InputError or ComputationError with a sentence for the operator.
    """
    began = time.monotonic()
    stages = Stages(_WEIGHTS, report)
    session = read_session(path)
    return _keep(session, measure(session, settings, stages, executor), settings, stages, began)


def measure(
    session: Session, settings: Settings, stages: Stages | None = None, executor: Executor | None = None
) -> Measured:
    """Everything of a run but the writing of its files. executor : of the tasks; None runs them in this process."""
    steps = _with_captures_at_rest(session)
    tracked = track(session, settings, steps, stages, executor)
    ring = tracked.ring
    results = with_uncertainty(tracked.results, camera_covariance(ring.bundle))
    results, drift, floor = _noise_floor(results, tracked.drift, steps)
    found = summary.summarise(results, ring, tracked.errors, drift, tracked.agreement, tracked.warnings)
    found["noise_floor"] = floor
    for warning in found["warnings"]:
        log.warning("%s", warning)
    return Measured(results, ring, tracked.errors, found)


def track(
    session: Session,
    settings: Settings,
    steps: Sequence[Capture],
    stages: Stages | None = None,
    executor: Executor | None = None,
    calibrate: Calibrate = calibrate_ring,
    merging: Merging = merge_surfaces,
) -> Tracked:
    """The surface at the steps, the reference first.

    executor : of the tasks; None runs them in this process. calibrate, merging : what does these, where it is kept
    from before.
    """
    stages, steps = stages or Stages(_WEIGHTS, silent), tuple(steps)
    stages.at("prepare", 0.0, "loading the correlation kernels (compiled at the first use)")
    load_kernels()
    stages.at("calibrate", 0.0)
    ring = calibrate(session, settings.calibration, lambda done, who: stages.at("calibrate", done, who))
    errors, warnings = _usable_pairs(session, ring, steps)
    if settings.surface.method == "global":
        whole = _whole_ring(session, ring, tuple(errors), steps, settings, stages, executor)
        results, drift, agreement, more_warnings = whole.results, whole.drift, whole.agreement, whole.warnings
    else:
        surfaces, more_warnings = _surfaces(session, ring, tuple(errors), steps, settings, stages, executor)
        results, agreement = pairs_surface(session, ring, surfaces, steps, settings, merging)
        drift = {"-".join(surface.matches.cameras): surface.drift for surface in surfaces}
    return Tracked(results, ring, errors, drift, agreement, (*ring.warnings, *warnings, *more_warnings))


def _specimen_steps(session: Session) -> tuple[Capture, ...]:
    steps = session.of_kind("specimen")
    if not steps:
        raise InputError(f"{session.path}: no capture of the specimen; capture or import the reference and the steps")
    return steps


def _with_captures_at_rest(session: Session) -> tuple[Capture, ...]:
    """The steps, and right after the reference, where nothing has moved yet, the captures at rest."""
    steps = _specimen_steps(session)
    return (steps[0], *session.of_kind("static"), *steps[1:])


def _noise_floor(
    results: Results, drift: dict[str, NDArray[np.float64]], steps: tuple[Capture, ...]
) -> tuple[Results, dict[str, NDArray[np.float64]], dict[str, Any] | None]:
    """The results and the drift without the captures at rest, and the noise floor that these show."""
    at_rest = [k for k, step in enumerate(steps) if step.kind == "static"]
    if not at_rest:
        return results, drift, None
    kept = [k for k in range(len(steps)) if k not in at_rest]
    floor = noise_floor.noise_floor(noise_floor.part(results, [0, *at_rest]))
    return noise_floor.part(results, kept), {who: values[kept] for who, values in drift.items()}, floor


def _usable_pairs(
    session: Session, ring: Ring, steps: tuple[Capture, ...]
) -> tuple[dict[tuple[str, str], ReconstructionError], tuple[str, ...]]:
    """Pairs of calibrated cameras with a reference image and how well they agree; a sentence for each left out."""
    usable: dict[tuple[str, str], ReconstructionError] = {}
    warnings: list[str] = []
    for pair in session.rig.pairs:
        missing = [id_ for id_ in pair if id_ not in ring.cameras]
        blind = [id_ for id_ in pair if id_ not in steps[0].images]
        if missing:
            warnings.append(f"pair {pair[0]}-{pair[1]} is left out: camera {' and '.join(missing)} is not calibrated")
        elif blind:
            warnings.append(
                f"pair {pair[0]}-{pair[1]} is left out: camera {' and '.join(blind)} has no image in {steps[0].id}"
            )
        else:
            try:
                usable[pair] = control_points(ring.cameras[pair[0]], ring.cameras[pair[1]])
            except ComputationError as error:
                warnings.append(str(error))
    if not usable:
        raise InputError(f"{session.path}: no camera pair can be used: {'; '.join(warnings)}")
    return usable, tuple(warnings)


def _surfaces(
    session: Session,
    ring: Ring,
    pairs: tuple[tuple[str, str], ...],
    steps: tuple[Capture, ...],
    settings: Settings,
    stages: Stages,
    executor: Executor | None,
) -> tuple[list[PairSurface], list[str]]:
    """Every pair matched at every step, as tasks, and triangulated."""
    cameras = {id_: each.camera for id_, each in ring.cameras.items()}
    correlation = CorrelationSettings(**settings.correlation.keywords)
    jobs = pair_jobs(session, cameras, pairs, steps, _search(session, settings), correlation)
    _run(in_order(jobs), executor, stages, session)
    surfaces: list[PairSurface] = []
    warnings: list[str] = []

    def surface(job: PairJob) -> PairSurface | str:
        try:
            return pair_surface(job.cameras, job.matches(), correlation.step, settings.surface.sigma_max_px)
        except ComputationError as error:
            return str(error)

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for k, made in enumerate(pool.map(surface, jobs), start=1):
            stages.at("triangulate", k / len(jobs), f"pair {jobs[k - 1].name}")
            if isinstance(made, str):
                warnings.append(made)
            else:
                surfaces.append(made)
    if not surfaces:
        raise ComputationError(f"{session.path}: no camera pair gave a surface: {'; '.join(warnings)}")
    return surfaces, warnings


def _run(tasks: Sequence[Task], executor: Executor | None, stages: Stages, session: Session) -> None:
    """Run the tasks and tell how far they are; outputs of long ago make room for theirs."""
    whole = sum(task.cost for task in tasks)
    began, done, points = time.monotonic(), 0.0, 0

    def told(task: Task, ran: Ran, count: int, total: int) -> None:
        nonlocal done, points
        done += task.cost
        points += ran.points
        rate = f"{points / max(time.monotonic() - began, 1e-3):,.0f} points/s" if points else ""
        stages.at("correlate", done / whole, f"{task.name} ({count} of {total})", rate)

    stages.at("correlate", 0.0)
    (executor or LocalExecutor()).run(tasks, told)
    tidy(work_folder(session.path), tasks)


def _whole_ring(
    session: Session,
    ring: Ring,
    pairs: tuple[tuple[str, str], ...],
    steps: tuple[Capture, ...],
    settings: Settings,
    stages: Stages,
    executor: Executor | None,
) -> RingSurface:
    """One surface from all cameras that have a reference image, as tasks."""
    from processing.ring_surface import surface_of_tracks  # loaded where it is asked for: pairs need none of it
    from processing.ring_tasks import ring_job

    cameras = [each.camera for each in ring.cameras.values() if each.camera.id in steps[0].images]
    job = ring_job(session, cameras, pairs, steps, _search(session, settings), settings)
    _run(job.tasks, executor, stages, session)
    shape, tracks = job.found()
    stages.at("triangulate", 0.0)
    names = [step.id for step in steps]
    return surface_of_tracks(session.rig.name, cameras, pairs, names, shape, tracks, settings)


def _search(session: Session, settings: Settings) -> Search:
    return Search(
        radius=settings.surface.radius_mm or session.rig.target.radius_mm,
        reach=settings.surface.reach_mm,
        incidence=settings.surface.incidence_deg,
    )


def _keep(session: Session, measured: Measured, settings: Settings, stages: Stages, began: float) -> Path:
    """Write the run aside and give it its number."""
    stages.at("deform", 0.0)
    found, calibration = measured.found, measured.calibration
    with new_run(session.path) as run:
        found["seconds"] = round(time.monotonic() - began, 2)
        results = replace(measured.results, calibration=calibration, summary=found)
        write_results(run.folder / "results.h5", results, lambda done: stages.at("deform", done))
        (run.folder / "settings.toml").write_text(settings.to_toml(), encoding="utf-8")
        (run.folder / "calibration.json").write_text(json.dumps(calibration), encoding="utf-8")
        (run.folder / "summary.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    assert run.final is not None
    return run.final
