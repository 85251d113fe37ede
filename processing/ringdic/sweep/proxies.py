"""Where a match can lie: concentric cylinders about the target's axis as stand-ins for the unknown surface.

Between two calibrated cameras the search is one-dimensional: depth moves a match along the epipolar line only.
Sweeping the radius of a proxy cylinder gives, for each image position, a row of hypotheses, each with the
affine warp that the proxy's surface implies, so that even strong perspective gradients start right.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from ringdic.arrays import Floats
from ringdic.correlation import Row
from ringdic.geometry import lens
from ringdic.geometry.camera import Camera

_APART = 4  # radii from one that is followed exactly to the next
_AROUND = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=float)
_NO_LENS = np.zeros(5)


def on_cylinder(camera: Camera, px: Floats, radii: Floats) -> Floats:
    """Nearer intersections (n, K, 3) mm of lines of sight through px (n, 2) with cylinders about z; NaN if none.

    radii : mm, (K,), or (n, K), each line's own.
    """
    origin, d = camera.centre, camera.ray(px)
    a = d[:, None, 0] ** 2 + d[:, None, 1] ** 2
    b = (origin[0] * d[:, 0] + origin[1] * d[:, 1])[:, None]
    c = origin[0] ** 2 + origin[1] ** 2 - np.atleast_2d(radii) ** 2
    with np.errstate(invalid="ignore"):
        t = (-b - np.sqrt(b * b - a * c)) / a
    return origin + t[..., None] * d[:, None, :]


def stereo_hypotheses(
    first: Camera,
    second: Camera,
    px: Floats,
    radii: Floats,
    half_width: float,
    between: tuple[Floats, Floats] | None = None,
) -> Row:
    """Warps from positions px (n, 2) of the first image into the second, for proxies of the given radii (K,) mm.

    The gradients are central differences over ``half_width`` px, about the radius of a subset. Of a long row of radii
    every fourth is followed exactly. NaN where the line of sight misses the proxy or the match leaves the second image.
    between : (n,) and (n,) mm, the smallest and the largest radius of use; what lies clearly beyond is NaN too.
    """
    fewer = radii if len(radii) <= 2 * _APART else np.append(radii[:-1:_APART], radii[-1])
    rays = first.ray(px[:, None, :] + half_width * _AROUND)
    lens_of, K = second.intrinsics, np.eye(3)
    low, high = between or (np.full(len(px), -np.inf), np.full(len(px), np.inf))
    apart = float(np.diff(fewer).max(initial=0.0))
    knots = np.full((len(px), len(fewer), 6), np.nan)
    _follow(
        first.centre,
        np.ascontiguousarray(rays),
        np.ascontiguousarray(px, dtype=float),
        fewer,
        low - apart,
        high + apart,
        np.ascontiguousarray(second.P),
        K if lens_of is None else np.ascontiguousarray(lens_of.K),
        _NO_LENS if lens_of is None else lens_of.distortion,
        second.size,
        half_width,
        knots,
    )
    return Row(knots, np.interp(radii, fewer, np.arange(len(fewer))))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _seen(origin, ray, radius, P, K, distortion):  # type: ignore[no-untyped-def]
    """Where a camera (P, K, distortion) sees the nearer point of a line of sight on a cylinder, px; NaN if none."""
    a = ray[0] * ray[0] + ray[1] * ray[1]
    b = origin[0] * ray[0] + origin[1] * ray[1]
    t = (-b - np.sqrt(b * b - a * (origin[0] * origin[0] + origin[1] * origin[1] - radius * radius))) / a
    x, y, z = origin[0] + t * ray[0], origin[1] + t * ray[1], origin[2] + t * ray[2]
    w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w
    x_d, y_d = lens.distorted_point((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], distortion)
    return K[0, 0] * x_d + K[0, 1] * y_d + K[0, 2], K[1, 1] * y_d + K[1, 2]


@nb.njit(cache=True, nogil=True, error_model="numpy", parallel=True)
def _follow(origin, rays, px, radii, low, high, P, K, distortion, size, half_width, warps):  # type: ignore[no-untyped-def]
    """Fills the warps (n, K, 6) of positions px (n, 2) for radii (K,) from low (n,) to high (n,).

    rays (n, 5, 3) : their lines of sight and those about them.
    """
    for i in nb.prange(len(px)):
        seen = np.empty((5, 2))
        for k in range(len(radii)):
            if not low[i] <= radii[k] <= high[i]:
                continue
            for m in range(5):
                seen[m, 0], seen[m, 1] = _seen(origin, rays[i, m], radii[k], P, K, distortion)
            x, y = seen[0]
            if x >= 0.0 and y >= 0.0 and x < size[0] and y < size[1]:
                warps[i, k, 0], warps[i, k, 1] = x - px[i, 0], y - px[i, 1]
                warps[i, k, 2] = (seen[1, 0] - seen[2, 0]) / (2 * half_width) - 1
                warps[i, k, 3] = (seen[3, 0] - seen[4, 0]) / (2 * half_width)
                warps[i, k, 4] = (seen[1, 1] - seen[2, 1]) / (2 * half_width)
                warps[i, k, 5] = (seen[3, 1] - seen[4, 1]) / (2 * half_width) - 1


def sweep_radii(radius: float, reach: float, spacing: float) -> Floats:
    """Radii (K,) mm of the sweep: ± reach about a radius in steps near ``spacing``, all positive."""
    count = max(3, 2 * round(reach / spacing) + 1)
    radii = np.linspace(radius - reach, radius + reach, count)
    return radii[radii > 0.1 * radius]
