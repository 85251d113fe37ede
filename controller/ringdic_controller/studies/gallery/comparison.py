"""Errors of a run on a solid body against the exact truth, beside the standard deviations that the run states."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from ringdic.arrays import Floats, Mask, Points, Vectors
from ringdic.results.results import Results
from ringdic.strain.deformation import deformation
from ringdic_node.virtual_rig.scenes import SolidSpecimen

from ringdic_controller.studies.gallery.sample import SurfaceSample

WRONG = 1.0  # mm
COVERED, SHAPE, SPREAD = 0.97, 1.3, (0.80, 1.25)  # what is aimed at
_STEP = 1  # of the results: the body after its motion


@dataclass(frozen=True)
class Spread:
    """Errors over their standard deviations: RMS of all, and 1.4826 times the median magnitude; 1 is expected."""

    plain: float
    robust: float

    @classmethod
    def of(cls, errors: Floats, sigma: Floats) -> Spread:
        """The spread of errors (n, k) with standard deviations sigma (n, k) of an equal unit; NaN takes no part."""
        ratio = np.abs(errors / np.where(sigma > 0, sigma, np.nan))
        ratio = ratio[np.isfinite(ratio)]
        if not len(ratio):
            return cls(float("nan"), float("nan"))
        return cls(float(np.sqrt(np.mean(ratio**2))), float(1.4826 * np.median(ratio)))


@dataclass(frozen=True)
class RowFigures:
    """Figures of one row of the gallery.

    seen_cm2 : area that two cameras see below 60°. covered : share of it under measured triangles; covered_later : of
    what two cameras see before and after the motion, the share under triangles measured at both. points : number
    measured; wrong : of these, off the surface or displaced wrongly by more than 1 mm. shape_mm : RMS distance of the
    others from the surface. displacement_mm : RMS of their error. stretch : RMS error of the stretches.
    """

    seen_cm2: float
    covered: float
    covered_later: float
    points: int
    wrong: int
    shape_mm: float
    shape: Spread
    displacement_mm: float
    displacement: Spread
    stretch_rms: float
    stretches: Spread

    @property
    def missed(self) -> list[str]:
        """Names of the aims that are not reached."""
        low, high = SPREAD
        reached = {
            "coverage": self.covered >= COVERED,
            "wrong points": self.wrong == 0,
            "shape": self.shape.plain <= SHAPE,
            "displacement": low <= self.displacement.robust <= high,
            "stretches": low <= self.stretches.robust <= high,
        }
        return [name for name, each in reached.items() if not each]


@dataclass(frozen=True)
class JudgedRun:
    """A run compared with the truth.

    figures : its row. normals : (N, 3) unit vectors of the surface at the vertices. distance : (N,) mm of the vertices
    from the surface, outside positive. displacement : (N,) mm, length of the error, NaN where lost. covered : (n,) of
    the sample's points.
    """

    figures: RowFigures
    normals: Vectors
    distance: Floats
    displacement: Floats
    sample: SurfaceSample
    covered: Mask = field(repr=False)


def judged(results: Results, before: SolidSpecimen, after: SolidSpecimen, sample: SurfaceSample) -> JudgedRun:
    """Compare the results of a run of two steps with the truth.

    before, after : the body at the reference and at the second step.
    """
    xyz = results.vertices_ref
    foot, normals, distance = before.solid.nearest(xyz)
    error = results.vertices[_STEP] - xyz - (after.moved(foot) - foot)
    length = np.linalg.norm(error, axis=1)
    wrong = (np.abs(distance) > WRONG) | (length > WRONG)
    good = ~wrong
    faces = results.faces
    # The true stretches of the triangles, not of the tangent planes: a triangle's size is no error of the measurement.
    measured, true = results.deformation(_STEP), deformation(foot, after.moved(foot), faces)
    stretch = np.stack([measured.lambda1 - true.lambda1, measured.lambda2 - true.lambda2], axis=1)
    stretch[wrong[faces].any(axis=1)] = np.nan
    covered = sample.covered(xyz, faces)
    followed = sample.covered(xyz, faces[np.isfinite(length)[faces].all(axis=1)])
    sigma_xyz = total_sigma(results.sigma_xyz[0], _at(results.sigma_calibration, 0))
    sigma_moved = total_sigma(
        _at(results.sigma_displacement, _STEP), _at(results.sigma_displacement_calibration, _STEP)
    )
    sigma_lambda = total_sigma(_at(results.sigma_lambda, _STEP), _at(results.sigma_lambda_calibration, _STEP))
    towards = viewing_directions(results, normals)
    figures = RowFigures(
        seen_cm2=len(sample.points) * sample.area / 100.0,
        covered=_share(covered),
        covered_later=_share(followed[sample.later]),
        points=len(xyz),
        wrong=int(wrong.sum()),
        shape_mm=_rms(distance[good]),
        shape=Spread.of(distance[good], normal_sigma(sigma_xyz, normals, towards)[good]),
        displacement_mm=_rms(length[good]),
        displacement=Spread.of(error[good], np.broadcast_to(sigma_moved, error.shape)[good]),
        stretch_rms=_rms(stretch),
        stretches=Spread.of(stretch, np.broadcast_to(sigma_lambda, stretch.shape)),
    )
    return JudgedRun(figures, normals, distance, length, sample, covered)


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


def _at(values: Floats | None, step: int) -> Floats | None:
    return None if values is None else values[step]


def _share(which: Mask) -> float:
    return float(which.mean()) if len(which) else float("nan")


def _rms(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")
