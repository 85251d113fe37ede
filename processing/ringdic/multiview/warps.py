"""Second-order warps of subsets between two cameras, computed from the shape of a curved surface.

A pixel of the reference camera is taken along its line of sight to the surface and from there into the other camera.
The derivatives are central differences over the reach of a subset, so they suit a subset of that size.
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Floats, Pixels, Points
from ringdic.charts.patches import STENCIL
from ringdic.geometry.camera import Camera
from ringdic.multiview.lattice import SurfaceLattice, evaluate

_NEWTON = 6  # iterations


def surface_stencil(
    lattice: SurfaceLattice, coefficients: Floats, theta: Floats, z: Floats, camera: Camera, px: Pixels, reach: float
) -> Points:
    """Intersections of the lines of sight of pixels and of eight neighbours of each with pieces of surface.

    Parameters
    ----------
    lattice : of the pieces.
    coefficients : (n, 10) mm, of the pieces.
    theta, z : (n,) rad and mm, nodes of the pieces.
    camera : whose pixels they are.
    px : (n, 2) float64, px.
    reach : px, from each pixel to its neighbours.

    Returns
    -------
    Positions (n, 9, 3) mm, world frame, in the order of ``STENCIL``; NaN where a line of sight misses the piece.
    """
    d = camera.ray(px[:, None, :] + reach * STENCIL)
    origin = camera.centre
    radius = coefficients[:, 0]
    node = np.stack([radius * np.cos(theta), radius * np.sin(theta), z], axis=-1)
    t = np.sum((node - origin)[:, None, :] * d, axis=-1)
    for _ in range(_NEWTON):
        p = origin + t[..., None] * d
        rho = np.hypot(p[..., 0], p[..., 1])
        turn = np.arctan2(p[..., 1], p[..., 0])
        value, by_a, by_b = evaluate(coefficients[:, None], lattice.arc(turn, theta[:, None]), p[..., 2] - z[:, None])
        outwards = (p[..., 0] * d[..., 0] + p[..., 1] * d[..., 1]) / rho
        turning = (p[..., 0] * d[..., 1] - p[..., 1] * d[..., 0]) / rho**2
        slope = outwards - by_a * lattice.radius * turning - by_b * d[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(np.abs(slope) > 1e-3, (rho - value) / slope, np.nan)
        t = t - np.clip(step, -20.0, 20.0)
    return np.where(np.abs(step)[..., None] < 1e-6, origin + t[..., None] * d, np.nan)
