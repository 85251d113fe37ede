"""From the scatter of displacements to the scatter of stretches over a strain window.

The stretch along a unit vector N of the window's plane, with the unit vector m that it is turned into, moves by
``δλ = Σ_j w_j m · δu_j`` over the points of the window, ``w = (S⁻¹ s_j) · N`` with the coordinates s of the points
about their mean and ``S = Σ s sᵀ``. Neighbouring subsets share pixels, so their errors are alike by ρ of their distance
and

``var λ = (Σ_i m_i² σ_i²) N · S⁻¹ K S⁻¹ N``,  ``K = Σ_jk ρ_jk s_j s_kᵀ``.

S and K belong to the mesh and are found once; σ, per component of the world, changes little over a window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices
from ringdic.mesh.mesh import Mesh
from ringdic.strain.deformation import Deformation, directors
from ringdic.strain.window import StrainWindow

_BLOCK = 10_000  # windows at a time, which bounds the memory


@dataclass(frozen=True)
class WindowScatter:
    """How the scatter of displacements becomes that of stretches in the windows of M triangles.

    faces : (M, 3). tangents : (M, 2, 3) unit vectors in the plane of each triangle. gain : (M, 2, 2) mm⁻²,
    ``S⁻¹ K S⁻¹`` in them; NaN where a window spans no plane.
    """

    faces: Indices
    tangents: Floats
    gain: Floats

    def stretch_sigma(self, found: Deformation, sigma: Floats) -> Floats:
        """Standard deviations (M, 2) of λ1 and λ2 over the windows at one step; NaN where not measured.

        found : the deformation over the windows. sigma : (N, 3) mm, of the displacements, by noise.
        """
        before = np.stack([found.direction1_reference, found.direction2_reference], axis=1)  # (M, 2, 3)
        after = np.stack([found.direction1_current, found.direction2_current], axis=1)
        with np.errstate(invalid="ignore"):
            variance = (sigma**2)[self.faces].mean(axis=1)
            N = np.einsum("mki,mai->mka", before, self.tangents)
            gain = np.einsum("mka,mab,mkb->mk", N, self.gain, N)
            return np.asarray(np.sqrt(gain * np.einsum("mki,mi->mk", after**2, variance)))


def window_scatter(window: StrainWindow, alike: Callable[[Floats], Floats], reach: float) -> WindowScatter:
    """The scatter of a mesh's windows.

    alike : correlation of the errors of two points at a distance, mm. reach : mm, beyond which it is 0.
    """
    mesh = window.mesh
    D, _ = directors(mesh.vertices, mesh.faces)
    first = D[:, 0] / np.linalg.norm(D[:, 0], axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(D[:, 2], first)], axis=1)
    R = _correlation(mesh, alike, reach)
    gain = np.full((len(mesh.faces), 2, 2), np.nan)
    for start in range(0, len(mesh.faces), _BLOCK):
        block = slice(start, min(start + _BLOCK, len(mesh.faces)))
        s = _coordinates(window.members[block], mesh.vertices, tangents[block])
        felt = [part @ R for part in s]
        S, K = (np.array([[_row_sums(a, b) for b in s] for a in whose]) for whose in (s, felt))  # (2, 2, m)
        S, K = np.moveaxis(S, -1, 0), np.moveaxis(K, -1, 0)
        spans = (window.points[block] > 2) & (np.linalg.det(S) > 1e-9 * np.trace(S, axis1=1, axis2=2) ** 2)
        inverse = np.linalg.inv(S[spans])
        gain[np.arange(block.start, block.stop)[spans]] = inverse @ K[spans] @ inverse
    return WindowScatter(mesh.faces, tangents, gain)


def _coordinates(members: scipy.sparse.csr_matrix, vertices: Floats, tangents: Floats) -> list[scipy.sparse.csr_matrix]:
    """Both tangential coordinates of the points of each window about their mean, as sparse (m, N)."""
    row = np.repeat(np.arange(members.shape[0]), np.diff(members.indptr))
    count = np.maximum(np.diff(members.indptr), 1)
    found = []
    for a in range(2):
        along = np.einsum("ki,ki->k", vertices[members.indices], tangents[row, a])
        mean = np.bincount(row, along, members.shape[0]) / count
        found.append(scipy.sparse.csr_matrix((along - mean[row], members.indices, members.indptr), members.shape))
    return found


def _correlation(mesh: Mesh, alike: Callable[[Floats], Floats], reach: float) -> scipy.sparse.csr_matrix:
    """Correlations (N, N), sparse, of the errors of all points of a mesh."""
    N = len(mesh.vertices)
    finite = np.flatnonzero(np.isfinite(mesh.vertices).all(axis=1))
    i, j = finite[scipy.spatial.cKDTree(mesh.vertices[finite]).query_pairs(reach, output_type="ndarray")].T
    rho = alike(np.linalg.norm(mesh.vertices[i] - mesh.vertices[j], axis=1))
    upper = scipy.sparse.csr_matrix((rho, (i, j)), (N, N))
    return scipy.sparse.csr_matrix(upper + upper.T + scipy.sparse.identity(N, format="csr"))


def _row_sums(a: scipy.sparse.csr_matrix, b: scipy.sparse.csr_matrix) -> Floats:
    return np.asarray(a.multiply(b).sum(axis=1), dtype=float).ravel()
