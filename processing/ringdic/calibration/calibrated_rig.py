"""Calibration of all cameras of a session, with its quality figures and with advice to the operator.

Each camera is first calibrated alone, by the direct linear transformation; the bundle adjustment starts from there. A
calibration depends only on the images of board and target, the rig and the settings. It is stored in the session under
a hash of these, so that a later run, or a run after one more capture, does not repeat it.
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

from numpy.typing import NDArray

from ringdic.calibration.advice import camera_advice, pair_advice
from ringdic.calibration.azimuths import AzimuthCandidates, azimuth_candidates, camera_azimuths
from ringdic.calibration.bundle import BundleFit, TargetPrior, bundle_adjustment
from ringdic.calibration.camera_calibration import CameraCalibration, calibrate_camera
from ringdic.calibration.contradictions import ExpectedErrors, contradictions
from ringdic.calibration.dots import find_dots
from ringdic.calibration.intrinsics import read_intrinsics
from ringdic.calibration.quality import (
    CameraQuality,
    PairQuality,
    ReconstructionError,
    camera_quality,
    pair_quality,
)
from ringdic.compiled import source_digest
from ringdic.errors import ComputationError, InputError
from ringdic.findings import Finding
from ringdic.session.folder import Capture, Session
from ringdic.session.images import read_gray
from ringdic.session.rig import Rig, Target
from ringdic.settings import CalibrationGroup
from ringdic.tasks.step_images import Digests

_VERSION = 5  # of the method; raise it when stored calibrations are no longer what a new run would give


@dataclass(frozen=True)
class CalibratedRig:
    """The calibrated cameras of a rig, with figures and sentences for the operator.

    target : as the rig describes it.
    cameras : calibrations by camera id.
    findings : cameras without an image of the target, a rotated target, and what contradicts: measures of the target,
        lenses of the boards, places of the dots.
    bundle : fit of the bundle adjustment, None where each camera was calibrated alone.
    quality, pairs : figures of each camera, and of the rig's pairs that see dots in common.
    advice : sentences on what would improve the calibration.
    """

    target: Target
    cameras: dict[str, CameraCalibration]
    findings: tuple[Finding, ...]
    bundle: BundleFit | None = None
    quality: tuple[CameraQuality, ...] = ()
    pairs: tuple[PairQuality, ...] = ()
    advice: tuple[str, ...] = ()


def calibrate_rig(
    session: Session, settings: CalibrationGroup, progress: Callable[[float, str], None] = lambda *_: None
) -> CalibratedRig:
    """Calibrate every camera of a session that has an image of the target.

    progress : called with the share done, 0 to 1, and the name of the current stage.

    Raises InputError or ComputationError, naming the camera, for images that do not determine its calibration.
    """
    targets = session.of_kind("target")
    if not targets:
        raise InputError(f"{session.path}: no capture of the calibration target; capture or import one")
    target = targets[-1]
    taking_part = [camera.id for camera in session.rig.cameras if camera.id in target.images]
    findings = tuple(
        Finding(
            "camera-not-calibrated", f"camera {camera.id} has no image of the target in {target.id} and takes no part",
            (camera.id,), target.id,
        )
        for camera in session.rig.cameras
        if camera.id not in target.images
    )  # fmt: skip
    digests = Digests(session)
    rig, turned = _with_true_azimuths(session, target, taking_part, digests)
    findings = (*findings, *turned)
    done = 0
    calibrated: dict[str, CameraCalibration] = {}
    keys: list[str] = []
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        futures = {
            id_: pool.submit(_camera_calibration, replace(session, rig=rig), id_, target, settings, digests)
            for id_ in taking_part
        }
        for id_, future in futures.items():
            calibrated[id_], key = future.result()
            keys.append(key)
            done += 1
            progress(done / len(taking_part), f"camera {id_}")
    findings = (*findings, *_contradictions(session, calibrated, keys, settings))
    if settings.method == "dlt":
        return _with_quality(session.rig, CalibratedRig(session.rig.target, calibrated, findings))
    progress(1.0, "all cameras together")
    adjusted, fit = _bundle(session, calibrated, keys, settings)
    return _with_quality(session.rig, CalibratedRig(session.rig.target, adjusted, findings, fit))


def control_points(first: CameraCalibration, second: CameraCalibration) -> ReconstructionError:
    """Reconstruction error of the dots that two cameras both see (Solav et al. 2018, eq. 10-11)."""
    return pair_quality(first, second)[0]


def _with_true_azimuths(
    session: Session, capture: Capture, ids: list[str], digests: Digests
) -> tuple[Rig, tuple[Finding, ...]]:
    """The rig with the azimuths that the images of the target show, and findings; stored in the session's folder."""
    target = session.rig.target
    cameras = {camera.id: camera for camera in session.rig.cameras if camera.id in ids}
    digest = hashlib.sha256(f"{_VERSION} {target} {list(cameras.values())}".encode())
    for id_ in ids:
        digest.update(bytes.fromhex(digests.image(capture, id_) or ""))
    path = session.path / "calibration" / f"survey-{digest.hexdigest()[:16]}.json"
    values = _stored(path)
    if values is None:

        def candidates(id_: str) -> AzimuthCandidates:
            image = read_gray(capture.images[id_])
            return azimuth_candidates(image, find_dots(image, target), cameras[id_], target)

        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            result = camera_azimuths(dict(zip(cameras, pool.map(candidates, cameras), strict=True)), target)
        values = {"azimuths": result.azimuths, "findings": [each.to_json() for each in result.findings]}
        _store(path, values)
    azimuths = values["azimuths"]
    entries = (replace(c, azimuth_deg=azimuths.get(c.id, c.azimuth_deg)) for c in session.rig.cameras)
    return replace(session.rig, cameras=tuple(entries)), tuple(map(Finding.from_json, values["findings"]))


def _contradictions(
    session: Session, calibrated: dict[str, CameraCalibration], keys: list[str], settings: CalibrationGroup
) -> tuple[Finding, ...]:
    """What contradicts in the cameras' single calibrations; stored in the session's folder, and read from there again.

    keys : of the single calibrations.
    """
    target, expected = session.rig.target, _expected(settings)
    distances = {each.id: each.distance_mm for each in session.rig.cameras if each.distance_mm is not None}
    # Another version of the program may find others.
    digest = hashlib.sha256(f"{source_digest()} {keys} {target} {expected} {distances}".encode()).hexdigest()[:16]
    path = session.path / "calibration" / f"contradictions-{digest}.json"
    values = _stored(path)
    if values is None:
        found = contradictions(calibrated, target, expected, distances)
        values = {"findings": [each.to_json() for each in found]}
        _store(path, values)
    return tuple(map(Finding.from_json, values["findings"]))


def _with_quality(rig: Rig, ring: CalibratedRig) -> CalibratedRig:
    """The calibrated rig with figures of its cameras and pairs, and with advice."""
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


def _camera_calibration(
    session: Session, camera_id: str, target: Capture, settings: CalibrationGroup, digests: Digests
) -> tuple[CameraCalibration, str]:
    """The calibration of one camera alone and its key; stored in the session's folder, and read from there again."""
    captures = [capture for capture in session.of_kind("board") if camera_id in capture.images]
    boards = {capture.id: capture.images[camera_id] for capture in captures}
    lens_file = session.rig.camera(camera_id).intrinsics
    hashes = [digests.image(capture, camera_id) or "" for capture in (target, *captures)]
    key = _key(session, camera_id, hashes, settings)
    path = session.path / "calibration" / f"{camera_id}-{key}.json"
    values = _stored(path)
    if values is not None:
        return CameraCalibration.from_dict(values), key
    views = boards if settings.distortion and lens_file is None else {}
    images = _images_of_one_size(camera_id, [target.images[camera_id], *views.values()])
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
        board_names=list(views),
    )
    _store(path, calibration.to_dict())
    return calibration, key


def _bundle(
    session: Session, calibrated: dict[str, CameraCalibration], keys: list[str], settings: CalibrationGroup
) -> tuple[dict[str, CameraCalibration], BundleFit]:
    """Bundle adjustment of the cameras; stored in the session's folder, and read from there again.

    keys : of the single calibrations.
    """
    own = settings.model_copy(update={"refine_poses": False})  # the poses are refined after the calibration
    digest = hashlib.sha256(f"{_VERSION} {keys} {own}".encode()).hexdigest()[:16]
    path = session.path / "calibration" / f"bundle-{digest}.json"
    values = _stored(path)
    if values is not None:
        cameras = [CameraCalibration.from_dict(each) for each in values["cameras"]]
        return {each.camera.id: each for each in cameras}, BundleFit.from_dict(values["fit"])
    prior = TargetPrior(
        dots=settings.print_error_mm,
        radius=settings.radius_error_mm,
        pitch=settings.pitch_error_mm,
        tilt=math.radians(settings.tilt_error_deg),
    )
    adjusted, fit = bundle_adjustment(calibrated, session.rig.target, prior)
    _store(path, {"cameras": [each.to_dict() for each in adjusted.values()], "fit": fit.to_dict()})
    return adjusted, fit


def _expected(settings: CalibrationGroup) -> ExpectedErrors:
    """How far the target may be from its measures: more, where the adjustment releases them."""
    if settings.method == "dlt":
        return ExpectedErrors(settings.print_error_mm)
    return ExpectedErrors(settings.print_error_mm, settings.radius_error_mm, settings.pitch_error_mm)


def _stored(path: Path) -> dict[str, Any] | None:
    """The values of a JSON file, or None where it does not exist."""
    if not path.is_file():
        return None
    values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return values


def _store(path: Path, values: dict[str, Any]) -> None:
    """Write values to a JSON file, which appears only when it is complete."""
    path.parent.mkdir(exist_ok=True)
    aside = path.with_suffix(".partial")
    aside.write_text(json.dumps(values), encoding="utf-8")
    aside.replace(path)


def _images_of_one_size(camera_id: str, paths: list[Path]) -> list[NDArray]:
    """Grey images (height, width) of some files; InputError names one whose size differs from that of the first."""
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
    """Hash of all that the calibration of a camera depends on. images : SHA-256 of its images, hexadecimal."""
    digest = hashlib.sha256()
    alone = f"{settings.distortion} {settings.drop_percentile} {settings.terms} {settings.radial_terms}"
    alone += f" {settings.tangential} {settings.skew}"
    digest.update(f"{_VERSION} {camera_id} {session.rig.target} {session.rig.board} {alone}".encode())
    digest.update(repr(session.rig.camera(camera_id)).encode())
    for image in images:
        digest.update(bytes.fromhex(image))
    return digest.hexdigest()[:16]
