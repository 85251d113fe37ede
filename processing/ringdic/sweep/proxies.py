"""Warp hypotheses between two calibrated cameras, from cylinders about the target's axis as proxies of the surface.

Between two calibrated cameras the search for a match is one-dimensional: with the depth of a point, its match moves
along the epipolar line only. For each image position, a row of cylinders of different radii gives a row of hypotheses,
each with the affine warp that the cylinder's surface implies, so that even strong perspective gradients start right.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from ringdic.arrays import Floats, Pixels, Points
from ringdic.correlation import WarpHypotheses
from ringdic.correlation.parallel import in_ranges
from ringdic.geometry import lens
from ringdic.geometry.camera import Camera

_KNOT_STEP = 4  # every so many radii the warp is computed exactly
_AROUND = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=float)
_NO_LENS = np.zeros(5)


def cylinder_intersections(camera: Camera, px: Pixels, radii: Floats) -> Points:
    """Nearer intersections of a camera's lines of sight with cylinders about the world's z axis.

    px : (n, 2) float64, px, image positions. radii : (K,) float64, mm, or (n, K), each line's own.
    Returns (n, K, 3), mm, in the world frame; NaN where a line of sight misses the cylinder.
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
    px: Pixels,
    radii: Floats,
    half_width: float,
    between: tuple[Floats, Floats] | None = None,
) -> WarpHypotheses:
    """Affine warps from the first camera's image into the second's, one for each radius of a proxy cylinder.

    Parameters
    ----------
    px : (n, 2) float64, px, positions in the first image.
    radii : (K,) float64, mm, ascending. Of many, every fourth is computed exactly and the others are interpolated.
    half_width : px, over which the gradients are central differences; about the radius of a subset.
    between : smallest and largest radius of interest at each position, two (n,) in mm; other warps may be NaN.

    Returns
    -------
    hypotheses : K warps at each of the n positions; NaN where the line of sight misses the cylinder or the match lies
        outside the second image.
    """
    exact = radii if len(radii) <= 2 * _KNOT_STEP else np.append(radii[:-1:_KNOT_STEP], radii[-1])
    rays = first.ray(px[:, None, :] + half_width * _AROUND)
    intrinsics, K = second.intrinsics, np.eye(3)
    low, high = between or (np.full(len(px), -np.inf), np.full(len(px), np.inf))
    spacing = float(np.diff(exact).max(initial=0.0))
    knots = np.full((len(px), len(exact), 6), np.nan)
    in_ranges(
        _fill_warps,
        len(px),
        first.centre,
        np.ascontiguousarray(rays),
        np.ascontiguousarray(px, dtype=float),
        exact,
        low - spacing,
        high + spacing,
        np.ascontiguousarray(second.P),
        K if intrinsics is None else np.ascontiguousarray(intrinsics.K),
        _NO_LENS if intrinsics is None else intrinsics.distortion,
        second.size,
        half_width,
        knots,
        least=100,
    )
    return WarpHypotheses(knots, np.interp(radii, exact, np.arange(len(exact))))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _project_intersection(origin, ray, radius, P, K, distortion):  # type: ignore[no-untyped-def]
    """Image position, px, of the nearer point of a line of sight on a cylinder, in a camera (P, K, distortion).

    NaN where the line of sight misses the cylinder.
    """
    a = ray[0] * ray[0] + ray[1] * ray[1]
    b = origin[0] * ray[0] + origin[1] * ray[1]
    t = (-b - np.sqrt(b * b - a * (origin[0] * origin[0] + origin[1] * origin[1] - radius * radius))) / a
    x, y, z = origin[0] + t * ray[0], origin[1] + t * ray[1], origin[2] + t * ray[2]
    w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w
    x_d, y_d = lens.distort_point((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], distortion)
    return K[0, 0] * x_d + K[0, 1] * y_d + K[0, 2], K[1, 1] * y_d + K[1, 2]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _fill_warps(begin, end, origin, rays, px, radii, low, high, P, K, distortion, size, half_width, warps):  # type: ignore[no-untyped-def]
    """Compute the warps (n, K, 6) of positions px (n, 2) for the radii (K,) between low (n,) and high (n,).

    begin, end : of the positions to compute for.
    rays : (n, 5, 3), lines of sight through each position and through four positions ``half_width`` px around it.
    """
    for i in range(begin, end):
        image = np.empty((5, 2))
        for k in range(len(radii)):
            if not low[i] <= radii[k] <= high[i]:
                continue
            for m in range(5):
                image[m, 0], image[m, 1] = _project_intersection(origin, rays[i, m], radii[k], P, K, distortion)
            x, y = image[0]
            if x >= 0.0 and y >= 0.0 and x < size[0] and y < size[1]:
                warps[i, k, 0], warps[i, k, 1] = x - px[i, 0], y - px[i, 1]
                warps[i, k, 2] = (image[1, 0] - image[2, 0]) / (2 * half_width) - 1
                warps[i, k, 3] = (image[3, 0] - image[4, 0]) / (2 * half_width)
                warps[i, k, 4] = (image[1, 1] - image[2, 1]) / (2 * half_width)
                warps[i, k, 5] = (image[3, 1] - image[4, 1]) / (2 * half_width) - 1


def sweep_radii(radius: float, reach: float, spacing: float) -> Floats:
    """Radii of a sweep: equally spaced by about ``spacing`` within ``reach`` of a radius, all positive.

    All in mm. Returns (K,) float64, mm, ascending.
    """
    count = max(3, 2 * round(reach / spacing) + 1)
    radii = np.linspace(radius - reach, radius + reach, count)
    return radii[radii > 0.1 * radius]
