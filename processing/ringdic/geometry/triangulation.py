"""Linear, unweighted triangulation of points in space from matched pixels (Solav et al. 2018, eq. 7-9).

Every camera that sees a point gives two equations in three unknowns. With the rows p1, p2, p3 of its projection
matrix and the undistorted pixel (u, v): ``(p1 - u p3) · (X, 1) = 0`` and ``(p2 - v p3) · (X, 1) = 0``. The
least-squares solution follows in closed form from three normal equations for each point. They are well conditioned
because the projection matrices are scaled to P[2, 3] = 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Floats, Mask, Pixels, Points
from ringdic.geometry import kernels
from ringdic.geometry.camera import Camera


def triangulate(cameras: Sequence[Camera], px: Pixels) -> Points:
    """Points in space from their pixels in two or more images, by linear least squares.

    Parameters
    ----------
    cameras : the C cameras, C ≥ 2.
    px : (C, n, 2) image pixels as they are in the images (distorted); NaN where a camera did not match the point.

    Returns
    -------
    (n, 3) mm, world frame. NaN where fewer than two cameras saw the point or the lines of sight are parallel.

    Raises
    ------
    ValueError : fewer than two cameras, or pixels of another shape.
    """
    px = pixels_of_cameras(cameras, px)
    undistorted = np.stack([camera.undistort(image) for camera, image in zip(cameras, px, strict=True)])
    return triangulate_undistorted(np.stack([camera.P for camera in cameras]), undistorted)


def triangulate_undistorted(P: Floats, px: Pixels) -> Points:
    """Points in space from projection matrices and undistorted pixels, by linear least squares.

    P : (C, 3, 4), world mm to undistorted px. px : (C, n, 2) undistorted px, NaN where a camera did not match the
    point. Returns (n, 3) mm, NaN where fewer than two cameras saw the point or the lines of sight are parallel.
    """
    P, px = np.ascontiguousarray(P, dtype=float), np.ascontiguousarray(px, dtype=float)
    n = px.shape[1]
    normal, right, views, xyz = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty(n, np.int64), np.empty((n, 3))
    solvable = kernels.normal_equations(P, px, normal, right, views)  # where AᵀA is proved regular
    unsure = ~solvable
    solvable[unsure] = _well_conditioned(normal[unsure])
    kernels.solve_normal_equations(normal, right, solvable & (views >= 2), xyz)
    return xyz


def _well_conditioned(normal: Floats) -> Mask:
    """Which symmetric matrices (n, 3, 3) have eigenvalues within a factor of 1e12 of one another. (n,) bool."""
    least, _, most = np.moveaxis(np.linalg.eigvalsh(normal), -1, 0)
    return np.asarray(least * 1e12 > most)


def pixels_of_cameras(cameras: Sequence[Camera], px: Pixels) -> Pixels:
    """Pixels as floats, checked to be those of two or more cameras.

    px : (C, n, 2) px, one row for each of the C cameras. Raises ValueError for C < 2 or another shape.
    """
    px = np.asarray(px, dtype=float)
    if len(cameras) < 2 or px.shape[:1] != (len(cameras),) or px.ndim != 3 or px.shape[2] != 2:
        raise ValueError(f"{len(cameras)} cameras do not go with pixels of shape {px.shape}; wanted (C, n, 2), C >= 2")
    return px


def reprojection_residuals(cameras: Sequence[Camera], xyz: Points, px: Pixels) -> Pixels:
    """Reprojection residuals of points: measured minus projected pixels.

    xyz : (n, 3) mm, world frame. px : (C, n, 2) image px. Returns (C, n, 2) px, NaN where point or pixel is.
    """
    return np.stack([image - camera.project(xyz) for camera, image in zip(cameras, px, strict=True)])
