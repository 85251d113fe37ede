"""From the matches of camera pairs to points in space and triangles: the surfaces of the pairs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from processing.camera import Camera
from processing.matching import PairMatches
from processing.mesh import Mesh
from processing.outliers import Lost, crossing_outliers, neighbours, surface_outliers
from processing.results import Matches
from processing.triangulation import LinearSystem, reprojection_residuals
from processing.uncertainty.position import linear_sigma

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PairSurface:
    """One pair's points in space. F steps, N vertices, M triangles.

    vertices : (F, N, 3) mm, finite at the reference, NaN where lost later. faces : (M, 3), normals outwards.
    correlation : (F, N). sigma : (F, N, 3) mm. status : (F, N). matches : with the index of each point's vertex.
    drift : (F,) px, mean vertical reprojection residual of the first camera: cameras that moved between frames.
    """

    vertices: Array
    faces: NDArray[np.int64]
    correlation: Array
    sigma: Array
    status: NDArray[np.int8]
    matches: Matches
    drift: Array


def pair_surface(cameras: tuple[Camera, Camera], found: PairMatches, step_px: int, sigma_max_px: float) -> PairSurface:
    """Triangulate a pair's matches, drop what cannot be right, and keep the triangles between measured points.

    step_px : spacing of the grid in the reference image. sigma_max_px : least certain match that is believed.
    """
    matches = found.matches
    steps, n = matches.c_ls.shape
    xyz = np.full((steps, n, 3), np.nan)
    sigma = np.full((steps, n, 3), np.nan)
    with np.errstate(invalid="ignore"):
        uncertain = (matches.sigma > sigma_max_px).any(axis=(1, 3))
    status = np.where((matches.status == 0) & uncertain, Lost.UNCERTAIN, matches.status).astype(np.int8)
    drift = np.full(steps, np.nan)
    beside = neighbours(matches.xy, step_px)
    for step in range(steps):
        good = status[step] == 0
        px = np.where(good[None, :, None], matches.px[step], np.nan)
        system = LinearSystem.of(cameras, px)
        xyz[step] = system.solution
        # The second camera's place rests on the match between the cameras and on that in time. The noise of its
        # reference image is in both, the other way round, and goes out: the larger deviation holds.
        sigma[step] = linear_sigma(cameras, system, np.fmax(matches.sigma[0], matches.sigma[step]))
        residuals = reprojection_residuals(cameras, xyz[step], px)
        if good.any():
            drift[step] = float(np.nanmean(residuals[0, :, 1]))
        status[step, good & crossing_outliers(residuals)] = Lost.RESIDUAL
        xyz[step, status[step] != 0] = np.nan
        _drop_off_surface(beside, xyz, status, step)
    sigma[status != 0] = np.nan
    whole = _whole_faces(xyz[0], found.faces, cameras)
    used = np.unique(whole)
    vertex = np.full(n, -1)
    vertex[used] = np.arange(len(used))
    correlation = np.where(status == 0, matches.c_ls, np.nan)
    return PairSurface(
        xyz[:, used],
        vertex[whole],
        correlation[:, used],
        sigma[:, used],
        status[:, used],
        replace(matches, status=status, vertex=vertex),
        drift,
    )


def _drop_off_surface(beside: NDArray[np.int64], xyz: Array, status: NDArray[np.int8], step: int) -> None:
    """Drop points off the surface of their neighbours, or that moved otherwise than their neighbours did."""
    values = xyz[step] if step == 0 else xyz[step] - xyz[0]
    lost = surface_outliers(beside, values)
    status[step, lost] = Lost.SURFACE
    xyz[step, lost] = np.nan
    # A point without a reference cannot be tracked.
    if step:
        unknown = np.isnan(xyz[0]).any(axis=1) & (status[step] == 0)
        status[step, unknown] = status[0, unknown]
        xyz[step, unknown] = np.nan


def _whole_faces(xyz: Array, faces: NDArray[np.int32], cameras: Sequence[Camera]) -> NDArray[np.int64]:
    """Triangles between measured points, turned towards the cameras; none across a step in depth.

    A triangle whose longest edge is far longer than the grid's usual one joins two surfaces.
    """
    mesh = Mesh(xyz, faces.astype(np.int64)).without_lost()
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    mesh = Mesh(xyz, mesh.faces[longest < 4 * np.median(longest)]) if len(longest) else mesh
    middle = np.mean([camera.centre for camera in cameras], axis=0)
    return mesh.facing(middle).faces
