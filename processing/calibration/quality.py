"""How good a calibration is: reconstruction error of control points and a row of figures for each camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.calibration.camera_calibration import CameraCalibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReconstructionError:
    """Control points against their reconstruction (Solav et al. 2018, eq. 10-11).

    mean_vector : (3,) mean of reconstructed minus true position, mm; ``mean`` its length.
    rms : root mean square of the error's length, mm.
    points : number of points that were reconstructed.
    """

    mean_vector: Array
    mean: float
    rms: float
    points: int


def reconstruction_error(xyz_true: Array, xyz_reconstructed: Array) -> ReconstructionError:
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
    board_views, board_views_used, board_rms : views of the checkerboard and RMS distance of their corners, px;
        0, 0 and None where the lens was not calibrated from views.
    """

    camera: str
    dots: int
    columns: tuple[int, ...]
    residual_rms: float
    left_out: int
    board_views: int
    board_views_used: int
    board_rms: float | None


def camera_quality(calibration: CameraCalibration) -> CameraQuality:
    """The figures of one calibrated camera."""
    fit = calibration.fit
    return CameraQuality(
        camera=calibration.camera.id,
        dots=len(calibration.dots),
        columns=tuple(sorted(set(calibration.dots.columns.tolist()))),
        residual_rms=calibration.residual_rms,
        left_out=calibration.left_out,
        board_views=0 if fit is None else len(fit.kept),
        board_views_used=0 if fit is None else int(fit.kept.sum()),
        board_rms=None if fit is None else fit.rms,
    )
