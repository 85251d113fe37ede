"""The camera model: distortion with skew, and projection of the world.

``x_d = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)``, ``y_d`` likewise with the roles of p1 and p2
swapped; ``u = fx x_d + s y_d + cx``, ``v = fy y_d + cy`` (Brown 1971; Solav et al. 2018, step 0).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ringdic.arrays import Floats
from ringdic.geometry import lens


@dataclass(frozen=True)
class Intrinsics:
    """Inner orientation of one camera.

    K : (3, 3), px, with skew ``K[0, 1]``.
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
        """K of undistorted pixels: the same without the skew. (3, 3), px."""
        K = self.K.copy()
        K[0, 1] = 0.0
        return K

    def distort_normalised(self, xy: Floats) -> Floats:
        """Ideal normalised points (..., 2) to distorted normalised points."""
        return np.asarray(lens.distorted(_rows(xy), self.distortion)).reshape(np.shape(xy))

    def _jacobian_normalised(self, xy: Floats) -> Floats:
        """d(distorted)/d(ideal) of normalised points. (..., 2, 2)."""
        return np.asarray(lens.slopes(_rows(xy), self.distortion)).reshape(*np.shape(xy), 2)

    def to_undistorted(self, px: Floats) -> Floats:
        """Image pixels (..., 2) to undistorted pixels, by Newton's method to round-off; NaN where it diverges."""
        px = np.asarray(px, dtype=float)
        (fx, s, cx), (_, fy, cy) = self.K[0], self.K[1]
        y_d = (px[..., 1] - cy) / fy
        target = np.stack([(px[..., 0] - cx - s * y_d) / fx, y_d], axis=-1)
        xy = np.asarray(lens.undistorted(_rows(target), self.distortion)).reshape(px.shape)
        return xy * np.array([fx, fy]) + np.array([cx, cy])

    def to_distorted(self, px: Floats) -> Floats:
        """Undistorted pixels (..., 2) to image pixels."""
        px = np.asarray(px, dtype=float)
        (fx, s, cx), (_, fy, cy) = self.K[0], self.K[1]
        xy_d = self.distort_normalised((px - np.array([cx, cy])) / np.array([fx, fy]))
        return np.stack([fx * xy_d[..., 0] + s * xy_d[..., 1] + cx, fy * xy_d[..., 1] + cy], axis=-1)

    def slope(self, px: Floats) -> Floats:
        """d(image pixel)/d(undistorted pixel) at undistorted pixels (..., 2). (..., 2, 2)."""
        K = np.ascontiguousarray(self.K)
        return np.asarray(lens.pixel_slopes(_rows(px), K, self.distortion)).reshape(*np.shape(px), 2)


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: projection to undistorted pixels, then the lens.

    id : the camera's name in the rig.
    P : (3, 4) projection of world points (mm) to undistorted pixels, scaled to P[2, 3] = 1 as the DLT gives it.
    intrinsics : the lens, or None where distortion is not corrected (undistorted = image pixels).
    """

    id: str
    P: Floats
    size: tuple[int, int]
    intrinsics: Intrinsics | None = None
    centre: Floats = field(init=False)

    def __post_init__(self) -> None:
        P = np.asarray(self.P, dtype=float).reshape(3, 4)
        object.__setattr__(self, "P", P)
        object.__setattr__(self, "centre", -np.linalg.solve(P[:, :3], P[:, 3]))

    def project_undistorted(self, xyz: Floats) -> Floats:
        """World points (..., 3) mm to undistorted pixels (..., 2)."""
        h = np.asarray(xyz, dtype=float) @ self.P[:, :3].T + self.P[:, 3]
        return h[..., :2] / h[..., 2:]

    def project(self, xyz: Floats) -> Floats:
        """World points (..., 3) mm to image pixels (..., 2)."""
        px = self.project_undistorted(xyz)
        return px if self.intrinsics is None else self.intrinsics.to_distorted(px)

    def project_with_slope(self, xyz: Floats) -> tuple[Floats, Floats]:
        """Image pixels (..., 2) of world points (..., 3) mm, and how they move with the points. (..., 2, 3), px/mm."""
        h = np.asarray(xyz, dtype=float) @ self.P[:, :3].T + self.P[:, 3]
        px = h[..., :2] / h[..., 2:]
        slope = (self.P[:2, :3] - px[..., None] * self.P[2, :3]) / h[..., 2, None, None]
        if self.intrinsics is None:
            return px, slope
        return self.intrinsics.to_distorted(px), self.intrinsics.slope(px) @ slope

    def undistort(self, px: Floats) -> Floats:
        """Image pixels (..., 2) to undistorted pixels."""
        return np.asarray(px, dtype=float) if self.intrinsics is None else self.intrinsics.to_undistorted(px)

    def ray(self, px: Floats) -> Floats:
        """Unit directions (..., 3) in the world of the lines of sight of image pixels (..., 2), outwards."""
        undistorted = self.undistort(px)
        h = np.concatenate([undistorted, np.ones((*undistorted.shape[:-1], 1))], axis=-1)
        M = self.P[:, :3]
        d = np.linalg.solve(M, h.reshape(-1, 3).T).T.reshape(h.shape) * np.sign(np.linalg.det(M))
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    def incidence_cosine(self, xyz: Floats, normals: Floats) -> Floats:
        """Cosine of the angle between outward normals (..., 3) and the direction to the camera. (...)."""
        towards = self.centre - xyz
        return np.sum(towards * normals, axis=-1) / np.linalg.norm(towards, axis=-1)


def _rows(xy: Floats) -> Floats:
    """Points (..., 2) as the loops take them, (n, 2)."""
    return np.ascontiguousarray(xy, dtype=float).reshape(-1, 2)
