"""The camera model: projection of world points to undistorted pixels, then lens distortion and skew.

A normalised point (x, y), r² = x² + y², is distorted to (x_d, y_d) and brought to the image pixel (u, v) by

``x_d = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)``, ``y_d`` likewise with the roles of p1 and p2
swapped; ``u = fx x_d + s y_d + cx``, ``v = fy y_d + cy`` (Brown 1971; Solav et al. 2018, step 0). *Undistorted pixels*
are those of the same camera without distortion and skew: ``u = fx x + cx``, ``v = fy y + cy``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ringdic.arrays import Floats, Pixels, Points, Vectors
from ringdic.geometry import lens


@dataclass(frozen=True)
class Intrinsics:
    """Inner orientation of one camera: camera matrix, lens distortion and image size.

    K : (3, 3), px, focal lengths, skew ``K[0, 1]`` and principal point.
    distortion : (5,), k1 k2 p1 p2 k3, without unit.
    size : (width, height) of the image, px.
    """

    K: Floats
    distortion: Floats
    size: tuple[int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.asarray(self.K, dtype=float).reshape(3, 3))
        object.__setattr__(self, "distortion", np.asarray(self.distortion, dtype=float).reshape(5))
        if not (self.K[0, 0] > 0 and self.K[1, 1] > 0):
            raise ValueError("focal lengths must be positive")

    @property
    def K_undistorted(self) -> Floats:
        """Camera matrix of undistorted pixels: K with the skew set to zero. (3, 3), px."""
        K = self.K.copy()
        K[0, 1] = 0.0
        return K

    def distort_normalised(self, xy: Floats) -> Floats:
        """Lens distortion of normalised image points.

        xy : (..., 2) ideal points x/z, y/z in the camera frame, without unit. Returns the distorted points (..., 2).
        """
        return np.asarray(lens.distort_points(_rows(xy), self.distortion)).reshape(np.shape(xy))

    def jacobian_normalised(self, xy: Floats) -> Floats:
        """Jacobian d(distorted)/d(ideal) of the distortion at ideal normalised points.

        xy : (..., 2), without unit. Returns (..., 2, 2), without unit.
        """
        return np.asarray(lens.jacobians(_rows(xy), self.distortion)).reshape(*np.shape(xy), 2)

    def to_undistorted(self, px: Pixels) -> Pixels:
        """Undistorted pixels of image pixels, by Newton's method to round-off.

        px : (..., 2) px. Returns (..., 2) px, NaN for a pixel that the lens cannot show.
        """
        px = np.asarray(px, dtype=float)
        (fx, s, cx), (_, fy, cy) = self.K[0], self.K[1]
        y_d = (px[..., 1] - cy) / fy
        target = np.stack([(px[..., 0] - cx - s * y_d) / fx, y_d], axis=-1)
        xy = np.asarray(lens.undistort_points(_rows(target), self.distortion)).reshape(px.shape)
        return xy * np.array([fx, fy]) + np.array([cx, cy])


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: projection of world points to undistorted pixels, followed by lens distortion.

    id : the camera's name in the rig.
    P : (3, 4) projection of world points (mm) to undistorted pixels, scaled to P[2, 3] = 1 as the DLT gives it.
    size : (width, height) of the image, px.
    intrinsics : the lens, or None where distortion is not corrected (undistorted = image pixels).
    centre : (3,) mm, projection centre in the world frame, computed from P.
    """

    id: str
    P: Floats
    size: tuple[int, int]
    intrinsics: Intrinsics | None = None
    centre: Points = field(init=False)

    def __post_init__(self) -> None:
        P = np.ascontiguousarray(self.P, dtype=float).reshape(3, 4)
        object.__setattr__(self, "P", P)
        object.__setattr__(self, "centre", -np.linalg.solve(P[:, :3], P[:, 3]))

    def reduced(self, factor: int) -> Camera:
        """The camera of images that are reduced by averaging over squares of ``factor`` pixels.

        A pixel (u, v) of the full image lies at ``((u + ½) / factor - ½, (v + ½) / factor - ½)`` in the reduced one.
        """
        S = np.diag([1.0 / factor, 1.0 / factor, 1.0])
        S[:2, 2] = 0.5 / factor - 0.5
        size = (self.size[0] // factor, self.size[1] // factor)
        lens_of_image = None
        if self.intrinsics is not None:
            lens_of_image = Intrinsics(S @ self.intrinsics.K, self.intrinsics.distortion, size)
        return Camera(self.id, S @ self.P, size, lens_of_image)

    @cached_property
    def optics(self) -> tuple[Floats, Floats]:
        """Camera matrix (3, 3) px and distortion (5,) of the lens; the identity and zeros where there is none."""
        if self.intrinsics is None:
            return np.eye(3), np.zeros(5)
        return np.ascontiguousarray(self.intrinsics.K), np.ascontiguousarray(self.intrinsics.distortion)

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of the projection centre about the world's +z axis, counted from +x, -180 to 180 degrees."""
        return math.degrees(math.atan2(self.centre[1], self.centre[0]))

    def project_undistorted(self, xyz: Points) -> Pixels:
        """Undistorted pixels of world points. xyz : (..., 3) mm. Returns (..., 2) px."""
        h = np.asarray(xyz, dtype=float) @ self.P[:, :3].T + self.P[:, 3]
        return h[..., :2] / h[..., 2:]

    def project(self, xyz: Points) -> Pixels:
        """Image pixels of world points. xyz : (..., 3) mm. Returns (..., 2) px."""
        px = lens.projections(self.P, *self.optics, _rows(xyz))
        return np.asarray(px).reshape(*np.shape(xyz)[:-1], 2)

    def project_with_jacobian(self, xyz: Points) -> tuple[Pixels, Floats]:
        """Image pixels of world points, and the Jacobian of the projection.

        xyz : (..., 3) mm. Returns pixels (..., 2) px and d(pixel)/d(point) (..., 2, 3) px/mm.
        """
        jacobian = lens.projection_slopes(self.P, *self.optics, _rows(xyz))
        return self.project(xyz), np.asarray(jacobian).reshape(*np.shape(xyz)[:-1], 2, 3)

    def undistort(self, px: Pixels) -> Pixels:
        """Undistorted pixels of image pixels. px : (..., 2) px. Returns (..., 2) px, NaN where the lens shows none."""
        return np.asarray(px, dtype=float) if self.intrinsics is None else self.intrinsics.to_undistorted(px)

    def ray(self, px: Pixels) -> Vectors:
        """Directions of the lines of sight of image pixels, away from the camera.

        px : (..., 2) px. Returns unit vectors (..., 3) in the world frame.
        """
        undistorted = self.undistort(px)
        h = np.concatenate([undistorted, np.ones((*undistorted.shape[:-1], 1))], axis=-1)
        M = self.P[:, :3]
        d = np.linalg.solve(M, h.reshape(-1, 3).T).T.reshape(h.shape) * np.sign(np.linalg.det(M))
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    def incidence_cosine(self, xyz: Points, normals: Vectors) -> Floats:
        """Cosine of the angle between surface normals and the directions to the camera.

        xyz : (..., 3) mm, points of the surface. normals : (..., 3) outward unit normals. Returns (...), 1 where the
        surface faces the camera, negative where it faces away.
        """
        towards = self.centre - xyz
        along, square = (np.einsum("...i,...i->...", towards, each) for each in (normals, towards))
        return np.asarray(along / np.sqrt(square))


def stacked_optics(cameras: Sequence[Camera]) -> tuple[Floats, Floats, Floats]:
    """Projections P (C, 3, 4), camera matrices (C, 3, 3) px and distortions (C, 5) of several cameras, for kernels."""
    optics = [camera.optics for camera in cameras]
    return (
        np.stack([camera.P for camera in cameras]),
        np.stack([K for K, _ in optics]),
        np.stack([distortion for _, distortion in optics]),
    )


def signed_degrees(angle: float) -> float:
    """Wrap an angle in degrees to the interval -180 ≤ angle < 180."""
    return (angle + 180.0) % 360.0 - 180.0


def _rows(points: Floats) -> Floats:
    """Points (..., k) as contiguous rows (n, k), the form that the compiled loops take."""
    return np.ascontiguousarray(points, dtype=float).reshape(-1, np.shape(points)[-1])
