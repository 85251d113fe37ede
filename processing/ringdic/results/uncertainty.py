"""Standard deviations of positions, displacements and stretches due to the calibration, by which results are completed.

They are stored in two parts, by cause: image noise, which differs from exposure to exposure and comes with the results,
and the calibration, whose error all points and steps share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Points
from ringdic.calibration.bundle import BundleFit
from ringdic.calibration.moved_cameras import MOTION, CameraMotions, motion_parameters
from ringdic.calibration.parameters import PER_CAMERA
from ringdic.results.results import Results
from ringdic.strain.deformation import Deformation, deformation
from ringdic.uncertainty.calibration import (
    CameraCovariance,
    Sensitivity,
    position_sensitivity,
    sensitivity_sigma,
    stretch_sigma_by_cameras,
)
from ringdic.uncertainty.position import Gain, position_gain

# Triangles, about, at which the part of the calibration is computed.
_SAMPLE = 3000


def camera_covariance(fit: BundleFit | None, motions: CameraMotions | None = None) -> CameraCovariance | None:
    """Covariance of the camera parameters after a bundle adjustment; None where each camera was calibrated alone.

    motions : how the cameras moved between the calibration and the reference, None where they did not; what is not
    known of it is added.
    """
    if fit is None:
        return None
    size = PER_CAMERA * len(fit.cameras)
    parameters = fit.covariance[:size, :size]
    if motions is not None:
        parameters = parameters + _of_motions(motions, fit.cameras)
    return CameraCovariance(fit.cameras, parameters)


def motion_covariance(motions: CameraMotions) -> CameraCovariance:
    """Covariance of the camera parameters due to what is not known of the cameras' motions."""
    ids = tuple(camera.id for camera in motions.cameras)
    return CameraCovariance(ids, _of_motions(motions, ids))


def _of_motions(motions: CameraMotions, ids: Sequence[str]) -> Floats:
    """Covariance (16 C, 16 C) of the parameters of C cameras, by id, that is due to their motions."""
    by_motion = np.zeros((PER_CAMERA * len(ids), MOTION * len(motions.cameras)))
    for c, camera in enumerate(motions.cameras):
        row = PER_CAMERA * ids.index(camera.id)
        by_motion[row : row + PER_CAMERA, MOTION * c : MOTION * (c + 1)] = motion_parameters(camera)
    return np.asarray(by_motion @ motions.covariance @ by_motion.T)


class StepUncertainty:
    """The standard deviations of a run's results due to the covariance of the cameras, computed one step at a time.

    reference : the results of the reference alone. known : covariance of the cameras.

    They vary smoothly over the surface. On a large one they are computed at a sample of the triangles and their
    corners, and every other triangle and point has those of the nearest one.

    Each camera tracks the points from the projection of their reference position, so that the cameras' errors move
    both positions alike.
    """

    def __init__(self, reference: Results, known: CameraCovariance) -> None:
        self._known = known
        every = max(1, len(reference.faces) // _SAMPLE)
        self._vertex, corners = np.unique(reference.faces[::every], return_inverse=True)
        self._faces = corners.reshape(-1, 3)
        at, centroids = reference.vertices_ref[self._vertex], reference.mesh.centroids
        self._points, self._triangles = _Nearest(at, reference.vertices_ref), _Nearest(centroids[::every], centroids)
        self._at_reference: Sensitivity = position_sensitivity(
            reference.cameras, at, _gain(reference, 0, self._vertex), known
        )
        self._position = self._points.spread(sensitivity_sigma(self._at_reference))

    def complete(self, results: Results, deformed: Deformation, motions: CameraMotions | None = None) -> Results:
        """Complete the results of one step with its standard deviations.

        results : of the reference and this step, or of the reference alone. deformed : from the reference to the step.
        motions : how the cameras moved since the reference, None where they did not; what is not known of it is part of
        the calibration's.
        """
        N, M = len(results.vertices_ref), len(results.faces)
        rows = [(self._position, np.zeros((N, 3)), np.zeros((M, 2)))]
        if len(results.steps) > 1:
            reference, current = results.vertices_ref[self._vertex], results.vertices[1, self._vertex]
            gain, at_reference = _gain(results, 1, self._vertex), self._at_reference
            at_step = position_sensitivity(results.cameras, current, gain, self._known, (reference, self._at_reference))
            if motions is not None:
                more = position_sensitivity(results.cameras, current, gain, motion_covariance(motions))
                at_step = np.concatenate([at_step, more], axis=2)
                at_reference = np.concatenate([at_reference, np.zeros_like(more)], axis=2)
            sample = deformation(reference, current, self._faces)
            stretches = stretch_sigma_by_cameras(sample, reference, self._faces, at_reference, at_step)
            both = np.concatenate([sensitivity_sigma(at_step), sensitivity_sigma(at_step - at_reference)], axis=1)
            of_points, of_triangles = self._points.spread(both), self._triangles.spread(stretches)
            of_points[~np.isfinite(results.vertices[1]).all(axis=1)] = np.nan
            of_triangles[~np.isfinite(deformed.J)] = np.nan
            rows.append((of_points[:, :3], of_points[:, 3:], of_triangles))
        names = ("sigma_calibration", "sigma_displacement_calibration", "sigma_lambda_calibration")
        arrays: dict[str, Any] = dict(zip(names, map(np.stack, zip(*rows, strict=True)), strict=True))
        return replace(results, **arrays)


class _Nearest:
    """Positions xyz (n, 3) mm, to which values known at some of the positions ``at`` (m, 3) mm are spread."""

    def __init__(self, at: Points, xyz: Points) -> None:
        self._at, self._xyz = at, xyz
        self._nearest: Indices = np.asarray(cKDTree(at).query(xyz)[1])

    def spread(self, values: Floats) -> Floats:
        """Values (n, k): those (m, k) of the nearest position that has some, NaN where none has."""
        known: Mask = np.asarray(np.isfinite(values).all(axis=1))
        nearest, lost = self._nearest, np.flatnonzero(~known[self._nearest])
        if len(lost) and known.any():
            some = np.flatnonzero(known)
            nearest = nearest.copy()
            nearest[lost] = some[cKDTree(self._at[some]).query(self._xyz[lost])[1]]
        return np.asarray(values[nearest])


def _gain(results: Results, step: int, vertex: Indices) -> Gain:
    """Gain from the pixels of each camera to the positions of some vertices at a step, (C, k, 3, 2) mm a px.

    vertex : (k,) indices, ascending.
    """
    index = {camera.id: k for k, camera in enumerate(results.cameras)}
    sigma = np.full((len(results.cameras), len(vertex), 2), np.nan)
    number = np.full(len(results.vertices_ref) + 1, -1)  # of a vertex among these; the last stands for no vertex
    number[vertex] = np.arange(len(vertex))
    for matches in results.matches:
        used = np.flatnonzero((number[matches.vertex] >= 0) & (matches.status[step] == 0))
        for view, id_ in enumerate(matches.cameras):
            sigma[index[id_], number[matches.vertex[used]]] = matches.sigma[step, view, used]
    return position_gain(results.cameras, results.vertices[step, vertex], sigma)
