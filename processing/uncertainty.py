"""From the scatter of matched pixels to the scatter of points in space, to first order.

The triangulated point minimises ``|A(px) X - b(px)|²``; for consistent pixels its change is ``dX = -(AᵀA)⁻¹ Aᵀ dr``
with ``dr = (dA) X - db``, and the residual of a camera moves by ``-(p3 · (X, 1))`` times the change of its pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from processing.camera import Camera

Array = NDArray[np.float64]


def position_sigma(cameras: Sequence[Camera], px: Array, sigma: Array) -> Array:
    """Standard deviations of linearly triangulated points from those of their pixels, taken as independent.

    Parameters
    ----------
    cameras : the C cameras.
    px, sigma : (C, n, 2) image pixels and their standard deviations, px; NaN where a camera did not match.

    Returns
    -------
    (n, 3) mm, world frame; NaN where fewer than two cameras know the point and its scatter.
    """
    px = np.where(np.isfinite(sigma), np.asarray(px, dtype=float), np.nan)
    P = np.stack([camera.P for camera in cameras])
    undistorted = np.stack([camera.undistort(image) for camera, image in zip(cameras, px, strict=True)])
    seen: NDArray[np.bool_] = np.all(np.isfinite(undistorted), axis=-1)
    rows = np.where(seen[..., None, None], P[:, None, :2, :] - undistorted[..., None] * P[:, None, 2:, :], 0.0)
    A, b = rows[..., :3], -rows[..., 3]
    normal = np.einsum("cnri,cnrj->nij", A, A)
    solvable = (seen.sum(axis=0) >= 2) & (np.linalg.cond(normal) < 1e12)
    inverse = np.full_like(normal, np.nan)
    inverse[solvable] = np.linalg.inv(normal[solvable])
    xyz = np.einsum("nij,cnrj,cnr->ni", inverse, A, b)
    depth = np.einsum("ci,ni->cn", P[:, 2, :3], xyz) + P[:, None, 2, 3]
    # Change of the point by each undistorted pixel coordinate: (C, n, 3, 2).
    slope = np.einsum("nij,cnrj,cn->cnir", inverse, A, depth)
    variance = np.nan_to_num(np.asarray(sigma, dtype=float)) ** 2 * seen[..., None]
    return np.sqrt(np.einsum("cnir,cnr->ni", slope**2, variance))
