"""Results of the measurement by all cameras together, from the reference shape and the cameras' tracks.

The points of the reference shape are tracked by every camera against its own reference image and triangulated from all
cameras together. The camera pair of a point is formed by the two cameras that face it most squarely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.calibration.refined_cameras import RefinedCameras
from ringdic.charts.views import facing_pairs
from ringdic.correlation import Status
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint
from ringdic.geometry.triangulation import reprojection_residuals
from ringdic.multiview.motion import Motion, VertexTrack, surface_motion, vertex_track
from ringdic.multiview.shape import ReferenceShape, ShapeSettings
from ringdic.multiview.tracking import CameraTrack, Tracking
from ringdic.multiview.uncertainty import surface_uncertainty
from ringdic.multiview.views import incidence
from ringdic.results.results import Matches, Results
from ringdic.settings import Settings


@dataclass(frozen=True)
class MultiviewSurface:
    """Results of a surface measured by all cameras, how well the cameras agree, and warnings for the operator.

    drift : (F,) px for each camera id, mean vertical residual at each step. agreement : mean number of views of a
    point, RMS residual of the cameras at the reference (px), spacing of the lattice (mm), numbers of lost nodes by
    reason, and the steps at which cameras had moved. warnings : a sentence for each camera that was
    not used or moved.
    """

    results: Results
    drift: dict[str, Floats]
    agreement: dict[str, Any]
    warnings: list[str]


def surface_of_tracks(
    rig: str,
    cameras: Sequence[Camera],
    pairs: Sequence[tuple[str, str]],
    steps: Sequence[str],
    shape: ReferenceShape,
    tracks: Mapping[int, CameraTrack],
    settings: Settings,
) -> MultiviewSurface:
    """Combine the reference shape and the cameras' tracks into the results of a surface.

    Parameters
    ----------
    rig : its name.
    cameras : all C cameras that have a reference image.
    pairs : ids of neighbouring cameras.
    steps : names of the F steps, the reference first.
    shape : of the surface at the reference.
    tracks : through all F steps, by index of the camera.
    settings : of the run.

    Raises ComputationError where the shape has no triangle.
    """
    if not len(shape.faces):
        raise ComputationError("too few neighbouring points of the surface were measured to make a triangle")
    step, sigma_max = settings.correlation.step_px, settings.surface.sigma_max_px
    vertex_tracks = []
    for k, track in tracks.items():
        vertex, x0 = reference_pixels(cameras[k], shape, k)
        vertex_tracks.append(vertex_track(k, x0, vertex, shape, track, step, sigma_max))
    poses = RefinedCameras(cameras)
    refine_poses = poses if settings.calibration.refine_poses else None
    motion = surface_motion(cameras, shape, vertex_tracks, len(steps), refine_poses)
    residuals = reprojection_residuals(cameras, shape.xyz, shape.px)
    return MultiviewSurface(
        _results(rig, cameras, pairs, steps, shape, motion, settings),
        _drift(cameras, residuals, motion),
        {**_agreement(shape, residuals), "moved_cameras": poses.figures(steps)},
        _idle(cameras, shape) + poses.sentences(steps),
    )


def reference_pixels(camera: Camera, shape: ReferenceShape, k: int) -> tuple[Indices, Pixels]:
    """Points of the shape that camera number k sees, and the pixels from which it tracks them.

    Returns indices (n,) int of the points, and their projections (n, 2) float64, px, into the reference image.
    """
    vertex = np.flatnonzero(np.isfinite(shape.px[k, :, 0]))
    return vertex, camera.project(shape.xyz[vertex])


def pair_indices(cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]]) -> list[tuple[int, int]]:
    """Indices of the two cameras of each pair of camera ids."""
    ids = [camera.id for camera in cameras]
    return [(ids.index(first), ids.index(second)) for first, second in pairs]


def shape_settings(settings: Settings) -> ShapeSettings:
    """Settings of the reference shape's measurement, from the settings of a run."""
    return ShapeSettings(
        incidence=settings.surface.incidence_deg,
        spacing=settings.surface.spacing_mm,
        curvature=settings.surface.curvature,
        sigma_max=settings.surface.sigma_max_px,
    )


def _drift(cameras: Sequence[Camera], residuals: Pixels, motion: Motion) -> dict[str, Floats]:
    """Mean vertical residual (F,) px of each camera that was used, by id.

    residuals : (C, n, 2) px at the reference, where they are between the cameras. Points are tracked from where the
    reference puts them, so the residuals of later steps are added to those.
    """
    drift = {}
    for k, camera in enumerate(cameras):
        own = residuals[k, :, 1]
        if np.isfinite(own).any():
            drift[camera.id] = float(np.nanmean(own)) + np.concatenate([[0.0], motion.drift[1:, k]])
    return drift


def _agreement(shape: ReferenceShape, residuals: Pixels) -> dict[str, Any]:
    """Figures of how well the cameras agree at the reference. residuals : (C, n, 2) px."""
    reasons = {int(reason): reason.name.lower() for kind in (Status, LostPoint) for reason in kind}
    lost, count = np.unique(shape.status, return_counts=True)
    partner_residuals = residuals.copy()
    partner_residuals[shape.reference, np.arange(len(shape.xyz))] = np.nan  # whole pixels by definition
    return {
        "views": float(np.isfinite(shape.px[..., 0]).sum(axis=0).mean()),
        "residual_px": float(np.sqrt(np.nanmean(partner_residuals**2))),
        "lattice_mm": list(shape.pieces.lattice.spacing),
        "lost": {
            reasons[int(reason)]: int(number)
            for reason, number in zip(lost, count, strict=True)
            if reason not in (Status.GOOD, Status.NOT_REACHED)
        },
    }


def _idle(cameras: Sequence[Camera], shape: ReferenceShape) -> list[str]:
    """A sentence for each camera that shares no measured point with another."""
    taking_part: Mask = np.asarray(np.isfinite(shape.px[..., 0]).any(axis=1))
    return [
        f"camera {camera.id} shares no measured point of the surface with another; check that it sees the specimen, "
        "that it is in focus, and its mask"
        for camera, busy in zip(cameras, taking_part, strict=True)
        if not busy
    ]


def tracking_settings(settings: Settings) -> Tracking:
    """Settings of the tracking in time, from the settings of a run."""
    order = settings.correlation.order
    return Tracking(
        two_pass=settings.tracking.two_pass and order == 1,
        update_reference=settings.tracking.update_reference,
        order=order,
    )


def _results(
    rig: str,
    cameras: Sequence[Camera],
    pairs: Sequence[tuple[str, str]],
    steps: Sequence[str],
    shape: ReferenceShape,
    motion: Motion,
    settings: Settings,
) -> Results:
    """Arrays of the results from the shape and its motion."""
    facing, vertex_pair = _facing_pairs(cameras, pairs, shape)
    corners = vertex_pair[shape.faces]
    same_pair = (corners == corners[:, :1]).all(axis=1)
    tracking = settings.correlation
    uncertainty = surface_uncertainty(cameras, shape, motion, tracking.radius_px, tracking.order)
    with np.errstate(invalid="ignore"):
        chi2 = motion.chi2 / np.where(motion.degrees > 0, motion.degrees, 1)
    return Results(
        rig=rig,
        steps=tuple(steps),
        cameras=tuple(cameras),
        pairs=facing,
        vertices_ref=shape.xyz,
        vertices=motion.xyz,
        faces=shape.faces,
        pair=np.where(same_pair, corners[:, 0], -1),
        vertex_pair=vertex_pair,
        correlation=motion.c_ls,
        sigma_xyz=uncertainty.position,
        status=motion.status,
        matches=tuple(_matches(cameras, one, shape) for one in motion.tracks),
        settings=settings.to_toml(),
        sigma_displacement=uncertainty.displacement,
        sigma_lambda=uncertainty.stretches,
        chi2=chi2,
    )


def _facing_pairs(
    cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]], shape: ReferenceShape
) -> tuple[tuple[tuple[str, str], ...], Indices]:
    """Pair of cameras that face each point most squarely, of those that measured it.

    Returns the pairs of camera ids, with pairs that are not listed in the rig appended, and the index (n,) of each
    point's pair among them.
    """
    squarely = incidence(shape.pieces, cameras)[:, shape.node[:, 0], shape.node[:, 1]]
    squarely = np.where(np.isfinite(shape.px[..., 0]) & np.isfinite(squarely), squarely, -1.0)
    return facing_pairs(cameras, pairs, squarely)


def _matches(cameras: Sequence[Camera], track: VertexTrack, shape: ReferenceShape) -> Matches:
    """Matches of one camera; good ones that contradicted the other cameras are marked as such."""
    sigma = track.sigma.copy()
    sigma[0] = shape.sigma[track.camera, track.vertex]
    status = np.where((track.status == 0) & ~track.used, LostPoint.RESIDUAL, track.status).astype(np.int8)
    return Matches(
        cameras=(cameras[track.camera].id,),
        xy=shape.px[track.camera, track.vertex],
        px=track.px[:, None],
        c_ls=track.c_ls,
        sigma=sigma[:, None],
        status=status,
        vertex=track.vertex,
    )
