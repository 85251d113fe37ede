"""The straight line from a session folder to results: calibrate, correlate_points, triangulate, deform, keep.

This is the only place where the stages meet.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ringdic.arrays import Floats
from ringdic.calibration.calibrated_rig import CalibratedRig, calibrate_rig, control_points
from ringdic.calibration.quality import ReconstructionError
from ringdic.correlation import CorrelationSettings
from ringdic.correlation.correlate import load_kernels
from ringdic.errors import ComputationError, InputError
from ringdic.jobs import summary
from ringdic.pairs.reconstruction import pair_shape
from ringdic.pairs.surfaces import Merging, PairSurface, merge_surfaces, pairs_surface, reconstruct_pair
from ringdic.pairs.tasks import PairJob, ordered_tasks, pair_jobs
from ringdic.progress import Report, Stages, silent
from ringdic.results import noise_floor
from ringdic.results.results import Results
from ringdic.results.series import InMemory, Series, StepCache, join_steps
from ringdic.results.uncertainty import StepUncertainty, camera_covariance
from ringdic.results.writer import ResultsWriter, StepRecord, in_turn
from ringdic.session.folder import Capture, Session, new_run, open_session
from ringdic.settings import CalibrationGroup, Settings
from ringdic.sweep.sweep import DepthSearch
from ringdic.tasks import Executor, LocalExecutor, Ran, Task, tidy, work_folder

if TYPE_CHECKING:
    from ringdic.multiview.surface import MultiviewSurface

Calibrate = Callable[[Session, CalibrationGroup, Callable[[float, str], None]], CalibratedRig]

log = logging.getLogger(__name__)

_WEIGHTS = {"prepare": 0.03, "calibrate": 0.25, "correlate": 0.62, "triangulate": 0.04, "deform": 0.06}


@dataclass(frozen=True)
class SessionMatches:
    """A surface through some steps, and what is told of it. errors : of the pairs' reconstruction of control points."""

    series: Series
    ring: CalibratedRig
    errors: dict[tuple[str, str], ReconstructionError]
    drift: dict[str, Floats]
    agreement: dict[str, Any]
    warnings: tuple[str, ...]

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
    session = open_session(path)
    steps = _with_captures_at_rest(session)
    tracked = match_session(session, settings, steps, stages, executor)
    stages.at("deform", 0.0)
    with new_run(session.path) as run:
        (run.folder / "settings.toml").write_text(settings.to_toml(), encoding="utf-8")
        (run.folder / "calibration.json").write_text(json.dumps(tracked.calibration), encoding="utf-8")
        found = _deform(tracked, steps, run.folder / "results.h5", stages, began)
        (run.folder / "summary.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    assert run.final is not None
    for warning in found["warnings"]:
        log.warning("%s", warning)
    return run.final


def match_session(
    session: Session,
    settings: Settings,
    steps: Sequence[Capture],
    stages: Stages | None = None,
    executor: Executor | None = None,
    calibrate: Calibrate = calibrate_rig,
    merging: Merging = merge_surfaces,
) -> SessionMatches:
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
    series: Series
    if settings.surface.method == "global":
        whole = _whole_ring(session, ring, tuple(errors), steps, settings, stages, executor)
        series, drift, agreement, more_warnings = InMemory(whole.results), whole.drift, whole.agreement, whole.warnings
    else:
        pairs, more_warnings = _pairs(session, ring, tuple(errors), steps, settings, stages, executor)
        cameras, names = [each.camera for each in ring.cameras.values()], [step.id for step in steps]
        series, agreement = pairs_surface(session.rig.name, cameras, pairs, names, settings, merging)
        drift = {"-".join(pair.shape.ids): pair.drift for pair in pairs}
    return SessionMatches(series, ring, errors, drift, agreement, (*ring.warnings, *warnings, *more_warnings))


def _deform(
    tracked: SessionMatches, steps: tuple[Capture, ...], path: Path, stages: Stages, began: float
) -> dict[str, Any]:
    """Deformation and uncertainty of every step, each written when it is found; the summary. path : of the results.

    Of captures at rest, which are not written, the summary tells the noise floor.
    """
    series = tracked.series
    stated = StepUncertainty(series.reference, camera_covariance(tracked.ring.bundle), series.noise)
    kept = [k for k, step in enumerate(steps) if step.kind != "static"]
    reference = stated.of(series.reference, 0)
    at_rest = [replace(series.reference, matches=())]
    figures: list[summary.StepFigures] = []
    with ResultsWriter(path, reference, [series.names[k] for k in kept]) as file:

        def made(k: int) -> Results | tuple[StepRecord, summary.StepFigures]:
            results = series.at(k) if k else reference
            if k not in kept:
                return replace(results, matches=())
            last = len(results.steps) - 1
            motion, found = results.motion(last), results.deformation(last)
            results = stated.of(results, k, found) if k else reference
            return file.made(results, motion, found), summary.step_figures(results, motion, found)

        for k, one in enumerate(in_turn(made, range(len(steps)))):
            if isinstance(one, Results):
                at_rest.append(one)
            else:
                file.write(len(figures), one[0])
                figures.append(one[1])
            stages.at("deform", (k + 1) / len(steps))
        drift = {who: values[kept] for who, values in tracked.drift.items()}
        found = summary.summarise(
            reference, figures, tracked.ring, tracked.errors, drift, tracked.agreement, tracked.warnings
        )
        found["noise_floor"] = noise_floor.noise_floor(join_steps(at_rest)) if len(at_rest) > 1 else None
        found["seconds"] = round(time.monotonic() - began, 2)
        file.finish(tracked.calibration, found)
    return found


def _specimen_steps(session: Session) -> tuple[Capture, ...]:
    steps = session.of_kind("specimen")
    if not steps:
        raise InputError(f"{session.path}: no capture of the specimen; capture or import the reference and the steps")
    return steps


def _with_captures_at_rest(session: Session) -> tuple[Capture, ...]:
    """The steps, and right after the reference, where nothing has moved yet, the captures at rest."""
    steps = _specimen_steps(session)
    return (steps[0], *session.of_kind("static"), *steps[1:])


def _usable_pairs(
    session: Session, ring: CalibratedRig, steps: tuple[Capture, ...]
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


def _pairs(
    session: Session,
    ring: CalibratedRig,
    pairs: tuple[tuple[str, str], ...],
    steps: tuple[Capture, ...],
    settings: Settings,
    stages: Stages,
    executor: Executor | None,
) -> tuple[list[PairSurface], list[str]]:
    """Every pair matched at every step, as tasks, and triangulated; a sentence for each that gave no surface."""
    cameras = {id_: each.camera for id_, each in ring.cameras.items()}
    correlation = CorrelationSettings(**settings.correlation.keywords)
    jobs = pair_jobs(session, cameras, pairs, steps, _search(session, settings), correlation)
    _run(ordered_tasks(jobs), executor, stages, session)
    shelf = StepCache(work_folder(session.path))

    def followed(job: PairJob) -> PairSurface | str:
        try:
            grid, at_first = job.at_reference()
        except ComputationError as error:
            return str(error)
        shape = pair_shape(job.cameras, grid.xy, grid.faces, at_first, correlation.step, settings.surface.sigma_max_px)
        return reconstruct_pair(shape, lambda k: job.step(k, at_first) if k else at_first, len(steps), shelf)

    found: list[PairSurface] = []
    warnings: list[str] = []
    for k, made in enumerate(in_turn(lambda k: followed(jobs[k]), range(len(jobs))), start=1):
        stages.at("triangulate", k / len(jobs), f"pair {jobs[k - 1].name}")
        if isinstance(made, str):
            warnings.append(made)
        else:
            found.append(made)
    if not found:
        raise ComputationError(f"{session.path}: no camera pair gave a surface: {'; '.join(warnings)}")
    return found, warnings


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
    ring: CalibratedRig,
    pairs: tuple[tuple[str, str], ...],
    steps: tuple[Capture, ...],
    settings: Settings,
    stages: Stages,
    executor: Executor | None,
) -> MultiviewSurface:
    """One surface from all cameras that have a reference image, as tasks."""
    from ringdic.multiview.surface import surface_of_tracks  # loaded where it is asked for: pairs need none of it
    from ringdic.multiview.tasks import multiview_job

    cameras = [each.camera for each in ring.cameras.values() if each.camera.id in steps[0].images]
    job = multiview_job(session, cameras, pairs, steps, _search(session, settings), settings)
    _run(job.tasks, executor, stages, session)
    shape, tracks = job.outputs()
    stages.at("triangulate", 0.0)
    names = [step.id for step in steps]
    return surface_of_tracks(session.rig.name, cameras, pairs, names, shape, tracks, settings)


def _search(session: Session, settings: Settings) -> DepthSearch:
    return DepthSearch(
        radius=settings.surface.radius_mm or session.rig.target.radius_mm,
        reach=settings.surface.reach_mm,
        incidence=settings.surface.incidence_deg,
    )
