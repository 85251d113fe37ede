"""One surface from all cameras at once: from calibrated cameras and images to results.

The reference shape is measured first, then its points are followed by every camera against its own reference image
and placed by all cameras together. The pair of a point is the two cameras that face it most squarely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.calibration.refined_cameras import RefinedCameras
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
    """Results, how well the cameras agree, and a sentence for each that took no part.

    drift : (F,) px for each camera, the mean vertical residual of each step. agreement : views a point, RMS residual of
    the cameras at the reference (px), the places of the surface that two cameras see and none could be matched in, by
    the reason, and the steps at which cameras were seen to have moved.
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
    """The same from the reference shape and each camera's track through all steps, by its index."""
    _require_faces(shape)
    step, sigma_max = settings.correlation.step_px, settings.surface.sigma_max_px
    followed = []
    for k, found in tracks.items():
        vertex, x0 = reference_pixels(cameras[k], shape, k)
        followed.append(vertex_track(k, x0, vertex, shape, found, step, sigma_max))
    steadied = RefinedCameras(cameras)
    placed = steadied if settings.calibration.refine_poses else None
    motion = surface_motion(cameras, shape, followed, len(steps), placed)
    return _found(rig, cameras, pairs, steps, shape, motion, steadied, settings)


def reference_pixels(camera: Camera, shape: ReferenceShape, k: int) -> tuple[Indices, Floats]:
    """The points (n,) that camera k saw at the reference, and the pixels (n, 2) from which it follows them."""
    vertex = np.flatnonzero(np.isfinite(shape.px[k, :, 0]))
    return vertex, camera.project(shape.xyz[vertex])


def pair_indices(cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]]) -> list[tuple[int, int]]:
    """The pairs by the cameras' indices."""
    ids = [camera.id for camera in cameras]
    return [(ids.index(first), ids.index(second)) for first, second in pairs]


def shape_settings(settings: Settings) -> ShapeSettings:
    """How the reference shape is measured."""
    return ShapeSettings(
        incidence=settings.surface.incidence_deg,
        spacing=settings.surface.spacing_mm,
        curvature=settings.surface.curvature,
        sigma_max=settings.surface.sigma_max_px,
    )


def _require_faces(shape: ReferenceShape) -> None:
    if not len(shape.faces):
        raise ComputationError("too few neighbouring points of the surface were measured to make a triangle")


def _found(
    rig: str,
    cameras: Sequence[Camera],
    pairs: Sequence[tuple[str, str]],
    steps: Sequence[str],
    shape: ReferenceShape,
    motion: Motion,
    steadied: RefinedCameras,
    settings: Settings,
) -> MultiviewSurface:
    residuals = reprojection_residuals(cameras, shape.xyz, shape.px)
    return MultiviewSurface(
        _results(rig, cameras, pairs, steps, shape, motion, settings),
        _drift(cameras, residuals, motion),
        {**_agreement(shape, residuals), "moved_cameras": steadied.figures(steps)},
        _idle(cameras, shape) + steadied.sentences(steps),
    )


def _drift(cameras: Sequence[Camera], residuals: Floats, motion: Motion) -> dict[str, Floats]:
    """Mean vertical residuals (F,) px of each camera that took part.

    At the reference they are between the cameras; the points are followed from where the reference puts them, so what
    the steps show is added.
    """
    found = {}
    for k, camera in enumerate(cameras):
        own = residuals[k, :, 1]
        if np.isfinite(own).any():
            found[camera.id] = float(np.nanmean(own)) + np.concatenate([[0.0], motion.drift[1:, k]])
    return found


def _agreement(shape: ReferenceShape, residuals: Floats) -> dict[str, Any]:
    reasons = {int(reason): reason.name.lower() for kind in (Status, LostPoint) for reason in kind}
    lost, count = np.unique(shape.status, return_counts=True)
    matched = residuals.copy()
    matched[shape.reference, np.arange(len(shape.xyz))] = np.nan  # whole pixels by definition
    return {
        "views": float(np.isfinite(shape.px[..., 0]).sum(axis=0).mean()),
        "residual_px": float(np.sqrt(np.nanmean(matched**2))),
        "lattice_mm": list(shape.pieces.lattice.spacing),
        "lost": {
            reasons[int(reason)]: int(number)
            for reason, number in zip(lost, count, strict=True)
            if reason not in (Status.GOOD, Status.NOT_REACHED)
        },
    }


def _idle(cameras: Sequence[Camera], shape: ReferenceShape) -> list[str]:
    taking_part: Mask = np.asarray(np.isfinite(shape.px[..., 0]).any(axis=1))
    return [
        f"camera {camera.id} shares no measured point of the surface with another; check that it sees the specimen, "
        "that it is in focus, and its mask"
        for camera, busy in zip(cameras, taking_part, strict=True)
        if not busy
    ]


def tracking_settings(settings: Settings) -> Tracking:
    """How points are followed."""
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
    facing, vertex_pair = _facing_pairs(cameras, pairs, shape)
    corners = vertex_pair[shape.faces]
    alike = (corners == corners[:, :1]).all(axis=1)
    tracking = settings.correlation
    sure = surface_uncertainty(cameras, shape, motion, tracking.radius_px, tracking.order)
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
        pair=np.where(alike, corners[:, 0], -1),
        vertex_pair=vertex_pair,
        correlation=motion.c_ls,
        sigma_xyz=sure.position,
        status=motion.status,
        matches=tuple(_matches(cameras, one, shape) for one in motion.tracks),
        settings=settings.to_toml(),
        sigma_displacement=sure.displacement,
        sigma_lambda=sure.stretches,
        chi2=chi2,
    )


def _facing_pairs(
    cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]], shape: ReferenceShape
) -> tuple[tuple[tuple[str, str], ...], Indices]:
    """The pairs and, for each point (n,), which of them are the two cameras used that face it most squarely.

    Two cameras that are no pair of the rig are added to the list, in the order of the ring.
    """
    squarely = incidence(shape.pieces, cameras)[:, shape.node[:, 0], shape.node[:, 1]]
    squarely = np.where(np.isfinite(shape.px[..., 0]) & np.isfinite(squarely), squarely, -1.0)
    best = np.sort(np.argsort(-squarely, axis=0)[:2], axis=0)
    listed = [(first, second) for first, second in pairs]
    index = {frozenset(pair): k for k, pair in enumerate(listed)}
    vertex_pair = np.empty(len(shape.xyz), np.int64)
    for a, b in np.unique(best, axis=1).T:
        pair = (cameras[a].id, cameras[b].id)
        if frozenset(pair) not in index:
            index[frozenset(pair)] = len(listed)
            listed.append(pair)
        vertex_pair[(best[0] == a) & (best[1] == b)] = index[frozenset(pair)]
    return tuple(listed), vertex_pair


def _matches(cameras: Sequence[Camera], one: VertexTrack, shape: ReferenceShape) -> Matches:
    """One camera's matches. Good ones that contradicted the other cameras' are marked."""
    sigma = one.sigma.copy()
    sigma[0] = shape.sigma[one.camera, one.vertex]
    status = np.where((one.status == 0) & ~one.used, LostPoint.RESIDUAL, one.status).astype(np.int8)
    return Matches(
        cameras=(cameras[one.camera].id,),
        xy=shape.px[one.camera, one.vertex],
        px=one.px[:, None],
        c_ls=one.c_ls,
        sigma=sigma[:, None],
        status=status,
        vertex=one.vertex,
    )
