"""All cameras of a session calibrated, and how well they agree on the control points.

Each camera is calibrated alone, by the direct linear transformation; the bundle adjustment starts from there. A
calibration depends on the images of board and target, the rig and the settings alone. It is kept in the session under
a key made of these, so that a later run, or a run after one more capture, need not repeat it.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.calibration.advice import camera_advice, pair_advice
from ringdic.calibration.bundle import BundleFit, TargetPrior, adjust_ring
from ringdic.calibration.camera_calibration import CameraCalibration, calibrate_camera
from ringdic.calibration.dots import find_dots
from ringdic.calibration.intrinsics import read_intrinsics
from ringdic.calibration.quality import (
    CameraQuality,
    PairQuality,
    ReconstructionError,
    camera_quality,
    pair_quality,
)
from ringdic.calibration.survey import Sight, sight, survey
from ringdic.errors import ComputationError, InputError
from ringdic.session.folder import Capture, Session
from ringdic.session.images import read_gray
from ringdic.session.rig import Rig, Target
from ringdic.settings import CalibrationGroup
from ringdic.tasks.step_images import Digests

_VERSION = 3  # of what a kept calibration means; raise it when the method changes
#: A lens this much further from the board's than its uncertainty tells of a fault of board or target.
_LENS_CHI2 = 25.0


@dataclass(frozen=True)
class CalibratedRig:
    """Calibrated cameras by id, and one sentence for each that could not take part or whose images disagree.

    target : as the rig describes it.
    bundle : of the adjustment of all cameras together, None where each was calibrated alone.
    quality, pairs : figures of each camera, and of the rig's pairs that see dots in common.
    advice : what could be done for a better calibration, a sentence each.
    """

    target: Target
    cameras: dict[str, CameraCalibration]
    warnings: tuple[str, ...]
    bundle: BundleFit | None = None
    quality: tuple[CameraQuality, ...] = ()
    pairs: tuple[PairQuality, ...] = ()
    advice: tuple[str, ...] = ()


def calibrate_rig(
    session: Session, settings: CalibrationGroup, progress: Callable[[float, str], None] = lambda *_: None
) -> CalibratedRig:
    """Calibrate every camera that has an image of the target.

    Raises InputError or ComputationError, naming the camera, for images that do not determine it.
    """
    targets = session.of_kind("target")
    if not targets:
        raise InputError(f"{session.path}: no capture of the calibration target; capture or import one")
    target = targets[-1]
    taking_part = [camera.id for camera in session.rig.cameras if camera.id in target.images]
    warnings = tuple(
        f"camera {camera.id} has no image of the target in {target.id} and takes no part"
        for camera in session.rig.cameras
        if camera.id not in target.images
    )
    digests = Digests(session)
    rig, turned = _surveyed(session, target, taking_part, digests)
    warnings = (*warnings, *turned)
    done = 0
    calibrated: dict[str, CameraCalibration] = {}
    keys: list[str] = []
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        futures = {
            id_: pool.submit(_calibrated, replace(session, rig=rig), id_, target, settings, digests)
            for id_ in taking_part
        }
        for id_, future in futures.items():
            calibrated[id_], key = future.result()
            keys.append(key)
            done += 1
            progress(done / len(taking_part), f"camera {id_}")
    if settings.method == "dlt":
        return _judged(session.rig, CalibratedRig(session.rig.target, calibrated, warnings))
    progress(1.0, "all cameras together")
    adjusted, fit = _adjusted(session, calibrated, keys, settings)
    return _judged(session.rig, CalibratedRig(session.rig.target, adjusted, (*warnings, *_contradictions(fit)), fit))


def control_points(first: CameraCalibration, second: CameraCalibration) -> ReconstructionError:
    """Reconstruction error of the dots that two cameras both see (Solav et al. 2018, eq. 10-11)."""
    return pair_quality(first, second)[0]


def _surveyed(session: Session, seen_in: Capture, ids: list[str], digests: Digests) -> tuple[Rig, tuple[str, ...]]:
    """The rig with the azimuths at which the cameras stand, from the session's folder if they are there; sentences."""
    target = session.rig.target
    cameras = {camera.id: camera for camera in session.rig.cameras if camera.id in ids}
    digest = hashlib.sha256(f"{_VERSION} {target} {list(cameras.values())}".encode())
    for id_ in ids:
        digest.update(bytes.fromhex(digests.image(seen_in, id_) or ""))
    kept = session.path / "calibration" / f"survey-{digest.hexdigest()[:16]}.json"
    if kept.is_file():
        values = json.loads(kept.read_text(encoding="utf-8"))
    else:

        def seen(id_: str) -> Sight:
            image = read_gray(seen_in.images[id_])
            return sight(image, find_dots(image, target), cameras[id_], target)

        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            found = survey(dict(zip(cameras, pool.map(seen, cameras), strict=True)), target)
        values = {"azimuths": found.azimuths, "warnings": list(found.warnings)}
        _keep(kept, values)
    azimuths = values["azimuths"]
    entries = (replace(c, azimuth_deg=azimuths.get(c.id, c.azimuth_deg)) for c in session.rig.cameras)
    return replace(session.rig, cameras=tuple(entries)), tuple(values["warnings"])


def _judged(rig: Rig, ring: CalibratedRig) -> CalibratedRig:
    """The ring with its figures and with advice."""
    quality = tuple(camera_quality(each, rig.camera(id_).azimuth_deg) for id_, each in ring.cameras.items())
    advice = [sentence for row in quality for sentence in camera_advice(ring.cameras[row.camera], row)]
    pairs = []
    for first, second in rig.pairs:
        if first in ring.cameras and second in ring.cameras:
            try:
                pairs.append(pair_quality(ring.cameras[first], ring.cameras[second])[1])
            except ComputationError as error:
                advice.append(str(error))
    advice += [sentence for row in pairs for sentence in pair_advice(row)]
    return replace(ring, quality=quality, pairs=tuple(pairs), advice=tuple(advice))


def _calibrated(
    session: Session, camera_id: str, target: Capture, settings: CalibrationGroup, digests: Digests
) -> tuple[CameraCalibration, str]:
    """One camera's calibration and its key, from the session's folder if it is there, else made and kept."""
    captures = [capture for capture in session.of_kind("board") if camera_id in capture.images]
    boards = {capture.id: capture.images[camera_id] for capture in captures}
    lens_file = session.rig.camera(camera_id).intrinsics
    seen = [digests.image(capture, camera_id) or "" for capture in (target, *captures)]
    key = _key(session, camera_id, seen, settings)
    kept = session.path / "calibration" / f"{camera_id}-{key}.json"
    if kept.is_file():
        return CameraCalibration.from_dict(json.loads(kept.read_text(encoding="utf-8"))), key
    looked_at = boards if settings.distortion and lens_file is None else {}
    images = _of_one_size(camera_id, [target.images[camera_id], *looked_at.values()])
    calibration = calibrate_camera(
        session.rig,
        camera_id,
        images[1:],
        images[0],
        distortion=settings.distortion,
        intrinsics=None if lens_file is None else read_intrinsics(session.path / lens_file),
        radial=None if settings.radial_terms == 3 else settings.radial_terms,
        tangential=settings.tangential,
        skew=settings.skew,
        fewest_terms=settings.terms == "criterion",
        drop_percentile=settings.drop_percentile,
        board_names=list(looked_at),
    )
    _keep(kept, calibration.to_dict())
    return calibration, key


def _adjusted(
    session: Session, calibrated: dict[str, CameraCalibration], keys: list[str], settings: CalibrationGroup
) -> tuple[dict[str, CameraCalibration], BundleFit]:
    """The cameras adjusted together, from the session's folder if they are there, else made and kept."""
    own = settings.model_copy(update={"refine_poses": False})  # which comes after the calibration
    digest = hashlib.sha256(f"{_VERSION} {keys} {own}".encode()).hexdigest()[:16]
    kept = session.path / "calibration" / f"bundle-{digest}.json"
    if kept.is_file():
        values = json.loads(kept.read_text(encoding="utf-8"))
        cameras = [CameraCalibration.from_dict(each) for each in values["cameras"]]
        return {each.camera.id: each for each in cameras}, BundleFit.from_dict(values["fit"])
    prior = TargetPrior(
        dots=settings.print_error_mm,
        radius=settings.radius_error_mm,
        pitch=settings.pitch_error_mm,
        tilt=math.radians(settings.tilt_error_deg),
    )
    adjusted, fit = adjust_ring(calibrated, session.rig.target, prior)
    _keep(kept, {"cameras": [each.to_dict() for each in adjusted.values()], "fit": fit.to_dict()})
    return adjusted, fit


def _contradictions(fit: BundleFit) -> tuple[str, ...]:
    """A sentence where the lenses that the target asks for are not those of the boards."""
    off = [id_ for id_, chi2 in zip(fit.cameras, fit.lens_chi2, strict=True) if chi2 > _LENS_CHI2]
    if not off:
        return ()
    worst = math.sqrt(float(np.nanmax(fit.lens_chi2)))
    return (
        f"camera {', '.join(off)}: the lens that fits the target is up to {worst:.0f} standard errors from the one "
        "that fits the checkerboard, so the board counted less; check that the board is flat and its squares true, "
        "that rig.toml describes the target, and that no lens was touched in between",
    )


def _keep(path: Path, values: dict[str, Any]) -> None:
    path.parent.mkdir(exist_ok=True)
    aside = path.with_suffix(".partial")
    aside.write_text(json.dumps(values), encoding="utf-8")
    aside.replace(path)


def _of_one_size(camera_id: str, paths: list[Path]) -> list[NDArray]:
    """The images, grey; InputError names the first whose size differs from that of the first image."""
    images = [read_gray(path) for path in paths]
    height, width = images[0].shape
    for path, image in zip(paths, images, strict=True):
        if image.shape != (height, width):
            raise InputError(
                f"{path}: {image.shape[1]} x {image.shape[0]} px, but {paths[0]} of the same camera '{camera_id}' has "
                f"{width} x {height} px; capture board, target and specimen at one size"
            )
    return images


def _key(session: Session, camera_id: str, images: list[str], settings: CalibrationGroup) -> str:
    """Of everything that a camera's calibration depends on. images : SHA-256 of the target's and the boards', hex."""
    digest = hashlib.sha256()
    alone = f"{settings.distortion} {settings.drop_percentile} {settings.terms} {settings.radial_terms}"
    alone += f" {settings.tangential} {settings.skew}"
    digest.update(f"{_VERSION} {camera_id} {session.rig.target} {session.rig.board} {alone}".encode())
    digest.update(repr(session.rig.camera(camera_id)).encode())
    for image in images:
        digest.update(bytes.fromhex(image))
    return digest.hexdigest()[:16]
