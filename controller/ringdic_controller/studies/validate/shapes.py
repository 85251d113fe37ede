"""Least-squares cylinder through points, by which the paper measures a diameter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ringdic.arrays import Floats
from scipy.optimize import least_squares


@dataclass(frozen=True)
class FittedCylinder:
    """A cylinder fitted to n points.

    diameter : mm. spread : standard deviation of twice the points' radii, mm. radial : (n,) distances from the surface,
    outside positive, mm.
    """

    diameter: float
    spread: float
    radial: Floats


def fitted_cylinder(points: Floats, radius: float = 57.0) -> FittedCylinder:
    """The least-squares cylinder of points (n, 3) mm about an axis near z; a point that is NaN takes no part."""
    points = points[np.isfinite(points).all(axis=1)]
    middle = 0.5 * (points[:, 2].min() + points[:, 2].max())

    def misfit(q: Floats) -> Floats:
        axis = np.array([q[2], q[3], 1.0]) / np.sqrt(q[2] ** 2 + q[3] ** 2 + 1.0)
        offset = points - [q[0], q[1], middle]
        return np.asarray(np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=1) - q[4])

    fit = least_squares(misfit, [0.0, 0.0, 0.0, 0.0, radius], x_scale=[1.0, 1.0, 0.01, 0.01, 1.0])
    return FittedCylinder(2.0 * float(fit.x[4]), 2.0 * float(fit.fun.std()), fit.fun)
