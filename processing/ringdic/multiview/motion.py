"""The points of the reference shape through all steps: each camera follows its own, all of them make the position."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask
from ringdic.correlation import Status
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint, grid_neighbours, surface_outliers
from ringdic.multiview.agreement import triangulate_agreeing
from ringdic.multiview.shape import ReferenceShape
from ringdic.multiview.tracking import CameraTrack
from ringdic.multiview.weights import smooth_sigma
from ringdic.uncertainty.matches import match_parts
from ringdic.uncertainty.noise import camera_noise
from ringdic.uncertainty.texture import Texture

Placed = Callable[[int, Floats, Floats], Sequence[Camera]]

_CELL = 8  # steps of the correlation, side of the squares over which weights are levelled
_LEAST_SIGMA = 1e-3  # px, what no match is better than


@dataclass(frozen=True)
class VertexTrack:
    """The k points that one camera followed through F steps.

    camera : its index. vertex : (k,) the points. px, sigma : (F, k, 2) px, sigma with all that is uncertain in it;
    noise : (F, k, 2) px, of the displacement by the images' noise alone; weight : (F, k, 2) px, sigma level over the
    image, by which positions are found. grey_noise : variance of the grey levels.
    c_ls, status : (F, k). used : (F, k), whether the position rests on it.
    """

    camera: int
    vertex: Indices
    px: Floats
    sigma: Floats
    noise: Floats
    weight: Floats
    grey_noise: float
    c_ls: Floats
    status: NDArray[np.int8]
    used: Mask


@dataclass(frozen=True)
class Motion:
    """Positions of the n points at F steps.

    xyz : (F, n, 3) mm, NaN where lost. covariance : (F, n, 3, 3) mm² of the displacement since the reference.
    chi2, degrees : (F, n). c_ls : (F, n), the largest over the cameras used. status : (F, n), 0 measured.
    tracks : of the cameras. drift : (F, C) px, mean vertical residual of a camera: it moved between the steps.
    """

    xyz: Floats
    covariance: Floats
    chi2: Floats
    degrees: Indices
    c_ls: Floats
    status: NDArray[np.int8]
    tracks: tuple[VertexTrack, ...]
    drift: Floats


def vertex_track(
    camera: int, x0: Floats, vertex: Indices, shape: ReferenceShape, found: CameraTrack, step: int, sigma_max: float
) -> VertexTrack:
    """One camera's track with what its pixels are uncertain by.

    camera : its index. x0 : (k, 2) px of the points ``vertex`` (k,) at the reference. found : at all F steps, the
    reference first. step : px, of the correlation.
    """
    with np.errstate(invalid="ignore"):
        uncertain = (found.status == 0) & (found.sigma > sigma_max).any(axis=2)
    status = np.where(uncertain, LostPoint.UNCERTAIN, found.status).astype(np.int8)
    texture = shape.textures[camera].part(vertex)
    variance = camera_noise(float(shape.grey_noise[camera]), found.c_ls[1:], texture.contrast)
    noise, sigma = _parted(found, texture, variance)
    weight = np.stack([smooth_sigma(x0, np.maximum(one, _LEAST_SIGMA), _CELL * step) for one in sigma])
    used = np.zeros(status.shape, bool)
    return VertexTrack(camera, vertex, found.px, sigma, noise, weight, variance, found.c_ls, status, used)


def _parted(found: CameraTrack, texture: Texture, variance: float) -> tuple[Floats, Floats]:
    """Standard deviations (F, k, 2) px of the displacements by noise alone, and by all."""
    noise, total = np.zeros_like(found.sigma), np.zeros_like(found.sigma)
    for step in range(1, len(found.px)):
        parts = match_parts(found.sigma[step], found.c_ls[step], (texture, texture), (variance, variance))
        noise[step] = np.hypot(parts.reference, parts.current)
        total[step] = np.hypot(noise[step], parts.systematic)
    return noise, total


def surface_motion(
    cameras: Sequence[Camera],
    shape: ReferenceShape,
    tracks: Sequence[VertexTrack],
    steps: int,
    placed: Placed | None = None,
) -> Motion:
    """The points placed at every step from the tracks of the cameras; placed : see :func:`measure_motion`."""
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
        _step(cameras, shape, motion, step, placed)
    return motion


def _step(cameras: Sequence[Camera], shape: ReferenceShape, motion: Motion, step: int, placed: Placed | None) -> None:
    """Fill one step of the motion."""
    n, count = len(shape.xyz), len(cameras)
    px, sigma = np.full((count, n, 2), np.nan), np.full((count, n, 2), np.nan)
    c_ls = np.full((count, n), np.nan)
    status = np.full(n, Status.NOT_REACHED, np.int8)
    for one in motion.tracks:
        good = one.status[step] == 0
        who = one.vertex[good]
        px[one.camera, who] = one.px[step, good]
        sigma[one.camera, who] = one.weight[step, good]
        c_ls[one.camera, who] = one.c_ls[step, good]
        status[one.vertex[~good]] = one.status[step, ~good]
    if placed is not None:
        cameras = placed(step, px, sigma)
    points, used = triangulate_agreeing(cameras, px, sigma)
    enough: Mask = np.asarray(np.isfinite(px[..., 0]).sum(axis=0) >= 2)
    lost: Mask = np.asarray(~np.isfinite(points.xyz).all(axis=1))
    status = np.where(lost, np.where(enough, LostPoint.RESIDUAL, status), 0).astype(np.int8)
    moved = np.where(lost[:, None], np.nan, points.xyz - shape.xyz)
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
