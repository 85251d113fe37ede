"""Standard deviations of displacements and stretches, by which results are completed.

They are stored in two parts, by cause: image noise, which differs from exposure to exposure, and the calibration, whose
error all points and steps share. The surface measured by all cameras together comes with the
part due to noise; for surfaces of camera pairs it is computed here, from the matches.

Each camera of a pair is tracked in its own images, from its reference image to that of the step. Let δ_c be the error
that noise gives the subset in camera c's reference image, ε_c the error in the step's image, and A_c the gain from the
camera's pixels to the position at the step, A_c⁰ that at the reference. The displacement then has the error
``A₁ (ε₁ - δ₁) + A₂ ε₂ - A₂⁰ δ₂``. The two cameras differ because the second one's pixel at the reference comes from the
match between the cameras. That match contains δ₂ and tracking from it subtracts δ₂ again, so of the two positions only
the reference one has the error δ₂. Any other error of that match shifts the point at both steps and cancels.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Pixels, Points
from ringdic.calibration.bundle import BundleFit
from ringdic.calibration.parameters import PER_CAMERA
from ringdic.geometry.camera import Camera
from ringdic.results.results import Matches, Results
from ringdic.results.series import InMemorySeries, join_steps
from ringdic.settings import settings_of_run
from ringdic.strain.deformation import Deformation, deformation
from ringdic.uncertainty.calibration import (
    CameraCovariance,
    Sensitivity,
    position_sensitivity,
    sensitivity_sigma,
    stretch_sigma_by_cameras,
)
from ringdic.uncertainty.matches import INTERPOLATED_NOISE
from ringdic.uncertainty.position import covariance, position_gain
from ringdic.uncertainty.strain import corner_correlations, stretch_sigma

# The variance that a correlation states, in units of the variance due to noise of one image: it contains the noise of
# the reference image and that of the interpolated current one.
_BOTH_IMAGES = 1.0 + INTERPOLATED_NOISE
# Triangles, about, at which the part of the calibration is computed.
_SAMPLE = 3000
# Shift between the pixel coordinates of different reference images, px: their subsets share no pixels.
_APART = 1e6


def camera_covariance(fit: BundleFit | None) -> CameraCovariance | None:
    """Covariance of the camera parameters after a bundle adjustment; None where each camera was calibrated alone."""
    if fit is None:
        return None
    size = PER_CAMERA * len(fit.cameras)
    return CameraCovariance(fit.cameras, fit.covariance[:size, :size])


def add_uncertainty(results: Results, known: CameraCovariance | None) -> Results:
    """Complete results with the standard deviations of all steps.

    known : covariance of the cameras; None where it is unknown, and the part due to the calibration is left out.
    """
    series = InMemorySeries(results)
    uncertainty = StepUncertainty(series.reference, known, series.noise)
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        parts = pool.map(lambda k: uncertainty.complete(series.at(k), k), range(len(results.steps)))
        return join_steps(list(parts))


class StepUncertainty:
    """The standard deviations of a run's results, computed one step at a time.

    reference : the results of the reference alone. known : covariance of the cameras, None where it is unknown.
    noise : for each of the matches, (F, C) px, from `Series.noise`.
    """

    def __init__(self, reference: Results, known: CameraCovariance | None, noise: Sequence[Floats]) -> None:
        pairwise = any(len(matches.cameras) == 2 for matches in reference.matches)
        scattered = pairwise and reference.sigma_displacement is None
        self._noise = _NoiseUncertainty(reference, noise) if scattered else None
        self._calibration = None if known is None else _CalibrationUncertainty(reference, known, tracked=not pairwise)

    def complete(self, results: Results, step: int, deformation: Deformation | None = None) -> Results:
        """Complete the results of one step with its standard deviations.

        results : of the reference and this step, from `Series.at`. step : its number in the series.
        deformation : of the step since the reference; computed where it is None.
        """
        last = len(results.steps) - 1
        deformed = results.deformation(last) if deformation is None else deformation
        added: dict[str, Any] = {}
        if self._noise is not None:
            added |= self._noise.arrays(results, step, deformed)
        if self._calibration is not None:
            added |= self._calibration.arrays(results, deformed)
        return replace(results, **added)


class _CalibrationUncertainty:
    """Standard deviations due to the covariance of the cameras.

    They vary smoothly over the surface. On a large one they are computed at a sample of the triangles and their
    corners, and every other triangle and point has those of the nearest one.

    tracked : whether each camera tracked the points from the projection of their reference position.
    """

    def __init__(self, reference: Results, known: CameraCovariance, tracked: bool) -> None:
        self._known, self._tracked = known, tracked
        every = max(1, len(reference.faces) // _SAMPLE)
        self._vertex, corners = np.unique(reference.faces[::every], return_inverse=True)
        self._faces = corners.reshape(-1, 3)
        self._middles = reference.mesh.centroids[::every]
        self._at_reference: Sensitivity = position_sensitivity(
            reference.cameras, reference.vertices_ref[self._vertex], _gain(reference, 0, self._vertex), known
        )
        at = reference.vertices_ref[self._vertex]
        self._position = _from_nearest(at, sensitivity_sigma(self._at_reference), reference.vertices_ref)

    def arrays(self, results: Results, deformed: Deformation) -> dict[str, Floats]:
        """The standard deviations at the reference and at the step, by the names of the arrays of `Results`."""
        N, M = len(results.vertices_ref), len(results.faces)
        rows = [(self._position, np.zeros((N, 3)), np.zeros((M, 2)))]
        if len(results.steps) > 1:
            reference, current = results.vertices_ref[self._vertex], results.vertices[1, self._vertex]
            at_step = position_sensitivity(
                results.cameras, current, _gain(results, 1, self._vertex), self._known,
                (reference, self._at_reference) if self._tracked else None,
            )  # fmt: skip
            sample = deformation(reference, current, self._faces)
            stretches = stretch_sigma_by_cameras(sample, reference, self._faces, self._at_reference, at_step)
            both = np.concatenate([sensitivity_sigma(at_step), sensitivity_sigma(at_step - self._at_reference)], axis=1)
            of_points = _from_nearest(reference, both, results.vertices_ref)
            of_triangles = _from_nearest(self._middles, stretches, results.mesh.centroids)
            of_points[~np.isfinite(results.vertices[1]).all(axis=1)] = np.nan
            of_triangles[~np.isfinite(deformed.J)] = np.nan
            rows.append((of_points[:, :3], of_points[:, 3:], of_triangles))
        names = ("sigma_calibration", "sigma_displacement_calibration", "sigma_lambda_calibration")
        return {name: np.stack(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}


def _from_nearest(at: Points, values: Floats, xyz: Points) -> Floats:
    """Values (n, k) at positions xyz (n, 3) mm: those of the nearest of the positions ``at`` (m, 3) mm that has some.

    values : (m, k), NaN where there are none.
    """
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not len(known):
        return np.full((len(xyz), values.shape[1]), np.nan)
    return np.asarray(values[known[cKDTree(at[known]).query(xyz)[1]]])


def _gain(results: Results, step: int, vertex: Indices) -> Floats:
    """Gain from the pixels of each camera to the positions of some vertices at a step, (C, k, 3, 2) mm a px.

    vertex : (k,) indices.
    """
    index = {camera.id: k for k, camera in enumerate(results.cameras)}
    sigma = np.full((len(results.cameras), len(results.vertices_ref), 2), np.nan)
    for matches in results.matches:
        used = (matches.vertex >= 0) & (matches.status[step] == 0)
        for view, id_ in enumerate(matches.cameras):
            # The points of a pair are triangulated with equal weights.
            weight = 1.0 if len(matches.cameras) == 2 else matches.sigma[step, view, used]
            sigma[index[id_], matches.vertex[used]] = weight
    return position_gain(results.cameras, results.vertices[step, vertex], sigma[:, vertex])


@dataclass(frozen=True)
class _Sources:
    """The four independent errors of a pair's points: of its two reference images, then of the step's two images.

    gain : (4, N, 3, 2) mm a px, from each error to the displacement. sigma : (4, N, 2) px, of each error.
    """

    gain: Floats
    sigma: Floats


class _NoiseUncertainty:
    """Standard deviations of displacements and stretches measured by camera pairs, due to image noise.

    noise : for each pair (F, 2) px, as `Series.noise` gives it. The residual of the step where it is smallest is taken
    as noise; what other steps have more is due to motion and light.
    """

    def __init__(self, reference: Results, noise: Sequence[Floats]) -> None:
        self._noise_shares = [_share_of_noise(level) for level in noise]
        settings = settings_of_run(reference.settings).correlation
        cameras = {camera.id: camera for camera in reference.cameras}
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            self._pairs = list(pool.map(partial(_Pair.of, reference, cameras), range(len(reference.matches))))
        px = np.full((2, len(reference.vertices_ref), 2), np.nan)
        for pair in self._pairs:
            px[:, pair.vertex[pair.rows]] = pair.px
        correlation = corner_correlations(px, reference.faces, settings.radius_px, settings.order)
        self._correlation = np.concatenate([correlation, correlation])

    def arrays(self, results: Results, step: int, deformed: Deformation) -> dict[str, Floats]:
        """The standard deviations at the reference and at the step, by the names of the arrays of `Results`."""
        N = len(results.vertices_ref)
        displacement, stretches = [np.zeros((N, 3))], [np.zeros((len(results.faces), 2))]
        if len(results.steps) > 1:
            sources = _Sources(np.zeros((4, N, 3, 2)), np.full((4, N, 2), np.nan))
            for pair, matches, share in zip(self._pairs, results.matches, self._noise_shares, strict=True):
                _fill(sources, results.vertices[1], pair, matches, share[step])
            of_points = np.sqrt(np.einsum("nii->ni", covariance(sources.gain, sources.sigma)))
            of_triangles = stretch_sigma(
                deformed, results.vertices_ref, results.faces, sources.gain, self._correlation, sources.sigma
            )
            of_points[~np.isfinite(results.vertices[1]).all(axis=1)] = np.nan
            of_triangles[~np.isfinite(deformed.J)] = np.nan
            displacement.append(of_points)
            stretches.append(of_triangles)
        return {"sigma_displacement": np.stack(displacement), "sigma_lambda": np.stack(stretches)}


@dataclass(frozen=True)
class _Pair:
    """The points of a camera pair at the reference.

    cameras : the two. vertex : (n,) vertex index of each matched point, -1 where it has none. rows : (k,) indices of
    the points that have one. px : (2, k, 2) px, these points in the reference images, shifted so that points of
    different images are far apart. gain : (2, k, 3, 2) mm a px, from the pixels to the reference positions.
    """

    cameras: tuple[Camera, ...]
    vertex: Indices
    rows: Indices
    px: Pixels
    gain: Floats

    @classmethod
    def of(cls, results: Results, cameras: Mapping[str, Camera], k: int) -> _Pair:
        """The pair of the k-th matches of the reference's results."""
        matches = results.matches[k]
        own = tuple(cameras[id_] for id_ in matches.cameras)
        rows = np.flatnonzero(matches.vertex >= 0)
        gain = position_gain(own, results.vertices_ref[matches.vertex[rows]], np.ones((2, len(rows), 2)))
        px = matches.px[0][:, rows] + np.array([[2 * k * _APART, 0.0], [(2 * k + 1) * _APART, 0.0]])[:, None]
        return cls(own, matches.vertex, rows, px, gain)


def _share_of_noise(level: Floats) -> Floats:
    """Share of the noise in the standard deviations of the matches, (F, 2); NaN where these are unknown.

    level : (F, 2) px, median standard deviation of each step's matches in each camera.
    """
    later = level.copy()
    later[0] = np.nan  # no match in time: the grid itself, or the match between the cameras
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.fmin.reduce(later, axis=0) / later)


def _fill(sources: _Sources, xyz: Points, pair: _Pair, matches: Matches, share: Floats) -> None:
    """Fill in the errors of one pair's points.

    xyz : (N, 3) mm at the step. share : (2,) of the noise in the matches' standard deviations, of each camera.
    """
    noise = matches.sigma[1][:, pair.rows] / np.sqrt(_BOTH_IMAGES) * share[:, None, None]
    usable = (matches.status[1, pair.rows] == 0) & np.isfinite(noise).all(axis=(0, 2))
    noise, vertex = noise[:, usable], pair.vertex[pair.rows[usable]]
    gain = position_gain(pair.cameras, xyz[vertex], np.ones((2, len(vertex), 2)))
    sources.gain[:, vertex] = np.concatenate([gain[:1], pair.gain[1:, usable], gain])
    sources.sigma[:, vertex] = np.concatenate([noise, noise])
