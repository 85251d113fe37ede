"""Deformation of every triangle as a triangular Cosserat point element (Solav et al. 2018, eq. 12-18).

A triangle with corners P1 P2 P3 carries the directors ``D1 = P2 - P1``, ``D2 = P3 - P1`` and its unit normal ``D3``;
the deformation gradient maps the reference directors to the current ones, so its third principal stretch is 1, along
the normal. All tensors are Cartesian in the world frame; E lives in the reference, e in the current configuration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing import strain

Array = NDArray[np.float64]
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
    area : (M,) mm², reference. isotropy : (..., M) 1 equilateral … 0 degenerate, current.
    normal_reference : (M, 3); normal_current : (..., M, 3), unit.

    Other families of strain follow from the stretches and directions: :mod:`processing.strain`.
    """

    F: Array
    E: Array
    e: Array
    J: Array
    lambda1: Array
    lambda2: Array
    E1: Array
    E2: Array
    e1: Array
    e2: Array
    E_magnitude: Array
    e_magnitude: Array
    E_equivalent: Array
    e_equivalent: Array
    E_shear: Array
    e_shear: Array
    direction1_reference: Array
    direction2_reference: Array
    direction1_current: Array
    direction2_current: Array
    shear_direction_reference: Array
    shear_direction_current: Array
    area: Array
    isotropy: Array
    normal_reference: Array
    normal_current: Array

    def __post_init__(self) -> None:
        if self.F.shape[-2:] != (3, 3) or self.E.shape != self.F.shape or self.J.shape != self.F.shape[:-2]:
            raise ValueError("deformation fields of different shapes")


def deformation(reference: Array, current: Array, faces: NDArray[np.int_]) -> Deformation:
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


def of_directors(D: Array, d: Array, area: Array, isotropy: Array) -> Deformation:
    """The same from directors (..., M, 3, 3), rows D1 D2 in the tangent plane and D3 the unit normal, before and after.

    area : (M,) mm². isotropy : (..., M).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        F = np.einsum("...ki,...kj->...ij", d, _reciprocal(D))  # eq. 13
        C = np.einsum("...ki,...kj->...ij", F, F)  # eq. 14
        E = 0.5 * (C - _I)  # eq. 16
        b_inverse = _inverse_left_cauchy_green(D, d)
        e = 0.5 * (_I - b_inverse)  # eq. 17
        E1, E2, direction1, direction2 = _principal_in_plane(E, D)
        lambda1, lambda2 = np.sqrt(1.0 + 2.0 * E1), np.sqrt(1.0 + 2.0 * E2)
        e1, e2 = E1 / (1.0 + 2.0 * E1), E2 / (1.0 + 2.0 * E2)  # e = ½ (1 - λ⁻²), monotonic in E
        now1 = np.einsum("...ij,...j->...i", F, direction1) / lambda1[..., None]
        now2 = np.einsum("...ij,...j->...i", F, direction2) / lambda2[..., None]
        return Deformation(
            F=F, E=E, e=e, J=lambda1 * lambda2, lambda1=lambda1, lambda2=lambda2, E1=E1, E2=E2, e1=e1, e2=e2,
            E_magnitude=_norm(E), e_magnitude=_norm(e), E_equivalent=_equivalent(E), e_equivalent=_equivalent(e),
            E_shear=strain.shear(E1, E2), e_shear=strain.shear(e1, e2),
            direction1_reference=direction1, direction2_reference=direction2,
            direction1_current=now1, direction2_current=now2,
            shear_direction_reference=_diagonals(direction1, direction2),
            shear_direction_current=_diagonals(now1, now2),
            area=area, isotropy=isotropy, normal_reference=D[..., 2, :], normal_current=d[..., 2, :],
        )  # fmt: skip


def directors(vertices: Array, faces: NDArray[np.int_]) -> tuple[Array, Array]:
    """Directors (..., M, 3, 3), rows D1 D2 D3 (eq. 12), and areas (..., M) mm², of vertices (..., N, 3) mm."""
    corners = vertices[..., faces, :]
    D1 = corners[..., 1, :] - corners[..., 0, :]
    D2 = corners[..., 2, :] - corners[..., 0, :]
    with np.errstate(invalid="ignore"):
        cross = np.cross(D1, D2)
        length = np.linalg.norm(cross, axis=-1, keepdims=True)
        length = np.where(length > 0, length, np.nan)
        return np.stack([D1, D2, cross / length], axis=-2), 0.5 * length[..., 0]


def isotropy(vertices: Array, faces: NDArray[np.int_]) -> Array:
    """Shape of triangles, (..., M), 1 equilateral … 0 degenerate: ``2 σ2/(σ2 + σ3)`` of ``X Xᵀ/3`` about centroids."""
    corners = vertices[..., faces, :]
    X = corners - corners.mean(axis=-2, keepdims=True)
    S = np.einsum("...ki,...kj->...ij", X, X) / 3.0
    # One singular value is zero; the other two have the sum tr S and the product of S's second invariant.
    trace = np.einsum("...ii->...", S)
    product = 0.5 * (trace**2 - np.einsum("...ij,...ij->...", S, S))
    smaller = 0.5 * (trace - np.sqrt(np.maximum(trace**2 - 4.0 * product, 0.0)))
    return 2.0 * smaller / trace


def _reciprocal(D: Array) -> Array:
    """Reciprocal directors, rows, with ``D^i · D_j = δ_ij``. D : (..., 3, 3) with rows D_j."""
    D1, D2, D3 = D[..., 0, :], D[..., 1, :], D[..., 2, :]
    volume = np.einsum("...i,...i->...", np.cross(D1, D2), D3)[..., None]
    return np.stack([np.cross(D2, D3) / volume, np.cross(D3, D1) / volume, D3], axis=-2)


def _inverse_left_cauchy_green(D: Array, d: Array) -> Array:
    """``B⁻¹ = F⁻ᵀ F⁻¹`` with ``F⁻¹ = Σ D_i ⊗ d^i``, the same element seen from the current configuration."""
    F_inverse = np.einsum("...ki,...kj->...ij", D, _reciprocal(d))
    return np.einsum("...ki,...kj->...ij", F_inverse, F_inverse)


def _principal_in_plane(E: Array, D: Array) -> tuple[Array, Array, Array, Array]:
    """Principal values and unit directions of E in the plane of the reference triangle, smaller value first."""
    a1 = D[..., 0, :] / np.linalg.norm(D[..., 0, :], axis=-1, keepdims=True)
    a2 = np.cross(D[..., 2, :], a1)
    E11 = np.einsum("...i,...ij,...j->...", a1, E, a1)
    E22 = np.einsum("...i,...ij,...j->...", a2, E, a2)
    E12 = np.einsum("...i,...ij,...j->...", a1, E, a2)
    mean, half, radius = 0.5 * (E11 + E22), 0.5 * (E11 - E22), np.hypot(0.5 * (E11 - E22), E12)
    angle = 0.5 * np.arctan2(E12, half) + 0.5 * np.pi  # of the smaller principal value, from a1
    cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
    return mean - radius, mean + radius, cos * a1 + sin * a2, cos * a2 - sin * a1


def _norm(T: Array) -> Array:
    return np.sqrt(np.einsum("...ij,...ij->...", T, T))


def _equivalent(T: Array) -> Array:
    deviator = T - np.einsum("...ii->...", T)[..., None, None] / 3.0 * _I
    return np.sqrt(2.0 / 3.0) * _norm(deviator)


def _diagonals(first: Array, second: Array) -> Array:
    """The two unit lines half-way between two perpendicular unit directions, stacked on the last axis but one."""
    return np.stack([first + second, second - first], axis=-2) / np.sqrt(2.0)
