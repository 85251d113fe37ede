"""Strain over a window of the surface: a virtual strain gauge on the mesh, from positions that are already known.

Round the centre of every triangle, positions are fitted by least squares as linear functions of the two coordinates
``s`` in its plane, once the reference positions ``X`` and once the current ones ``x`` of the same vertices:

``X ≈ X0 + G0 s``,  ``x ≈ x0 + G s``,  and F takes the columns of G0 to those of G and the normal to the normal.

Fitting both makes a rigid motion free of strain and an affine deformation exact, however curved the surface: heights
above the plane lean both fits alike. All strains follow from F as for a single triangle.

A window of width ``w`` takes the vertices within ``w / 2`` of the centre that can be reached along the mesh on a path
of about that length, so not those of another part that is merely close in space. What one such strain averages over is

``L_VSG = (L_window - 1) L_step + L_subset``

with ``L_window`` the points across the window, ``L_step`` their spacing and ``L_subset`` the width of a subset
(International Digital Image Correlation Society, Good Practices Guide); here ``(L_window - 1) L_step`` is ``w``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask
from ringdic.mesh import geodesic
from ringdic.mesh.mesh import Mesh
from ringdic.strain.deformation import Deformation, directors, isotropy, of_directors

_FEWEST = 4  # points of a window; three determine the plane and say nothing of its fit
_SLENDER = 0.02  # smallest ratio of the second moments along and across: below it, the points lie on a line


@dataclass(frozen=True)
class StrainWindow:
    """The windows of all triangles of a mesh.

    mesh : the reference, N vertices, M triangles. width : mm. members : (M, N) sparse, 1 where a vertex belongs to
    the window of a triangle.
    """

    mesh: Mesh
    width: float
    members: scipy.sparse.csr_matrix

    def __post_init__(self) -> None:
        if self.members.shape != (len(self.mesh.faces), len(self.mesh.vertices)):
            raise ValueError(f"windows of shape {self.members.shape} do not go with the mesh")

    @property
    def points(self) -> Indices:
        """Number of vertices in each window, (M,)."""
        return np.diff(self.members.indptr).astype(np.int64)

    def deformation(self, current: Floats, reference: Floats | None = None) -> Deformation:
        """Every deformation field of one step over the windows, one for each triangle.

        current, reference : (N, 3) mm, NaN where lost; the reference is the mesh's own unless given. A vertex that is
        lost in either takes no part; the field is NaN where a corner of the triangle itself is lost, or where what is
        left of a window does not span a plane. Area and isotropy are the triangle's own.
        """
        current = np.asarray(current, dtype=float)
        reference = self.mesh.vertices if reference is None else np.asarray(reference, dtype=float)
        faces = self.mesh.faces
        own, area = directors(self.mesh.vertices, faces)
        whole: Mask = np.asarray(np.isfinite(np.hstack([current, reference])).all(axis=1))
        middle = np.mean(self.mesh.vertices[whole], axis=0) if whole.any() else np.zeros(3)
        X = np.where(whole[:, None], self.mesh.vertices - middle, 0.0)  # the mesh's coordinates serve both fits
        a1 = own[:, 0] / np.linalg.norm(own[:, 0], axis=1, keepdims=True)
        tangents = np.stack([a1, np.cross(own[:, 2], a1)], axis=1)  # (M, 2, 3)
        count, mean, moment = self._moments(whole, X)
        S = np.einsum("mai,mij,mbj->mab", tangents, moment, tangents)
        usable = whole[faces].all(axis=1) & (count >= _FEWEST) & _spans_plane(S)
        inverse = np.full_like(S, np.nan)
        inverse[usable] = np.linalg.inv(S[usable])

        def fitted(positions: Floats) -> Floats:
            """Directors of the fitted plane (M, 3, 3): rows d1 d2 along the tangents, d3 the normal."""
            Y = np.where(whole[:, None], positions - X, 0.0)  # the rest beside the reference: few digits are lost
            cross = self._cross_moments(X, Y, count, mean) + moment
            slope = np.einsum("mab,mbi,mij->maj", inverse, tangents, cross)  # rows of Gᵀ
            normal = np.cross(slope[:, 0], slope[:, 1])
            return np.concatenate([slope, (normal / np.linalg.norm(normal, axis=1, keepdims=True))[:, None]], axis=1)

        with np.errstate(invalid="ignore"):
            return of_directors(
                fitted(reference - middle), fitted(current - current[whole].mean(axis=0) if whole.any() else current),
                area, isotropy(current, faces),
            )  # fmt: skip

    def _moments(self, whole: Mask, X: Floats) -> tuple[Floats, Floats, Floats]:
        """Number (M,), mean (M, 3) and second central moment (M, 3, 3) of the points of each window, sums over them."""
        count = self.members @ whole.astype(float)
        safe = np.maximum(count, 1.0)[:, None]
        mean = (self.members @ X) / safe
        second = (self.members @ _outer(X, X)).reshape(-1, 3, 3)
        return count, mean, second - count[:, None, None] * mean[:, :, None] * mean[:, None, :]

    def _cross_moments(self, X: Floats, Y: Floats, count: Floats, mean: Floats) -> Floats:
        """Sums over each window of ``(X - mean) ⊗ Y``, (M, 3, 3)."""
        second = (self.members @ _outer(X, Y)).reshape(-1, 3, 3)
        return np.asarray(second - mean[:, :, None] * (self.members @ Y)[:, None, :])


def strain_window(mesh: Mesh, width: float) -> StrainWindow:
    """The windows of ``width`` mm round the centres of the triangles of the reference mesh.

    Raises ValueError for a width that is not positive. A window of a width near the mesh's spacing holds hardly more
    than the triangle's own corners, and then has no strain: :attr:`StrainWindow.points` tells.
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
    """What a strain averages over, mm: ``length = across + subset``.

    width : of the window, 0 for the triangle alone. step : usual spacing of the points. subset : width of a subset.
    """

    width: float
    step: float
    subset: float

    @property
    def points_across(self) -> float:
        """``L_window``: a triangle has two points across."""
        return 2.0 if self.width == 0 else self.width / self.step + 1.0

    @property
    def length(self) -> float:
        """``L_VSG = (L_window - 1) L_step + L_subset``, mm."""
        return (self.points_across - 1.0) * self.step + self.subset


def _outer(X: Floats, Y: Floats) -> Floats:
    return (X[:, :, None] * Y[:, None, :]).reshape(len(X), 9)


def _spans_plane(S: Floats) -> Mask:
    """Whether points with second moments S (M, 2, 2) are spread in both directions."""
    trace, determinant = S[:, 0, 0] + S[:, 1, 1], S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(determinant / (0.5 * trace) ** 2 > 4 * _SLENDER)
