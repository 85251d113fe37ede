"""Compiled lens distortion, its Jacobian and its inverse, and the projection of points in space through the lens.

Each is there for one point, called by other kernels, and for many points.

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
def undistort_point(to_x, to_y, c):  # type: ignore[no-untyped-def]
    """Ideal point x, y whose image by the distortion c (5,) is the distorted point to_x, to_y.

    Newton's method to round-off; NaN where it diverges and beyond the radius where the polynomial folds the image over.
    """
    x, y = to_x, to_y
    for _ in range(_ROUNDS):
        at_x, at_y = distort_point(x, y, c)
        ex, ey = at_x - to_x, at_y - to_y
        xx, xy, yy = jacobian_of_point(x, y, c)
        det = xx * yy - xy * xy
        x, y = x - (yy * ex - xy * ey) / det, y - (xx * ey - xy * ex) / det
        if not (abs(ex) > _SETTLED or abs(ey) > _SETTLED):
            break
    at_x, at_y = distort_point(x, y, c)
    xx, xy, yy = jacobian_of_point(x, y, c)
    solved = max(abs(at_x - to_x), abs(at_y - to_y)) < _SOLVED
    # Beyond the radius where the polynomial turns back, a root maps the image folded over: it is no solution.
    real = solved and xx * yy - xy * xy > 0 and xx + yy > 0
    return (x, y) if real else (np.nan, np.nan)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def undistort_points(target, c):  # type: ignore[no-untyped-def]
    """Ideal points (n, 2) whose images by the distortion c (5,) are the distorted points target (n, 2)."""
    out = np.empty_like(target)
    for i in range(len(target)):
        out[i, 0], out[i, 1] = undistort_point(target[i, 0], target[i, 1], c)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def projection_of_point(P, K, c, x, y, z):  # type: ignore[no-untyped-def]
    """Image pixel u, v of one point x, y, z (mm).

    P (3, 4), K (3, 3), c (5,): projection, camera matrix and distortion of the camera.
    """
    depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / depth
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / depth
    to_x, to_y = distort_point((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], c)
    return K[0, 0] * to_x + K[0, 1] * to_y + K[0, 2], K[1, 1] * to_y + K[1, 2]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def slopes_of_projection(P, K, c, x, y, z):  # type: ignore[no-untyped-def]
    """Derivatives of the image pixel of one point x, y, z (mm): du/dx, du/dy, du/dz, dv/dx, dv/dy, dv/dz, px/mm.

    P (3, 4), K (3, 3), c (5,): projection, camera matrix and distortion of the camera.
    """
    depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / depth
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / depth
    fx, fy, skew = K[0, 0], K[1, 1], K[0, 1]
    xx, xy, yy = jacobian_of_point((u - K[0, 2]) / fx, (v - K[1, 2]) / fy, c)
    uu, uv, vu = (fx * xx + skew * xy) / fx, (fx * xy + skew * yy) / fy, fy * xy / fx
    ux, uy, uz = (P[0, 0] - u * P[2, 0]) / depth, (P[0, 1] - u * P[2, 1]) / depth, (P[0, 2] - u * P[2, 2]) / depth
    vx, vy, vz = (P[1, 0] - v * P[2, 0]) / depth, (P[1, 1] - v * P[2, 1]) / depth, (P[1, 2] - v * P[2, 2]) / depth
    return (
        uu * ux + uv * vx, uu * uy + uv * vy, uu * uz + uv * vz,
        vu * ux + yy * vx, vu * uy + yy * vy, vu * uz + yy * vz,
    )  # fmt: skip


@nb.njit(cache=True, nogil=True, error_model="numpy")
def projections(P, K, c, xyz):  # type: ignore[no-untyped-def]
    """Image pixels (n, 2) of points xyz (n, 3) mm.

    P (3, 4), K (3, 3), c (5,): projection, camera matrix and distortion of the camera.
    """
    out = np.empty((len(xyz), 2))
    for i in range(len(xyz)):
        out[i, 0], out[i, 1] = projection_of_point(P, K, c, xyz[i, 0], xyz[i, 1], xyz[i, 2])
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def projection_slopes(P, K, c, xyz):  # type: ignore[no-untyped-def]
    """Jacobians d(image pixel)/d(point) (n, 2, 3) px/mm at points xyz (n, 3) mm.

    P (3, 4), K (3, 3), c (5,): projection, camera matrix and distortion of the camera.
    """
    out = np.empty((len(xyz), 2, 3))
    for i in range(len(xyz)):
        (
            out[i, 0, 0], out[i, 0, 1], out[i, 0, 2], out[i, 1, 0], out[i, 1, 1], out[i, 1, 2]
        ) = slopes_of_projection(P, K, c, xyz[i, 0], xyz[i, 1], xyz[i, 2])  # fmt: skip
    return out
