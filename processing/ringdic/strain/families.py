"""Families of strain as functions of the principal stretches.

Every family gives the same principal directions; only the scale along them differs. Seth-Hill (Seth 1964; Hill 1968):
``(λ^(2m) - 1) / (2m)``, and ``ln λ`` for m = 0.

=====  =======================  ====================
m      family                   principal value
=====  =======================  ====================
1      Green-Lagrange           ``(λ² - 1) / 2``
½      Biot                     ``λ - 1``
0      Hencky (logarithmic)     ``ln λ``
-½     Hill                     ``1 - 1/λ``
-1     Euler-Almansi            ``(1 - λ⁻²) / 2``
=====  =======================  ====================

For m ≥ 0 the tensor is usually drawn on the directions of the reference (material) configuration, for m < 0 on those of
the current (spatial) one. The third principal value, along the normal, is 0 by the kinematics of the triangle: what the
surface does in thickness is not measured.
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Floats
from ringdic.strain.kernels import linear_principal

GREEN_LAGRANGE, BIOT, HENCKY, EULER_ALMANSI = 1.0, 0.5, 0.0, -1.0
_LOGARITHMIC = 1e-18  # an exponent below it changes no digit of the logarithm, and products with it may underflow


def seth_hill(stretch: Floats, m: float) -> Floats:
    """Principal strain of the Seth-Hill family with exponent ``m``, of principal stretches of any shape.

    Written with ``expm1``: small strains keep their digits, and small m runs smoothly into the logarithm.
    """
    return seth_hill_of_log(np.log(stretch), m)


def seth_hill_of_log(log: Floats, m: float) -> Floats:
    """The same of the logarithms of stretches."""
    return log if abs(m) < _LOGARITHMIC else np.expm1(2.0 * m * log) / (2.0 * m)


def bazant(stretch: Floats, m: float) -> Floats:
    """Bažant's (1998) symmetric family ``(λ^m - λ^-m) / (2m)``: opposite for inverse stretches; ``ln λ`` for m = 0."""
    log = np.log(stretch)
    return log if abs(m) < _LOGARITHMIC else np.sinh(m * log) / m


def magnitude(first: Floats, second: Floats) -> Floats:
    """Frobenius norm of the tensor with these in-plane principal values and none along the normal."""
    return np.asarray(np.sqrt(first * first + second * second))


def equivalent(first: Floats, second: Floats) -> Floats:
    """Equivalent strain ``√(⅔ dev:dev)`` of the same tensor."""
    return np.sqrt(2.0 / 3.0 * (first**2 + second**2 - (first + second) ** 2 / 3.0))


def shear(first: Floats, second: Floats) -> Floats:
    """Largest in-plane shear strain of the tensor, half the difference of its principal values."""
    return 0.5 * (second - first)


def tensor(first: Floats, second: Floats, direction1: Floats, direction2: Floats) -> Floats:
    """The Cartesian tensor (..., 3, 3) of principal values (...) along unit directions (..., 3)."""
    return first[..., None, None] * _square(direction1) + second[..., None, None] * _square(direction2)


def infinitesimal(F: Floats, normal_reference: Floats) -> Floats:
    """Linear strain ``½ (F + Fᵀ) - I`` in the tangent plane of the reference, (..., 3, 3).

    It takes a rotation for strain (``cos φ - 1``): remove the rigid motion first, and use it for small rotations only.
    F : (..., 3, 3). normal_reference : (..., 3) unit.
    """
    in_plane = np.eye(3) - _square(normal_reference)
    linear = 0.5 * (F + np.swapaxes(F, -1, -2)) - np.eye(3)
    return np.asarray(in_plane @ linear @ in_plane)


def infinitesimal_principal(F: Floats, normal_reference: Floats, turn: Floats | None = None) -> tuple[Floats, Floats]:
    """Principal values (...), first ≤ second, of the same tensor, after a rotation (3, 3) if there is one."""
    shape = F.shape[:-2]
    normal = np.ascontiguousarray(np.broadcast_to(normal_reference, (*shape, 3)))
    out = np.empty((2, *shape))
    turn = np.eye(3) if turn is None else np.ascontiguousarray(turn, dtype=float)
    tensors = np.ascontiguousarray(F, dtype=float).reshape(-1, 3, 3)
    linear_principal(turn, tensors, normal.reshape(-1, 3), out.reshape(2, -1))
    return out[0], out[1]


def _square(direction: Floats) -> Floats:
    return direction[..., :, None] * direction[..., None, :]
