"""The sixteen parameters of a camera in an adjustment, and derivatives of image points with respect to them.

The parameters are ``fx fy s cx cy k1 k2 p1 p2 k3`` of the lens, and ω (rad) and τ (mm) of a small motion of the pose,
``R ← exp([ω]×) R``, ``t ← t + τ``.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ringdic.arrays import Floats, Pixels, Points, Vectors
from ringdic.geometry.camera import Camera, Intrinsics

#: Numbers of parameters of the lens, of the pose, and of a camera.
LENS, POSE = 10, 6
PER_CAMERA = LENS + POSE


@dataclass(frozen=True)
class CameraParameters:
    """Values of the parameters of a camera.

    inner : (10,) fx fy s cx cy k1 k2 p1 p2 k3, px or without unit.
    rotation, translation : (3, 3) and (3,) mm, world to camera.
    """

    inner: Floats
    rotation: Floats
    translation: Floats

    @classmethod
    def of(cls, camera: Camera) -> CameraParameters:
        """The parameters of a calibrated camera; without intrinsics, focal lengths, skew and centre are those of P."""
        lens = camera.intrinsics
        K, distortion = (decompose(camera.P)[0], np.zeros(5)) if lens is None else (lens.K, lens.distortion)
        return cls(np.array([K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2], *distortion]), *nearest_pose(camera.P, lens))

    def plus(self, step: Floats) -> CameraParameters:
        """The parameters after adding a step of the adjustment. step : (16,) px or without unit, rad, mm."""
        turn = cv2.Rodrigues(np.asarray(step[LENS : LENS + 3], dtype=np.float64))[0]
        return CameraParameters(
            self.inner + step[:LENS], turn @ self.rotation, np.asarray(self.translation + step[LENS + 3 :])
        )

    def camera(self, like: Camera) -> Camera:
        """The camera of these parameters; its id and size, and whether it has a lens, are taken from ``like``."""
        K = camera_matrix(self.inner)
        lens = None if like.intrinsics is None else Intrinsics(K, self.inner[5:], like.size)
        P = (K if lens is None else lens.K_undistorted) @ np.column_stack([self.rotation, self.translation])
        return Camera(like.id, P / P[2, 3], like.size, lens)


def camera_matrix(inner: Floats) -> Floats:
    """Camera matrix K (3, 3) px of inner parameters (10,) or (5,), fx fy s cx cy first."""
    fx, fy, s, cx, cy = inner[:5]
    return np.array([[fx, s, cx], [0, fy, cy], [0, 0, 1.0]])


def lens_of(inner: Floats, size: tuple[int, int] = (1, 1)) -> Intrinsics:
    """Intrinsics of inner parameters (10,), px or without unit; size : (width, height) of the image, px."""
    return Intrinsics(camera_matrix(inner), inner[5:], size)


def decompose(P: Floats) -> tuple[Floats, Floats]:
    """Camera matrix and rotation of a projection matrix ``P = λ K [R | t]`` (RQ decomposition).

    P : (3, 4), world mm to px, of a camera that has the world in front of it. Returns K (3, 3) px, upper triangular
    with K[2, 2] = 1, and R (3, 3), world to camera.
    """
    M = P[:, :3] * np.sign(np.linalg.det(P[:, :3]))
    Q, U = np.linalg.qr(np.flipud(M).T)
    K, R = np.fliplr(np.flipud(U.T)), np.flipud(Q.T)
    signs = np.diag(np.sign(np.diag(K)))
    K = K @ signs
    return K / K[2, 2], signs @ R


def nearest_pose(P: Floats, lens: Intrinsics | None) -> tuple[Floats, Vectors]:
    """Pose of the camera nearest to a projection matrix, with the camera matrix of its lens.

    P : (3, 4), world mm to undistorted px. lens : its K is used, or that of P where it is None. The projection centre
    is that of P.

    Returns rotation (3, 3) and translation (3,) mm, world to camera.
    """
    centre = -np.linalg.solve(P[:, :3], P[:, 3])
    if lens is None:
        R = decompose(P)[1]
        return R, -R @ centre
    M = np.linalg.solve(lens.K_undistorted, P[:, :3])
    U, _, Vt = np.linalg.svd(M * np.sign(np.linalg.det(M)))
    R = U @ Vt
    return R, -R @ centre


def projection_jacobians(parameters: CameraParameters, xyz: Points) -> tuple[Pixels, Floats, Floats]:
    """Projections of world points and their derivatives with respect to camera parameters and points.

    xyz : (n, 3) mm, world frame.

    Returns image px (n, 2), derivatives with respect to the parameters (n, 2, 16) and the points (n, 2, 3) px/mm.
    """
    rotated = np.asarray(xyz, dtype=float) @ parameters.rotation.T
    px, by_inner, by_pose, by_point = pose_jacobians(
        lens_of(parameters.inner), rotated, rotated + parameters.translation
    )
    return px, np.concatenate([by_inner, by_pose], axis=-1), by_point @ parameters.rotation


def pose_jacobians(lens: Intrinsics, rotated: Points, in_camera: Points) -> tuple[Pixels, Floats, Floats, Floats]:
    """Projections of points in the camera frame and their derivatives with respect to lens, pose and point.

    rotated, in_camera : (..., n, 3) mm, the points ``R X`` and ``R X + t``.

    Returns image px (..., n, 2) and derivatives with respect to the lens's parameters (..., n, 2, 10), ω and τ of the
    pose (..., n, 2, 6), and the point in the camera frame (..., n, 2, 3) px/mm.
    """
    xy = in_camera[..., :2] / in_camera[..., 2:]
    px, by_inner, by_ideal = lens_jacobians(lens, xy)
    z = in_camera[..., 2]
    ideal = np.zeros((*z.shape, 2, 3))
    ideal[..., 0, 0] = ideal[..., 1, 1] = 1 / z
    ideal[..., 0, 2], ideal[..., 1, 2] = -xy[..., 0] / z, -xy[..., 1] / z
    by_point = by_ideal @ ideal
    by_pose = np.concatenate([np.cross(rotated[..., None, :], by_point), by_point], axis=-1)
    return px, by_inner, by_pose, by_point


def lens_jacobians(lens: Intrinsics, xy: Floats) -> tuple[Pixels, Floats, Floats]:
    """Image pixels of ideal normalised points and their derivatives with respect to lens parameters and points.

    xy : (..., 2) without unit. Returns px (..., 2), derivatives with respect to fx fy s cx cy k1 k2 p1 p2 k3
    (..., 2, 10) and xy (..., 2, 2) px.
    """
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    distorted = lens.distort_normalised(xy)
    to_px = lens.K[:2, :2]
    inner = np.zeros((*xy.shape, LENS))
    inner[..., 0, 0], inner[..., 1, 1], inner[..., 0, 2] = distorted[..., 0], distorted[..., 1], distorted[..., 1]
    inner[..., 0, 3] = inner[..., 1, 4] = 1.0
    by_lens = np.stack(
        [
            np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], axis=-1),
            np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], axis=-1),
        ],
        axis=-2,
    )
    inner[..., 5:] = to_px @ by_lens
    return distorted @ to_px.T + lens.K[:2, 2], inner, to_px @ lens.jacobian_normalised(xy)
