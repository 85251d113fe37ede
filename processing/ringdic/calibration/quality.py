"""How good a calibration is: reconstruction error of control points, figures of each camera and each pair."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ringdic.arrays import Floats
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.parameters import lens_jacobians
from ringdic.errors import ComputationError
from ringdic.geometry.triangulation import reprojection_residuals, triangulate


@dataclass(frozen=True)
class ReconstructionError:
    """Control points against their reconstruction (Solav et al. 2018, eq. 10-11).

    mean_vector : (3,) mean of reconstructed minus true position, mm; ``mean`` its length.
    rms : root mean square of the error's length, mm.
    points : number of points that were reconstructed.
    """

    mean_vector: Floats
    mean: float
    rms: float
    points: int


def reconstruction_error(xyz_true: Floats, xyz_reconstructed: Floats) -> ReconstructionError:
    """Mean error vector and RMS error of control points (n, 3) mm; points that are NaN are left out."""
    error = np.asarray(xyz_reconstructed, dtype=float) - np.asarray(xyz_true, dtype=float)
    error = error[np.isfinite(error).all(axis=1)]
    if not len(error):
        return ReconstructionError(np.full(3, np.nan), float("nan"), float("nan"), 0)
    mean = error.mean(axis=0)
    rms = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return ReconstructionError(mean, float(np.linalg.norm(mean)), rms, len(error))


@dataclass(frozen=True)
class CameraQuality:
    """One camera's row in the table of the calibration.

    dots, columns : how many dots were used, and the columns they stand in.
    residual_rms : RMS distance of the dots from their projection, undistorted px.
    left_out : dots recognised but left out as gross errors.
    azimuth_deg, azimuth_off_deg : where the camera stands, and that minus what rig.toml says.
    board_views, board_views_used, board_rms : views of the checkerboard and RMS distance of their corners, px;
        0, 0 and None where the lens was not calibrated from views.
    board_coverage : part of the image that the views used cover, 0 to 1. residual_distortion : px, what corners seen at
        one place of the image are off in common, RMS. lens_error : px, how far the standard errors of the lens shift
        the dots' images, RMS, beyond what a turn of the camera and its distance take up. All None without views.
    lens_terms, lens_reason : the terms of the lens, and why these.
    focal, focal_sigma, centre, centre_sigma : px, along x and y; sigma None where it is not known.
    """

    camera: str
    dots: int
    columns: tuple[int, ...]
    residual_rms: float
    left_out: int
    azimuth_deg: float
    azimuth_off_deg: float
    board_views: int = 0
    board_views_used: int = 0
    board_rms: float | None = None
    board_coverage: float | None = None
    residual_distortion: float | None = None
    lens_error: float | None = None
    lens_terms: str | None = None
    lens_reason: str | None = None
    focal: tuple[float, float] | None = None
    focal_sigma: tuple[float, float] | None = None
    centre: tuple[float, float] | None = None
    centre_sigma: tuple[float, float] | None = None


def camera_quality(calibration: CameraCalibration, nominal_azimuth_deg: float | None = None) -> CameraQuality:
    """The figures of one calibrated camera."""
    fit, lens = calibration.fit, calibration.camera.intrinsics
    azimuth = _azimuth(calibration)
    off = 0.0 if nominal_azimuth_deg is None else (azimuth - nominal_azimuth_deg + 180.0) % 360.0 - 180.0
    row = CameraQuality(
        camera=calibration.camera.id,
        dots=len(calibration.dots),
        columns=tuple(sorted(set(calibration.dots.columns.tolist()))),
        residual_rms=calibration.residual_rms,
        left_out=calibration.left_out,
        azimuth_deg=azimuth,
        azimuth_off_deg=off,
    )
    if lens is not None:
        K = lens.K
        row = replace(row, focal=(float(K[0, 0]), float(K[1, 1])), centre=(float(K[0, 2]), float(K[1, 2])))
    if fit is None:
        return row
    sigma = [float(value) for value in fit.sigma]
    return replace(
        row,
        board_views=len(fit.kept),
        board_views_used=int(fit.kept.sum()),
        board_rms=fit.rms,
        board_coverage=_finite(fit.coverage),
        residual_distortion=_finite(fit.residual_distortion),
        lens_error=_lens_error(calibration),
        lens_terms=fit.model,
        lens_reason=fit.reason,
        focal_sigma=(sigma[0], sigma[1]),
        centre_sigma=(sigma[3], sigma[4]),
    )


@dataclass(frozen=True)
class PairQuality:
    """How well two cameras agree.

    points : dots of the target that both see. mean, rms : mm, of their reconstruction. angle_deg : between their lines
    of sight at the target. epipolar_rms : px, RMS distance of the dots' images from the reprojected points.
    """

    pair: tuple[str, str]
    points: int
    mean: float
    rms: float
    angle_deg: float
    epipolar_rms: float


def pair_quality(first: CameraCalibration, second: CameraCalibration) -> tuple[ReconstructionError, PairQuality]:
    """Reconstruction error of the dots that two cameras both see, and the figures of the pair.

    True are the places that the calibration takes the dots to have: after a bundle adjustment the print errors found
    are in them. Raises ComputationError where no dot is seen by both.
    """
    seen = [
        {(int(row), int(column)): i for i, (row, column) in enumerate(zip(dots.rows, dots.columns, strict=True))}
        for dots in (first.dots, second.dots)
    ]
    common = sorted(seen[0].keys() & seen[1].keys())
    if not common:
        raise ComputationError(
            f"cameras {first.camera.id} and {second.camera.id} have no dot of the target in common; "
            "check that nothing hides the target, and their azimuths in rig.toml"
        )
    chosen = [[places[dot] for dot in common] for places in seen]
    px = np.stack([first.dot_centres[chosen[0]], second.dot_centres[chosen[1]]])
    cameras = [first.camera, second.camera]
    xyz = triangulate(cameras, px)
    error = reconstruction_error(first.dots.xyz[chosen[0]], xyz)
    towards = [camera.centre - np.nanmean(xyz, axis=0) for camera in cameras]
    cosine = towards[0] @ towards[1] / (np.linalg.norm(towards[0]) * np.linalg.norm(towards[1]))
    residuals = reprojection_residuals(cameras, xyz, px)
    return error, PairQuality(
        pair=(first.camera.id, second.camera.id),
        points=error.points,
        mean=error.mean,
        rms=error.rms,
        angle_deg=math.degrees(math.acos(float(np.clip(cosine, -1, 1)))),
        epipolar_rms=float(np.sqrt(np.nanmean(np.sum(residuals**2, axis=2)))),
    )


def _azimuth(calibration: CameraCalibration) -> float:
    centre = calibration.camera.centre
    return math.degrees(math.atan2(centre[1], centre[0])) % 360.0


def _lens_error(calibration: CameraCalibration) -> float:
    """RMS shift of the dots' images by one standard error of the lens, less what turn and distance take up. px."""
    lens, fit = calibration.camera.intrinsics, calibration.fit
    assert lens is not None
    assert fit is not None
    ideal = (lens.to_undistorted(calibration.dots.px) - lens.K[:2, 2]) / np.diag(lens.K)[:2]
    _, by_inner, by_ideal = lens_jacobians(lens, ideal)
    x, y = ideal.T
    along_x = np.stack([x * y, -(1 + x * x), y, x], axis=1)
    along_y = np.stack([1 + y * y, -x * y, -x, y], axis=1)
    J, T = by_inner.reshape(-1, by_inner.shape[-1]), (by_ideal @ np.stack([along_x, along_y], axis=1)).reshape(-1, 4)
    J = J - T @ np.linalg.lstsq(T, J, rcond=None)[0]
    return float(np.sqrt(2 * np.mean(np.einsum("ni,ij,nj->n", J, fit.covariance, J))))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
