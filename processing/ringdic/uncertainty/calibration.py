"""Standard deviations of positions, displacements and stretches due to the covariance of the camera parameters.

All points and steps share the errors of the calibration, so repeating the images does not show them. With errors dp of
the parameters p_c of the cameras a point moves by ``-Σ_c A_c (∂u_c/∂p_c) dp_c``, where A_c is the gain from camera c's
pixel u_c to the position. Let R be a root of the parameters' covariance, R Rᵀ, and dp = R dq with S independent errors
dq of unit variance. The derivative with respect to dq, a matrix (3, S) for each point, is called its *sensitivity*
here. Sensitivities of different points and steps are subtracted before they are squared, so errors in common cancel: a
displacement and a stretch are much less uncertain than the positions that they are computed from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Points
from ringdic.calibration.parameters import PER_CAMERA, CameraParameters, projection_jacobians
from ringdic.geometry.camera import Camera
from ringdic.strain.deformation import Deformation
from ringdic.uncertainty.position import Gain
from ringdic.uncertainty.strain import stretch_slopes

#: Derivatives (..., S) of quantities with respect to S independent errors of unit variance, in single precision.
Sensitivity = NDArray[np.float32]

_BLOCK = 512  # triangles at a time, which bounds the memory


@dataclass(frozen=True)
class CameraCovariance:
    """Covariance of the parameters of K cameras after a bundle adjustment.

    ids : of the cameras. parameters : (16 K, 16 K) covariance of the sixteen `Parameters` of each camera (px, rad, mm
    and, for the distortion, no unit), camera after camera.
    """

    ids: tuple[str, ...]
    parameters: Floats

    def __post_init__(self) -> None:
        size = PER_CAMERA * len(self.ids)
        if self.parameters.shape != (size, size):
            raise ValueError("a covariance of cameras has sixteen parameters a camera")

    @cached_property
    def root(self) -> Floats:
        """Root R (16 K, S) of the covariance, R Rᵀ, in the units of the parameters (px, rad, mm); S = 16 K.

        The rows of fixed parameters are zero.
        """
        values, vectors = np.linalg.eigh(self.parameters)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def position_sensitivity(
    cameras: Sequence[Camera],
    xyz: Points,
    gain: Gain,
    known: CameraCovariance,
    tracked_from: tuple[Points, Sensitivity] | None = None,
) -> Sensitivity:
    """Sensitivity of positions to the independent errors of the calibration.

    Parameters
    ----------
    cameras : the C cameras that the points were triangulated from.
    xyz : (n, 3) mm, the positions.
    gain : (C, n, 3, 2) mm a px, from the pixels to the positions, as `position_gain` computes it.
    known : covariance of the camera parameters.
    tracked_from : for points that each camera tracked from the projection of their reference position: the reference
        positions (n, 3) mm and their sensitivity (n, 3, S). None for pixels that do not depend on the cameras.

    Returns
    -------
    (n, 3, S) mm; NaN where a point has no gain.

    Raises
    ------
    ValueError for a camera without a covariance.
    """
    missing = [camera.id for camera in cameras if camera.id not in known.ids]
    if missing:
        raise ValueError(f"no covariance of camera {', '.join(missing)}; it took no part in the adjustment")
    visible: Mask = np.asarray(gain.any(axis=(2, 3)) & np.isfinite(xyz).all(axis=1))
    by_camera, follows = _errors_by_camera(
        cameras, xyz, gain, visible, None if tracked_from is None else tracked_from[0]
    )
    place = np.cumsum(visible, axis=1) - 1  # of each point among those that the camera sees
    root = known.root.astype(np.float32).reshape(len(known.ids), PER_CAMERA, -1)
    out = np.full((len(xyz), 3, root.shape[2]), np.nan, dtype=np.float32)
    same = np.zeros(len(xyz), np.int64)  # number of the set of cameras that see a point
    for row in visible:
        same = np.unique(2 * same + row, return_inverse=True)[1]
    for k in range(int(same.max(initial=-1)) + 1):
        index = np.flatnonzero(same == k)
        seen = np.flatnonzero(visible[:, index[0]]).tolist()
        if not seen:
            continue
        errors = np.concatenate([by_camera[c][place[c, index]] for c in seen], axis=2)
        roots = np.concatenate([root[known.ids.index(cameras[c].id)] for c in seen])
        moved = (errors.reshape(-1, errors.shape[2]) @ roots).reshape(len(index), 3, -1)
        if tracked_from is not None:
            moved += follows[index] @ tracked_from[1][index]
        out[index] = moved
    return out


def _errors_by_camera(
    cameras: Sequence[Camera], xyz: Points, gain: Gain, visible: Mask, reference: Points | None
) -> tuple[list[NDArray[np.float32]], NDArray[np.float32]]:
    """Derivatives of positions with respect to the parameters of each camera, and to their reference positions.

    visible : (C, n) bool. reference : (n, 3) mm, positions from whose projections the points were tracked, or None.
    Returns for each camera (k, 3, 16) mm a unit of the parameter for the k points that it sees, and (n, 3, 3).
    """
    by_camera, follows = [], np.zeros((len(xyz), 3, 3), np.float32)
    for camera, own, seen in zip(cameras, gain, visible, strict=True):
        parameters, index = CameraParameters.of(camera), np.flatnonzero(seen)
        errors = -projection_jacobians(parameters, xyz[index])[1]
        if reference is not None:
            _, at_first, by_place = projection_jacobians(parameters, reference[index])
            errors += at_first
            follows[index] += (own[index] @ by_place).astype(np.float32)
        by_camera.append((own[index] @ errors).astype(np.float32))
    return by_camera, follows


def sensitivity_sigma(sensitivity: Sensitivity) -> Floats:
    """Standard deviations (...) of quantities from their sensitivity (..., S), in the same unit."""
    return np.asarray(np.sqrt(np.einsum("...s,...s->...", sensitivity, sensitivity)), dtype=float)


def stretch_sigma_by_cameras(
    deformed: Deformation, reference: Points, faces: Indices, at_reference: Sensitivity, at_step: Sensitivity
) -> Floats:
    """Standard deviations (M, 2) of the stretches λ1 and λ2 due to the covariance of the cameras.

    deformed : deformation of the M triangles at the step. reference : (N, 3) mm. faces : (M, 3) vertex indices.
    at_reference, at_step : sensitivities (N, 3, S) mm of the vertices at the reference and at the step.
    """
    current, before = (each.astype(np.float32) for each in stretch_slopes(deformed, reference, faces))
    out = np.full((len(faces), 2), np.nan)
    for first in range(0, len(faces), _BLOCK):
        part = slice(first, first + _BLOCK)
        m = len(faces[part])
        stretches = np.zeros((m, 2, at_step.shape[-1]), dtype=np.float32)
        for slope, sensitivity in ((current, at_step), (-before, at_reference)):
            along = slope[:, part].transpose(1, 0, 2, 3).reshape(m, 2, 9)
            stretches += along @ sensitivity[faces[part]].reshape(m, 9, -1)
        out[part] = sensitivity_sigma(stretches)
    return out
