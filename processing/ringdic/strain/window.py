"""Strain over windows of a triangulated surface (virtual strain gauges), from the measured positions of its vertices.

Round the centroid of every triangle, positions are fitted by least squares as linear functions of two coordinates ``s``
in its plane: once the reference positions ``X`` and once the current positions ``x`` of the vertices in the window,

``X ≈ X0 + G0 s``,  ``x ≈ x0 + G s``.

The deformation gradient F maps the columns of G0 to those of G, and the normal of the one plane to that of the other.
Because both configurations are fitted, a rigid motion gives no strain and an affine deformation the exact one, also on
a curved surface: its heights above the plane tilt both fits alike. All strains follow from F as for a single triangle.

A window of width ``w`` holds the vertices within ``w / 2`` of the centroid that are connected to it along the mesh by a
path of about that length; vertices of another part that is merely close in space are not in it. The length over which
such a strain averages is

``L_VSG = (L_window - 1) L_step + L_subset``

with ``L_window`` the points across the window, ``L_step`` their spacing and ``L_subset`` the width of a subset
(International Digital Image Correlation Society, Good Practices Guide); here ``(L_window - 1) L_step`` is ``w``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask, Points, Vectors
from ringdic.mesh import geodesic
from ringdic.mesh.mesh import Mesh
from ringdic.strain.deformation import Deformation, deformation_of_directors, directors, isotropy

_FEWEST = 4  # points in a window: three determine the plane but leave nothing to average
_SLENDER = 0.02  # least ratio of the second moments across and along: below it the points lie about on a line


@dataclass(frozen=True)
class StrainWindow:
    """Strain windows round the centroids of all triangles of a mesh.

    mesh : the reference configuration, N vertices and M triangles. width : of the windows, mm. members : sparse (M, N),
    1 where a vertex is in the window of a triangle, else 0.
    """

    mesh: Mesh
    width: float
    members: scipy.sparse.csr_matrix

    def __post_init__(self) -> None:
        if self.members.shape != (len(self.mesh.faces), len(self.mesh.vertices)):
            raise ValueError(f"windows of shape {self.members.shape} do not go with the mesh")

    @property
    def points(self) -> Indices:
        """The number of vertices in each window, (M,)."""
        return np.diff(self.members.indptr).astype(np.int64)

    def deformation(self, current: Points, reference: Points | None = None) -> Deformation:
        """Deformation of one step over the windows, one for each of the M triangles.

        Parameters
        ----------
        current : (N, 3) mm, NaN where lost.
        reference : (N, 3) mm, NaN where lost, or None for the vertices of the mesh.

        A vertex that is lost in either is left out. The result is NaN where a corner of the triangle itself is lost, or
        where the remaining vertices of a window do not span a plane. Area and isotropy are those of the triangle.
        """
        current = np.asarray(current, dtype=float)
        reference = self.mesh.vertices if reference is None else np.asarray(reference, dtype=float)
        faces = self.mesh.faces
        triangle, area = directors(self.mesh.vertices, faces)
        whole: Mask = np.asarray(np.isfinite(np.hstack([current, reference])).all(axis=1))
        middle = np.mean(self.mesh.vertices[whole], axis=0) if whole.any() else np.zeros(3)
        X = np.where(whole[:, None], self.mesh.vertices - middle, 0.0)  # coordinates s for both fits
        a1 = triangle[:, 0] / np.linalg.norm(triangle[:, 0], axis=1, keepdims=True)
        tangents = np.stack([a1, np.cross(triangle[:, 2], a1)], axis=1)  # (M, 2, 3)
        count, mean, moment = self._moments(whole, X)
        S = np.einsum("mai,mij,mbj->mab", tangents, moment, tangents)
        usable = whole[faces].all(axis=1) & (count >= _FEWEST) & _spans_plane(S)
        inverse = np.full_like(S, np.nan)
        inverse[usable] = np.linalg.inv(S[usable])

        def plane_directors(positions: Points) -> Vectors:
            """Directors of the fitted planes (M, 3, 3): rows d1 and d2, images of the tangents, and d3 the normal."""
            Y = np.where(whole[:, None], positions - X, 0.0)  # displacements are small, so few digits are lost
            cross = self._cross_moments(X, Y, mean) + moment
            slope = np.einsum("mab,mbi,mij->maj", inverse, tangents, cross)  # rows of Gᵀ
            normal = np.cross(slope[:, 0], slope[:, 1])
            return np.concatenate([slope, (normal / np.linalg.norm(normal, axis=1, keepdims=True))[:, None]], axis=1)

        with np.errstate(invalid="ignore"):
            return deformation_of_directors(
                plane_directors(reference - middle),
                plane_directors(current - current[whole].mean(axis=0) if whole.any() else current),
                area,
                isotropy(current, faces),
            )

    def _moments(self, whole: Mask, X: Points) -> tuple[Floats, Points, Floats]:
        """Number (M,), mean (M, 3) mm and sum of central second moments (M, 3, 3) mm² of each window's measured points.

        whole : (N,). X : (N, 3) mm, 0 where not whole.
        """
        count = self.members @ whole.astype(float)
        safe = np.maximum(count, 1.0)[:, None]
        mean = (self.members @ X) / safe
        second = (self.members @ _outer(X, X)).reshape(-1, 3, 3)
        return count, mean, second - count[:, None, None] * mean[:, :, None] * mean[:, None, :]

    def _cross_moments(self, X: Points, Y: Points, mean: Points) -> Floats:
        """Sums over each window of ``(X - mean) ⊗ Y``, (M, 3, 3) mm². X, Y : (N, 3) mm. mean : (M, 3) mm."""
        second = (self.members @ _outer(X, Y)).reshape(-1, 3, 3)
        return np.asarray(second - mean[:, :, None] * (self.members @ Y)[:, None, :])


def strain_window(mesh: Mesh, width: float) -> StrainWindow:
    """Strain windows of ``width`` mm round the centroids of the triangles of the reference mesh.

    A window about as wide as the mesh's spacing holds hardly more than the three corners of the triangle and then gives
    no strain; :attr:`StrainWindow.points` counts them. Raises ValueError for a width that is not positive.
    """
    if not width > 0:
        raise ValueError(f"a strain window must have a width above 0 mm, not {width}")
    radius = 0.5 * width
    M, N = len(mesh.faces), len(mesh.vertices)
    reached = geodesic.reach(mesh, geodesic.DETOUR * radius)
    corners = scipy.sparse.csr_matrix((np.ones(3 * M), mesh.faces.ravel(), 3 * np.arange(M + 1)), (M, N))
    near = (corners @ reached).tocsr()
    row = np.repeat(np.arange(M), np.diff(near.indptr))
    with np.errstate(invalid="ignore"):
        inside = np.linalg.norm(mesh.vertices[near.indices] - mesh.centroids[row], axis=1) <= radius
    pointer = np.concatenate([[0], np.cumsum(np.bincount(row[inside], minlength=M))])
    return StrainWindow(
        mesh, float(width), scipy.sparse.csr_matrix((np.ones(pointer[-1]), near.indices[inside], pointer), (M, N))
    )


@dataclass(frozen=True)
class Gauge:
    """Virtual strain gauge: the length of surface, mm, over which one strain value averages.

    width : of the strain window, mm, 0 for a single triangle. step : median spacing of the points, mm. subset : width
    of a subset, mm.
    """

    width: float
    step: float
    subset: float

    @property
    def points_across(self) -> float:
        """Number of points across the window, ``L_window``; 2 for a single triangle."""
        return 2.0 if self.width == 0 else self.width / self.step + 1.0

    @property
    def length(self) -> float:
        """Length of the virtual strain gauge, ``L_VSG = (L_window - 1) L_step + L_subset``, mm."""
        return (self.points_across - 1.0) * self.step + self.subset


def _outer(X: Points, Y: Points) -> Floats:
    """Dyads ``X ⊗ Y`` (n, 9) of vectors (n, 3)."""
    return (X[:, :, None] * Y[:, None, :]).reshape(len(X), 9)


def _spans_plane(S: Floats) -> Mask:
    """Which windows (M,) have points that do not lie about on a line, by their second moments S (M, 2, 2)."""
    trace, determinant = S[:, 0, 0] + S[:, 1, 1], S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(determinant / (0.5 * trace) ** 2 > 4 * _SLENDER)
