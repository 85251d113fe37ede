"""A camera as sixteen numbers: what is adjusted, and how the image of a point depends on each.

The parameters are ``fx fy s cx cy k1 k2 p1 p2 k3``, ω, τ: the lens, and a small motion of the pose
``R ← exp([ω]×) R``, ``t ← t + τ`` (rad, mm).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ringdic.arrays import Floats
from ringdic.geometry.camera import Camera, Intrinsics

#: Parameters of the lens, of the pose, and of a camera.
LENS, POSE = 10, 6
PER_CAMERA = LENS + POSE


@dataclass(frozen=True)
class Parameters:
    """The state of a camera.

    inner : (10,) fx fy s cx cy k1 k2 p1 p2 k3, px or without unit. rotation : (3, 3) and translation : (3,) mm, world
    to camera.
    """

    inner: Floats
    rotation: Floats
    translation: Floats

    @classmethod
    def of(cls, camera: Camera) -> Parameters:
        """Of a calibrated camera. Where it has no lens of its own, focal lengths, skew and centre are those of P."""
        lens = camera.intrinsics
        K, distortion = (split(camera.P)[0], np.zeros(5)) if lens is None else (lens.K, lens.distortion)
        return cls(
            np.array([K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2], *distortion]), *pose(camera.P, camera.intrinsics)
        )

    def moved(self, step: Floats) -> Parameters:
        """After a step (16,) in the parameters."""
        turn = cv2.Rodrigues(np.asarray(step[LENS : LENS + 3], dtype=np.float64))[0]
        return Parameters(
            self.inner + step[:LENS], turn @ self.rotation, np.asarray(self.translation + step[LENS + 3 :])
        )

    def camera(self, like: Camera) -> Camera:
        """The camera of these parameters, with name and size, and with or without a lens, as another one."""
        fx, fy, s, cx, cy = self.inner[:5]
        K = np.array([[fx, s, cx], [0, fy, cy], [0, 0, 1.0]])
        lens = None if like.intrinsics is None else Intrinsics(K, self.inner[5:], like.size)
        P = (K if lens is None else lens.K_undistorted) @ np.column_stack([self.rotation, self.translation])
        return Camera(like.id, P / P[2, 3], like.size, lens)


def split(P: Floats) -> tuple[Floats, Floats]:
    """P = λ K [R | t], K upper triangular with K[2, 2] = 1: K (3, 3) and R (3, 3). The world lies before the camera."""
    M = P[:, :3] * np.sign(np.linalg.det(P[:, :3]))
    Q, U = np.linalg.qr(np.flipud(M).T)
    K, R = np.fliplr(np.flipud(U.T)), np.flipud(Q.T)
    signs = np.diag(np.sign(np.diag(K)))
    K = K @ signs
    return K / K[2, 2], signs @ R


def pose(P: Floats, lens: Intrinsics | None) -> tuple[Floats, Floats]:
    """Rotation and translation nearest to a projection, with the lens's own focal lengths."""
    centre = -np.linalg.solve(P[:, :3], P[:, 3])
    if lens is None:
        R = split(P)[1]
        return R, -R @ centre
    M = np.linalg.solve(lens.K_undistorted, P[:, :3])
    U, _, Vt = np.linalg.svd(M * np.sign(np.linalg.det(M)))
    R = U @ Vt
    return R, -R @ centre


def projection_jacobians(parameters: Parameters, xyz: Floats) -> tuple[Floats, Floats, Floats]:
    """Images of points and their derivatives.

    xyz : (n, 3) mm, world.

    Returns image px (n, 2), by the parameters (n, 2, 16) and by the point (n, 2, 3).
    """
    rotated = np.asarray(xyz, dtype=float) @ parameters.rotation.T
    in_camera = rotated + parameters.translation
    xy = in_camera[:, :2] / in_camera[:, 2:]
    inner = parameters.inner
    lens = Intrinsics(
        np.array([[inner[0], inner[2], inner[3]], [0, inner[1], inner[4]], [0, 0, 1.0]]), inner[5:], (1, 1)
    )
    px, by_inner, by_ideal = lens_jacobians(lens, xy)
    z = in_camera[:, 2]
    ideal = np.zeros((len(z), 2, 3))
    ideal[:, 0, 0] = ideal[:, 1, 1] = 1 / z
    ideal[:, 0, 2], ideal[:, 1, 2] = -xy[:, 0] / z, -xy[:, 1] / z
    by_point = by_ideal @ ideal
    by_turn = np.cross(rotated[:, None, :], by_point)
    return px, np.concatenate([by_inner, by_turn, by_point], axis=-1), by_point @ parameters.rotation


def lens_jacobians(lens: Intrinsics, xy: Floats) -> tuple[Floats, Floats, Floats]:
    """Image px (..., 2) of ideal normalised points (..., 2), their derivatives by the ten parameters of the lens
    (..., 2, 10) and by the ideal points (..., 2, 2).
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
