"""Points from all their views but those that contradict the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.geometry.camera import Camera
from ringdic.geometry.weighted_triangulation import WeightedPoints, triangulate_weighted

_LIMIT = 25.0  # χ² a degree of freedom, in units of the usual one
_ROUNDS = 2


def triangulate_agreeing(
    cameras: Sequence[Camera], px: Floats, sigma: Floats, given: Indices | None = None
) -> tuple[WeightedPoints, Mask]:
    """Points (n) from px, sigma (C, n, 2), up to two views dropped where a point's χ² is far beyond the usual.

    given : (n,) a camera a point whose pixel defines the point and is not dropped. A point of two views that
    contradict one another is lost. Returns the points and which views (C, n) they rest on.
    """
    px = px.copy()
    points = triangulate_weighted(cameras, px, sigma)
    usual = _usual(points)
    for _ in range(_ROUNDS):
        bad = np.flatnonzero(_contradicted(points, usual))
        if not len(bad):
            break
        px[_worst(cameras, points.xyz[bad], px[:, bad], sigma[:, bad], None if given is None else given[bad]), bad] = (
            np.nan
        )
        again = triangulate_weighted(cameras, px[:, bad], sigma[:, bad])
        points.xyz[bad], points.covariance[bad] = again.xyz, again.covariance
        points.chi2[bad], points.degrees[bad] = again.chi2, again.degrees
    bad = np.flatnonzero(_contradicted(points, usual))
    points.xyz[bad], points.covariance[bad], points.chi2[bad], points.degrees[bad] = np.nan, np.nan, np.nan, 0
    return points, np.asarray(np.isfinite(px[..., 0]) & np.isfinite(points.chi2))


def _usual(points: WeightedPoints) -> float:
    """χ² a degree of freedom of the middling point, and not below one."""
    known = points.degrees > 0
    return max(1.0, float(np.median(points.chi2[known] / points.degrees[known]))) if known.any() else 1.0


def _contradicted(points: WeightedPoints, usual: float) -> Mask:
    return np.asarray((points.degrees > 0) & (np.nan_to_num(points.chi2) > _LIMIT * usual * points.degrees))


def _worst(cameras: Sequence[Camera], xyz: Floats, px: Floats, sigma: Floats, given: Indices | None) -> Indices:
    """Index (n,) of the view that fits worst."""
    residual = np.stack([camera.project(xyz) for camera in cameras]) - px
    each = np.nansum((residual / sigma) ** 2, axis=2)
    if given is not None:
        each[given, np.arange(len(given))] = -1.0
    return np.asarray(np.argmax(each, axis=0))
