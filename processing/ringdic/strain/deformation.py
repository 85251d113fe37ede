"""Deformation of every triangle as a triangular Cosserat point element (Solav et al. 2018, eq. 12-18).

A triangle with corners P1 P2 P3 carries the directors ``D1 = P2 - P1``, ``D2 = P3 - P1`` and its unit normal ``D3``;
the deformation gradient maps the reference directors to the current ones, so its third principal stretch is 1, along
the normal. All tensors are Cartesian in the world frame; E lives in the reference, e in the current configuration.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.strain import families as strain
from ringdic.strain import kernels

_I = np.eye(3)


@dataclass(frozen=True)
class Deformation:
    """Deformation of M triangles, with any leading axes (steps). NaN where a corner is lost or the triangle is flat.

    F : (..., M, 3, 3) deformation gradient.
    E, e : (..., M, 3, 3) Green-Lagrange and Euler-Almansi strain.
    J, lambda1, lambda2 : (..., M) area ratio λ1 λ2 and in-plane principal stretches, λ1 ≤ λ2.
    E1, E2, e1, e2 : (..., M) in-plane principal strains, first ≤ second.
    E_magnitude, e_magnitude : (..., M) Frobenius norms.
    E_equivalent, e_equivalent : (..., M) √(⅔ dev:dev).
    E_shear, e_shear : (..., M) largest in-plane shear strain, ½ (second - first principal).
    direction1_reference, direction2_reference : (..., M, 3) unit principal directions in the reference configuration;
        the sign is arbitrary, direction 2 is normal × direction 1.
    direction1_current, direction2_current : (..., M, 3) the same lines in the current configuration.
    shear_direction_reference, shear_direction_current : (..., M, 2, 3) the two lines of largest shear, ± 45° from the
        principal directions of that configuration.
    directors_reference : (M, 3, 3); directors_current : (..., M, 3, 3) mm, rows D1 D2 and the unit normal.
    area : (M,) mm², reference. isotropy : (..., M) 1 equilateral … 0 degenerate, current.
    normal_reference : (M, 3); normal_current : (..., M, 3), unit.

    What few ask for follows from the rest when it is asked for.

    Other families of strain follow from the stretches and directions: :mod:`ringdic.strain.families`.
    """

    F: Floats
    E: Floats
    J: Floats
    lambda1: Floats
    lambda2: Floats
    E1: Floats
    E2: Floats
    direction1_reference: Floats
    direction2_reference: Floats
    direction1_current: Floats
    direction2_current: Floats
    directors_reference: Floats
    directors_current: Floats
    area: Floats
    isotropy: Floats

    def __post_init__(self) -> None:
        if self.F.shape[-2:] != (3, 3) or self.E.shape != self.F.shape or self.J.shape != self.F.shape[:-2]:
            raise ValueError("deformation fields of different shapes")

    @cached_property
    def e(self) -> Floats:
        """Euler-Almansi strain."""
        out = np.empty_like(self.F)
        kernels.euler_almansi(_matrices(self.directors_reference), _matrices(self.directors_current), _matrices(out))
        return out

    @property
    def e1(self) -> Floats:
        """The smaller principal value of e."""
        return self.E1 / (1.0 + 2.0 * self.E1)  # e = ½ (1 - λ⁻²), monotonic in E

    @property
    def e2(self) -> Floats:
        """The larger principal value of e."""
        return self.E2 / (1.0 + 2.0 * self.E2)

    @property
    def E_magnitude(self) -> Floats:
        """Frobenius norm of E."""
        return _norm(self.E)

    @property
    def e_magnitude(self) -> Floats:
        """Frobenius norm of e."""
        return _norm(self.e)

    @property
    def E_equivalent(self) -> Floats:
        """√(⅔ dev:dev) of E."""
        return _equivalent(self.E)

    @property
    def e_equivalent(self) -> Floats:
        """√(⅔ dev:dev) of e."""
        return _equivalent(self.e)

    @property
    def E_shear(self) -> Floats:
        """Largest in-plane shear strain of E."""
        return strain.shear(self.E1, self.E2)

    @property
    def e_shear(self) -> Floats:
        """Largest in-plane shear strain of e."""
        return strain.shear(self.e1, self.e2)

    @property
    def shear_direction_reference(self) -> Floats:
        """The two lines of largest shear in the reference configuration."""
        return _diagonals(self.direction1_reference, self.direction2_reference)

    @property
    def shear_direction_current(self) -> Floats:
        """The two lines of largest shear in the current configuration."""
        return _diagonals(self.direction1_current, self.direction2_current)

    @property
    def normal_reference(self) -> Floats:
        """Unit normals of the reference configuration."""
        return self.directors_reference[..., 2, :]

    @property
    def normal_current(self) -> Floats:
        """Unit normals of the current configuration."""
        return self.directors_current[..., 2, :]


def deformation(reference: Floats, current: Floats, faces: NDArray[np.int_]) -> Deformation:
    """Every field of the triangles ``faces`` between two configurations.

    Parameters
    ----------
    reference : (N, 3) mm, world frame.
    current : (N, 3) or (F, N, 3) mm, NaN where a vertex is lost.
    faces : (M, 3) vertex indices, counter-clockwise seen from outside.
    """
    reference, current = np.asarray(reference, dtype=float), np.asarray(current, dtype=float)
    D, area = directors(reference, faces)
    d, _ = directors(current, faces)
    return of_directors(D, d, area, isotropy(current, faces))


def of_directors(D: Floats, d: Floats, area: Floats, isotropy: Floats) -> Deformation:
    """The same from directors (..., M, 3, 3), rows D1 D2 in the tangent plane and D3 the unit normal, before and after.

    area : (M,) mm². isotropy : (..., M).
    """
    D, d = np.ascontiguousarray(D, dtype=float), np.ascontiguousarray(d, dtype=float)
    places = d.shape[:-2]
    F, E = np.empty(d.shape), np.empty(d.shape)
    scalars, directions = np.empty((5, *places)), np.empty((4, *places, 3))
    kernels.fill_deformation(
        _matrices(D), _matrices(d), _matrices(F), _matrices(E), scalars.reshape(5, -1), directions.reshape(4, -1, 3)
    )
    lambda1, lambda2, J, E1, E2 = scalars
    first, second, first_now, second_now = directions
    return Deformation(
        F=F, E=E, J=J, lambda1=lambda1, lambda2=lambda2, E1=E1, E2=E2,
        direction1_reference=first, direction2_reference=second,
        direction1_current=first_now, direction2_current=second_now,
        directors_reference=D, directors_current=d, area=area, isotropy=isotropy,
    )  # fmt: skip


def directors(vertices: Floats, faces: NDArray[np.int_]) -> tuple[Floats, Floats]:
    """Directors (..., M, 3, 3), rows D1 D2 D3 (eq. 12), and areas (..., M) mm², of vertices (..., N, 3) mm."""
    vertices, faces = _steps(vertices), np.ascontiguousarray(faces)
    D, area = np.empty((*vertices.shape[:-2], len(faces), 3, 3)), np.empty((*vertices.shape[:-2], len(faces)))
    kernels.fill_directors(
        vertices.reshape(-1, *vertices.shape[-2:]), faces, D.reshape(-1, len(faces), 3, 3), area.reshape(-1, len(faces))
    )
    return D, area


def isotropy(vertices: Floats, faces: NDArray[np.int_]) -> Floats:
    """Shape of triangles, (..., M), 1 equilateral … 0 degenerate: ``2 σ2/(σ2 + σ3)`` of ``X Xᵀ/3`` about centroids."""
    vertices, faces = _steps(vertices), np.ascontiguousarray(faces)
    out = np.empty((*vertices.shape[:-2], len(faces)))
    kernels.fill_isotropy(vertices.reshape(-1, *vertices.shape[-2:]), faces, out.reshape(-1, len(faces)))
    return out


def _steps(vertices: Floats) -> Floats:
    return np.ascontiguousarray(vertices, dtype=float)


def _matrices(tensors: Floats) -> Floats:
    """Contiguous tensors (..., 3, 3) in one row, (n, 3, 3), without a copy."""
    return tensors.reshape(-1, 3, 3)


def _norm(T: Floats) -> Floats:
    return np.sqrt(np.einsum("...ij,...ij->...", T, T))


def _equivalent(T: Floats) -> Floats:
    deviator = T - np.einsum("...ii->...", T)[..., None, None] / 3.0 * _I
    return np.sqrt(2.0 / 3.0) * _norm(deviator)


def _diagonals(first: Floats, second: Floats) -> Floats:
    """The two unit lines half-way between two perpendicular unit directions, stacked on the last axis but one."""
    return np.stack([first + second, second - first], axis=-2) / np.sqrt(2.0)
