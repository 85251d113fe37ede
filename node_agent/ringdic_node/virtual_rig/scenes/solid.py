"""Speckled solid bodies of any form, with their motion and the exact truth: positions, stretches, what cameras see.

A material point is named by its position at the reference, in the world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ringdic_node.virtual_rig import solid
from ringdic_node.virtual_rig.arrays import Floats, Mask
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.rotation import rotation
from ringdic_node.virtual_rig.scenes.damage import Damage

MIDDLE = (0.0, 0.0, 125.0)  # mm, of the place where target and bodies stand
_EVERYWHERE = (-1e6, 1e6)
_SHELL = 0.5  # mm, half the thickness of the shell about the surface in which its sample is drawn
_HIDDEN = 0.05  # mm, by which a point may lie behind what its ray meets


@dataclass(frozen=True)
class Solid:
    """A solid body at its place in the rig at the reference.

    shape : parameters of its implicit function, as `ringdic_node.virtual_rig.solid` defines them. box : lowest and
    highest corner of a box about it. band : lowest and highest z of the speckles. All in the body's frame, mm.
    turn_deg : rotation vector, degrees, and middle : mm, from the body's frame to the world.
    """

    shape: tuple[float, ...]
    box: tuple[float, float, float, float, float, float]
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    middle: tuple[float, float, float] = MIDDLE
    band: tuple[float, float] = _EVERYWHERE

    @property
    def parameters(self) -> Floats:
        """Parameters (k,) of the implicit function, mm and rad."""
        return np.array(self.shape, dtype=float)

    @property
    def pose(self) -> tuple[Floats, Floats]:
        """R (3, 3) and t (3,) mm from the body's frame to the world at the reference."""
        return rotation(np.radians(self.turn_deg)), np.array(self.middle)

    def nearest(self, xyz: Floats) -> tuple[Floats, Floats, Floats]:
        """Points (n, 3) mm of the surface at the reference nearest to points xyz (n, 3) mm in the world.

        Returns with them the surface's outward unit normals (n, 3) there and the signed distances (n,) mm.
        """
        R, t = self.pose
        local = np.ascontiguousarray((np.asarray(xyz, dtype=float) - t) @ R)
        foot = np.empty_like(local)
        solid.feet(local, self.parameters, foot)
        normals = self._normals(foot)
        return foot @ R.T + t, normals @ R.T, np.sum((local - foot) * normals, axis=1)

    def sample(self, count: int, seed: int = 0) -> tuple[Floats, Floats, float]:
        """About ``count`` random points of the speckled surface at the reference, as many on each area.

        Points of a thin shell about the surface are drawn evenly and moved onto it. Returns points (n, 3) mm, outward
        unit normals (n, 3), and the area in mm² for which each point stands.
        """
        rng = np.random.default_rng([seed, 1812])
        low, high = np.array(self.box[:3]) - 1.0, np.array(self.box[3:]) + 1.0
        volume = float(np.prod(high - low))
        points: list[Floats] = []
        drawn = found = 0
        while found < count:
            xyz = rng.uniform(low, high, (200_000, 3))
            drawn += len(xyz)
            values, gradients = self.values(xyz)
            slope = np.linalg.norm(gradients, axis=1)
            shell = xyz[(np.abs(values) < _SHELL * slope) & (xyz[:, 2] > self.band[0]) & (xyz[:, 2] < self.band[1])]
            points.append(shell)
            found += len(shell)
            if drawn > 100_000_000:
                raise ValueError("the box of the body holds no surface")
        xyz = np.concatenate(points)
        area = volume * len(xyz) / drawn / (2.0 * _SHELL)
        foot = np.empty_like(xyz)
        solid.feet(xyz, self.parameters, foot)
        R, t = self.pose
        return foot @ R.T + t, self._normals(foot) @ R.T, area / len(xyz)

    def _normals(self, local: Floats) -> Floats:
        _, gradients = self.values(local)
        return np.asarray(gradients / np.linalg.norm(gradients, axis=1, keepdims=True))

    def values(self, local: Floats) -> tuple[Floats, Floats]:
        """Values (n,) mm and gradients (n, 3) of the implicit function at points local (n, 3) mm of the body."""
        values, gradients = np.empty(len(local)), np.empty((len(local), 3))
        solid.shape_values(np.ascontiguousarray(local), self.parameters, values, gradients)
        return values, gradients


@dataclass(frozen=True)
class SolidMotion:
    """The motion of a solid body since the reference: a deformation in the body's frame, then a rigid motion.

    stretch : along ``axis`` (unit vector). swell : widening at height swell_z, over a width of swell_width, mm. twist :
    rad a mm of height. bend : sideways, mm a mm² of height. turn_deg : rotation vector, degrees, about the middle of
    the rig; shift : mm.
    """

    stretch: float = 0.0
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    swell: float = 0.0
    swell_z: float = 0.0
    swell_width: float = 60.0
    twist: float = 0.0
    bend: tuple[float, float] = (0.0, 0.0)
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not math.isclose(math.hypot(*self.axis), 1.0, abs_tol=1e-9):
            raise ValueError("the axis of a stretch must be a unit vector")

    @property
    def is_rigid(self) -> bool:
        """Whether the body keeps its form."""
        return not (self.stretch or self.swell or self.twist or any(self.bend))

    def parameters(self, body: Solid) -> Floats:
        """Parameters (22,) of the motion of a body, mm and rad, as `ringdic_node.virtual_rig.solid` defines them."""
        R_body, t_body = body.pose
        R = rotation(np.radians(self.turn_deg))
        middle = np.array(MIDDLE)
        t = R @ (t_body - middle) + middle + np.array(self.shift)
        deformation = [self.stretch, *self.axis, self.swell, self.swell_z, self.swell_width, self.twist, *self.bend]
        return np.concatenate([deformation, (R @ R_body).ravel(), t])


@dataclass(frozen=True)
class SolidSpecimen:
    """A solid body after a motion: the scene that cameras see, and the truth of its material points.

    seed : of the speckles. defocus : standard deviation of the Gaussian by which its images are blurred in addition to
    the lens's point spread, px. speckle : size of the speckles, 1 is balls of 1.4 to 2 mm. period : mm, after
    which the pattern repeats along the axes of the body's frame; 0 is never. damage : shadows, reflections and bars.
    """

    solid: Solid
    motion: SolidMotion = SolidMotion()
    seed: int = 0
    defocus: float = 0.0
    speckle: float = 1.0
    period: float = 0.0
    damage: Damage = field(default_factory=Damage)

    def moved(self, xyz: Floats) -> Floats:
        """Positions (n, 3) mm after the motion of material points xyz (n, 3) mm."""
        local, out = self._local(xyz), np.empty((len(xyz), 3))
        solid.placed(local, self.motion.parameters(self.solid), out)
        return out

    def moved_back(self, xyz: Floats) -> Floats:
        """Material points (n, 3) mm that are at positions xyz (n, 3) mm after the motion."""
        R, t = self.solid.pose
        out = np.empty((len(xyz), 3))
        solid.placed_back(np.ascontiguousarray(xyz), self.motion.parameters(self.solid), out)
        return np.asarray(out @ R.T + t)

    def gradients(self, xyz: Floats) -> Floats:
        """Deformation gradients F (n, 3, 3) of the motion at material points xyz (n, 3) mm, without unit."""
        out = np.empty((len(xyz), 3, 3))
        solid.placed_slopes(self._local(xyz), self.motion.parameters(self.solid), out)
        return np.asarray(out @ self.solid.pose[0].T)

    def stretches(self, xyz: Floats, normals: Floats) -> Floats:
        """Principal stretches λ1 ≤ λ2 (n, 2) within the surface at material points xyz (n, 3) mm.

        normals : (n, 3) unit normals of the surface at the reference.
        """
        helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        first = np.cross(normals, helper)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        tangents = np.stack([first, np.cross(normals, first)], axis=2)
        return np.linalg.svd(self.gradients(xyz) @ tangents, compute_uv=False)[:, ::-1]

    def moved_normals(self, xyz: Floats, normals: Floats) -> Floats:
        """Unit normals (n, 3) after the motion, at material points xyz (n, 3) mm with unit normals (n, 3) before it."""
        turned = np.linalg.solve(self.gradients(xyz).transpose(0, 2, 1), normals[..., None])[..., 0]
        return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))

    def visible(
        self, cameras: Sequence[VirtualCamera], xyz: Floats, normals: Floats, incidence_deg: float = 60.0
    ) -> Mask:
        """Which cameras see material points after the motion: below an angle of incidence, in the image, unhidden.

        xyz, normals : (n, 3) mm and unit vectors at the reference. Returns (C, n) bool.
        """
        at, facing = self.moved(xyz), self.moved_normals(xyz, normals)
        seen = np.zeros((len(cameras), len(at)), dtype=bool)
        for k, camera in enumerate(cameras):
            towards = camera.centre - at
            distance = np.linalg.norm(towards, axis=1)
            cosine = np.sum(facing * towards, axis=1) / distance
            rows = np.flatnonzero(cosine > math.cos(math.radians(incidence_deg)))
            px = camera.project(at[rows])
            rows = rows[(px > 0).all(axis=1) & (px < [camera.width - 1, camera.height - 1]).all(axis=1)]
            rays = -towards[rows] / distance[rows, None]
            hit = self.hit_distances(np.tile(camera.centre, (len(rows), 1)), rays)
            seen[k, rows] = (hit < 0) | (hit > distance[rows] - _HIDDEN)
        return seen

    def hit_distances(self, origins: Floats, directions: Floats) -> Floats:
        """Distances (n,) mm at which rays first meet the body after the motion, -1 where they do not.

        origins : (n, 3) mm and directions : (n, 3) unit vectors, in the world.
        """
        motion = self.motion.parameters(self.solid)
        R, t = motion[10:19].reshape(3, 3), motion[19:22]
        out = np.empty(len(origins))
        o, d = np.ascontiguousarray((origins - t) @ R), np.ascontiguousarray(directions @ R)
        solid.first_hits(o, d, self.deformed_box(), self.solid.parameters, motion, out)
        return out

    def deformed_box(self) -> Floats:
        """Lowest and highest corner (6,) mm of a box about the deformed body, before its rigid motion."""
        low, high = np.array(self.solid.box[:3]), np.array(self.solid.box[3:])
        motion, axis = self.motion, np.abs(self.motion.axis)
        grow = abs(motion.stretch) * axis * float(axis @ np.maximum(np.abs(low), np.abs(high)))
        low, high = low - grow, high + grow
        height = float(max(abs(low[2]), abs(high[2])))
        if motion.swell or motion.twist:
            wide = float(np.hypot(*np.maximum(np.abs(low[:2]), np.abs(high[:2])))) * (1.0 + abs(motion.swell))
            low[:2], high[:2] = -wide, wide
        aside = np.abs(motion.bend) * height**2
        return np.concatenate([low[:2] - aside, low[2:], high[:2] + aside, high[2:]])

    def _local(self, xyz: Floats) -> Floats:
        R, t = self.solid.pose
        return np.ascontiguousarray((np.asarray(xyz, dtype=float) - t) @ R)
