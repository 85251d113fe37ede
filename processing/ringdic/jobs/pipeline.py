"""Processing of a session folder: calibration, correlation, triangulation, deformation, results file.

The stages do not import one another; this is the only module that calls them all.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ringdic.arrays import Floats
from ringdic.calibration.calibrated_rig import CalibratedRig, calibrate_rig, control_points
from ringdic.calibration.quality import ReconstructionError
from ringdic.charts.depth_map import lattice_places
from ringdic.charts.exchanged import confusion_findings, without_consequences
from ringdic.charts.series import SurfaceSeries
from ringdic.charts.sharpness import edge_width
from ringdic.charts.surface import ReferenceSurface
from ringdic.charts.unmeasured import places_of_arrays
from ringdic.correlation.correlate import load_kernels
from ringdic.errors import ComputationError, InputError
from ringdic.findings import Finding
from ringdic.geometry.camera import Camera
from ringdic.jobs import summary
from ringdic.jobs.compiling import compile_once
from ringdic.jobs.reference import ReferenceMatching
from ringdic.jobs.task_runs import run_tasks
from ringdic.progress import COMPILING, Report, Stages, silent
from ringdic.results import noise_floor
from ringdic.results.results import Results
from ringdic.results.series import StepCache
from ringdic.results.uncertainty import StepUncertainty, camera_covariance
from ringdic.results.writer import ResultsWriter, StepRecord, map_in_order
from ringdic.session.folder import Capture, Session, new_run, open_session
from ringdic.session.json_values import json_value
from ringdic.session.load import load_series
from ringdic.session.moments import moment_findings
from ringdic.settings import CalibrationGroup, Settings
from ringdic.tasks import Executor, LocalExecutor, process_memory, read_output, work_folder
from ringdic.tasks.step_images import step_image

Calibrate = Callable[[Session, CalibrationGroup, Callable[[float, str], None]], CalibratedRig]

log = logging.getLogger(__name__)

_TARGETS_LOOKED_AT, _PLACES_APART = 3, 32  # cameras, and px between the places, at which edges are measured

_WEIGHTS = {"prepare": 0.03, "calibrate": 0.25, "correlate": 0.62, "triangulate": 0.04, "deform": 0.06}


@dataclass(frozen=True)
class SessionMatches:
    """Results of matching a session: calibrated rig, surface at some steps, and quality measures.

    series : the surface, step by step. rig : the calibrated cameras.
    errors : reconstruction errors of the control points, by pair.
    drift : (F,) px by camera, mean vertical reprojection residual at each step.
    agreement : figures of how well the cameras' views of a point, and the charts, agree, as JSON values.
    findings : of calibration and matching.
    """

    series: SurfaceSeries
    rig: CalibratedRig
    errors: dict[tuple[str, str], ReconstructionError]
    drift: dict[str, Floats]
    agreement: dict[str, Any]
    findings: tuple[Finding, ...]

    @property
    def calibration(self) -> dict[str, Any]:
        """The calibrated cameras and figures of their quality, as JSON values: the contents of calibration.json."""
        return {
            "cameras": [camera.to_dict() for camera in self.rig.cameras.values()],
            "pairs": [
                {"pair": list(pair), "mean_mm": error.mean, "rms_mm": error.rms, "points": error.points}
                for pair, error in self.errors.items()
            ],
            "bundle": None if self.rig.bundle is None else self.rig.bundle.to_dict(),
        }


def process_session(path: Path, settings: Settings, report: Report = silent, executor: Executor | None = None) -> Path:
    """Process a session and return the folder of the new run; earlier runs stay as they are.

    Matches that an interrupted run has computed are reused.

    path : the session folder. report : called with the stage, the share done, the rate and the time left.
    executor : runs the tasks; None runs them in this process.
    Raises InputError or ComputationError with a sentence for the operator.
    """
    began = time.monotonic()
    stages = Stages(_WEIGHTS, report)
    session = open_session(path)
    steps = _with_captures_at_rest(session)
    matches = match_session(session, settings, steps, stages, executor)
    process_memory.clear()  # images and prepared references, of which no later stage has use
    stages.at("deform", 0.0)
    with new_run(session.path) as run:
        (run.folder / "settings.toml").write_text(settings.to_toml(), encoding="utf-8")
        (run.folder / "calibration.json").write_text(json.dumps(matches.calibration), encoding="utf-8")
        figures = _deform(matches, steps, settings, run.folder / "results.h5", stages, began)
        (run.folder / "summary.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    assert run.final is not None
    for finding in figures["findings"]:
        log.warning("%s: %s", finding["verdict"], finding["sentence"])
    return run.final


def match_session(
    session: Session,
    settings: Settings,
    steps: Sequence[Capture],
    stages: Stages | None = None,
    executor: Executor | None = None,
    calibrate: Calibrate = calibrate_rig,
) -> SessionMatches:
    """Calibrate the cameras of a session, match its images and triangulate the surface at some steps.

    steps : the captures, the reference first. executor : runs the tasks; None runs them in this process.
    calibrate : replaces the function that calibrates the rig, for callers that cache its results.
    """
    stages, steps = stages or Stages(_WEIGHTS, silent), tuple(steps)
    compile_once(lambda done, count, _: stages.at("prepare", 0.0, f"{COMPILING}; {done} of {count} parts are ready"))
    stages.at("prepare", 0.0, "loading the correlation kernels")
    load_kernels()
    stages.at("calibrate", 0.0)
    rig = calibrate(session, settings.calibration, lambda done, who: stages.at("calibrate", done, who))
    errors, left_out = _usable_pairs(session, rig, steps)
    work, executor = work_folder(session.path), executor or LocalExecutor()
    cameras = [each.camera for id_, each in rig.cameras.items() if id_ in steps[0].images]
    reference = ReferenceMatching(session, rig, tuple(errors), steps, settings)
    matched = reference.agreeing(cameras, stages, executor)
    job, cameras = matched.job, list(matched.calibrated)
    run_tasks(job.later, job.tasks, work, stages, executor)
    stages.at("triangulate", 0.0)
    found = read_output(job.surface.output)
    series = SurfaceSeries(
        session.rig.name, matched.placed, reference.pairs_of(cameras), job.names, [step.id for step in steps],
        ReferenceSurface.from_arrays(found), job.matches, settings, StepCache(work),
        places_of_arrays(cameras, found), found["unmatched"].tolist(), job.motions,
    )  # fmt: skip
    images = job.images(
        series.names, series.measured, settings.correlation.radius_px, partial(_target_edge, session, cameras)
    )
    moments = moment_findings([step for step in steps if step.kind == "specimen"])
    surface = without_consequences(series.findings, job.confused)
    findings = (
        *rig.findings,
        *left_out,
        *matched.findings,
        *confusion_findings(job.confused, steps[0].id),
        *moments,
        *images.findings(),
        *surface,
    )
    return SessionMatches(series, rig, errors, series.drift, series.agreement, findings)


def _deform(
    matches: SessionMatches, steps: tuple[Capture, ...], settings: Settings, path: Path, stages: Stages, began: float
) -> dict[str, Any]:
    """Compute deformation and uncertainty of every step and write each to the results file; returns the summary.

    Captures at rest are not written; the summary has the noise floor that they show.
    path : of the results file. began : start of the run on the monotonic clock, seconds.
    """
    series = matches.series
    known = camera_covariance(matches.rig.bundle, series.motions_at(0))
    uncertainty = None if known is None else StepUncertainty(series.reference, known)
    written = [k for k, step in enumerate(steps) if step.kind != "static"]
    load = load_series([steps[k].folder for k in written])
    reference = series.reference
    if uncertainty is not None:
        reference = uncertainty.complete(reference, reference.deformation(0))
    at_rest: list[Results] = []
    figures: list[summary.StepFigures] = []
    with ResultsWriter(path, reference, [series.names[k] for k in written]) as file:

        def compute(k: int) -> Results | tuple[StepRecord, summary.StepFigures]:
            results = series.at(k) if k else reference
            if k not in written:
                return replace(results, matches=())
            last = len(results.steps) - 1
            motion, deformation = results.motion(last), results.deformation(last)
            if k and uncertainty is not None:
                results = uncertainty.complete(results, deformation, series.motions_at(k))
            return file.record(results, motion, deformation), summary.step_figures(results, motion, deformation)

        for k, one in enumerate(map_in_order(compute, range(len(steps)))):
            if isinstance(one, Results):
                at_rest.append(one)
            else:
                file.write(len(figures), one[0])
                figures.append(one[1])
            stages.at("deform", (k + 1) / len(steps))
        drift = {who: values[written] for who, values in matches.drift.items()}
        values = summary.summarise(
            reference, figures, matches.rig, matches.errors, drift, matches.agreement, matches.findings,
            settings.accept,
        )  # fmt: skip
        values["noise_floor"] = noise_floor.noise_floor(at_rest) if at_rest else None
        if load:
            values["load"] = json_value(load)
        values["seconds"] = round(time.monotonic() - began, 2)
        file.finish(matches.calibration, values)
    return values


def _with_captures_at_rest(session: Session) -> tuple[Capture, ...]:
    """The reference, then the captures at rest, which show the specimen unmoved, then the other steps."""
    steps = session.of_kind("specimen")
    if not steps:
        raise InputError(f"{session.path}: no capture of the specimen; capture or import the reference and the steps")
    return (steps[0], *session.of_kind("static"), *steps[1:])


def _usable_pairs(
    session: Session, rig: CalibratedRig, steps: tuple[Capture, ...]
) -> tuple[dict[tuple[str, str], ReconstructionError], tuple[Finding, ...]]:
    """Pairs of calibrated cameras with a reference image, with their errors at the control points.

    The second value has a finding for each camera without a reference image and each pair that cannot be used. Raises
    InputError where no pair can.
    """
    usable: dict[tuple[str, str], ReconstructionError] = {}
    reference = steps[0]
    absent = [id_ for id_ in rig.cameras if id_ not in reference.images]
    sentence = "{}: camera {} has no image of the reference, so it takes no part; capture it again"
    findings = [
        Finding("image-missing", sentence.format(reference.id, id_), (id_,), reference.id, 1, 0, "images")
        for id_ in absent
    ]

    def leave_out(sentence: str) -> None:
        findings.append(Finding("pair-left-out", sentence, pair))

    for pair in session.rig.pairs:
        missing = [id_ for id_ in pair if id_ not in rig.cameras]
        blind = [id_ for id_ in pair if id_ not in steps[0].images]
        if missing:
            leave_out(f"pair {pair[0]}-{pair[1]} is left out: camera {' and '.join(missing)} is not calibrated")
        elif blind:
            leave_out(
                f"pair {pair[0]}-{pair[1]} is left out: camera {' and '.join(blind)} has no image in {steps[0].id}"
            )
        else:
            try:
                usable[pair] = control_points(rig.cameras[pair[0]], rig.cameras[pair[1]])
            except ComputationError as error:
                leave_out(str(error))
    if not usable:
        raise InputError(f"{session.path}: no camera pair can be used: {'; '.join(each.sentence for each in findings)}")
    return usable, tuple(findings)


def _target_edge(session: Session, cameras: Sequence[Camera]) -> float:
    """Median width, px, of the sharpest edges in images of the target by some of the cameras; NaN without any."""
    images = {id_: path for capture in session.of_kind("target") for id_, path in capture.images.items()}
    edges = []
    for camera in cameras[:_TARGETS_LOOKED_AT]:
        if camera.id in images:
            places = lattice_places(camera.size, _PLACES_APART, _PLACES_APART, None)
            edges.append(edge_width(step_image(images[camera.id], camera, again=False), places))
    return float(np.median(edges)) if edges else float("nan")
