"""The direct linear transformation: eleven parameters of a camera from control points (Solav et al. 2018, step 1).

``u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1)``, ``v = (L5 X + … + L8) / (same)``
(Abdel-Aziz & Karara 1971).
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Floats, Mask
from ringdic.errors import ComputationError


def solve_dlt(xyz: Floats, px: Floats) -> Floats:
    """The eleven parameters by plain linear least squares over all points.

    xyz : (n, 3) mm, not all in one plane, n ≥ 6.
    px : (n, 2) undistorted px.

    Returns L (11,). Raises ComputationError where the points do not determine it.
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
    """Projection matrix with ``P[2, 3] = 1``. (3, 4)."""
    return np.append(np.asarray(L, dtype=float), 1.0).reshape(3, 4)


def residuals(L: Floats, xyz: Floats, px: Floats) -> Floats:
    """Measured minus projected position. (n, 2) px."""
    h = np.asarray(xyz, dtype=float) @ to_projection(L)[:, :3].T + to_projection(L)[:, 3]
    return np.asarray(px, dtype=float) - h[:, :2] / h[:, 2:]


def solve_dlt_robust(xyz: Floats, px: Floats, *, sigmas: float = 5.0, floor: float = 0.5) -> tuple[Floats, Mask]:
    """The DLT without gross errors: points off by more than ``sigmas`` robust standard deviations are left out.

    The scale is the median of the residuals' lengths (for a normal error 1.1774 σ a component), never taken
    smaller than ``floor`` px, so that a good target keeps all its points.

    Returns L (11,) and which points were kept (n,).
    """
    kept = np.ones(len(xyz), dtype=bool)
    L = solve_dlt(xyz, px)
    for _ in range(20):
        lengths = np.linalg.norm(residuals(L, xyz, px), axis=1)
        limit = sigmas * max(float(np.median(lengths[kept])) / 1.1774, floor / sigmas)
        now = lengths <= limit
        if np.array_equal(now, kept) or now.sum() < 6:
            break
        kept = now
        L = solve_dlt(xyz[kept], px[kept])
    return L, kept
