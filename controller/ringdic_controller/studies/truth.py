"""Measured results compared with the exact truth of the virtual rig: shape, displacement, stretch, coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from ringdic.arrays import Floats, Mask
from ringdic.results.results import Results
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.scenes import Cylinder, Limb, Specimen

Surface = Cylinder | Limb

TURN = 2 * np.pi
_CELL = 0.5  # mm of the grid on which areas are counted
_SHIFT = 4  # fractional bits of a corner's position in cells, for cv2.fillConvexPoly


@dataclass(frozen=True)
class Errors:
    """Errors, measured minus true, of the results of one surface.

    theta, z : (N,) material coordinates of the vertices, rad and mm. distance : (N,) of the reference vertices from
    the true surface, outside positive, mm. displacement : (F, N, 3) mm, NaN where lost.
    stretches : (F, M, 2) of λ1, λ2, NaN where lost.
    """

    theta: Floats
    z: Floats
    distance: Floats
    displacement: Floats
    stretches: Floats


def errors(results: Results, surface: Surface, steps: Sequence[int] | None = None) -> Errors:
    """Errors of every vertex and triangle of the results against the formulas of the true surface.

    The material point of a vertex is the point of the true reference surface nearest to it.

    steps : step of the surface for each step of the results, the first 0; None if both are numbered alike.
    """
    steps = range(len(results.steps)) if steps is None else steps
    theta, z, distance = surface.material_coordinates(results.vertices_ref)
    reference = surface.position(theta, z, 0)
    middles = face_centroids(theta, z, results.faces)
    displacement, stretches = np.empty((len(steps), len(theta), 3)), np.empty((len(steps), len(results.faces), 2))
    for k, step in enumerate(steps):
        moved = surface.position(theta, z, step) - reference
        displacement[k] = results.vertices[k] - results.vertices_ref - moved
        true = surface.stretches(*middles, step)
        measured = results.deformation(k)
        stretches[k] = np.stack([measured.lambda1 - true[0], measured.lambda2 - true[1]], axis=1)
    return Errors(theta, z, distance, displacement, stretches)


def face_centroids(theta: Floats, z: Floats, faces: NDArray[np.integer]) -> tuple[Floats, Floats]:
    """Material coordinates of the centroids of triangles, theta (M,) rad and z (M,) mm.

    theta, z : (N,) rad and mm, of the vertices. faces : (M, 3); a triangle may span the seam at theta = 0.
    """
    corners = theta[faces]
    corners = corners[:, :1] + np.mod(corners - corners[:, :1] + np.pi, TURN) - np.pi
    return corners.mean(axis=1), z[faces].mean(axis=1)


@dataclass(frozen=True)
class SurfaceGrid:
    """The speckled band of a specimen, divided into cells of material coordinates, to measure areas.

    theta, z : (rows, columns) rad and mm, middles of the cells; z grows with the row. area : (rows, columns) mm², of
    each cell in the reference.
    """

    specimen: Specimen
    theta: Floats
    z: Floats
    area: Floats

    @classmethod
    def of(cls, specimen: Specimen) -> SurfaceGrid:
        """The grid over the speckled band of a specimen, in cells of about half a millimetre."""
        low, high = specimen.band
        across, along = round(TURN * 57.0 / _CELL), round((high - low) / _CELL)
        theta, z = np.meshgrid(
            (np.arange(across) + 0.5) * TURN / across, low + (np.arange(along) + 0.5) * (high - low) / along
        )
        tangents = specimen.surface.tangents(theta, z, 0)
        area = np.linalg.norm(np.cross(tangents[..., 0, :], tangents[..., 1, :]), axis=-1)
        return cls(specimen, theta, z, area * TURN / across * (high - low) / along)

    def views(self, cameras: Sequence[VirtualCamera], incidence_deg: float = 60.0) -> tuple[Mask, Mask]:
        """Which cameras see each cell at the specimen's step, inside their image and below an angle of incidence.

        Returns two arrays (C, rows, columns) of bool: whether a camera sees the cell, and whether nothing spoils that
        view (no bar, no reflection, no worn speckles).
        """
        step, damage = self.specimen.step, self.specimen.damage
        xyz = self.specimen.surface.position(self.theta, self.z, step).reshape(-1, 3)
        tangents = self.specimen.surface.tangents(self.theta, self.z, step).reshape(-1, 2, 3)
        normals = np.cross(tangents[:, 0], tangents[:, 1])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        visible = np.zeros((len(cameras), len(xyz)), dtype=bool)
        clean = visible.copy()
        for k, camera in enumerate(cameras):
            towards = camera.centre - xyz
            cosine = np.sum(normals * towards, axis=1) / np.linalg.norm(towards, axis=1)
            facing = np.flatnonzero(cosine > np.cos(np.radians(incidence_deg)))
            px = camera.project(xyz[facing])
            inside = facing[(px > 0).all(axis=1) & (px < [camera.width - 1, camera.height - 1]).all(axis=1)]
            visible[k, inside] = True
            clean[k, inside] = ~damage.spoilt(camera.centre, xyz[inside], normals[inside])
        clean &= ~damage.worn(self.theta, self.z).ravel()
        return visible.reshape(-1, *self.theta.shape), clean.reshape(-1, *self.theta.shape)

    def covered(self, theta: Floats, z: Floats, faces: NDArray[np.integer]) -> Mask:
        """Which cells lie under the triangles of a mesh, (rows, columns) bool.

        theta, z : (N,) rad and mm, material coordinates of the vertices. faces : (M, 3).
        """
        picture = np.zeros(self.theta.shape, np.uint8)
        rows, columns = len(self.z), len(self.z[0])
        low, high = self.specimen.band
        corners = theta[faces]
        corners = corners[:, :1] % TURN + (corners - corners[:, :1] + np.pi) % TURN - np.pi
        y = (z[faces] - low) * rows / (high - low) - 0.5
        for turn in (-TURN, 0.0, TURN):
            x = (corners + turn) * columns / TURN - 0.5
            near = (x.max(axis=1) > -1) & (x.min(axis=1) < columns)
            for triangle in np.rint(np.stack([x[near], y[near]], axis=-1) * 2**_SHIFT).astype(np.int32):
                cv2.fillConvexPoly(picture, triangle, 255, shift=_SHIFT)
        return picture > 0
