"""Disturbances of a specimen's images: worn speckles, hairs, reflections of lamps, bars in front of the body.

Positions are in the world, mm; worn patches and hairs lie on the body, in its material coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ringdic_node.virtual_rig.arrays import Floats, Mask
from ringdic_node.virtual_rig.texture import RADIUS

GLARE_PEAK = 3.0  # radiance of a lamp's reflection; 1 saturates
GLARE_WIDTH = 0.03  # rad, standard deviation of the lobe about the mirror's direction
BAR = 0.10  # radiance of a bar
HAIR = 0.05  # radiance of a hair
_GLARING = 0.3  # radiance of a reflection above which the speckles under it count as spoilt


@dataclass(frozen=True)
class SpoiltPatch:
    """An ellipse where the speckles are worn off: middle at theta (rad), z (mm), half axes along arc and height, mm."""

    theta: float
    z: float
    half_arc: float
    half_height: float


@dataclass(frozen=True)
class Bar:
    """An opaque round bar with round ends, from one point to another, mm."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class Shadow:
    """A shadow on everything on one side of a plane: the points x with direction · x < edge, in the world, mm.

    direction : unit vector. depth : share of the light that is missing. width : of the half-shadow, mm.
    """

    direction: tuple[float, float, float]
    edge: float
    depth: float = 0.5
    width: float = 10.0


@dataclass(frozen=True)
class Hair:
    """A dark hair that lies on a solid body and moves with it, in the plane through its root across the surface.

    root : mm, the material point at which it begins. along : unit vector, its direction there; across : unit vector in
    the surface at right angles to it. length, radius : mm.
    """

    root: tuple[float, float, float]
    along: tuple[float, float, float]
    across: tuple[float, float, float]
    length: float
    radius: float


@dataclass(frozen=True)
class Damage:
    """Disturbances of a specimen's images at one step. lamps : positions, mm, reflected by the glossy body.

    Shadows fall, and hairs lie, on solid bodies only; worn patches are on the others only.
    """

    patches: tuple[SpoiltPatch, ...] = ()
    lamps: tuple[tuple[float, float, float], ...] = ()
    bars: tuple[Bar, ...] = ()
    shadows: tuple[Shadow, ...] = ()
    hairs: tuple[Hair, ...] = ()

    def arrays(self) -> tuple[Floats, Floats, Floats]:
        """Arrays for the renderer, mm.

        Patches (k, 4): arc, z, half axes. Lamps (m, 3). Bars (b, 7): start, end, radius.
        """
        patches = [
            (each.theta % (2 * np.pi) * RADIUS, each.z, each.half_arc, each.half_height) for each in self.patches
        ]
        bars = [(*bar.start, *bar.end, bar.radius) for bar in self.bars]
        return (
            np.array(patches, dtype=float).reshape(-1, 4),
            np.array(self.lamps, dtype=float).reshape(-1, 3),
            np.array(bars, dtype=float).reshape(-1, 7),
        )

    def worn(self, theta: Floats, z: Floats) -> Mask:
        """Which material points have lost their speckles. theta : (n,) rad. z : (n,) mm. (n,) bool."""
        off = np.zeros(np.shape(theta), dtype=bool)
        for patch in self.patches:
            arc = (np.asarray(theta) - patch.theta + np.pi) % (2 * np.pi) - np.pi
            off |= (RADIUS * arc / patch.half_arc) ** 2 + ((z - patch.z) / patch.half_height) ** 2 < 1.0
        return off

    def spoilt(self, centre: Floats, xyz: Floats, normals: Floats) -> Mask:
        """Which points of the surface are hidden from a camera by a bar or lie in a lamp's reflection, (n,) bool.

        centre : (3,) of the camera; xyz : (n, 3) points of the surface, mm; normals : (n, 3) of unit length, outwards.
        """
        hidden = np.zeros(len(xyz), dtype=bool)
        for bar in self.bars:
            hidden |= _gap(centre, xyz, np.array(bar.start), np.array(bar.end)) < bar.radius
        return np.asarray(hidden | (self.reflections(centre, xyz, normals) > _GLARING))

    def reflections(self, centre: Floats, xyz: Floats, normals: Floats) -> Floats:
        """Radiance (n,), without unit, of the lamps' reflections that a camera sees in points of the surface.

        centre : (3,) of the camera; xyz : (n, 3) points, mm; normals : (n, 3) of unit length, outwards.
        """
        view = centre - xyz
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        glare = np.zeros(len(xyz))
        for lamp in self.lamps:
            light = np.array(lamp) - xyz
            light /= np.linalg.norm(light, axis=1, keepdims=True)
            half = view + light
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            facing = np.sum(light * normals, axis=1) > 0
            angle_squared = 2.0 * (1.0 - np.sum(half * normals, axis=1))
            glare += np.where(facing, GLARE_PEAK * np.exp(-0.5 * angle_squared / GLARE_WIDTH**2), 0.0)
        return glare

    def lit(self, xyz: Floats) -> Floats:
        """Share (n,) of the light, without unit, that the shadows leave at points xyz (n, 3) mm."""
        light = np.ones(len(xyz))
        for shadow in self.shadows:
            beyond = xyz @ np.array(shadow.direction) - shadow.edge
            light *= 1.0 - shadow.depth * np.clip(0.5 - beyond / shadow.width, 0.0, 1.0)
        return light

    def bar_shares(self, centre: Floats, xyz: Floats, per: float) -> Iterator[Floats]:
        """For each bar the share (n,), without unit, of each line of sight's pixel that it covers.

        centre : (3,) mm, of the camera. xyz : (n, 3) mm, where the lines end. per : width of a pixel at distance 1.
        """
        for bar in self.bars:
            start, end = np.array(bar.start), np.array(bar.end)
            wide = per * float(np.linalg.norm(0.5 * (start + end) - centre))
            yield np.clip(0.5 - (_gap(centre, xyz, start, end) - bar.radius) / wide, 0.0, 1.0)


def _gap(centre: Floats, xyz: Floats, start: Floats, end: Floats) -> Floats:
    """Distance (n,) mm of each line of sight, from the centre to a point (n, 3), from the segment start to end."""
    d, e = xyz - centre, end - start
    w = centre - start
    a, b, c = np.sum(d * d, axis=1), d @ e, float(e @ e)
    f, g = d @ w, float(e @ w)
    det = np.maximum(a * c - b * b, 1e-12)
    s = np.clip((a * g - b * f) / det, 0.0, 1.0)
    t = np.clip((b * s - f) / a, 0.0, 1.0)
    return np.asarray(np.linalg.norm(w + t[:, None] * d - s[:, None] * e, axis=1))
