"""The straight line from a session folder to results: calibrate, correlate, triangulate, deform, keep.

This is the only place where the stages meet.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing import noise_floor, summary
from processing.calibration.quality import ReconstructionError
from processing.camera import Camera
from processing.correlation import CorrelationSettings
from processing.correlation.correlate import load_kernels
from processing.errors import ComputationError, InputError
from processing.images import read_gray, read_mask
from processing.matching import PairMatches, match_pair
from processing.pairs_surface import pairs_surface
from processing.progress import Report, Stages, silent
from processing.results import Results, write_results
from processing.ring import Ring, calibrate_ring, control_points
from processing.ring_surface import RingSurface, ring_surface
from processing.session import Capture, Session, new_run, read_session
from processing.settings import Settings
from processing.surface import PairSurface, pair_surface
from processing.sweep import Search

log = logging.getLogger(__name__)

_WEIGHTS = {"prepare": 0.03, "calibrate": 0.25, "correlate": 0.62, "triangulate": 0.04, "deform": 0.06}
_IMAGES_KEPT = 4  # decoded images held at a time: a pair uses its own two reference images again


def process_session(path: Path, settings: Settings, report: Report = silent) -> Path:
    """Process a session and return the folder of the new run; earlier runs stay as they are.

    path : the session folder. report : is told the stage, the share done, the rate and the time left.
    Raises InputError or ComputationError with a sentence for the operator.
    """
    began = time.monotonic()
    stages = Stages(_WEIGHTS, report)
    session = read_session(path)
    steps = _with_captures_at_rest(session)
    stages.at("prepare", 0.0, "loading the correlation kernels (compiled at the first use)")
    load_kernels()
    stages.at("calibrate", 0.0)
    ring = calibrate_ring(session, settings.calibration, lambda done, who: stages.at("calibrate", done, who))
    errors, warnings = _usable_pairs(session, ring, steps)
    if settings.surface.method == "global":
        whole = _whole_ring(session, ring, tuple(errors), steps, settings, stages)
        results, drift, agreement, more_warnings = whole.results, whole.drift, whole.agreement, whole.warnings
    else:
        surfaces, more_warnings = _surfaces(session, ring, tuple(errors), steps, settings, stages)
        results, agreement = pairs_surface(session, ring, surfaces, steps, settings)
        drift = {"-".join(surface.matches.cameras): surface.drift for surface in surfaces}
    results, drift, floor = _noise_floor(results, drift, steps)
    found = summary.summarise(results, ring, errors, drift, agreement, (*ring.warnings, *warnings, *more_warnings))
    found["noise_floor"] = floor
    for warning in found["warnings"]:
        log.warning("%s", warning)
    return _keep(session, results, found, ring, errors, settings, stages, began)


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
) -> tuple[list[PairSurface], list[str]]:
    """Every pair matched and triangulated, one after the other: the correlation itself uses all cores."""
    search = _search(session, settings)
    correlation = CorrelationSettings(**settings.correlation.keywords)
    image = _image_source(session, ring, steps)
    surfaces: list[PairSurface] = []
    warnings: list[str] = []
    refined, seconds = 0, 0.0
    for k, pair in enumerate(pairs):
        cameras = (ring.cameras[pair[0]].camera, ring.cameras[pair[1]].camera)
        rate = f"{refined / seconds:,.0f} points/s" if seconds else ""

        def progress(share: float, k: int = k, pair: tuple[str, str] = pair, rate: str = rate) -> None:
            stages.at("correlate", (k + share) / len(pairs), f"pair {pair[0]}-{pair[1]}", rate)

        progress(0.0)
        try:
            found = match_pair(cameras, image, len(steps), _mask(session, cameras[0]), search, correlation, progress)
            surfaces.append(pair_surface(cameras, found, correlation.step, settings.surface.sigma_max_px))
        except ComputationError as error:
            warnings.append(str(error))
            continue
        refined += _matches_made(found)
        seconds += found.matches.seconds["refine"]
    if not surfaces:
        raise ComputationError(f"{session.path}: no camera pair gave a surface: {'; '.join(warnings)}")
    stages.at("triangulate", 1.0)
    return surfaces, warnings


def _whole_ring(
    session: Session,
    ring: Ring,
    pairs: tuple[tuple[str, str], ...],
    steps: tuple[Capture, ...],
    settings: Settings,
    stages: Stages,
) -> RingSurface:
    """One surface from all cameras that have a reference image."""
    cameras = [each.camera for each in ring.cameras.values() if each.camera.id in steps[0].images]
    masks = {camera.id: mask for camera in cameras if (mask := _mask(session, camera)) is not None}
    return ring_surface(
        session.rig.name,
        cameras,
        pairs,
        _image_source(session, ring, steps),
        masks,
        tuple(step.id for step in steps),
        _search(session, settings),
        settings,
        lambda share, what, rate: stages.at("correlate", share, what, rate),
    )


def _search(session: Session, settings: Settings) -> Search:
    return Search(
        radius=settings.surface.radius_mm or session.rig.target.radius_mm,
        reach=settings.surface.reach_mm,
        incidence=settings.surface.incidence_deg,
    )


def _matches_made(found: PairMatches) -> int:
    steps, n = found.matches.status.shape
    return n * (2 * steps - 1)


def _image_source(session: Session, ring: Ring, steps: tuple[Capture, ...]) -> Callable[[str, int], NDArray | None]:
    @lru_cache(maxsize=_IMAGES_KEPT)
    def image(camera_id: str, step: int) -> NDArray | None:
        path = steps[step].images.get(camera_id)
        if path is None:
            return None
        grey = read_gray(path)
        width, height = ring.cameras[camera_id].camera.size
        if grey.shape != (height, width):
            raise InputError(
                f"{path}: {grey.shape[1]} x {grey.shape[0]} px, but camera {camera_id} was calibrated at "
                f"{width} x {height} px; capture board, target and specimen at one size"
            )
        return grey

    return image


def _mask(session: Session, camera: Camera) -> NDArray[np.bool_] | None:
    path = session.mask(camera.id)
    return None if path is None else read_mask(path, (camera.size[1], camera.size[0]))


def _keep(
    session: Session,
    results: Results,
    found: dict[str, Any],
    ring: Ring,
    errors: dict[tuple[str, str], ReconstructionError],
    settings: Settings,
    stages: Stages,
    began: float,
) -> Path:
    """Write the run aside and give it its number."""
    calibration = {
        "cameras": [camera.to_dict() for camera in ring.cameras.values()],
        "pairs": [
            {"pair": list(pair), "mean_mm": error.mean, "rms_mm": error.rms, "points": error.points}
            for pair, error in errors.items()
        ],
        "bundle": None if ring.bundle is None else ring.bundle.to_dict(),
    }
    stages.at("deform", 0.0)
    with new_run(session.path) as run:
        found["seconds"] = round(time.monotonic() - began, 2)
        results = replace(results, calibration=calibration, summary=found)
        write_results(run.folder / "results.h5", results, lambda done: stages.at("deform", done))
        (run.folder / "settings.toml").write_text(settings.to_toml(), encoding="utf-8")
        (run.folder / "calibration.json").write_text(json.dumps(calibration), encoding="utf-8")
        (run.folder / "summary.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    assert run.final is not None
    return run.final
