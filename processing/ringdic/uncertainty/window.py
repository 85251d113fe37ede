"""Standard deviations of the stretches over a strain window from those of the displacements.

Let N be a unit vector in the plane of the window and m the unit vector of its current direction. Displacements δu_j of
the points of the window change the stretch along N by ``δλ = Σ_j w_j m · δu_j`` with ``w_j = (S⁻¹ s_j) · N``, where s_j
are the coordinates of the points in the plane about their mean and ``S = Σ_j s_j s_jᵀ``. Neighbouring subsets share
pixels, so their errors have a correlation coefficient ρ that depends on their distance, and

``var λ = (Σ_i m_i² σ_i²) N · S⁻¹ K S⁻¹ N``,  ``K = Σ_jk ρ_jk s_j s_kᵀ``.

S and K depend on the mesh alone and are computed once. σ_i, the standard deviation of component i of the displacements,
is taken as constant over a window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Points, Vectors
from ringdic.mesh.mesh import Mesh
from ringdic.strain.deformation import Deformation, directors
from ringdic.strain.window import StrainWindow

_BLOCK = 10_000  # windows at a time, which bounds the memory


@dataclass(frozen=True)
class WindowScatter:
    """Propagation of the variance of displacements to that of stretches in the windows of M triangles.

    faces : (M, 3) vertex indices. tangents : (M, 2, 3) unit vectors in the plane of each triangle. gain : (M, 2, 2)
    mm⁻², the matrix ``S⁻¹ K S⁻¹`` in the basis of the tangents; NaN where the points of a window lie on a line.
    """

    faces: Indices
    tangents: Vectors
    gain: Floats

    def stretch_sigma(self, deformed: Deformation, sigma: Floats) -> Floats:
        """Standard deviations (M, 2) of the stretches λ1 and λ2 over the windows at one step; NaN where not measured.

        deformed : the deformation over the windows. sigma : (N, 3) mm, of the displacements, due to noise.
        """
        before = np.stack([deformed.direction1_reference, deformed.direction2_reference], axis=1)  # (M, 2, 3)
        after = np.stack([deformed.direction1_current, deformed.direction2_current], axis=1)
        with np.errstate(invalid="ignore"):
            variance = (sigma**2)[self.faces].mean(axis=1)
            N = np.einsum("mki,mai->mka", before, self.tangents)
            gain = np.einsum("mka,mab,mkb->mk", N, self.gain, N)
            return np.asarray(np.sqrt(gain * np.einsum("mki,mi->mk", after**2, variance)))


def window_scatter(window: StrainWindow, correlation: Callable[[Floats], Floats], reach: float) -> WindowScatter:
    """Compute the propagation of the displacements' variance to the stretches in the strain windows of a mesh.

    correlation : correlation coefficients (n,) of the errors of two points, as a function of their distances (n,), mm.
    reach : distance from which on the correlation is 0, mm.
    """
    mesh = window.mesh
    D, _ = directors(mesh.vertices, mesh.faces)
    first = D[:, 0] / np.linalg.norm(D[:, 0], axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(D[:, 2], first)], axis=1)
    R = _correlations(mesh, correlation, reach)
    gain = np.full((len(mesh.faces), 2, 2), np.nan)
    for start in range(0, len(mesh.faces), _BLOCK):
        block = slice(start, min(start + _BLOCK, len(mesh.faces)))
        s = _coordinates(window.members[block], mesh.vertices, tangents[block])
        correlated = [part @ R for part in s]
        S, K = (np.array([[_row_sums(a, b) for b in s] for a in whose]) for whose in (s, correlated))  # (2, 2, m)
        S, K = np.moveaxis(S, -1, 0), np.moveaxis(K, -1, 0)
        spans = (window.points[block] > 2) & (np.linalg.det(S) > 1e-9 * np.trace(S, axis1=1, axis2=2) ** 2)
        inverse = np.linalg.inv(S[spans])
        gain[np.arange(block.start, block.stop)[spans]] = inverse @ K[spans] @ inverse
    return WindowScatter(mesh.faces, tangents, gain)


def _coordinates(
    members: scipy.sparse.csr_matrix, vertices: Points, tangents: Vectors
) -> list[scipy.sparse.csr_matrix]:
    """Both tangential coordinates of the points of each window about their mean, mm, each a sparse (m, N) matrix.

    members : (m, N) sparse, which vertices each window has. vertices : (N, 3) mm. tangents : (m, 2, 3).
    """
    row = np.repeat(np.arange(members.shape[0]), np.diff(members.indptr))
    count = np.maximum(np.diff(members.indptr), 1)
    coordinates = []
    for a in range(2):
        along = np.einsum("ki,ki->k", vertices[members.indices], tangents[row, a])
        mean = np.bincount(row, along, members.shape[0]) / count
        coordinates.append(scipy.sparse.csr_matrix((along - mean[row], members.indices, members.indptr), members.shape))
    return coordinates


def _correlations(mesh: Mesh, correlation: Callable[[Floats], Floats], reach: float) -> scipy.sparse.csr_matrix:
    """Correlation coefficients (N, N), sparse, of the errors of all pairs of vertices of a mesh."""
    N = len(mesh.vertices)
    finite = np.flatnonzero(np.isfinite(mesh.vertices).all(axis=1))
    i, j = finite[scipy.spatial.cKDTree(mesh.vertices[finite]).query_pairs(reach, output_type="ndarray")].T
    rho = correlation(np.linalg.norm(mesh.vertices[i] - mesh.vertices[j], axis=1))
    upper = scipy.sparse.csr_matrix((rho, (i, j)), (N, N))
    return scipy.sparse.csr_matrix(upper + upper.T + scipy.sparse.identity(N, format="csr"))


def _row_sums(a: scipy.sparse.csr_matrix, b: scipy.sparse.csr_matrix) -> Floats:
    """Sums (m,) over the rows of the elementwise product of two sparse matrices (m, N)."""
    return np.asarray(a.multiply(b).sum(axis=1), dtype=float).ravel()
