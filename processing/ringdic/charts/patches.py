"""Patches of surface as one camera sees them: inverse depth about a pixel, and the warps that it implies elsewhere.

The depth of a point is its distance from the camera along the optical axis, mm. Of a plane the inverse depth ω is a
linear function of the (undistorted) pixel, so a patch of any surface is described about a pixel p by a quadratic

``ω(p + δ) = ω + g · δ + ½ (xx δx² + 2 xy δx δy + yy δy²)``.

A pixel p is taken along its line of sight to the point ``X = C + r(p) / ω(p)``, r the direction of the line of sight
whose component along the optical axis is 1, and from there into any other camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Indices, Pixels, Points, Vectors
from ringdic.geometry.camera import Camera

#: Offsets of the central differences, in units of the reach: centre, ± x, ± y, and the four corners.
STENCIL = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]], dtype=float)


@dataclass(frozen=True)
class Patches:
    """Patches of surface about n pixels of a camera.

    px : (n, 2) px. inverse_depth : (n,) 1/mm. gradient : (n, 2) 1/(mm px), along x and y. curvature : (n, 3) 1/(mm
    px²), second derivatives xx, xy, yy.
    """

    px: Pixels
    inverse_depth: Floats
    gradient: Floats
    curvature: Floats

    def part(self, index: Indices) -> Patches:
        """Some of the patches. index : (k,) int, or (n,) bool."""
        return Patches(self.px[index], self.inverse_depth[index], self.gradient[index], self.curvature[index])

    def points(self, camera: Camera, offsets: Pixels, rays: Vectors | None = None) -> Points:
        """Points of the patches at offsets from their pixels.

        camera : whose pixels they are. offsets : (k, 2) px. rays : (n, k, 3), axial rays there where they are known.
        Returns (n, k, 3) mm, world frame; NaN where a patch reaches infinity.
        """
        rays = axial_rays(camera, self.px[:, None] + offsets) if rays is None else rays
        dx, dy = offsets.T
        xx, xy, yy = self.curvature.T[..., None]
        inverse = self.inverse_depth[:, None] + self.gradient[:, :1] * dx + self.gradient[:, 1:] * dy
        inverse = inverse + 0.5 * xx * dx**2 + xy * dx * dy + 0.5 * yy * dy**2
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(inverse[..., None] > 0, camera.centre + rays / inverse[..., None], np.nan)

    def normals(self, camera: Camera) -> Vectors:
        """Normals of the patches, towards the camera, (n, 3) of unit length, no unit."""
        right, left, down, up = np.moveaxis(self.points(camera, STENCIL[1:5]), 1, 0)
        normals = np.cross(right - left, down - up)
        towards = camera.centre - right
        normals *= np.sign(np.sum(normals * towards, axis=1, keepdims=True))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def stencil(self, camera: Camera, reach: float, rays: Vectors | None = None) -> Points:
        """Points of the patches from whose projections `warps_between` takes derivatives, (n, 9, 3) mm.

        reach : px. rays : (n, 9, 3), of `stencil_rays`, where they are known.
        """
        return self.points(camera, reach * STENCIL, rays)


def stencil_rays(camera: Camera, px: Pixels, reach: float) -> Vectors:
    """Axial rays of the pixels of a stencil. px : (n, 2) px. reach : px. Returns (n, 9, 3)."""
    return axial_rays(camera, px[:, None] + reach * STENCIL)


def axial_rays(camera: Camera, px: Pixels) -> Vectors:
    """Directions of lines of sight whose component along the optical axis is 1. px : (..., 2). Returns (..., 3)."""
    M = camera.P[:, :3]  # of whose inverse times (x, y, 1) the component along M's last row is the same everywhere
    inverse = np.linalg.inv(M) * np.linalg.norm(M[2]) * np.sign(np.linalg.det(M))
    return np.asarray(camera.undistort(px) @ inverse[:, :2].T + inverse[:, 2])


def focal_length(camera: Camera) -> float:
    """Focal length, px, without the distortion: pixels across for each unit of the tangent of the angle to the axis."""
    middle = (np.array(camera.size) - 1.0) / 2.0
    ends = camera.ray(np.stack([middle, middle + np.array([1.0, 0.0])]))
    return 1.0 / float(np.linalg.norm(ends[1] - ends[0]))


def optical_axis(camera: Camera) -> Vectors:
    """Unit vector (3,) along which depth is measured, into the scene."""
    axis = camera.P[2, :3] * np.sign(np.linalg.det(camera.P[:, :3]))
    return np.asarray(axis / np.linalg.norm(axis))


def depths(camera: Camera, xyz: Points) -> Floats:
    """Depths of points. xyz : (..., 3) mm. Returns (...) mm, negative behind the camera."""
    return np.asarray((xyz - camera.centre) @ optical_axis(camera))


def warps_between(camera: Camera, px: Pixels, stencil: Points, reach: float) -> Floats:
    """Warps from a first camera into another one, by central differences of the projections of patches.

    camera : the other one. px : (n, 2) px, in the first. stencil : (n, 9, 3) mm, of `Patches.stencil` with the same
    ``reach``, px, about the radius of a subset. Returns (n, 12) u v ux uy vx vy uxx uxy uyy vxx vxy vyy, in px and its
    powers.
    """
    displacement = camera.project(stencil) - (px[:, None, :] + reach * STENCIL)
    centre, right, left, below, above, br, bl, ar, al = np.moveaxis(displacement, 1, 0)
    first = np.stack([(right - left) / (2 * reach), (below - above) / (2 * reach)], axis=-1)  # (n, u v, x y)
    second = np.stack(
        [
            (right - 2 * centre + left) / reach**2,
            (br - bl - ar + al) / (4 * reach**2),
            (below - 2 * centre + above) / reach**2,
        ],
        axis=-1,
    )
    return np.concatenate([centre, first.reshape(-1, 4), second.reshape(-1, 6)], axis=1)


def patches_from_warps(
    first: Camera, second: Camera, px: Pixels, xyz: Points, gradient: Floats
) -> tuple[Patches, Floats]:
    """Plane patches about matched pixels, whose slants the affine warps of the matches tell.

    With J the derivative of the projection into the second camera, ``I + gradient = J (∂r/∂p) / ω - J r / ω² ∇ωᵀ``,
    four equations for the two components of ∇ω, which is their least-squares solution.

    Parameters
    ----------
    first, second : the cameras.
    px : (n, 2) px, pixels of the first.
    xyz : (n, 3) mm, the triangulated points.
    gradient : (n, 2, 2), derivatives of the displacement from the first image to the second.

    Returns
    -------
    The patches, without curvature, and the derivative of the second camera's pixel by the inverse depth, (n,) px mm.
    """
    inverse = 1.0 / depths(first, xyz)
    rays = axial_rays(first, px[:, None] + STENCIL[:5])
    by_x, by_y = 0.5 * (rays[:, 1] - rays[:, 2]), 0.5 * (rays[:, 3] - rays[:, 4])
    _, jacobian = second.project_with_jacobian(xyz)
    plain = jacobian @ np.stack([by_x, by_y], axis=-1) / inverse[:, None, None]  # (n, 2, 2) with ∇ω = 0
    along = -(jacobian @ rays[:, 0, :, None])[..., 0] / inverse[:, None] ** 2  # (n, 2) px mm
    square = np.sum(along**2, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.einsum("nij,ni->nj", np.eye(2) + gradient - plain, along) / square[:, None]
    return Patches(px, inverse, slope, np.zeros((len(px), 3))), np.sqrt(square)
