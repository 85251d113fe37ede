"""What points owe to uncertain cameras: an error that all points and steps share, and that no repetition shows.

With the cameras' parameters off by dp a point moves by ``-Σ A_c (∂u_c/∂p_c) dp_c``, A_c the gain of its pixels. Written
for dp = R dq with R Rᵀ their covariance and dq of unit variance, that is a matrix (3, S) a point: its *share* in each
of the S independent errors. Shares of different points and steps subtract before they are squared, so what is common
to them cancels: a displacement and a stretch are far surer than the places they come from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Mask
from ringdic.calibration.parameters import PER_CAMERA, Parameters, projection_jacobians
from ringdic.geometry.camera import Camera
from ringdic.strain.deformation import Deformation
from ringdic.uncertainty.strain import stretch_slopes

Shares = NDArray[np.float32]

_BLOCK = 4096  # points or triangles at a time, which bounds the memory


@dataclass(frozen=True)
class CameraCovariance:
    """What an adjustment knows of its K cameras.

    ids : of the cameras. parameters : (16 K, 16 K) covariance of sixteen parameters of each, in their order.
    """

    ids: tuple[str, ...]
    parameters: Floats

    def __post_init__(self) -> None:
        size = PER_CAMERA * len(self.ids)
        if self.parameters.shape != (size, size):
            raise ValueError("a covariance of cameras has sixteen parameters a camera")

    @property
    def root(self) -> Floats:
        """R with R Rᵀ the covariance; parameters that were held have none."""
        values, vectors = np.linalg.eigh(self.parameters)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def shares(
    cameras: Sequence[Camera],
    xyz: Floats,
    gain: Floats,
    known: CameraCovariance,
    followed: tuple[Floats, Shares] | None = None,
) -> Shares:
    """How points move with the independent errors of the cameras, (n, 3, S) mm; NaN where a point has no gain.

    Parameters
    ----------
    cameras : C. xyz : (n, 3) mm. gain : (C, n, 3, 2) mm a px, of ``position_gain``.
    followed : positions (n, 3) of the same points at the reference and their shares there, where each camera followed
        a point from the projection of that position; None where its pixels are measured in themselves.

    Raises ValueError for a camera that was not adjusted.
    """
    missing = [camera.id for camera in cameras if camera.id not in known.ids]
    if missing:
        raise ValueError(f"no covariance of camera {', '.join(missing)}; it took no part in the adjustment")
    root = known.root.astype(np.float32)
    out = np.full((len(xyz), 3, len(root)), np.nan, dtype=np.float32)
    seen: Mask = np.asarray(gain.any(axis=(2, 3)) & np.isfinite(xyz).all(axis=1))
    for first in range(0, len(xyz), _BLOCK):
        part = slice(first, first + _BLOCK)
        moved = np.zeros((len(xyz[part]), 3, len(root)), dtype=np.float32)
        follows = np.zeros((len(moved), 3, 3))
        for k, camera in enumerate(cameras):
            index = np.flatnonzero(seen[k, part])
            parameters = Parameters.of(camera)
            by_camera = -projection_jacobians(parameters, xyz[part][index])[1]
            if followed is not None:
                _, at_first, by_place = projection_jacobians(parameters, followed[0][part][index])
                by_camera += at_first
                follows[index] += gain[k, part][index] @ by_place
            at = PER_CAMERA * known.ids.index(camera.id)
            moved[index, :, at : at + PER_CAMERA] = gain[k, part][index] @ by_camera
        moved = moved @ root
        if followed is not None:
            moved += follows.astype(np.float32) @ followed[1][part]
        moved[np.flatnonzero(~np.any(seen[:, part], axis=0))] = np.nan
        out[part] = moved
    return out


def sigma_of(share: Shares) -> Floats:
    """Standard deviations (...) of quantities with shares (..., S)."""
    return np.asarray(np.sqrt(np.einsum("...s,...s->...", share, share)), dtype=float)


def stretch_sigma_by_cameras(
    found: Deformation, reference: Floats, faces: NDArray[np.int_], at_first: Shares, now: Shares
) -> Floats:
    """Standard deviations (M, 2) of λ1 and λ2 by those of the cameras.

    found : deformation of the step. reference : (N, 3) mm. faces : (M, 3). at_first, now : shares (N, 3, S) of the
    points at the reference and at the step.
    """
    current, before = (each.astype(np.float32) for each in stretch_slopes(found, reference, faces))
    out = np.full((len(faces), 2), np.nan)
    for first in range(0, len(faces), _BLOCK):
        part = slice(first, first + _BLOCK)
        m = len(faces[part])
        felt = np.zeros((m, 2, now.shape[-1]), dtype=np.float32)
        for slope, share in ((current, now), (-before, at_first)):
            along = slope[:, part].transpose(1, 0, 2, 3).reshape(m, 2, 9)
            felt += along @ share[faces[part]].reshape(m, 9, -1)
        out[part] = sigma_of(felt)
    return out
