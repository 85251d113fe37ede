"""Rotations by a rotation vector."""

from __future__ import annotations

import math

import numpy as np

from ringdic_node.virtual_rig.arrays import Floats


def rotation(vector: Floats) -> Floats:
    """Rotation matrix (3, 3) of a rotation vector (3,), rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    S = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * S + (1 - math.cos(angle)) * (S @ S))
