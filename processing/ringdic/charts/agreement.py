"""Triangulation of points from all cameras, with rejection of inconsistent views by a χ² test."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.geometry.camera import Camera
from ringdic.geometry.weighted_triangulation import WeightedPoints, triangulate_weighted

_LIMIT = 25.0  # χ² for each degree of freedom, in units of its median over the points
_ROUNDS = 2


def triangulate_agreeing(
    cameras: Sequence[Camera], px: Pixels, sigma: Floats, fixed: Indices | None = None
) -> tuple[WeightedPoints, Mask]:
    """Triangulate points from all cameras, and drop up to two views of each point whose χ² is too large.

    A point whose only two views are inconsistent is lost.

    Parameters
    ----------
    cameras : the C cameras.
    px, sigma : (C, n, 2) float64, px, pixels of the points and their standard deviations, NaN where a camera has none.
    fixed : (n,) int, index of a camera whose pixel defines the point and is never dropped; None: any view may be
        dropped.

    Returns
    -------
    The points, NaN where lost, and the views (C, n) bool that they were triangulated from.
    """
    px = px.copy()
    points = triangulate_weighted(cameras, px, sigma)
    median_chi2 = _median_chi2(points)
    for _ in range(_ROUNDS):
        bad = np.flatnonzero(_contradicted(points, median_chi2))
        if not len(bad):
            break
        px[_worst(cameras, points.xyz[bad], px[:, bad], sigma[:, bad], None if fixed is None else fixed[bad]), bad] = (
            np.nan
        )
        again = triangulate_weighted(cameras, px[:, bad], sigma[:, bad])
        points.xyz[bad], points.covariance[bad] = again.xyz, again.covariance
        points.chi2[bad], points.degrees[bad] = again.chi2, again.degrees
    bad = np.flatnonzero(_contradicted(points, median_chi2))
    points.xyz[bad], points.covariance[bad], points.chi2[bad], points.degrees[bad] = np.nan, np.nan, np.nan, 0
    return points, np.asarray(np.isfinite(px[..., 0]) & np.isfinite(points.chi2))


def _median_chi2(points: WeightedPoints) -> float:
    """Median over the points of χ² for each degree of freedom, at least one."""
    known = points.degrees > 0
    return max(1.0, float(np.median(points.chi2[known] / points.degrees[known]))) if known.any() else 1.0


def _contradicted(points: WeightedPoints, median_chi2: float) -> Mask:
    """Points (n,) whose χ² is far above the median, as when one view is inconsistent with the others."""
    return np.asarray((points.degrees > 0) & (np.nan_to_num(points.chi2) > _LIMIT * median_chi2 * points.degrees))


def _worst(cameras: Sequence[Camera], xyz: Points, px: Pixels, sigma: Floats, fixed: Indices | None) -> Indices:
    """Index (n,) of the camera whose pixel is farthest from each point's projection, in standard deviations."""
    residual = np.stack([camera.project(xyz) for camera in cameras]) - px
    each = np.nansum((residual / sigma) ** 2, axis=2)
    if fixed is not None:
        each[fixed, np.arange(len(fixed))] = -1.0
    return np.asarray(np.argmax(each, axis=0))
