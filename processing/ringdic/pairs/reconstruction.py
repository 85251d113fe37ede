"""Reconstruction of a camera pair's surface, points and triangles, from its matches, one step at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint, crossing_outliers, grid_neighbours, surface_outliers
from ringdic.geometry.triangulation import LinearSystem, reprojection_residuals
from ringdic.mesh.mesh import Mesh
from ringdic.uncertainty.position import linear_sigma


class PairMatches(Protocol):
    """Interface of the matches that a reconstruction needs: a pair's n points in both images of one step."""

    @property
    def px(self) -> Floats:
        """Pixels (2, n, 2) px in both images, NaN where a camera has no match."""

    @property
    def sigma(self) -> NDArray[Any]:
        """Standard deviations (2, n, 2) px of the pixels."""

    @property
    def c_ls(self) -> NDArray[Any]:
        """Correlation coefficients C_LS (n,), the largest over the images used."""

    @property
    def status(self) -> NDArray[np.int8]:
        """Status (n,) int, 0 where good in both images."""

    @property
    def seconds(self) -> Mapping[str, float]:
        """Time spent on the match, by stage."""


@dataclass(frozen=True)
class PairStep:
    """Surface of a pair at one step: N points in space, of n matches.

    vertices : (N, 3) mm, world frame, NaN where lost. correlation : (N,) C_LS. sigma : (N, 3) mm. status : (n,) int, of
    the matches, with the reasons of those rejected in space. drift : px, mean vertical reprojection
    residual of the first camera.
    """

    vertices: Points
    correlation: NDArray[np.float32]
    sigma: NDArray[np.float32]
    status: NDArray[np.int8]
    drift: float


@dataclass(frozen=True)
class PairShape:
    """Surface of a pair at the reference: n matches, N vertices, M triangles, and the data that later steps need.

    xy : (n, 2) px, the grid. rows : (N,) int, the matches that are vertices. faces : (M, 3) int, normals outwards.
    reference : the step of the reference. neighbours : (n, 4, 2) int, of the matches on the grid, from
    ``grid_neighbours``. xyz : (n, 3) mm, world frame, NaN where lost. scatter : (2, n, 2) px, standard deviations of
    the match between the cameras. sigma_max_px : greatest standard deviation of an accepted match.
    """

    cameras: tuple[Camera, Camera]
    xy: Pixels
    rows: Indices
    faces: Indices
    reference: PairStep
    neighbours: Indices
    xyz: Points
    scatter: NDArray[Any]
    sigma_max_px: float

    @property
    def ids(self) -> tuple[str, str]:
        """Ids of the cameras, the one of the reference image first."""
        return self.cameras[0].id, self.cameras[1].id

    @property
    def vertex(self) -> Indices:
        """Index of the vertex of each match, (n,) int, -1 where it has none."""
        vertex = np.full(len(self.xy), -1)
        vertex[self.rows] = np.arange(len(self.rows))
        return vertex

    def step(self, matches: PairMatches) -> PairStep:
        """Surface at a later step, from the matches of that step."""
        # The second camera's pixel depends on the match between the cameras and on that in time. The noise of its
        # reference image enters both with opposite signs and cancels, so the larger deviation of the two holds.
        scatter = np.fmax(self.scatter, matches.sigma)
        xyz, sigma, status, drift = _triangulate_step(self.cameras, matches, scatter, self.sigma_max_px)
        _drop(surface_outliers(self.neighbours, xyz - self.xyz), xyz, status)
        # A point without a reference cannot be tracked.
        unknown = np.isnan(self.xyz).any(axis=1) & (status == 0)
        status[unknown] = self.reference.status[unknown]
        xyz[unknown] = np.nan
        return _step_of_rows(self.rows, xyz, sigma, status, matches, drift)


def pair_shape(
    cameras: tuple[Camera, Camera],
    xy: Pixels,
    faces: NDArray[np.int32],
    matches: PairMatches,
    step_px: int,
    sigma_max_px: float,
) -> PairShape:
    """Triangulate a pair's reference matches, reject outliers, and form triangles between the remaining points.

    Parameters
    ----------
    cameras : of the pair.
    xy : (n, 2) float64, px, the grid in the first camera's image.
    faces : (m, 3) int, triangles of the grid.
    matches : at the reference.
    step_px : spacing of the grid.
    sigma_max_px : greatest standard deviation of an accepted match.
    """
    neighbours = grid_neighbours(xy, step_px)
    xyz, sigma, status, drift = _triangulate_step(cameras, matches, matches.sigma, sigma_max_px)
    _drop(surface_outliers(neighbours, xyz), xyz, status)
    whole = _faces_without_steps(xyz, faces, cameras)
    rows = np.unique(whole)
    reference = _step_of_rows(rows, xyz, sigma, status, matches, drift)
    return PairShape(
        cameras, xy, rows, np.searchsorted(rows, whole), reference, neighbours, xyz, matches.sigma, sigma_max_px
    )


def _triangulate_step(
    cameras: tuple[Camera, Camera], matches: PairMatches, scatter: NDArray[Any], sigma_max_px: float
) -> tuple[Floats, Floats, NDArray[np.int8], float]:
    """Triangulate the matches of a step.

    scatter : (2, n, 2) px, standard deviations of the pixels. Returns positions (n, 3) mm, their standard deviations
    (n, 3) mm, status (n,) and drift, px.
    """
    with np.errstate(invalid="ignore"):
        uncertain = (matches.sigma > sigma_max_px).any(axis=(0, 2))
    status = np.where((matches.status == 0) & uncertain, LostPoint.UNCERTAIN, matches.status).astype(np.int8)
    good = status == 0
    px = np.where(good[None, :, None], matches.px, np.nan)
    system = LinearSystem.of(cameras, px)
    xyz, sigma = system.solution, linear_sigma(cameras, system, scatter)
    residuals = reprojection_residuals(cameras, xyz, px)
    drift = float(np.nanmean(residuals[0, :, 1])) if good.any() else np.nan
    _drop(good & crossing_outliers(residuals), xyz, status, LostPoint.RESIDUAL)
    xyz[status != 0] = np.nan
    return xyz, sigma, status, drift


def _drop(lost: Mask, xyz: Points, status: NDArray[np.int8], why: LostPoint = LostPoint.SURFACE) -> None:
    """Mark some points (n,) as lost for a reason, in place."""
    status[lost] = why
    xyz[lost] = np.nan


def _step_of_rows(
    rows: Indices, xyz: Points, sigma: Floats, status: NDArray[np.int8], matches: PairMatches, drift: float
) -> PairStep:
    """Step of a pair's surface, whose vertices are the rows (N,) of the matches."""
    lost = status[rows] != 0
    correlation, scatter = matches.c_ls[rows].astype(np.float32), sigma[rows].astype(np.float32)
    correlation[lost], scatter[lost] = np.nan, np.nan
    return PairStep(xyz[rows], correlation, scatter, status, drift)


def _faces_without_steps(xyz: Points, faces: NDArray[np.int32], cameras: Sequence[Camera]) -> Indices:
    """Triangles (M, 3) between measured points, turned towards the cameras, without those across a step in depth.

    A triangle whose longest edge is far longer than is usual on the grid joins two surfaces.
    """
    mesh = Mesh(xyz, faces.astype(np.int64)).without_lost()
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    mesh = Mesh(xyz, mesh.faces[longest < 4 * np.median(longest)]) if len(longest) else mesh
    middle = np.mean([camera.centre for camera in cameras], axis=0)
    return mesh.facing(middle).faces
