"""Compiled lens distortion, its Jacobian and its inverse: for one point, called by other kernels, and for many points.

``x_d = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)``, ``y_d`` likewise with the roles of p1 and p2
swapped (Brown 1971). ``c`` is everywhere (5,), k1 k2 p1 p2 k3; points are normalised, without unit.
"""

from __future__ import annotations

import numba as nb
import numpy as np

_ROUNDS = 30
_SETTLED = 1e-14
_SOLVED = 1e-10


@nb.njit(cache=True, nogil=True, error_model="numpy")
def distort_point(x, y, c):  # type: ignore[no-untyped-def]
    """Distorted coordinates x_d, y_d of one ideal point x, y; c (5,) are the distortion coefficients."""
    r2 = x * x + y * y
    radial = 1 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))
    return (
        x * radial + 2 * c[2] * x * y + c[3] * (r2 + 2 * x * x),
        y * radial + c[2] * (r2 + 2 * y * y) + 2 * c[3] * x * y,
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def jacobian_of_point(x, y, c):  # type: ignore[no-untyped-def]
    """Jacobian dx_d/dx, dx_d/dy = dy_d/dx and dy_d/dy of the distortion c (5,) at one ideal point x, y."""
    r2 = x * x + y * y
    radial = 1 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))
    slope = 2 * (c[0] + r2 * (2 * c[1] + 3 * r2 * c[4]))
    cross = x * y * slope + 2 * (c[2] * x + c[3] * y)
    return (
        radial + x * x * slope + 2 * c[2] * y + 6 * c[3] * x,
        cross,
        radial + y * y * slope + 6 * c[2] * y + 2 * c[3] * x,
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def distort_points(xy, c):  # type: ignore[no-untyped-def]
    """Distorted points (n, 2) of ideal points xy (n, 2), by the coefficients c (5,)."""
    out = np.empty_like(xy)
    for i in range(len(xy)):
        out[i, 0], out[i, 1] = distort_point(xy[i, 0], xy[i, 1], c)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def jacobians(xy, c):  # type: ignore[no-untyped-def]
    """Jacobians d(distorted)/d(ideal) (n, 2, 2) of the distortion c (5,) at ideal points xy (n, 2)."""
    out = np.empty((len(xy), 2, 2))
    for i in range(len(xy)):
        out[i, 0, 0], out[i, 0, 1], out[i, 1, 1] = jacobian_of_point(xy[i, 0], xy[i, 1], c)
        out[i, 1, 0] = out[i, 0, 1]
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def pixel_jacobians(px, K, c):  # type: ignore[no-untyped-def]
    """Jacobians d(image pixel)/d(undistorted pixel) (n, 2, 2) at undistorted pixels px (n, 2).

    K (3, 3) is the camera matrix with skew, c (5,) the distortion.
    """
    out = np.empty((len(px), 2, 2))
    fx, fy, skew = K[0, 0], K[1, 1], K[0, 1]
    for i in range(len(px)):
        xx, xy, yy = jacobian_of_point((px[i, 0] - K[0, 2]) / fx, (px[i, 1] - K[1, 2]) / fy, c)
        out[i, 0, 0], out[i, 0, 1] = (fx * xx + skew * xy) / fx, (fx * xy + skew * yy) / fy
        out[i, 1, 0], out[i, 1, 1] = fy * xy / fx, yy
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def undistort_points(target, c):  # type: ignore[no-untyped-def]
    """Ideal points (n, 2) whose images by the distortion c (5,) are the distorted points target (n, 2).

    Newton's method to round-off; NaN where it diverges and beyond the radius where the polynomial folds the image over.
    """
    out = np.empty_like(target)
    for i in range(len(target)):
        x, y = target[i, 0], target[i, 1]
        for _ in range(_ROUNDS):
            at_x, at_y = distort_point(x, y, c)
            ex, ey = at_x - target[i, 0], at_y - target[i, 1]
            xx, xy, yy = jacobian_of_point(x, y, c)
            det = xx * yy - xy * xy
            x, y = x - (yy * ex - xy * ey) / det, y - (xx * ey - xy * ex) / det
            if not (abs(ex) > _SETTLED or abs(ey) > _SETTLED):
                break
        at_x, at_y = distort_point(x, y, c)
        xx, xy, yy = jacobian_of_point(x, y, c)
        solved = max(abs(at_x - target[i, 0]), abs(at_y - target[i, 1])) < _SOLVED
        # Beyond the radius where the polynomial turns back, a root maps the image folded over: it is no solution.
        real = solved and xx * yy - xy * xy > 0 and xx + yy > 0
        out[i, 0], out[i, 1] = (x, y) if real else (np.nan, np.nan)
    return out
