"""Least-squares rigid motion between two sets of points (Kabsch 1976; Umeyama 1991)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Points, Vectors


@dataclass(frozen=True)
class RigidMotion:
    """A rigid motion ``x -> R x + t``. R : (3, 3) proper rotation, without unit. t : (3,) translation, mm."""

    R: Floats
    t: Vectors

    def __post_init__(self) -> None:
        object.__setattr__(self, "R", np.asarray(self.R, dtype=float).reshape(3, 3))
        object.__setattr__(self, "t", np.asarray(self.t, dtype=float).reshape(3))

    def apply(self, xyz: Points) -> Points:
        """Positions ``R x + t`` of points after the motion. xyz : (..., 3) mm. Returns (..., 3) mm."""
        x, y, z = np.moveaxis(np.asarray(xyz, dtype=float), -1, 0)  # a matrix product is slower for so small a matrix
        return np.stack([x * a + y * b + z * c + t for (a, b, c), t in zip(self.R, self.t, strict=True)], axis=-1)

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad, from 0 to π."""
        sine = 0.5 * np.linalg.norm(
            [self.R[2, 1] - self.R[1, 2], self.R[0, 2] - self.R[2, 0], self.R[1, 0] - self.R[0, 1]]
        )
        return float(np.arctan2(sine, 0.5 * (np.trace(self.R) - 1.0)))


def kabsch(source: Points, destination: Points) -> RigidMotion:
    """Rigid motion that takes points ``source`` to ``destination`` with the least sum of squared distances.

    source, destination : (n, 3) mm; a point that is NaN in either is ignored. Raises ValueError for fewer than three
    common points.
    """
    source, destination = np.asarray(source, dtype=float), np.asarray(destination, dtype=float)
    common = np.isfinite(source).all(axis=1) & np.isfinite(destination).all(axis=1)
    if common.sum() < 3:
        raise ValueError(f"a rigid motion needs three points common to both sets; here are {common.sum()}")
    p, q = source[common], destination[common]
    p_mean, q_mean = p.mean(axis=0), q.mean(axis=0)
    U, _, Vt = np.linalg.svd((p - p_mean).T @ (q - q_mean))
    reflection = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = Vt.T @ np.diag([1.0, 1.0, reflection]) @ U.T
    return RigidMotion(R, q_mean - R @ p_mean)


def motion_to_reference(reference: Points, current: Points) -> RigidMotion:
    """Least-squares rigid motion that takes the current configuration back onto the reference.

    reference, current : (n, 3) mm, NaN where lost.

    ``motion.apply(current) - reference`` is the displacement without rigid motion. The identity is returned where fewer
    than three points are common to both.
    """
    try:
        return kabsch(current, reference)
    except ValueError:
        return RigidMotion(np.eye(3), np.zeros(3))
