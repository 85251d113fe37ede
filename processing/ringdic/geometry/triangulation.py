"""Linear, unweighted triangulation of points in space from matched pixels (Solav et al. 2018, eq. 7-9).

Every camera that sees a point gives two equations in three unknowns. With the rows p1, p2, p3 of its projection
matrix and the undistorted pixel (u, v): ``(p1 - u p3) · (X, 1) = 0`` and ``(p2 - v p3) · (X, 1) = 0``. The
least-squares solution follows in closed form from three normal equations for each point. They are well conditioned
because the projection matrices are scaled to P[2, 3] = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
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
    return LinearSystem.of(cameras, px).solution


def triangulate_undistorted(P: Floats, px: Pixels) -> Points:
    """Points in space from projection matrices and undistorted pixels, by linear least squares.

    P : (C, 3, 4), world mm to undistorted px. px : (C, n, 2) undistorted px, NaN where a camera did not match the
    point. Returns (n, 3) mm, NaN where fewer than two cameras saw the point or the lines of sight are parallel.
    """
    return LinearSystem(P, px).solution


@dataclass(frozen=True)
class LinearSystem:
    """The linear equations of n points in C images (Solav et al. 2018, eq. 7-9) and their solution.

    P : (C, 3, 4) projection matrices, world mm to undistorted px.
    undistorted : (C, n, 2) undistorted px, NaN where a camera did not match the point.
    """

    P: Floats
    undistorted: Pixels

    def __post_init__(self) -> None:
        for name in ("P", "undistorted"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=float))

    @classmethod
    def of(cls, cameras: Sequence[Camera], px: Pixels) -> LinearSystem:
        """The system of image pixels, which are undistorted by each camera's lens.

        px : (C, n, 2) px, NaN where a camera did not match the point. Raises ValueError for fewer than two cameras or
        another shape.
        """
        px = pixels_of_cameras(cameras, px)
        undistorted = np.stack([camera.undistort(image) for camera, image in zip(cameras, px, strict=True)])
        return cls(np.stack([camera.P for camera in cameras]), undistorted)

    @cached_property
    def _summed(self) -> tuple[Floats, Floats, Indices, Mask]:
        """``AᵀA`` (n, 3, 3), ``Aᵀb`` (n, 3), numbers of cameras (n,), and where ``AᵀA`` is proved regular (n,)."""
        n = self.undistorted.shape[1]
        normal, right, views = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty(n, np.int64)
        return normal, right, views, kernels.normal_equations(self.P, self.undistorted, normal, right, views)

    @property
    def normal(self) -> Floats:
        """Normal matrices ``AᵀA`` of the points, (n, 3, 3) px²/mm²."""
        return self._summed[0]

    @cached_property
    def solvable(self) -> Mask:
        """Which points are determined, (n,) bool: visible in at least two cameras, with lines of sight that cross."""
        normal, _, views, sure = self._summed
        solvable = sure.copy()
        solvable[~sure] = _well_conditioned(normal[~sure])
        return np.asarray(solvable & (views >= 2))

    @cached_property
    def solution(self) -> Points:
        """Least-squares positions of the points, (n, 3) mm in the world frame, NaN where not determined."""
        xyz = np.empty(self.normal.shape[:2])
        kernels.solve_normal_equations(self.normal, self._summed[1], self.solvable, xyz)
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
