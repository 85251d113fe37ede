"""Triangulation of points in space from pixels with known standard deviations, with the covariance of each point.

A point minimises ``χ² = Σ ((u_c - û_c(X))/σ_c)²`` over the cameras that see it, with ``û_c`` its projection through the
lens. Gauss-Newton starts at the weighted linear solution (Solav et al. 2018, eq. 7-9). With m cameras χ² has 2 m - 3
degrees of freedom, and the covariance of the point is ``(Σ Jᵀ W J)⁻¹``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Indices, Pixels, Points
from ringdic.geometry import kernels
from ringdic.geometry.camera import Camera, stacked_optics
from ringdic.geometry.triangulation import pixels_of_cameras


@dataclass(frozen=True)
class WeightedPoints:
    """Triangulated points with their covariances and fit; NaN where a point is not determined by its views.

    xyz : (n, 3) mm, world frame.
    covariance : (n, 3, 3) mm², for independent pixel errors with the standard deviations that were given.
    chi2 : (n,) sum of squared residuals in units of their standard deviations.
    degrees : (n,) degrees of freedom of chi2, 2 m - 3 for m cameras, 0 where the point is not determined.
    """

    xyz: Points
    covariance: Floats
    chi2: Floats
    degrees: Indices

    def __post_init__(self) -> None:
        n = len(self.xyz)
        if self.xyz.shape != (n, 3) or self.covariance.shape != (n, 3, 3) or self.chi2.shape != (n,):
            raise ValueError("weighted points need a place, a covariance and a chi-square each")

    @property
    def sigma(self) -> Floats:
        """Standard deviations of x, y and z. (n, 3) mm."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))


def triangulate_weighted(cameras: Sequence[Camera], px: Pixels, sigma: Pixels) -> WeightedPoints:
    """Points in space from their pixels in two or more images, weighted by the pixels' standard deviations.

    Parameters
    ----------
    cameras : the C cameras, C ≥ 2.
    px, sigma : (C, n, 2) image pixels as they are in the images (distorted) and their standard deviations, px. A
        camera in which either is not finite is not used for the point.

    Raises
    ------
    ValueError : arrays of other shapes, or a standard deviation that is not positive.
    """
    px, sigma = pixels_of_cameras(cameras, px), np.asarray(sigma, dtype=float)
    if sigma.shape != px.shape:
        raise ValueError(f"standard deviations of shape {sigma.shape} do not go with pixels of shape {px.shape}")
    if (sigma <= 0).any():
        raise ValueError("a pixel with a standard deviation of zero or less has no weight; give it a positive one")
    n = px.shape[1]
    xyz, covariance, chi2, degrees = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n, np.int64)
    kernels.weighted_points(
        *stacked_optics(cameras), np.ascontiguousarray(px), np.ascontiguousarray(sigma), xyz, covariance, chi2, degrees
    )
    return WeightedPoints(xyz, covariance, chi2, degrees)
