"""Deformation of the triangles of a surface as triangular Cosserat point elements (Solav et al. 2018, eq. 12-18).

A triangle with corners P1 P2 P3 carries the directors ``D1 = P2 - P1``, ``D2 = P3 - P1`` and its unit normal ``D3``;
the deformation gradient maps the reference directors to the current ones, so its third principal stretch is 1, along
the normal. All tensors have Cartesian components in the world frame. The Green-Lagrange strain E refers to the
reference configuration, the Euler-Almansi strain e to the current one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ringdic.arrays import Floats, Indices, Points, Vectors
from ringdic.strain import families as strain
from ringdic.strain import kernels


@dataclass(frozen=True)
class Deformation:
    """Deformation of M triangles between two configurations; NaN where a corner is lost or a triangle has no area.

    The leading axes ``...`` are those of the current positions, such as steps. Lengths are in mm, stretches and strains
    have no unit. Strains e and those derived from E and e are computed on request; other families of
    strain follow from the stretches and directions by :mod:`ringdic.strain.families`.

    F : (..., M, 3, 3) deformation gradient.
    E, e : (..., M, 3, 3) Green-Lagrange and Euler-Almansi strain.
    J, lambda1, lambda2 : (..., M) area ratio λ1 λ2 and in-plane principal stretches, λ1 ≤ λ2.
    E1, E2, e1, e2 : (..., M) in-plane principal strains, first ≤ second.
    E_magnitude, e_magnitude : (..., M) Frobenius norms of E and e.
    E_equivalent, e_equivalent : (..., M) equivalent strains √(⅔ dev:dev) of E and e.
    E_shear, e_shear : (..., M) largest in-plane shear strain, half the difference of the principal strains.
    direction1_reference, direction2_reference : (..., M, 3) unit principal directions in the reference configuration;
        the sign is arbitrary, direction 2 is normal × direction 1.
    direction1_current, direction2_current : (..., M, 3) unit principal directions in the current configuration, the
        images of the reference ones.
    directors_reference : (M, 3, 3); directors_current : (..., M, 3, 3) mm, rows D1 D2 and the unit normal.
    area : (M,) mm², reference. isotropy : (..., M) shape, 1 equilateral … 0 degenerate, current.
    normal_reference : (M, 3); normal_current : (..., M, 3), unit normals.
    """

    F: Floats
    E: Floats
    J: Floats
    lambda1: Floats
    lambda2: Floats
    E1: Floats
    E2: Floats
    direction1_reference: Vectors
    direction2_reference: Vectors
    direction1_current: Vectors
    direction2_current: Vectors
    directors_reference: Vectors
    directors_current: Vectors
    area: Floats
    isotropy: Floats

    def __post_init__(self) -> None:
        if self.F.shape[-2:] != (3, 3) or self.E.shape != self.F.shape or self.J.shape != self.F.shape[:-2]:
            raise ValueError("deformation fields of different shapes")

    @cached_property
    def e(self) -> Floats:
        """Euler-Almansi strain e, (..., M, 3, 3) without unit."""
        out = np.empty_like(self.F)
        kernels.euler_almansi(_matrices(self.directors_reference), _matrices(self.directors_current), _matrices(out))
        return out

    @property
    def e1(self) -> Floats:
        """Smaller in-plane principal value of the Euler-Almansi strain, (..., M) without unit."""
        return self.E1 / (1.0 + 2.0 * self.E1)  # e = ½ (1 - λ⁻²), monotonic in E

    @property
    def e2(self) -> Floats:
        """Larger in-plane principal value of the Euler-Almansi strain, (..., M) without unit."""
        return self.E2 / (1.0 + 2.0 * self.E2)

    @property
    def E_magnitude(self) -> Floats:
        """Frobenius norm of the Green-Lagrange strain, (..., M) without unit."""
        return strain.magnitude(self.E1, self.E2)

    @property
    def e_magnitude(self) -> Floats:
        """Frobenius norm of the Euler-Almansi strain, (..., M) without unit."""
        return strain.magnitude(self.e1, self.e2)

    @property
    def E_equivalent(self) -> Floats:
        """Equivalent strain √(⅔ dev:dev) of the Green-Lagrange strain, (..., M) without unit."""
        return strain.equivalent(self.E1, self.E2)

    @property
    def e_equivalent(self) -> Floats:
        """Equivalent strain √(⅔ dev:dev) of the Euler-Almansi strain, (..., M) without unit."""
        return strain.equivalent(self.e1, self.e2)

    @property
    def E_shear(self) -> Floats:
        """Largest in-plane shear strain of the Green-Lagrange strain, (..., M) without unit."""
        return strain.shear(self.E1, self.E2)

    @property
    def e_shear(self) -> Floats:
        """Largest in-plane shear strain of the Euler-Almansi strain, (..., M) without unit."""
        return strain.shear(self.e1, self.e2)

    @property
    def normal_reference(self) -> Vectors:
        """Normals of the reference configuration as unit vectors, (M, 3)."""
        return self.directors_reference[..., 2, :]

    @property
    def normal_current(self) -> Vectors:
        """Normals of the current configuration as unit vectors, (..., M, 3)."""
        return self.directors_current[..., 2, :]


def deformation(reference: Points, current: Points, faces: Indices) -> Deformation:
    """Deformation of the triangles of a mesh between two configurations.

    Parameters
    ----------
    reference : (N, 3) mm, world frame.
    current : (N, 3) or (F, N, 3) mm, NaN where a vertex is lost.
    faces : (M, 3) vertex indices, counter-clockwise seen from outside.
    """
    reference, current = np.asarray(reference, dtype=float), np.asarray(current, dtype=float)
    D, area = directors(reference, faces)
    d, _ = directors(current, faces)
    return deformation_of_directors(D, d, area, isotropy(current, faces))


def deformation_of_directors(D: Vectors, d: Vectors, area: Floats, isotropy: Floats) -> Deformation:
    """Deformation of surface elements from their directors in two configurations.

    Parameters
    ----------
    D, d : (M, 3, 3) and (..., M, 3, 3) mm, reference and current directors: rows D1 and D2 in the tangent plane, D3 the
        unit normal.
    area : (M,) mm², reference. isotropy : (..., M) shape, 1 equilateral … 0 degenerate. Both are passed on.
    """
    D, d = np.ascontiguousarray(D, dtype=float), np.ascontiguousarray(d, dtype=float)
    leading = d.shape[:-2]
    F, E = np.empty(d.shape), np.empty(d.shape)
    scalars, directions = np.empty((5, *leading)), np.empty((4, *leading, 3))
    kernels.fill_deformation(
        _matrices(D), _matrices(d), _matrices(F), _matrices(E), scalars.reshape(5, -1), directions.reshape(4, -1, 3)
    )
    lambda1, lambda2, J, E1, E2 = scalars
    first_reference, second_reference, first_current, second_current = directions
    return Deformation(
        F=F, E=E, J=J, lambda1=lambda1, lambda2=lambda2, E1=E1, E2=E2,
        direction1_reference=first_reference, direction2_reference=second_reference,
        direction1_current=first_current, direction2_current=second_current,
        directors_reference=D, directors_current=d, area=area, isotropy=isotropy,
    )  # fmt: skip


def directors(vertices: Points, faces: Indices) -> tuple[Vectors, Floats]:
    """Directors and areas of triangles (Solav et al. 2018, eq. 12).

    vertices : (..., N, 3) mm. faces : (M, 3) vertex indices. Returns directors (..., M, 3, 3), rows D1 and D2 along two
    edges in mm and D3 the unit normal, and areas (..., M) mm².
    """
    vertices, faces = np.ascontiguousarray(vertices, dtype=float), np.ascontiguousarray(faces)
    D, area = np.empty((*vertices.shape[:-2], len(faces), 3, 3)), np.empty((*vertices.shape[:-2], len(faces)))
    kernels.fill_directors(
        vertices.reshape(-1, *vertices.shape[-2:]), faces, D.reshape(-1, len(faces), 3, 3), area.reshape(-1, len(faces))
    )
    return D, area


def isotropy(vertices: Points, faces: Indices) -> Floats:
    """Shape of triangles: 1 for an equilateral one, 0 for a degenerate one.

    ``2 σ2/(σ2 + σ3)`` with the singular values σ1 = 0 ≤ σ2 ≤ σ3 of ``X Xᵀ/3``, X the corners about the centroid.
    vertices : (..., N, 3) mm. faces : (M, 3) vertex indices. Returns (..., M) without unit.
    """
    vertices, faces = np.ascontiguousarray(vertices, dtype=float), np.ascontiguousarray(faces)
    out = np.empty((*vertices.shape[:-2], len(faces)))
    kernels.fill_isotropy(vertices.reshape(-1, *vertices.shape[-2:]), faces, out.reshape(-1, len(faces)))
    return out


def _matrices(tensors: Floats) -> Floats:
    """Contiguous tensors (..., 3, 3) as one list (n, 3, 3), a view that shares their memory."""
    return tensors.reshape(-1, 3, 3)
