"""The rigid part of a motion, by least squares, and the motion without it (Kabsch 1976; Umeyama 1991)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats


@dataclass(frozen=True)
class RigidMotion:
    """``x -> R x + t``. R : (3, 3) proper rotation; t : (3,) mm."""

    R: Floats
    t: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "R", np.asarray(self.R, dtype=float).reshape(3, 3))
        object.__setattr__(self, "t", np.asarray(self.t, dtype=float).reshape(3))

    def apply(self, xyz: Floats) -> Floats:
        """Moved points, (..., 3) mm."""
        x, y, z = np.moveaxis(np.asarray(xyz, dtype=float), -1, 0)  # a product with so small a matrix is slower
        return np.stack([x * a + y * b + z * c + t for (a, b, c), t in zip(self.R, self.t, strict=True)], axis=-1)

    def rotate(self, directions: Floats) -> Floats:
        """Turned directions, (..., 3); the translation does not act on them."""
        return np.asarray(directions, dtype=float) @ self.R.T

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad, from 0 to π."""
        sine = 0.5 * np.linalg.norm(
            [self.R[2, 1] - self.R[1, 2], self.R[0, 2] - self.R[2, 0], self.R[1, 0] - self.R[0, 1]]
        )
        return float(np.arctan2(sine, 0.5 * (np.trace(self.R) - 1.0)))


def kabsch(source: Floats, destination: Floats, weights: Floats | None = None) -> RigidMotion:
    """The rigid motion that takes ``source`` to ``destination`` with the least sum of squared distances.

    Parameters
    ----------
    source, destination : (n, 3) mm; a point that is NaN in either takes no part.
    weights : (n,) without unit, or None for equal weights.

    Raises
    ------
    ValueError : fewer than three common points.
    """
    source, destination = np.asarray(source, dtype=float), np.asarray(destination, dtype=float)
    weights = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=float)
    common = np.isfinite(source).all(axis=1) & np.isfinite(destination).all(axis=1) & (weights > 0)
    if common.sum() < 3:
        raise ValueError(f"a rigid motion needs three points common to both sets; here are {common.sum()}")
    p, q, w = source[common], destination[common], weights[common] / weights[common].sum()
    p_mean, q_mean = w @ p, w @ q
    U, _, Vt = np.linalg.svd((p - p_mean).T @ ((q - q_mean) * w[:, None]))
    reflection = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = Vt.T @ np.diag([1.0, 1.0, reflection]) @ U.T
    return RigidMotion(R, q_mean - R @ p_mean)


def motion_to_reference(reference: Floats, current: Floats, weights: Floats | None = None) -> RigidMotion:
    """The motion that takes the current configuration back onto the reference; identity if too few points remain.

    reference, current : (n, 3) mm. ``motion.apply(current) - reference`` is the displacement without rigid motion.
    """
    try:
        return kabsch(current, reference, weights)
    except ValueError:
        return RigidMotion(np.eye(3), np.zeros(3))
