"""From matched pixels to points in space: linear, unweighted (Solav et al. 2018, eq. 7-9).

Every camera that sees a point gives two equations in three unknowns. With the rows p1, p2, p3 of its projection
matrix and the undistorted pixel (u, v): ``(p1 - u p3) · (X, 1) = 0`` and ``(p2 - v p3) · (X, 1) = 0``. The
least-squares solution is closed: three normal equations a point, well conditioned because the rows are scaled as the
DLT gives them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.geometry import kernels
from ringdic.geometry.camera import Camera


def triangulate(cameras: Sequence[Camera], px: Floats) -> Floats:
    """Points in space from their pixels in two or more images.

    Parameters
    ----------
    cameras : the C cameras, C ≥ 2.
    px : (C, n, 2) image pixels as they are in the images (distorted); NaN where a camera did not match the point.

    Returns
    -------
    (n, 3) mm, world frame. NaN where fewer than two cameras saw the point or the lines of sight are parallel.
    """
    return LinearSystem.of(cameras, px).solution


def triangulate_undistorted(P: Floats, px: Floats) -> Floats:
    """The same from projection matrices (C, 3, 4) and undistorted pixels (C, n, 2). (n, 3) mm, NaN as above."""
    return LinearSystem(P, px).solution


@dataclass(frozen=True)
class LinearSystem:
    """Eq. 7-9 of n points in C images: P (C, 3, 4) and undistorted pixels (C, n, 2), NaN for a camera without part."""

    P: Floats
    undistorted: Floats

    def __post_init__(self) -> None:
        for name in ("P", "undistorted"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=float))

    @classmethod
    def of(cls, cameras: Sequence[Camera], px: Floats) -> LinearSystem:
        """From image pixels (C, n, 2), NaN where a camera did not match the point."""
        px = np.asarray(px, dtype=float)
        if len(cameras) < 2 or px.shape[:1] != (len(cameras),) or px.ndim != 3 or px.shape[2] != 2:
            raise ValueError(
                f"{len(cameras)} cameras do not go with pixels of shape {px.shape}; wanted (C, n, 2), C >= 2"
            )
        undistorted = np.stack([camera.undistort(image) for camera, image in zip(cameras, px, strict=True)])
        return cls(np.stack([camera.P for camera in cameras]), undistorted)

    @cached_property
    def _summed(self) -> tuple[Floats, Floats, Indices, Mask]:
        """``AᵀA`` (n, 3, 3), ``Aᵀb`` (n, 3), cameras a point (n,), and which ``AᵀA`` are well conditioned for sure."""
        n = self.undistorted.shape[1]
        normal, right, seen = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty(n, np.int64)
        return normal, right, seen, kernels.normal_equations(self.P, self.undistorted, normal, right, seen)

    @property
    def normal(self) -> Floats:
        """``AᵀA``. (n, 3, 3)."""
        return self._summed[0]

    @cached_property
    def solvable(self) -> Mask:
        """Points (n,) with two cameras whose lines of sight cross."""
        normal, _, seen, sure = self._summed
        solvable = sure.copy()
        solvable[~sure] = _well_conditioned(normal[~sure])
        return np.asarray(solvable & (seen >= 2))

    @cached_property
    def solution(self) -> Floats:
        """(n, 3) mm, NaN where it is not determined."""
        xyz = np.empty(self.normal.shape[:2])
        kernels.solve_normal_equations(self.normal, self._summed[1], self.solvable, xyz)
        return xyz


def _well_conditioned(normal: Floats) -> Mask:
    """Symmetric matrices (n, 3, 3) whose eigenvalues do not differ by more than a factor of 1e12. (n,)."""
    least, _, most = np.moveaxis(np.linalg.eigvalsh(normal), -1, 0)
    return np.asarray(least * 1e12 > most)


def reprojection_residuals(cameras: Sequence[Camera], xyz: Floats, px: Floats) -> Floats:
    """Measured minus projected pixels.

    xyz : (n, 3) mm; px : (C, n, 2) image pixels. Returns (C, n, 2) px, NaN where either is.
    """
    return np.stack([image - camera.project(xyz) for camera, image in zip(cameras, px, strict=True)])
