"""Motion of the reference shape: positions of its points at every step, from the tracks of all cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.charts.agreement import triangulate_agreeing
from ringdic.charts.weights import CELL_STEPS, smooth_sigma
from ringdic.correlation import Status
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint, grid_neighbours, surface_outliers
from ringdic.multiview.shape import ReferenceShape
from ringdic.multiview.tracking import CameraTrack
from ringdic.uncertainty.matches import match_uncertainty
from ringdic.uncertainty.noise import camera_noise
from ringdic.uncertainty.texture import Texture

#: Function of a step, pixels and standard deviations (C, n, 2) px; returns the cameras at that step.
PoseRefinement = Callable[[int, Pixels, Pixels], Sequence[Camera]]

_LEAST_SIGMA = 1e-3  # px, lower limit of a match's standard deviation


@dataclass(frozen=True)
class VertexTrack:
    """The k points that one camera tracked through F steps, with their uncertainty.

    camera : its index. vertex : (k,) int, the points. px : (F, k, 2) px. sigma : (F, k, 2) px, standard deviation due
    to all causes. noise : (F, k, 2) px, of the displacement due to image noise alone. weight : (F, k, 2) px, standard
    deviation smoothed over the image, by which positions are weighted. grey_noise : variance, grey levels². c_ls,
    status : (F, k). used : (F, k) bool, whether the position was triangulated from this camera.
    """

    camera: int
    vertex: Indices
    px: Pixels
    sigma: Pixels
    noise: Pixels
    weight: Pixels
    grey_noise: float
    c_ls: Floats
    status: NDArray[np.int8]
    used: Mask


@dataclass(frozen=True)
class Motion:
    """Positions of the n points of a surface at F steps.

    xyz : (F, n, 3) mm, world frame, NaN where lost. covariance : (F, n, 3, 3) mm², of the displacement since the
    reference. chi2, degrees : (F, n), of the triangulation. c_ls : (F, n), the largest over the cameras used.
    status : (F, n) int, 0 where measured. tracks : of the cameras. drift : (F, C) px, mean vertical residual of each
    camera, not zero for one that has moved between the steps.
    """

    xyz: Points
    covariance: Floats
    chi2: Floats
    degrees: Indices
    c_ls: Floats
    status: NDArray[np.int8]
    tracks: tuple[VertexTrack, ...]
    drift: Floats


def vertex_track(
    camera: int, x0: Pixels, vertex: Indices, shape: ReferenceShape, track: CameraTrack, step: int, sigma_max: float
) -> VertexTrack:
    """Complete a camera's track with the uncertainty of its pixels.

    Parameters
    ----------
    camera : index of the camera.
    x0 : (k, 2) float64, px, of the points at the reference.
    vertex : (k,) int, which points of the shape they are.
    track : at all F steps, the reference first.
    step : px, of the correlation's grid.
    sigma_max : px, greatest standard deviation of an accepted match.
    """
    with np.errstate(invalid="ignore"):
        uncertain = (track.status == 0) & (track.sigma > sigma_max).any(axis=2)
    status = np.where(uncertain, LostPoint.UNCERTAIN, track.status).astype(np.int8)
    texture = shape.textures[camera].part(vertex)
    variance = camera_noise(float(shape.grey_noise[camera]), track.c_ls[1:], texture.contrast)
    noise, sigma = _displacement_sigma(track, texture, variance)
    weight = np.stack([smooth_sigma(x0, np.maximum(one, _LEAST_SIGMA), CELL_STEPS * step) for one in sigma])
    used = np.zeros(status.shape, bool)
    return VertexTrack(camera, vertex, track.px, sigma, noise, weight, variance, track.c_ls, status, used)


def _displacement_sigma(track: CameraTrack, texture: Texture, variance: float) -> tuple[Floats, Floats]:
    """Standard deviations (F, k, 2) px of the displacements: due to noise alone and due to all causes.

    variance : of the noise, grey levels².
    """
    noise, total = np.zeros_like(track.sigma), np.zeros_like(track.sigma)
    for step in range(1, len(track.px)):
        parts = match_uncertainty(track.sigma[step], track.c_ls[step], (texture, texture), (variance, variance))
        noise[step] = np.hypot(parts.reference, parts.current)
        total[step] = np.hypot(noise[step], parts.systematic)
    return noise, total


def surface_motion(
    cameras: Sequence[Camera],
    shape: ReferenceShape,
    tracks: Sequence[VertexTrack],
    steps: int,
    refine_poses: PoseRefinement | None = None,
) -> Motion:
    """Triangulate the points of a shape at every step from the tracks of all cameras.

    tracks : of the cameras that see any of the points. steps : their number. refine_poses : function that returns the
    cameras at a step from the pixels and standard deviations (C, n, 2) px of that step; None: they have not moved.
    """
    n, count = len(shape.xyz), len(cameras)
    motion = Motion(
        xyz=np.full((steps, n, 3), np.nan),
        covariance=np.zeros((steps, n, 3, 3)),
        chi2=np.full((steps, n), np.nan),
        degrees=np.zeros((steps, n), np.int64),
        c_ls=np.full((steps, n), np.nan),
        status=np.zeros((steps, n), np.int8),
        tracks=tuple(tracks),
        drift=np.full((steps, count), np.nan),
    )
    motion.xyz[0], motion.chi2[0], motion.degrees[0], motion.c_ls[0] = shape.xyz, shape.chi2, shape.degrees, shape.c_ls
    for one in tracks:
        one.used[0] = True
    for step in range(1, steps):
        _step(cameras, shape, motion, step, refine_poses)
    return motion


def _step(
    cameras: Sequence[Camera], shape: ReferenceShape, motion: Motion, step: int, refine_poses: PoseRefinement | None
) -> None:
    """Compute one step of the motion, in place."""
    n, count = len(shape.xyz), len(cameras)
    px, sigma = np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan)
    c_ls = np.full((count, n), np.nan)
    status = np.full(n, Status.NOT_REACHED, np.int8)
    for one in motion.tracks:
        good = one.status[step] == 0
        vertices = one.vertex[good]
        px[one.camera, vertices] = one.px[step, good]
        sigma[one.camera, vertices] = one.weight[step, good]
        c_ls[one.camera, vertices] = one.c_ls[step, good]
        status[one.vertex[~good]] = one.status[step, ~good]
    if refine_poses is not None:
        cameras = refine_poses(step, px, sigma)
    points, used = triangulate_agreeing(cameras, px, sigma)
    enough: Mask = np.asarray(np.isfinite(px[..., 0]).sum(axis=0) >= 2)
    is_lost: Mask = np.asarray(~np.isfinite(points.xyz).all(axis=1))
    status = np.where(is_lost, np.where(enough, LostPoint.RESIDUAL, status), 0).astype(np.int8)
    moved = np.where(is_lost[:, None], np.nan, points.xyz - shape.xyz)
    status = np.where(surface_outliers(grid_neighbours(shape.node.astype(float), 1), moved), LostPoint.SURFACE, status)
    measured: Mask = np.asarray(status == 0)
    used &= measured
    motion.status[step] = status
    motion.xyz[step] = np.where(measured[:, None], points.xyz, np.nan)
    motion.covariance[step] = np.where(measured[:, None, None], points.covariance, np.nan)
    motion.chi2[step] = np.where(measured, points.chi2, np.nan)
    motion.degrees[step] = np.where(measured, points.degrees, 0)
    motion.c_ls[step] = np.where(measured, np.fmax.reduce(np.where(used, c_ls, np.nan), axis=0), np.nan)
    for one in motion.tracks:
        one.used[step] = used[one.camera, one.vertex]
        at = one.vertex[one.used[step]]
        if len(at):
            residual = px[one.camera, at] - cameras[one.camera].project(motion.xyz[step, at])
            motion.drift[step, one.camera] = float(np.mean(residual[:, 1]))
