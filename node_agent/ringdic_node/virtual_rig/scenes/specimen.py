"""Speckled bodies whose motion is a formula: a rigid cylinder and a limb that bulges, twists, stretches and bends.

Material points are named by (theta, z) of the reference configuration, step 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from ringdic_node.virtual_rig import body
from ringdic_node.virtual_rig.arrays import Floats
from ringdic_node.virtual_rig.scenes.damage import Damage
from ringdic_node.virtual_rig.texture import RADIUS


class _Surface(ABC):
    """A body of material points: positions, tangents and stretches at a step. theta in rad, z in mm, of one shape."""

    @abstractmethod
    def parameters(self, step: int) -> Floats:
        """Parameters of the surface at a step, (6,), as `ringdic_node.virtual_rig.body` defines them; mm."""

    def position(self, theta: Floats, z: Floats, step: int) -> Floats:
        """Positions (..., 3) mm of material points at a step."""
        return self._all(theta, z, step)[..., :3]

    def tangents(self, theta: Floats, z: Floats, step: int) -> Floats:
        """Derivatives of the position by theta and by z, (..., 2, 3)."""
        every = self._all(theta, z, step)
        return every[..., 3:].reshape(*every.shape[:-1], 2, 3)

    def stretches(self, theta: Floats, z: Floats, step: int) -> tuple[Floats, Floats]:
        """Principal stretches λ1 ≤ λ2 (...) from the reference to a step: roots of det(g - λ² G) = 0."""
        before, after = self.tangents(theta, z, 0), self.tangents(theta, z, step)
        G = np.einsum("...ai,...bi->...ab", before, before)
        g = np.einsum("...ai,...bi->...ab", after, after)
        mixed = np.linalg.solve(G, g)
        half = 0.5 * np.trace(mixed, axis1=-2, axis2=-1)
        root = np.sqrt(np.maximum(half**2 - np.linalg.det(mixed), 0.0))
        return np.sqrt(half - root), np.sqrt(half + root)

    def material_coordinates(self, xyz: Floats, step: int = 0) -> tuple[Floats, Floats, Floats]:
        """theta, z and signed distance (outside positive, mm) of the surface points nearest to xyz (n, 3) mm."""
        out = np.empty((len(xyz), 3))
        body.nearest(np.ascontiguousarray(xyz, dtype=np.float64), self.parameters(step), out)
        return out[:, 0], out[:, 1], out[:, 2]

    def _all(self, theta: Floats, z: Floats, step: int) -> Floats:
        theta, z = np.broadcast_arrays(np.asarray(theta, dtype=float), np.asarray(z, dtype=float))
        out = np.empty((theta.size, 9))
        body.points(theta.ravel(), z.ravel(), self.parameters(step), out)
        return out.reshape(*theta.shape, 9)


@dataclass(frozen=True)
class Cylinder(_Surface):
    """A rigid cylinder of 114 mm diameter that moves by ``per_step`` mm a step."""

    per_step: tuple[float, float, float] = (0.1, 0.0, 0.0)

    def parameters(self, step: int) -> Floats:
        """Parameters (6,) of the cylinder at its position at a step, mm."""
        return np.array([body.CYLINDER, RADIUS, *(step * np.array(self.per_step)), 0.0])


@dataclass(frozen=True)
class Limb(_Surface):
    """A calf, 47 to 66 mm in radius, loaded by a fifth of its full load a step: stretched by about 15 % at step 5."""

    load_per_step: float = 0.2

    def parameters(self, step: int) -> Floats:
        """Parameters (6,) of the limb under the load of a step; the load has no unit."""
        return np.array([body.LIMB, RADIUS, 0.0, 0.0, 0.0, step * self.load_per_step])


@dataclass(frozen=True)
class Specimen:
    """A specimen at one step: its surface with speckles over z 5 … 245 mm (limb) or 12 … 238 mm (cylinder)."""

    surface: Cylinder | Limb
    step: int
    seed: int = 0
    damage: Damage = field(default_factory=Damage)

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest z of the speckles in the reference, mm."""
        return (5.0, 245.0) if isinstance(self.surface, Limb) else (12.0, 238.0)

    def body(self) -> Floats:
        """Parameters (6,) of the surface at this step, as `ringdic_node.virtual_rig.body` defines them; mm."""
        return self.surface.parameters(self.step)
