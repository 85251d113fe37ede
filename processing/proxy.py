"""Where a match can lie: concentric cylinders about the target's axis as stand-ins for the unknown surface.

Between two calibrated cameras the search is one-dimensional: depth moves a match along the epipolar line only.
Sweeping the radius of a proxy cylinder gives, for each image position, a row of hypotheses, each with the
affine warp that the proxy's surface implies, so that even strong perspective gradients start right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.camera import Camera

Array = NDArray[np.float64]

_APART = 4  # radii from one that is followed exactly to the next


@dataclass(frozen=True)
class Hypotheses:
    """Candidate matches of image positions, one for each radius of the sweep.

    warps : (n, K, 6) px, u v du/dx du/dy dv/dx dv/dy from the first camera to the second; NaN where the line of
        sight misses the proxy or the match leaves the second image.
    xyz : (n, K, 3) mm, the point on the proxy.
    radii : (K,) mm.
    """

    warps: Array
    xyz: Array
    radii: Array


def on_cylinder(camera: Camera, px: Array, radii: Array) -> Array:
    """Nearer intersections (n, K, 3) mm of lines of sight through px (n, 2) with cylinders about z; NaN if none."""
    origin, d = camera.centre, camera.ray(px)
    a = d[:, None, 0] ** 2 + d[:, None, 1] ** 2
    b = (origin[0] * d[:, 0] + origin[1] * d[:, 1])[:, None]
    c = origin[0] ** 2 + origin[1] ** 2 - radii[None, :] ** 2
    with np.errstate(invalid="ignore"):
        t = (-b - np.sqrt(b * b - a * c)) / a
    return origin + t[..., None] * d[:, None, :]


def stereo_hypotheses(first: Camera, second: Camera, px: Array, radii: Array, half_width: float) -> Hypotheses:
    """Hypotheses for positions px (n, 2) of the first image in the second, for proxies of the given radii (K,) mm.

    The gradients are central differences over ``half_width`` px, about the radius of a subset. Of a long row of radii
    every fourth is followed exactly, the others lie evenly between: along a line of sight a match moves evenly.
    """
    fewer = radii if len(radii) <= 2 * _APART else np.append(radii[:-1:_APART], radii[-1])
    warps, xyz = _exact_hypotheses(first, second, px, fewer, half_width)
    if len(fewer) < len(radii):
        at = np.clip(np.searchsorted(fewer, radii, side="right") - 1, 0, len(fewer) - 2)
        share = ((radii - fewer[at]) / (fewer[at + 1] - fewer[at]))[:, None]
        warps = warps[:, at] + share * (warps[:, at + 1] - warps[:, at])
        xyz = xyz[:, at] + share * (xyz[:, at + 1] - xyz[:, at])
    return Hypotheses(warps, xyz, radii)


def _exact_hypotheses(first: Camera, second: Camera, px: Array, radii: Array, half_width: float) -> tuple[Array, Array]:
    """Warps (n, K, 6) and places (n, K, 3) mm on the proxies."""
    offsets = half_width * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=float)
    n, k = len(px), len(radii)
    around = (px[:, None, :] + offsets).reshape(-1, 2)
    xyz = on_cylinder(first, around, radii).reshape(n, 5, k, 3)
    seen = second.project(xyz)
    warps = np.empty((n, k, 6))
    warps[..., :2] = seen[:, 0] - px[:, None, :]
    along_x = (seen[:, 1] - seen[:, 2]) / (2 * half_width)
    along_y = (seen[:, 3] - seen[:, 4]) / (2 * half_width)
    warps[..., 2], warps[..., 4] = along_x[..., 0] - 1, along_x[..., 1]
    warps[..., 3], warps[..., 5] = along_y[..., 0], along_y[..., 1] - 1
    width, height = second.size
    inside = (seen[:, 0] >= 0).all(-1) & (seen[:, 0, :, 0] < width) & (seen[:, 0, :, 1] < height)
    warps[~inside] = np.nan
    return warps, xyz[:, 0]


def compose(inner: Array, outer: Array) -> Array:
    """The warp "inner, then outer": both (..., 6) first-order warps; outer taken at the position inner leads to."""
    result = np.empty(np.broadcast_shapes(inner.shape, outer.shape))
    result[..., :2] = inner[..., :2] + outer[..., :2]
    inner_gradient = np.broadcast_to(inner, result.shape)[..., 2:].reshape(*result.shape[:-1], 2, 2)
    outer_gradient = np.broadcast_to(outer, result.shape)[..., 2:].reshape(*result.shape[:-1], 2, 2)
    both = inner_gradient + outer_gradient + outer_gradient @ inner_gradient
    result[..., 2:] = both.reshape(*result.shape[:-1], 4)
    return result


def sweep_radii(radius: float, reach: float, spacing: float) -> Array:
    """Radii (K,) mm of the sweep: ± reach about a radius in steps near ``spacing``, all positive."""
    count = max(3, 2 * round(reach / spacing) + 1)
    radii = np.linspace(radius - reach, radius + reach, count)
    return radii[radii > 0.1 * radius]
