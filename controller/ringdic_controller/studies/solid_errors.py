"""Errors of a run on a solid body against the exact truth, beside the standard deviations that the run states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ringdic.arrays import Floats, Mask, Points, Vectors
from ringdic.results.results import Results
from ringdic.strain.deformation import deformation
from ringdic_node.virtual_rig.scenes import SolidSpecimen

WRONG = 1.0  # mm
FAR = 5.0  # σ, beyond which hardly an error should lie


@dataclass(frozen=True)
class Spread:
    """Errors over their standard deviations.

    plain : RMS of all, and robust : 1.4826 times the median magnitude, of which 1 is expected. beyond : share of the
    errors beyond 5 σ. count : number of errors. All but the number are NaN where there is none.
    """

    plain: float
    robust: float
    beyond: float
    count: int

    @classmethod
    def of(cls, errors: Floats, sigma: Floats) -> Spread:
        """The spread of errors (n, k) with standard deviations sigma (n, k) of an equal unit; NaN takes no part."""
        ratio = np.abs(errors / np.where(sigma > 0, sigma, np.nan))
        ratio = ratio[np.isfinite(ratio)]
        if not len(ratio):
            return cls(float("nan"), float("nan"), float("nan"), 0)
        robust = float(1.4826 * np.median(ratio))
        return cls(float(np.sqrt(np.mean(ratio**2))), robust, float(np.mean(ratio > FAR)), len(ratio))


@dataclass(frozen=True)
class StatedSpreads:
    """Errors over stated standard deviations, by quantity, over all points and steps.

    position : between cameras, the distance of the reference's points from the true surface. displacement : in time,
    its three components. stretch : in time, the two principal stretches of the triangles.
    """

    position: Spread
    displacement: Spread
    stretch: Spread


@dataclass(frozen=True)
class SolidErrors:
    """Errors, measured minus true, of a run on a solid body: N points and M triangles, F steps after the reference.

    normals : (N, 3) unit vectors of the true surface at the points. distance : (N,) mm of the points from it, outside
    positive. displacement : (F, N, 3) mm. stretch : (F, M, 2) of the principal stretches. sigma_distance,
    sigma_displacement, sigma_stretch : what the run states for them, of the same shapes and units. NaN where a point
    was lost or nothing is stated.
    """

    normals: Vectors
    distance: Floats
    displacement: Floats
    stretch: Floats
    sigma_distance: Floats
    sigma_displacement: Floats
    sigma_stretch: Floats

    @classmethod
    def of(cls, results: Results, specimens: Sequence[SolidSpecimen]) -> SolidErrors:
        """Compare the results of a run with the truth. specimens : the body at each step, the reference first."""
        xyz, faces, steps = results.vertices_ref, results.faces, range(1, len(results.steps))
        foot, normals, distance = specimens[0].solid.nearest(xyz)
        displacement, stretch = np.empty((len(steps), len(xyz), 3)), np.empty((len(steps), len(faces), 2))
        for k, step in enumerate(steps):
            true = specimens[step].moved(foot)
            displacement[k] = results.vertices[step] - xyz - (true - foot)
            # The true stretches of the triangles, not of the tangent planes: a triangle's size is no error.
            found, exact = results.deformation(step), deformation(foot, true, faces)
            stretch[k] = np.stack([found.lambda1 - exact.lambda1, found.lambda2 - exact.lambda2], axis=1)
        sigma_xyz = total_sigma(results.sigma_xyz[0], _first(results.sigma_calibration))
        moved = total_sigma(results.sigma_displacement, results.sigma_displacement_calibration)
        stretched = total_sigma(results.sigma_lambda, results.sigma_lambda_calibration)
        return cls(
            normals, distance, displacement, stretch,
            normal_sigma(sigma_xyz, normals, viewing_directions(results, normals)),
            np.broadcast_to(moved[1:] if moved.ndim else moved, displacement.shape),
            np.broadcast_to(stretched[1:] if stretched.ndim else stretched, stretch.shape),
        )  # fmt: skip

    @property
    def length(self) -> Floats:
        """Lengths (F, N) mm of the displacements' errors, NaN where lost."""
        return np.asarray(np.linalg.norm(self.displacement, axis=2))

    @property
    def wrong(self) -> Mask:
        """Which points, (N,) bool, are off the surface, or displaced wrongly at any step, by more than 1 mm."""
        return np.asarray((np.abs(self.distance) > WRONG) | (self.length > WRONG).any(axis=0))

    @property
    def spreads(self) -> StatedSpreads:
        """The errors over what is stated, of all points and steps, those included that are wildly wrong."""
        return StatedSpreads(
            Spread.of(self.distance, self.sigma_distance),
            Spread.of(self.displacement, self.sigma_displacement),
            Spread.of(self.stretch, self.sigma_stretch),
        )


def normal_sigma(sigma: Floats, normals: Vectors, towards: Vectors) -> Floats:
    """Standard deviations along the normal, (n,) mm, from those of x, y and z, sigma (n, 3) mm.

    A triangulated point scatters along the mean direction to its cameras and alike across it: covariance a I + b d dᵀ,
    whose diagonal gives a and b by least squares. normals, towards : (n, 3) unit vectors of normal and direction d.
    """
    square = sigma**2
    d2 = towards**2
    # Least squares of sigma_i² = a + b d_i² over the three coordinates.
    mean, mean_d2 = square.mean(axis=1), d2.mean(axis=1)
    spread = np.sum((d2 - mean_d2[:, None]) ** 2, axis=1)
    b = np.sum((d2 - mean_d2[:, None]) * square, axis=1) / np.maximum(spread, 1e-3)
    b = np.clip(b, 0.0, 3.0 * mean)
    a = np.maximum(mean - b * mean_d2, 0.0)
    along = np.sum(normals * towards, axis=1)
    return np.asarray(np.sqrt(np.minimum(a + b * along**2, np.sum(np.abs(normals) * sigma, axis=1) ** 2)))


def viewing_directions(results: Results, normals: Vectors) -> Points:
    """Mean direction (N, 3) from each vertex to the cameras that see its front below 65°, of unit length.

    normals : (N, 3) unit vectors at the vertices.
    """
    total = 1e-3 * normals
    for camera in results.cameras:
        towards = camera.centre - results.vertices_ref
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        total = total + towards * (np.sum(towards * normals, axis=1) > np.cos(np.radians(65.0)))[:, None]
    return np.asarray(total / np.linalg.norm(total, axis=1, keepdims=True))


def total_sigma(noise: Floats | None, calibration: Floats | None) -> Floats:
    """Standard deviations (..., ) of both causes together, in the unit of either; NaN where the noise's are unknown.

    noise, calibration : (..., ) due to each; None where unknown.
    """
    if noise is None:
        return np.array(np.nan)
    return noise if calibration is None else np.hypot(noise, calibration)


def rms(values: Floats) -> float:
    """Root mean square of the finite ones of some values (..., ), in their unit; NaN where there is none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def _first(values: Floats | None) -> Floats | None:
    return None if values is None else values[0]
