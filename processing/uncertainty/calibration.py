"""What points owe to uncertain cameras: an error that all points and steps share, and that no repetition shows.

With the cameras' parameters off by dp a point moves by ``-Σ A_c (∂u_c/∂p_c) dp_c``, A_c the gain of its pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from processing.calibration.parameters import PER_CAMERA, Parameters, projection_jacobians
from processing.camera import Camera

Array = NDArray[np.float64]

_BLOCK = 4096  # points at a time, which bounds the memory


def calibration_covariance(
    cameras: Sequence[Camera], xyz: Array, gain: Array, ids: Sequence[str], parameters: Array
) -> Array:
    """Covariance (n, 3, 3) mm² of points by that of their cameras.

    Parameters
    ----------
    cameras : C. xyz : (n, 3) mm. gain : (C, n, 3, 2) mm a px, of ``position_gain``.
    ids, parameters : the K cameras of a bundle adjustment, and the covariance of sixteen parameters of each, in their
        order; (16 K, 16 K) or larger, what follows (the target) is not used.

    NaN where a point has no gain. Raises ValueError for a camera that was not adjusted.
    """
    missing = [camera.id for camera in cameras if camera.id not in ids]
    if missing:
        raise ValueError(f"no covariance of camera {', '.join(missing)}; it took no part in the adjustment")
    size = PER_CAMERA * len(ids)
    root = _root(parameters[:size, :size])
    out = np.full((len(xyz), 3, 3), np.nan)
    for first in range(0, len(xyz), _BLOCK):
        part = slice(first, first + _BLOCK)
        moved = np.zeros((len(xyz[part]), 3, size))
        for k, camera in enumerate(cameras):
            index = np.flatnonzero(gain[k, part].any(axis=(1, 2)) & np.isfinite(xyz[part]).all(axis=1))
            _, by_parameters, _ = projection_jacobians(Parameters.of(camera), xyz[part][index])
            at = PER_CAMERA * list(ids).index(camera.id)
            moved[index, :, at : at + PER_CAMERA] = gain[k, part][index] @ by_parameters
        scaled = moved @ root
        found = scaled @ scaled.transpose(0, 2, 1)
        found[~moved.any(axis=(1, 2))] = np.nan
        out[part] = found
    return out


def _root(covariance: Array) -> Array:
    """R with R Rᵀ the covariance, whose held parameters have none."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
