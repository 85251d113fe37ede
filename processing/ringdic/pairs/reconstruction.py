"""From the matches of a camera pair to points in space and triangles, a step at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint, crossing_outliers, grid_neighbours, surface_outliers
from ringdic.geometry.triangulation import LinearSystem, reprojection_residuals
from ringdic.mesh.mesh import Mesh
from ringdic.uncertainty.position import linear_sigma


class PairMatches(Protocol):
    """A pair's n points in both images of one step.

    px, sigma : (2, n, 2) px, NaN where a camera has no match. c_ls : (n,). status : (n,), 0 good in both. seconds :
    time spent by stage.
    """

    @property
    def px(self) -> Floats: ...
    @property
    def sigma(self) -> NDArray[Any]: ...
    @property
    def c_ls(self) -> NDArray[Any]: ...
    @property
    def status(self) -> NDArray[np.int8]: ...
    @property
    def seconds(self) -> Mapping[str, float]: ...


@dataclass(frozen=True)
class PairStep:
    """One step of a pair's surface: N points in space, of n matches.

    vertices : (N, 3) mm, NaN where lost. correlation : (N,). sigma : (N, 3) mm. status : (n,), of the matches, with
    those dropped that cannot be right in space. drift : px, mean vertical reprojection residual of the first camera.
    """

    vertices: Floats
    correlation: NDArray[np.float32]
    sigma: NDArray[np.float32]
    status: NDArray[np.int8]
    drift: float


@dataclass(frozen=True)
class PairShape:
    """A pair's surface at the reference, and what each of its steps is found from. n matches, N vertices, M triangles.

    xy : (n, 2) px. rows : (N,) matches that are vertices. faces : (M, 3), normals outwards. at_first : the reference.
    beside : of the matches, of :func:`neighbours`. xyz : (n, 3) mm, NaN where lost. scatter : (2, n, 2) px, of the
    match between the cameras. sigma_max_px : least certain match that is believed.
    """

    cameras: tuple[Camera, Camera]
    xy: Floats
    rows: Indices
    faces: Indices
    at_first: PairStep
    beside: Indices
    xyz: Floats
    scatter: NDArray[Any]
    sigma_max_px: float

    @property
    def ids(self) -> tuple[str, str]:
        """The cameras' names, the one of the reference image first."""
        return self.cameras[0].id, self.cameras[1].id

    @property
    def vertex(self) -> Indices:
        """The vertex of each match, (n,), -1 where it has none."""
        found = np.full(len(self.xy), -1)
        found[self.rows] = np.arange(len(self.rows))
        return found

    def step(self, found: PairMatches) -> PairStep:
        """The points at a later step, by its matches."""
        # The second camera's place rests on the match between the cameras and on that in time. The noise of its
        # reference image is in both, the other way round, and goes out: the larger deviation holds.
        scatter = np.fmax(self.scatter, found.sigma)
        xyz, sigma, status, drift = _placed(self.cameras, found, scatter, self.sigma_max_px)
        _drop(surface_outliers(self.beside, xyz - self.xyz), xyz, status)
        # A point without a reference cannot be tracked.
        unknown = np.isnan(self.xyz).any(axis=1) & (status == 0)
        status[unknown] = self.at_first.status[unknown]
        xyz[unknown] = np.nan
        return _of_rows(self.rows, xyz, sigma, status, found, drift)


def pair_shape(
    cameras: tuple[Camera, Camera],
    xy: Floats,
    faces: NDArray[np.int32],
    found: PairMatches,
    step_px: int,
    sigma_max_px: float,
) -> PairShape:
    """Triangulate a pair's reference, drop what cannot be right, and keep the triangles between measured points.

    xy : (n, 2) px, the grid in the first camera's image, of spacing ``step_px``. faces : (m, 3) over it. found : its
    matches. sigma_max_px : least certain match that is believed.
    """
    beside = grid_neighbours(xy, step_px)
    xyz, sigma, status, drift = _placed(cameras, found, found.sigma, sigma_max_px)
    _drop(surface_outliers(beside, xyz), xyz, status)
    whole = _whole_faces(xyz, faces, cameras)
    rows = np.unique(whole)
    at_first = _of_rows(rows, xyz, sigma, status, found, drift)
    return PairShape(cameras, xy, rows, np.searchsorted(rows, whole), at_first, beside, xyz, found.sigma, sigma_max_px)


def _placed(
    cameras: tuple[Camera, Camera], found: PairMatches, scatter: NDArray[Any], sigma_max_px: float
) -> tuple[Floats, Floats, NDArray[np.int8], float]:
    """Places (n, 3) mm and their standard deviations, status (n,) and drift px, by where the lines of sight cross.

    scatter : (2, n, 2) px, of the places in the images.
    """
    with np.errstate(invalid="ignore"):
        uncertain = (found.sigma > sigma_max_px).any(axis=(0, 2))
    status = np.where((found.status == 0) & uncertain, LostPoint.UNCERTAIN, found.status).astype(np.int8)
    good = status == 0
    px = np.where(good[None, :, None], found.px, np.nan)
    system = LinearSystem.of(cameras, px)
    xyz, sigma = system.solution, linear_sigma(cameras, system, scatter)
    residuals = reprojection_residuals(cameras, xyz, px)
    drift = float(np.nanmean(residuals[0, :, 1])) if good.any() else np.nan
    _drop(good & crossing_outliers(residuals), xyz, status, LostPoint.RESIDUAL)
    xyz[status != 0] = np.nan
    return xyz, sigma, status, drift


def _drop(lost: Mask, xyz: Floats, status: NDArray[np.int8], why: LostPoint = LostPoint.SURFACE) -> None:
    status[lost] = why
    xyz[lost] = np.nan


def _of_rows(
    rows: Indices, xyz: Floats, sigma: Floats, status: NDArray[np.int8], found: PairMatches, drift: float
) -> PairStep:
    lost = status[rows] != 0
    correlation, scatter = found.c_ls[rows].astype(np.float32), sigma[rows].astype(np.float32)
    correlation[lost], scatter[lost] = np.nan, np.nan
    return PairStep(xyz[rows], correlation, scatter, status, drift)


def _whole_faces(xyz: Floats, faces: NDArray[np.int32], cameras: Sequence[Camera]) -> Indices:
    """Triangles between measured points, turned towards the cameras; none across a step in depth.

    A triangle whose longest edge is far longer than the grid's usual one joins two surfaces.
    """
    mesh = Mesh(xyz, faces.astype(np.int64)).without_lost()
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    mesh = Mesh(xyz, mesh.faces[longest < 4 * np.median(longest)]) if len(longest) else mesh
    middle = np.mean([camera.centre for camera in cameras], axis=0)
    return mesh.facing(middle).faces
