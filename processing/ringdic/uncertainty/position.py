"""Covariance of triangulated positions from the standard deviations of the matched pixels, to first order.

An error δ_c of camera c's pixel moves a point triangulated from all cameras by ``A_c δ_c``, with the gain
``A_c = (Σ Jᵀ W J)⁻¹ J_cᵀ W_c``; J_c is the derivative of the projection, W_c the weight of the pixel. A point that is
*defined* by a whole pixel p of its reference camera r has a further error: noise of the reference image changes which
point of the surface the pattern about p represents, and all its matches move along. With ``B = ∂X/∂p`` along the
surface, the error of the reference position is ``Σ A_c δ_c - B δ_r``.

At later steps the displacement of each camera's pixel is measured against that camera's own reference image, at the
projection of the point. The error of the reference position cancels in the displacement, which keeps
``Σ A'_c (ε_c(t) - ε_c(0))``, with ε_c the errors of the subsets that are matched in time and A'_c the gain at the step.
The position at a step is the reference position plus the displacement. It contains the noise of each reference image
twice: once through the match between cameras (δ), whose subset is narrowed where the view is steep, once through the
match in time (ε), whose subset is a whole disc. The disc contains the narrowed subset, so ``⟨δ ε⟩ = ⟨ε ε⟩``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ringdic.arrays import Floats, Indices, Points, Vectors
from ringdic.geometry import kernels
from ringdic.geometry.camera import Camera, stacked_optics

#: Sensitivities (C, n, 3, 2) of positions to the pixels of each camera, mm a px.
Gain = NDArray[np.floating]
#: Standard deviations (C, n, 2) px of pixels, in single or double precision.
Deviations = NDArray[np.floating]

_RARE = 0.002  # probability of a χ² from which on it speaks of more than noise and small systematic errors


def disagreement(chi2: Floats, degrees: Indices) -> Floats:
    """Factor by which the standard deviations of points grow where their cameras contradict one another.

    It is 1 for all but two points in a thousand where noise is all that there is, and makes the largest χ² plausible
    where there is more (the ratio of Birge 1932, for each point).

    chi2 : (n,) sums of squared residuals in units of their standard deviations. degrees : (n,) of freedom of these.
    Returns (n,) from 1 upwards, without unit; 1 where no camera could contradict.
    """
    plausible = chdtri(np.maximum(degrees, 1), _RARE)
    return np.sqrt(np.maximum(1.0, np.where(degrees > 0, np.nan_to_num(chi2), 0.0) / plausible))


def position_gain(cameras: Sequence[Camera], xyz: Points, sigma: Deviations) -> Gain:
    """Gain ``A_c`` from the pixels of each camera to positions triangulated from all cameras with weights 1 / σ².

    xyz : (n, 3) mm, the positions. sigma : (C, n, 2) px, standard deviations of the pixels that they were triangulated
    from, NaN for a camera that was not used.
    Returns (C, n, 3, 2) mm a px, in single precision; zero for a camera that was not used.
    """
    single = np.ascontiguousarray(sigma, dtype=np.float32)
    gain = np.empty((len(cameras), len(xyz), 3, 2), np.float32)
    kernels.gain(*stacked_optics(cameras), np.ascontiguousarray(xyz, dtype=float), single, gain)
    return gain


def covariance(gain: Gain, sigma: Deviations) -> Floats:
    """Covariance ``Σ A_c diag(σ_c²) A_cᵀ`` of positions from independent errors of the pixels.

    gain : (C, n, 3, 2) mm a px, of `position_gain`. sigma : (C, n, 2) px, standard deviations of the pixels.
    Returns (n, 3, 3) mm²; NaN where fewer than two cameras take part.
    """
    return np.asarray(kernels.fill_covariance(np.ascontiguousarray(gain), np.ascontiguousarray(sigma, np.float32)))


def along_surface(cameras: Sequence[Camera], reference: Indices, xyz: Points, normals: Vectors) -> Floats:
    """Derivative ``B = ∂X/∂p`` of the surface point that a pixel shows with respect to that pixel.

    It is the inverse of the projection, restricted to the surface: ``B = T (J T)⁻¹`` with any basis T of the tangent
    plane.

    reference : (n,) index of the camera whose pixel it is, -1 for none. xyz : (n, 3) mm, points of the surface.
    normals : (n, 3), normals there, of any length.
    Returns (n, 3, 2) mm a px; NaN where there is no camera.
    """
    out = np.full((len(xyz), 3, 2), np.nan)
    axis = np.eye(3)[np.argmin(np.abs(np.nan_to_num(normals)), axis=1)]
    first = np.cross(normals, axis)
    tangents = np.stack([first, np.cross(normals, first)], axis=-1)  # (n, 3, 2)
    for k in np.unique(reference[reference >= 0]):
        index = np.flatnonzero(reference == k)
        _, slope = cameras[k].project_with_jacobian(xyz[index])
        out[index] = tangents[index] @ np.linalg.inv(slope @ tangents[index])
    return out


def reference_covariance(gain: Gain, sigma: Deviations, reference: Indices, label: Floats) -> Floats:
    """Covariance due to image noise of reference positions, each defined by a pixel of its reference camera.

    gain : (C, n, 3, 2) mm a px, of `position_gain`. sigma : (C, n, 2) px, due to the noise of each image alone.
    reference : (n,) index of the reference camera. label : (n, 3, 2) mm a px, of `along_surface`.
    Returns (n, 3, 3) mm².
    """
    moved = gain.copy()
    moved[reference, np.arange(len(reference))] -= label
    return covariance(moved, sigma)


def step_covariance(
    gains: tuple[Gain, Gain],
    sigma: Deviations,
    tracked: tuple[Deviations, Deviations],
    reference: Indices,
    label: Floats,
) -> Floats:
    """Covariance of positions at a later step due to image noise.

    gains : (C, n, 3, 2) mm a px each, of `position_gain` at the reference and at the step.
    sigma : (C, n, 2) px, of the matches between the cameras due to the noise of each reference image alone.
    tracked : (C, n, 2) px each, of the matches in time due to the noise of the reference image alone and to that of the
        step's image alone.
    reference : (n,) index of the reference camera. label : (n, 3, 2) mm a px, of `along_surface`.
    Returns (n, 3, 3) mm².
    """
    total = np.empty((len(reference), 3, 3))
    kernels.fill_step_covariance(*gains, np.ascontiguousarray(sigma, np.float32), *tracked, reference, label, total)
    return total
