"""Prediction of a camera's matches from the surface at the reference and a rigid motion of the body.

Where a body turns by tens of degrees, the warp of a subset changes over few pixels, most of all where the surface is
seen obliquely. But the shape is known from the reference, so that a rigid motion fitted to some matches predicts the
warps of all points with their second derivatives. What is left to be measured is small and smooth.

The surface about each of its points is described in three dimensions, in the camera that faces it most squarely, by its
tangent plane and its second fundamental form: the height over the plane is ``½ (L s² + 2 M s t + N t²)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points, Vectors
from ringdic.charts.patches import STENCIL, Patches, depths, warps_between
from ringdic.correlation.quadratic import Neighbourhoods, neighbours_within
from ringdic.geometry.camera import Camera
from ringdic.strain.rigid_motion import RigidMotion

_REACH = 0.7  # subset radii over which a warp's central differences are taken; to the fourth order they leave no bias
_WINDOW = 2.0  # subset radii about a point of the surface, of the neighbours that its curvature is computed from
_ITERATIONS = 30  # of Gauss-Newton at most
_SETTLED = 1e-4  # rad and, times the size of the body, mm, of the last one
_TUKEY = 4.685  # standard deviations beyond which a match has no weight (Beaton & Tukey 1974)
_SINGULAR = 1e-12  # share of the largest, of a singular value of the normal matrix that counts as zero
_LEAST_SCATTER = 0.1  # px, standard deviation of the matches, at least
_SOME = 250  # matches, at most, that a motion is fitted to
_FEWEST = 12  # matches that a motion is fitted to
_STEEP = np.cos(np.radians(40.0))  # cosine of the incidence at the reference below which third derivatives count
_RIDGE = 1e-9  # share of the trace added to the diagonal: pixels on a line give no plane


@dataclass(frozen=True)
class SurfaceFrames:
    """Tangent planes and curvatures about N points of a surface, NaN where unknown.

    origin : (N, 3) mm. axes : (N, 3, 3), rows: two tangents and the normal, of unit length. form : (N, 3) 1/mm, second
    fundamental form L M N.
    """

    origin: Points
    axes: Vectors
    form: Floats

    @classmethod
    def of(cls, cameras: Sequence[Camera], xyz: Points, seen: Mask, own: Indices, radius: int) -> SurfaceFrames:
        """The frames of a surface.

        cameras : C cameras. xyz : (N, 3) mm. seen : (C, N) bool, which camera sees which point. own : (N,), the camera
        that faces each most squarely. radius : px, of the subsets.
        """
        out = cls(np.full((len(xyz), 3), np.nan), np.full((len(xyz), 3, 3), np.nan), np.full((len(xyz), 3), np.nan))
        for c, camera in enumerate(cameras):
            vertex = np.flatnonzero(seen[c])
            mine = own[vertex] == c
            if not mine.any():
                continue
            px, inverse = camera.project(xyz[vertex]), 1.0 / depths(camera, xyz[vertex])
            fit = Neighbourhoods(px, _WINDOW * radius, np.flatnonzero(mine)).fit(inverse[:, None])
            patches = Patches(px[mine], fit.value[:, 0], fit.gradient[:, 0], fit.curvature[:, 0])
            index, stencil = vertex[mine], patches.stencil(camera, _REACH * radius)
            out.origin[index] = stencil[:, 0]
            out.axes[index], out.form[index] = _frame(stencil)
        return out

    def meet(self, index: Indices, start: Points, rays: Vectors) -> Points:
        """Where lines of sight meet the surface about points of it.

        index : (n,), of the points. start : (3,) mm, of the lines. rays : (n, k, 3), their directions. Returns (n, k,
        3) mm, NaN where a line misses it.
        """
        axes, form = self.axes[index], self.form[index][:, None]
        way = np.einsum("nij,nkj->nki", axes, rays)
        at = np.einsum("nij,nj->ni", axes, start - self.origin[index])[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            plane = -at[..., 2] / way[..., 2]
            foot = at + plane[..., None] * way
            a = -0.5 * _form(form, way, way)
            b = way[..., 2] - _form(form, foot, way)
            c = -0.5 * _form(form, foot, foot)
            further = -2.0 * c / (b + np.sign(b) * np.sqrt(b * b - 4.0 * a * c))
        return np.asarray(start + (plane + further)[..., None] * rays)


def _form(form: Floats, p: Vectors, q: Vectors) -> Floats:
    """The second fundamental form (..., 3) of two directions (..., 3) in the frame."""
    L, M, N = np.moveaxis(form, -1, 0)
    cross = p[..., 0] * q[..., 1] + p[..., 1] * q[..., 0]
    return np.asarray(L * p[..., 0] * q[..., 0] + M * cross + N * p[..., 1] * q[..., 1])


def _frame(stencil: Points) -> tuple[Vectors, Floats]:
    """Axes (n, 3, 3) and second fundamental form (n, 3) 1/mm of patches with a stencil (n, 9, 3) mm."""
    centre, right, left, below, above = np.moveaxis(stencil[:, :5], 1, 0)
    first, normal = right - left, np.cross(right - left, below - above)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first), normal], axis=1)
    s, t, height = np.moveaxis(np.einsum("nij,nkj->nki", axes, stencil[:, 1:] - centre[:, None]), -1, 0)
    basis = np.stack([0.5 * s * s, s * t, 0.5 * t * t], axis=-1)
    normal_matrix = np.einsum("nki,nkj->nij", basis, basis)
    right_side = np.einsum("nki,nk->ni", basis, height)
    known = np.isfinite(right_side).all(axis=1)
    form = np.full((len(centre), 3), np.nan)
    form[known] = np.linalg.solve(normal_matrix[known], right_side[known, :, None])[..., 0]
    return axes, form


@dataclass(frozen=True)
class SeenBody:
    """The part of a body that one camera sees at the reference.

    camera : the camera. index : (k,) points of the surface that it sees. xyz : (k, 3) mm. px : (k, 2) px, where it
    shows them. frames : function that returns the frames of the whole surface, called where the body turns.
    """

    camera: Camera
    index: Indices
    xyz: Points
    px: Pixels
    frames: Callable[[], SurfaceFrames]

    def nearest(self, px: Pixels) -> Indices:
        """Number (n,) of the seen point next to each pixel (n, 2) px."""
        return np.asarray(cKDTree(self.px).query(px)[1])

    def points(self, px: Pixels, reach: float | None = None) -> Points:
        """Points of the surface that the camera shows at pixels, (n, 1, 3) mm, or about them, (n, 9, 3) mm.

        px : (n, 2) px. reach : px, of the stencil about each.
        """
        frames = self.frames()
        known = np.flatnonzero(np.isfinite(frames.form[self.index]).all(axis=1))
        offsets = np.zeros((1, 2)) if reach is None else reach * STENCIL
        index = self.index[known[cKDTree(self.px[known]).query(px)[1]]]
        return frames.meet(index, self.camera.centre, self.camera.ray(px[:, None] + offsets))

    def motion(self, at: Indices, px: Pixels, warp: Floats) -> RigidMotion | None:
        """Rigid motion of the body that shows pixels where they were matched; None for too few matches.

        at : (n,) numbers of the seen points next to the pixels px (n, 2) px. warp : (n, 6) or more, u v ux uy vx vy of
        the matches in px, NaN where unknown.
        """
        known = np.flatnonzero(np.isfinite(warp[:, :6]).all(axis=1))
        known = known[:: max(1, len(known) // _SOME)]
        if len(known) < _FEWEST:
            return None
        at, warp = at[known], warp[known]
        offset = self.px[at] - px[known]
        there = self.px[at] + warp[:, :2] + np.einsum("nij,nj->ni", warp[:, 2:6].reshape(-1, 2, 2), offset)
        return _fitted_motion(self.camera, self.xyz[at], there)

    def moved_camera(self, motion: RigidMotion) -> Camera:
        """The camera as the body sees it after its motion."""
        P = self.camera.P @ np.vstack([np.column_stack([motion.R, motion.t]), [0.0, 0.0, 0.0, 1.0]])
        return replace(self.camera, P=P / P[2, 3])


class PredictedPoints:
    """Points tracked by a camera whose warps a motion of the body predicts.

    body : what the camera sees. px : (n, 2) px, the points. lattice : (m, 2) px, pixels of the region that subsets use,
    ``spacing`` px apart. energy : (m, 2), squares of the derivatives of the grey levels there. radius : px, of the
    subsets.
    """

    def __init__(
        self, body: SeenBody, px: Pixels, lattice: Pixels, energy: Floats, radius: int, spacing: float
    ) -> None:
        self._body, self._px, self._lattice, self._reach = body, px, lattice, _REACH * radius
        self._stencil, self._on_lattice = body.points(px, self._reach), body.points(lattice)[:, 0]
        _, right, left, below, above = np.moveaxis(self._stencil[:, :5], 1, 0)
        normals = np.cross(right - left, below - above)
        with np.errstate(invalid="ignore"):
            self._normals = -normals / np.linalg.norm(normals, axis=1, keepdims=True)
        steep = ~(body.camera.incidence_cosine(self._stencil[:, 0], self._normals) > _STEEP)
        self._planes = SubsetPlanes(px, np.flatnonzero(steep), lattice, energy, radius, spacing)

    def after(self, motion: RigidMotion) -> tuple[Floats, Floats, Floats]:
        """Warps after a motion, cosines of incidence, and what steep subsets measure beside the warps.

        Returns warps (n, 12) in px and its powers, NaN where unknown, cosines (n,) without unit, and planes (n, 3, 2)
        px and 1.
        """
        camera = self._body.moved_camera(motion)
        warps = warps_between(camera, self._px, self._stencil, self._reach)
        planes = self._planes.planes(warps, camera.project(self._on_lattice) - self._lattice)
        return warps, camera.incidence_cosine(self._stencil[:, 0], self._normals), planes


class SubsetPlanes:
    """Planes that first-order subsets measure of a field beyond the quadratics that are held.

    Over a whole disc of even texture third derivatives of the field leave its value as it is. Over one that the rim
    cuts off, or whose texture is denser on one side, as where the surface curves away, they do not. A subset weights u
    by the squares of the derivatives of the grey levels along x, and v by those along y.

    centres : (n, 2) px. index : (c,) of those whose planes are wanted. lattice : (m, 2) px, pixels of the region,
    ``spacing`` px apart. energy : (m, 2), squares of the derivatives there by x and y. radius : px, of the subsets.
    """

    def __init__(
        self, centres: Pixels, index: Indices, lattice: Pixels, energy: Floats, radius: float, spacing: float
    ) -> None:
        self.index = index
        self._first, self._member = neighbours_within(centres[index], lattice, radius + 0.5 * spacing)
        self._of = np.repeat(np.arange(len(index)), np.diff(self._first))
        self._offset = offset = lattice[self._member] - centres[index[self._of]]
        inside = np.clip((radius - np.hypot(*offset.T)) / spacing + 0.5, 0.0, 1.0)
        terms = np.column_stack([np.ones(len(offset)), offset / radius])
        squares = (terms[:, :, None] * terms[:, None]).reshape(-1, 9)
        self._coefficients = []
        for m in range(2):
            weight = (inside * energy[self._member, m])[:, None]
            normal = self._sums(squares * weight).reshape(-1, 3, 3)
            ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2) + np.finfo(float).tiny
            inverse = np.linalg.inv(normal + ridge[:, None, None] * np.eye(3))
            solved = np.einsum("kij,kj->ki", inverse[self._of], terms) * weight
            self._coefficients.append(solved * [1.0, 1.0 / radius, 1.0 / radius])

    def planes(self, warp: Floats, shift: Pixels) -> Floats:
        """Values and slopes of the planes of displacements less the quadratics held, (n, 3, 2) px and 1.

        warp : (n, 12) px and its powers, the field with its derivatives at the centres. shift : (m, 2) px, the field at
        the lattice, NaN where unknown. Zero for subsets whose planes are not wanted.
        """
        dx, dy = self._offset.T
        here = warp[self.index][self._of]
        out = np.zeros((len(warp), 3, 2))
        for m in range(2):
            slope, bend = here[:, 2 + 2 * m : 4 + 2 * m].T, here[:, 6 + 3 * m : 9 + 3 * m].T
            held = here[:, m] + slope[0] * dx + slope[1] * dy
            held += 0.5 * bend[0] * dx * dx + bend[1] * dx * dy + 0.5 * bend[2] * dy * dy
            left = np.nan_to_num(shift[self._member, m] - held)
            out[self.index, :, m] = self._sums(self._coefficients[m] * left[:, None])
        return out

    def _sums(self, values: Floats) -> Floats:
        """Sums (c, j) over the members of each subset of values (k, j)."""
        if not len(self.index):
            return np.zeros((0, values.shape[1]))
        return np.stack([np.add.reduceat(each, self._first[:-1]) for each in np.ascontiguousarray(values.T)], axis=1)


def _fitted_motion(camera: Camera, xyz: Points, px: Pixels) -> RigidMotion:
    """Rigid motion that takes points (n, 3) mm to where a camera shows them, (n, 2) px, by robust Gauss-Newton."""
    middle = np.median(xyz, axis=0)
    size = float(np.median(np.linalg.norm(xyz - middle, axis=1)))
    R, shift = np.eye(3), np.zeros(3)
    for _ in range(_ITERATIONS):
        turned = (xyz - middle) @ R.T
        there, jacobian = camera.project_with_jacobian(turned + middle + shift)
        residual = px - there
        distance = np.linalg.norm(residual, axis=1)
        limit = _TUKEY * max(_LEAST_SCATTER, 1.4826 * float(np.median(distance)))
        weight = np.maximum(1.0 - (distance / limit) ** 2, 0.0)  # square root of Tukey's
        by_turn = np.cross(turned[:, None], jacobian)
        A = (np.concatenate([by_turn, jacobian * size], axis=2) * weight[:, None, None]).reshape(-1, 6)
        step = np.linalg.lstsq(A.T @ A, A.T @ (residual * weight[:, None]).ravel(), rcond=_SINGULAR)[0]
        R, shift = np.asarray(cv2.Rodrigues(step[:3])[0]) @ R, shift + size * step[3:]
        if np.abs(step).max() < _SETTLED:
            break
    return RigidMotion(R, middle + shift - R @ middle)
