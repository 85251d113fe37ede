"""Standard deviations due to image noise of a surface's positions, displacements and stretches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Vectors
from ringdic.geometry.camera import Camera
from ringdic.multiview.motion import Motion
from ringdic.multiview.shape import ReferenceShape
from ringdic.strain.deformation import deformation
from ringdic.uncertainty.position import (
    along_surface,
    covariance,
    position_gain,
    reference_covariance,
    step_covariance,
)
from ringdic.uncertainty.strain import corner_correlations, stretch_sigma


@dataclass(frozen=True)
class SurfaceUncertainty:
    """Standard deviations due to image noise, at F steps of n points and M triangles; NaN where lost.

    position : (F, n, 3) mm. displacement : (F, n, 3) mm, zero at the reference. stretches : (F, M, 2), of the principal
    stretches λ1 and λ2.
    """

    position: Vectors
    displacement: Vectors
    stretches: Floats


def surface_uncertainty(
    cameras: Sequence[Camera], shape: ReferenceShape, motion: Motion, radius: float, order: int
) -> SurfaceUncertainty:
    """Standard deviations of the positions, displacements and stretches of a surface measured by all cameras.

    radius : px, of the subsets in time. order : of their shape function, 1 or 2.
    """
    steps, n = motion.status.shape
    reference, normals = shape.reference, shape.pieces.normals[tuple(shape.node.T)]
    # The noise is better known from the images in time than from the flat parts of one image.
    image_noise = shape.noise.copy()
    for one in motion.tracks:
        if steps > 1:
            image_noise[one.camera] *= np.sqrt(one.grey_noise / shape.grey_noise[one.camera])
    label = along_surface(cameras, reference, shape.xyz, normals)
    reference_gain = position_gain(cameras, shape.xyz, shape.sigma)
    position, displacement = np.full((steps, n, 3), np.nan), np.full((steps, n, 3), np.nan)
    stretches = np.full((steps, len(shape.faces), 2), np.nan)
    position[0] = _sigma(reference_covariance(reference_gain, image_noise, reference, label))
    displacement[0], stretches[0] = 0.0, 0.0
    pixels = np.stack([camera.project(shape.xyz) for camera in cameras])
    corner_correlation = corner_correlations(pixels, shape.faces, radius, order)
    for step in range(1, steps):
        sigma, noise = _of_step(len(cameras), motion, step)
        gain = position_gain(cameras, motion.xyz[step], sigma)
        half = noise / np.sqrt(2.0)  # the share of either image
        displacement[step] = _sigma(covariance(gain, noise))
        position[step] = _sigma(step_covariance((reference_gain, gain), image_noise, (half, half), reference, label))
        strains = deformation(shape.xyz, motion.xyz[step], shape.faces)
        stretches[step] = stretch_sigma(strains, shape.xyz, shape.faces, gain, corner_correlation, noise)
        lost = ~np.isfinite(motion.xyz[step]).all(axis=1)
        position[step, lost], displacement[step, lost] = np.nan, np.nan
    return SurfaceUncertainty(position, displacement, stretches)


def _of_step(count: int, motion: Motion, step: int) -> tuple[Floats, Floats]:
    """Standard deviations (C, n, 2) px of the pixels that a step was triangulated from: total, and due to noise."""
    n = motion.status.shape[1]
    sigma, noise = np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan)
    for one in motion.tracks:
        used = one.used[step]
        vertices = one.vertex[used]
        sigma[one.camera, vertices], noise[one.camera, vertices] = one.weight[step, used], one.noise[step, used]
    return sigma, noise


def _sigma(covariances: Floats) -> Floats:
    """Standard deviations (n, 3) of covariances (n, 3, 3)."""
    return np.sqrt(np.einsum("nii->ni", covariances))
