"""Plane sweep between two cameras: depths and slants of a surface of which nothing is known but that both see it.

At every place of a coarse lattice, planes of nine slants (Gallup et al. 2007) at depths through the whole space in
which the specimen may stand are tried on reduced images, and the plane under which the images agree best is a start
value. A place is accepted where the agreement is high and no other depth agrees nearly as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Mask, Pixels, Points, Vectors
from ringdic.charts.patches import axial_rays, depths, optical_axis
from ringdic.correlation import Current, WarpHypotheses, search_hypotheses
from ringdic.correlation.prepared import as_8_bit
from ringdic.geometry.camera import Camera

_REDUCED_RADIUS = 8  # px of a subset in the reduced images
_RADII = 1.6  # subset's radius in the reduced images, in radii of a subset in the full ones
_KNOTS = 14  # depths at which warps are computed exactly
_SPACING = 2.0  # px of the reduced image between the matches of successive depths
_TOGETHER = 50  # places that are tried at one spacing of the depths
_STEEPEST = 60.0  # degrees of incidence at which a surface is still to be matched
_UPWARDS = 32.0  # degrees by which slants are turned out of the plane of the two lines of sight
_AROUND = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=float)
_LEAST_ZNCC = 0.6
_SECOND = 0.92  # largest ZNCC at another depth, as a share of the best


@dataclass(frozen=True)
class DepthRange:
    """Space in which the specimen may stand, as the rig alone gives it.

    centre : (3,) mm, the point nearest to all optical axes. reach : share of a camera's distance from the centre by
    which the depth of the surface may differ from that of the centre.
    """

    centre: Points
    reach: float = 0.45

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> DepthRange:
        """The space about the point nearest to the optical axes of all cameras."""
        across = [np.eye(3) - np.outer(axis, axis) for axis in map(optical_axis, cameras)]
        right = sum((M @ camera.centre for M, camera in zip(across, cameras, strict=True)), np.zeros(3))
        return cls(np.linalg.pinv(np.sum(across, axis=0)) @ right)

    def limits(self, camera: Camera) -> tuple[float, float]:
        """Least and largest depth in a camera, mm."""
        middle = float(depths(camera, self.centre))
        return middle * (1.0 - self.reach), middle * (1.0 + self.reach)

    def holds(self, camera: Camera, xyz: Points) -> Mask:
        """Which points have a depth in a camera that lies within the limits.

        xyz : (n, 3) mm, world frame. Returns (n,) bool.
        """
        low, high = self.limits(camera)
        depth = depths(camera, xyz)
        with np.errstate(invalid="ignore"):
            return np.asarray((depth > low) & (depth < high))


@dataclass(frozen=True)
class SweepMatches:
    """Start values at n places: warps (n, 6) u v ux uy vx vy in px of the full images, NaN where none is accepted."""

    warps: Floats

    @property
    def good(self) -> Mask:
        """Accepted places, (n,) bool."""
        return np.asarray(np.isfinite(self.warps).all(axis=1))


def reduction(radius: int) -> int:
    """Factor by which images are reduced for a sweep. radius : px, of the subsets in the full images."""
    return max(1, round(_RADII * radius / _REDUCED_RADIUS))


def reduced(image: Image, factor: int) -> NDArray[np.uint8]:
    """An image in 8 bits, reduced by averaging over squares of ``factor`` pixels.

    image : (height, width) grey levels. Returns (height // factor, width // factor) grey levels.
    """
    height, width = (side // factor * factor for side in image.shape)
    size = (width // factor, height // factor)
    return np.asarray(cv2.resize(as_8_bit(image)[:height, :width], size, interpolation=cv2.INTER_AREA), np.uint8)


def sweep_planes(
    cameras: tuple[Camera, Camera], images: tuple[Current, Current], px: Pixels, space: DepthRange, factor: int
) -> SweepMatches:
    """Search for the surface about places of the first camera's image by a sweep of slanted planes.

    Parameters
    ----------
    cameras : the two.
    images : of both, reduced by ``factor``.
    px : (n, 2) px, places in the full image of the first camera.
    space : where the surface may be.
    factor : of the reduction.
    """
    first, second = cameras
    nearest, farthest = space.limits(first)
    knots = np.linspace(1.0 / farthest, 1.0 / nearest, _KNOTS)
    warps = _plane_warps(first, second, px, np.array(_slants(cameras, space.centre)), knots, factor)
    moves = _moves(warps)
    warps[..., :2] /= factor
    at = np.rint((px + 0.5) / factor - 0.5)
    out = np.full((len(px), 6), np.nan)
    for some in np.array_split(np.argsort(moves.max(axis=1)), -(-len(px) // _TOGETHER)):
        along = _along_knots(moves[some].max(axis=0) / (_SPACING * factor))
        coordinates = np.concatenate([k * _KNOTS + along for k in range(warps.shape[1])])
        hypotheses = WarpHypotheses(warps[some].reshape(len(some), -1, 6), coordinates)
        best = search_hypotheses(
            images[0].image, images[1], at[some], hypotheses, _REDUCED_RADIUS, stride=1, zncc_min=_LEAST_ZNCC
        )
        with np.errstate(invalid="ignore"):
            good = (best.zncc > _LEAST_ZNCC) & (best.second_peak < _SECOND * best.zncc)
        out[some[good]] = best.warps[good]
    out[:, :2] *= factor
    return SweepMatches(out)


def _moves(warps: Floats) -> Floats:
    """Distances (n, J - 1) px between the matches of successive knots. warps : (n, S, J, 6), of S slants."""
    steps = np.linalg.norm(np.diff(warps[..., :2], axis=2), axis=3)
    return np.asarray(np.max(np.nan_to_num(steps), axis=1))


def _along_knots(moves: Floats) -> Floats:
    """Coordinates between the knots that lie no more than one unit of the moves (J - 1,) apart, no unit."""
    counts = np.maximum(np.ceil(moves).astype(int), 1)
    between = [k + np.arange(count) / count for k, count in enumerate(counts)]
    return np.append(np.concatenate(between), float(len(counts)))


def _slants(cameras: tuple[Camera, Camera], centre: Points) -> list[Vectors]:
    """Normals of the planes: nine directions that spread over those that both cameras see."""
    towards = [camera.centre - centre for camera in cameras]
    towards = [each / np.linalg.norm(each) for each in towards]
    middle = towards[0] + towards[1]
    middle /= np.linalg.norm(middle)
    across = towards[1] - towards[0]
    across /= np.linalg.norm(across)
    up = np.cross(middle, across)
    half = 0.5 * math.degrees(math.acos(float(np.clip(towards[0] @ towards[1], -1, 1))))
    sideways = max(10.0, (_STEEPEST - half) * 2.0 / 3.0)
    normals = []
    for tilt in (0.0, -_UPWARDS, _UPWARDS):
        for turn in (0.0, -sideways, sideways):
            a, b = math.radians(turn), math.radians(tilt)
            normals.append(math.cos(b) * (math.cos(a) * middle + math.sin(a) * across) + math.sin(b) * up)
    return normals


def _plane_warps(first: Camera, second: Camera, px: Pixels, normals: Vectors, inverse: Floats, reach: float) -> Floats:
    """Warps (n, S, J, 6) from the first camera into the second under planes of S normals at J inverse depths, 1/mm."""
    rays = axial_rays(first, px[:, None] + 4.0 * reach * _AROUND)  # (n, 5, 3)
    by_x, by_y = (rays[:, 1] - rays[:, 2]) / (8.0 * reach), (rays[:, 3] - rays[:, 4]) / (8.0 * reach)
    towards, slant = np.stack([by_x, by_y], axis=-1), rays @ normals.T  # (n, 3, 2), (n, 5, S)
    at, jacobian = second.project_with_jacobian(first.centre + rays[:, :1] / inverse[:, None])
    # Along the plane the depth changes by the share -n·∂r / n·r a pixel.
    share = np.einsum("sa,nai->nsi", normals, towards) / slant[:, 0, :, None]
    tangents = towards[:, None] - rays[:, 0, None, :, None] * share[:, :, None]  # (n, S, 3, 2)
    slopes = np.einsum("njba,nsai->nsjbi", jacobian, tangents, optimize=True) / inverse[:, None, None] - np.eye(2)
    warps = np.empty((*slopes.shape[:3], 6))
    warps[..., :2], warps[..., 2:] = (at - px[:, None])[:, None], slopes.reshape(*slopes.shape[:3], 4)
    inside: Mask = np.asarray(((at >= 0) & (at < np.array(second.size))).all(axis=-1))
    before: Mask = np.asarray((slant * slant[:, :1] > 0).all(axis=1))
    warps[~(inside[:, None] & before[..., None] & (np.abs(slopes).max(axis=(-2, -1)) < 3.0))] = np.nan
    return warps
