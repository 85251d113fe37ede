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
from numpy.typing import NDArray

from processing.camera import Camera

Array = NDArray[np.float64]


def triangulate(cameras: Sequence[Camera], px: Array) -> Array:
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


def triangulate_undistorted(P: Array, px: Array) -> Array:
    """The same from projection matrices (C, 3, 4) and undistorted pixels (C, n, 2). (n, 3) mm, NaN as above."""
    return LinearSystem(np.asarray(P, dtype=float), np.asarray(px, dtype=float)).solution


@dataclass(frozen=True)
class LinearSystem:
    """Eq. 7-9 of n points in C images: P (C, 3, 4) and undistorted pixels (C, n, 2)."""

    P: Array
    undistorted: Array

    @classmethod
    def of(cls, cameras: Sequence[Camera], px: Array) -> LinearSystem:
        """From image pixels (C, n, 2), NaN where a camera did not match the point."""
        px = np.asarray(px, dtype=float)
        if len(cameras) < 2 or px.shape[:1] != (len(cameras),) or px.ndim != 3 or px.shape[2] != 2:
            raise ValueError(
                f"{len(cameras)} cameras do not go with pixels of shape {px.shape}; wanted (C, n, 2), C >= 2"
            )
        undistorted = np.stack([camera.undistort(image) for camera, image in zip(cameras, px, strict=True)])
        return cls(np.stack([camera.P for camera in cameras]), undistorted)

    @cached_property
    def equations(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """A (C, n, 2, 3), b (C, n, 2) and which cameras take part (C, n)."""
        return equations(self.P, self.undistorted)

    @cached_property
    def normal(self) -> Array:
        """``AᵀA``. (n, 3, 3)."""
        A = _stacked(self.equations[0])
        return A.transpose(0, 2, 1) @ A

    @cached_property
    def solvable(self) -> NDArray[np.bool_]:
        """Points (n,) with two cameras whose lines of sight cross."""
        return determined(self.normal, self.equations[2])

    @cached_property
    def solution(self) -> Array:
        """(n, 3) mm, NaN where it is not determined."""
        A, b, _ = self.equations
        right = _stacked(A).transpose(0, 2, 1) @ _stacked(b[..., None])
        xyz = np.full((len(self.normal), 3), np.nan)
        xyz[self.solvable] = np.linalg.solve(self.normal[self.solvable], right[self.solvable])[..., 0]
        return xyz


def _stacked(rows: Array) -> Array:
    """The equations (C, n, 2, k) of all cameras under one another. (n, 2 C, k)."""
    return np.moveaxis(rows, 0, 1).reshape(rows.shape[1], -1, rows.shape[3])


def equations(P: Array, px: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The equations ``A X = b`` of eq. 7-9, from matrices (C, 3, 4) and undistorted pixels (C, n, 2).

    Returns A (C, n, 2, 3), b (C, n, 2), both zero for a camera that takes no part, and which take part, (C, n).
    """
    P, px = np.asarray(P, dtype=float), np.asarray(px, dtype=float)
    seen: NDArray[np.bool_] = np.all(np.isfinite(px), axis=-1)
    rows = P[:, None, :2, :] - px[..., None] * P[:, None, 2:, :]  # (C, n, 2, 4)
    rows = np.where(seen[..., None, None], rows, 0.0)
    return rows[..., :3], -rows[..., 3], seen


def determined(normal: Array, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which points (n,) have two cameras whose lines of sight cross. normal : ``AᵀA`` (n, 3, 3); seen : (C, n)."""
    return np.asarray((seen.sum(axis=0) >= 2) & _well_conditioned(normal))


def _well_conditioned(normal: Array) -> NDArray[np.bool_]:
    """Symmetric matrices (n, 3, 3) whose eigenvalues do not differ by more than a factor of 1e12. (n,)."""
    least, _, most = np.moveaxis(np.linalg.eigvalsh(normal), -1, 0)
    return np.asarray(least * 1e12 > most)


def reprojection_residuals(cameras: Sequence[Camera], xyz: Array, px: Array) -> Array:
    """Measured minus projected pixels.

    xyz : (n, 3) mm; px : (C, n, 2) image pixels. Returns (C, n, 2) px, NaN where either is.
    """
    return np.stack([image - camera.project(xyz) for camera, image in zip(cameras, px, strict=True)])
