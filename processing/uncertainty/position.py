"""From the scatter of matched pixels to the scatter of points in space, to first order.

The triangulated point minimises ``|A(px) X - b(px)|²``; for consistent pixels its change is ``dX = -(AᵀA)⁻¹ Aᵀ dr``
with ``dr = (dA) X - db``, and the residual of a camera moves by ``-(p3 · (X, 1))`` times the change of its pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from processing.camera import Camera
from processing.triangulation import determined, equations

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
    A, b, seen = equations(P, undistorted)
    normal = np.einsum("cnri,cnrj->nij", A, A)
    solvable = determined(normal, seen)
    inverse = np.full_like(normal, np.nan)
    inverse[solvable] = np.linalg.inv(normal[solvable])
    xyz = np.einsum("nij,cnrj,cnr->ni", inverse, A, b)
    depth = np.einsum("ci,ni->cn", P[:, 2, :3], xyz) + P[:, None, 2, 3]
    # Change of the point by each pixel coordinate of each image: (C, n, 3, 2).
    lens = np.stack([_lens_slope(camera, image) for camera, image in zip(cameras, px, strict=True)])
    slope = np.einsum("nij,cnrj,cn,cnrs->cnis", inverse, A, depth, np.nan_to_num(lens))
    variance = np.nan_to_num(np.asarray(sigma, dtype=float)) ** 2 * seen[..., None]
    return np.sqrt(np.einsum("cnis,cns->ni", slope**2, variance))


def _lens_slope(camera: Camera, px: Array, h: float = 0.5) -> Array:
    """d(undistorted pixel)/d(image pixel), (n, 2, 2), by central differences over one pixel."""
    columns = [(camera.undistort(px + d) - camera.undistort(px - d)) / (2 * h) for d in np.eye(2) * h]
    return np.stack(columns, axis=-1)
