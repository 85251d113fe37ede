"""Quality of a calibration: reconstruction error of control points, figures of each camera and of each pair."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ringdic.arrays import Points, Vectors
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.parameters import lens_jacobians
from ringdic.errors import ComputationError
from ringdic.geometry.camera import signed_degrees
from ringdic.geometry.triangulation import reprojection_residuals, triangulate


@dataclass(frozen=True)
class ReconstructionError:
    """Error of reconstructed control points (Solav et al. 2018, eq. 10-11).

    mean_vector : (3,) mm, mean of reconstructed minus true positions, world frame.
    mean : length of this vector, mm.
    rms : root mean square of the lengths of the errors, mm.
    points : number of points that were reconstructed.
    """

    mean_vector: Vectors
    mean: float
    rms: float
    points: int


def reconstruction_error(xyz_true: Points, xyz_reconstructed: Points) -> ReconstructionError:
    """Mean error vector and RMS error of reconstructed control points.

    xyz_true, xyz_reconstructed : (n, 3) mm, world frame; points that are NaN are left out.
    """
    error = np.asarray(xyz_reconstructed, dtype=float) - np.asarray(xyz_true, dtype=float)
    error = error[np.isfinite(error).all(axis=1)]
    if not len(error):
        return ReconstructionError(np.full(3, np.nan), float("nan"), float("nan"), 0)
    mean = error.mean(axis=0)
    rms = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return ReconstructionError(mean, float(np.linalg.norm(mean)), rms, len(error))


@dataclass(frozen=True)
class CameraQuality:
    """Quality measures of one camera's calibration, shown as a row of the calibration's table.

    dots, columns : number of dots used, and the columns in which they are.
    residual_rms : RMS length of the dots' residuals, undistorted px.
    left_out : number of dots that were identified but left out as gross errors.
    azimuth_deg, azimuth_off_deg : azimuth of the camera about +z from +x, and its difference from that in rig.toml.
    board_views, board_views_used, board_rms : number of views of the checkerboard, number of those that the lens was
        fitted to, and RMS length of their residuals, px; 0, 0 and None where the lens was not calibrated from views.
    board_coverage : part of the image that the board covers in these views, 0 to 1, or None without views.
    residual_distortion : RMS over cells of the image of the mean residual in a cell, px, or None without views.
    lens_error : RMS displacement of the dots' images due to the standard errors of the lens, px, less the part that a
        change of the pose would compensate; None without views.
    lens_terms, lens_reason : free terms of the lens, and why these; None without views.
    focal, centre : focal lengths and principal point along x and y, px, None without a lens.
    focal_sigma, centre_sigma : their standard errors, px, None where not known.
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
    """Quality measures of one calibrated camera. nominal_azimuth_deg : from rig.toml, None for no comparison."""
    fit, lens = calibration.fit, calibration.camera.intrinsics
    azimuth = calibration.camera.azimuth_deg % 360.0
    off = 0.0 if nominal_azimuth_deg is None else signed_degrees(azimuth - nominal_azimuth_deg)
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
        board_views=len(fit.inliers),
        board_views_used=int(fit.inliers.sum()),
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
    """Quality measures of two calibrated cameras: how well they reconstruct the dots that both see.

    points : number of dots of the target that both see. mean, rms : reconstruction error of these dots, mm. angle_deg :
    angle between the cameras' lines of sight to the target. epipolar_rms : RMS reprojection error of the dots, px.
    """

    pair: tuple[str, str]
    points: int
    mean: float
    rms: float
    angle_deg: float
    epipolar_rms: float


def pair_quality(first: CameraCalibration, second: CameraCalibration) -> tuple[ReconstructionError, PairQuality]:
    """Reconstruction error of the dots that two cameras both see, and quality measures of the pair.

    Every dot is judged by a calibration in which it took no part, against where the target has it without print error:
    so the error contains the print's. Raises ComputationError where no dot is seen by both.
    """
    indices = [
        {(int(row), int(column)): i for i, (row, column) in enumerate(zip(dots.rows, dots.columns, strict=True))}
        for dots in (first.dots, second.dots)
    ]
    common = sorted(indices[0].keys() & indices[1].keys())
    if not common:
        raise ComputationError(
            f"cameras {first.camera.id} and {second.camera.id} have no dot of the target in common; "
            "check that nothing hides the target, and their azimuths in rig.toml"
        )
    chosen = [[index[dot] for dot in common] for index in indices]
    px = np.stack([first.control_points[chosen[0]], second.control_points[chosen[1]]])
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


def _lens_error(calibration: CameraCalibration) -> float:
    """RMS displacement of the dots' images by the standard errors of the lens, px.

    The part that a rotation of the camera and a change of its distance would compensate is projected out.
    """
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
    """The value, or None where it is NaN or infinite."""
    return value if math.isfinite(value) else None
