"""Direct linear transformation (DLT): the projection of a camera from control points (Solav et al. 2018, step 1).

``u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1)``,
``v = (L5 X + L6 Y + L7 Z + L8) / (L9 X + L10 Y + L11 Z + 1)`` (Abdel-Aziz & Karara 1971).
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Floats, Mask, Pixels, Points
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera


def solve_dlt(xyz: Points, px: Pixels) -> Floats:
    """DLT parameters from control points, by linear least squares over all of them.

    xyz : (n, 3) mm, world frame, not all in one plane, n ≥ 6.
    px : (n, 2) undistorted px.

    Returns L1 … L11, (11,). Raises ComputationError where the points do not determine them.
    """
    xyz, px = np.asarray(xyz, dtype=float), np.asarray(px, dtype=float)
    n = len(xyz)
    if n < 6:
        raise ComputationError(f"a camera needs at least 6 control points, {n} are given")
    A = np.zeros((2 * n, 11))
    A[:n, :3] = A[n:, 4:7] = xyz
    A[:n, 3] = A[n:, 7] = 1.0
    A[:n, 8:] = -px[:, :1] * xyz
    A[n:, 8:] = -px[:, 1:] * xyz
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0] = 1.0
    L, _, rank, _ = np.linalg.lstsq(A / scale, px.T.ravel(), rcond=None)
    if rank < 11:
        raise ComputationError("the control points lie in one plane or on one line and do not determine a camera")
    return L / scale


def to_projection(L: Floats) -> Floats:
    """Projection matrix of DLT parameters, scaled to ``P[2, 3] = 1``.

    L : (11,). Returns P (3, 4), world mm to undistorted px.
    """
    return np.append(np.asarray(L, dtype=float), 1.0).reshape(3, 4)


def to_camera(L: Floats) -> Camera:
    """Camera of DLT parameters: without lens distortion and with an unknown image size.

    L : (11,), world mm to undistorted px.
    """
    return Camera("", to_projection(L), (1, 1))


def residuals(L: Floats, xyz: Points, px: Pixels) -> Pixels:
    """Measured minus projected positions of control points.

    L : (11,) DLT parameters. xyz : (n, 3) mm, world frame. px : (n, 2) undistorted px. Returns (n, 2) px.
    """
    h = np.asarray(xyz, dtype=float) @ to_projection(L)[:, :3].T + to_projection(L)[:, 3]
    return np.asarray(px, dtype=float) - h[:, :2] / h[:, 2:]


def solve_dlt_robust(xyz: Points, px: Pixels, *, sigmas: float = 5.0, floor: float = 0.5) -> tuple[Floats, Mask]:
    """DLT parameters from control points, with rejection of gross errors.

    Parameters
    ----------
    xyz : (n, 3) mm, world frame.
    px : (n, 2) undistorted px.
    sigmas, floor : a residual longer than ``sigmas`` robust standard deviations and ``floor`` px is a gross error.
        The standard deviation is the median length divided by 1.1774, as for normal errors of both components.

    Returns
    -------
    L (11,), and the inliers (n,) bool that it was fitted to.

    Raises
    ------
    ComputationError : the points do not determine the camera.
    """
    inliers = np.ones(len(xyz), dtype=bool)
    L = solve_dlt(xyz, px)
    for _ in range(20):
        lengths = np.linalg.norm(residuals(L, xyz, px), axis=1)
        limit = sigmas * max(float(np.median(lengths[inliers])) / 1.1774, floor / sigmas)
        now = lengths <= limit
        if np.array_equal(now, inliers) or now.sum() < 6:
            break
        inliers = now
        L = solve_dlt(xyz[inliers], px[inliers])
    return L, inliers
