"""Strain measures as functions of the principal stretches, and invariants of a plane strain.

The families share their principal directions; they differ in the principal values. Seth-Hill (Seth 1964; Hill 1968):
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

For m ≥ 0 the tensor is usually referred to the principal directions of the reference (material) configuration, for
m < 0 to those of the current (spatial) one. The third principal value, along the normal, is 0 by the kinematics of the
triangle: the change of thickness is not measured.
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Floats, Vectors
from ringdic.strain.kernels import linear_principal

GREEN_LAGRANGE, BIOT, HENCKY, EULER_ALMANSI = 1.0, 0.5, 0.0, -1.0
_LOGARITHMIC = 1e-18  # an exponent below it gives ln λ to all digits, and products with it might underflow


def seth_hill_of_log(log: Floats, m: float) -> Floats:
    """Principal strains of the Seth-Hill family from the logarithms of the principal stretches.

    log : (..., M) ln λ. Returns ``(exp(2 m ln λ) - 1) / (2m)``, (..., M) without unit. Computed by ``expm1``, so that
    small strains keep their digits and small m approaches the logarithm smoothly.
    """
    return log if abs(m) < _LOGARITHMIC else np.expm1(2.0 * m * log) / (2.0 * m)


def magnitude(first: Floats, second: Floats) -> Floats:
    """Frobenius norm of a strain whose principal value along the normal is 0.

    first, second : (..., M) in-plane principal strains. Returns (..., M) without unit.
    """
    return np.asarray(np.sqrt(first * first + second * second))


def equivalent(first: Floats, second: Floats) -> Floats:
    """Equivalent strain ``√(⅔ dev:dev)`` of a strain whose principal value along the normal is 0.

    first, second : (..., M) in-plane principal strains. Returns (..., M) without unit.
    """
    return np.sqrt(2.0 / 3.0 * (first**2 + second**2 - (first + second) ** 2 / 3.0))


def shear(first: Floats, second: Floats) -> Floats:
    """Largest in-plane shear strain, half the difference of the principal strains.

    first, second : (..., M) in-plane principal strains, first ≤ second. Returns (..., M) without unit.
    """
    return 0.5 * (second - first)


def infinitesimal_principal(F: Floats, normal_reference: Vectors, turn: Floats | None = None) -> tuple[Floats, Floats]:
    """Principal values of the linear strain ``½ (F + Fᵀ) - I`` in the tangent plane of the reference.

    A rotation by φ gives it a strain ``cos φ - 1``: it is for small rotations only, after the rigid motion is removed.

    Parameters
    ----------
    F : (..., 3, 3) deformation gradient.
    normal_reference : (..., 3) unit normals.
    turn : (3, 3) rotation that is applied to F first, such as the inverse of the rigid motion; None for none.

    Returns
    -------
    The smaller and the larger principal strain, (...) each, without unit.
    """
    shape = F.shape[:-2]
    normal = np.ascontiguousarray(np.broadcast_to(normal_reference, (*shape, 3)))
    out = np.empty((2, *shape))
    turn = np.eye(3) if turn is None else np.ascontiguousarray(turn, dtype=float)
    tensors = np.ascontiguousarray(F, dtype=float).reshape(-1, 3, 3)
    linear_principal(turn, tensors, normal.reshape(-1, 3), out.reshape(2, -1))
    return out[0], out[1]
