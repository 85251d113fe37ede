"""One simulated camera: pose, intrinsics with skew, and Brown's distortion applied and inverted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np

from ringdic_node.virtual_rig.arrays import Floats


@nb.njit(cache=True, nogil=True)
def distort(x, y, lens):  # type: ignore[no-untyped-def]
    """Brown's distortion: distorted normalised coordinates of the ideal ones x, y.

    lens : fx fy s cx cy k1 k2 p1 p2 k3.
    """
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@nb.njit(cache=True, nogil=True)
def ideal_of_pixel(u, v, lens, x, y):  # type: ignore[no-untyped-def]
    """Undistorted normalised coordinates of the pixel (u, v) and their derivatives by u and v, by Newton's method.

    lens : fx fy s cx cy k1 k2 p1 p2 k3. x, y : start of the iteration. Returns x, y, dx/du, dx/dv, dy/du, dy/dv.
    """
    yd = (v - lens[4]) / lens[1]
    xd = (u - lens[3] - lens[2] * yd) / lens[0]
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    for _ in range(12):
        a, b = distort(x, y, lens)
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        m00 = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        m11 = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        m01 = x * y * slope + 2.0 * (p1 * x + p2 * y)
        det = m00 * m11 - m01 * m01
        ex, ey = xd - a, yd - b
        x += (m11 * ex - m01 * ey) / det
        y += (m00 * ey - m01 * ex) / det
        if ex * ex + ey * ey < 1e-13:  # quadratic convergence: the step just made leaves less than 1e-11
            break
    # Distorted coordinates by pixel: dxd/du = 1/fx, dxd/dv = -s/(fx fy), dyd/dv = 1/fy.
    du, dv, sv = 1.0 / lens[0], 1.0 / lens[1], -lens[2] / (lens[0] * lens[1])
    return x, y, m11 / det * du, (m11 * sv - m01 * dv) / det, -m01 / det * du, (m00 * dv - m01 * sv) / det


@dataclass(frozen=True)
class VirtualCamera:
    """A camera of the simulated rig: pose, intrinsics and distortion.

    azimuth_deg : nominal, as a person would note it. K : (3, 3) px with skew. distortion : k1 k2 p1 p2 k3.
    R, t : world to camera, mm. width, height : px.
    """

    id: str
    azimuth_deg: float
    K: Floats
    distortion: Floats
    R: Floats
    t: Floats
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.width < 16 or self.height < 16:
            raise ValueError(f"camera {self.id}: an image of {self.width} x {self.height} px is too small")
        if not math.isclose(float(np.linalg.det(self.R)), 1.0, abs_tol=1e-9):
            raise ValueError(f"camera {self.id}: R is not a rotation")

    @property
    def lens(self) -> Floats:
        """Parameters of lens and sensor as the kernels take them, (10,): fx fy s cx cy in px, k1 k2 p1 p2 k3."""
        K = self.K
        return np.array([K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2], *self.distortion])

    @property
    def centre(self) -> Floats:
        """Centre of projection in the world, (3,) mm."""
        return np.asarray(-self.R.T @ self.t)

    def project(self, xyz: Floats) -> Floats:
        """Distorted pixels (n, 2) px of points xyz (n, 3) mm in the world frame."""
        return self.project_local(np.asarray(xyz, dtype=float) @ self.R.T + self.t)

    def project_local(self, xyz: Floats) -> Floats:
        """Distorted pixels (n, 2) px of points xyz (n, 3) mm in the camera's own frame."""
        xd, yd = distort(xyz[..., 0] / xyz[..., 2], xyz[..., 1] / xyz[..., 2], self.lens)
        fx, fy, s, cx, cy = self.lens[:5]
        return np.stack([fx * xd + s * yd + cx, fy * yd + cy], axis=-1)
