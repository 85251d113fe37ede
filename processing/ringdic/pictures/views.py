"""Projections of a surface: unrolled about the axis, from a side without perspective, through a camera of the rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Mask
from ringdic.geometry.camera import Camera
from ringdic.mesh.mesh import Mesh
from ringdic.pictures.painter import FaceImage, paint

Extent = tuple[float, float, float, float]

_TILT = float(np.radians(15.0))
_STEEPEST = 0.05  # cosine below which a triangle is seen edge-on and is not drawn


@dataclass(frozen=True)
class View:
    """A rasterised view of a surface.

    faces : (height, width) number of the triangle, −1 for none. inside : (height, width) whether its inner side shows.
    extent : left, right, bottom, top in the units of the axes (degrees and mm when unrolled, else mm).
    aspect : width over height of what is shown, on the body.
    """

    faces: FaceImage
    inside: Mask
    extent: Extent
    aspect: float

    @property
    def outside_share(self) -> float:
        """Share of the painted pixels that show the outer side."""
        painted = self.faces >= 0
        return float((painted & ~self.inside).sum() / max(painted.sum(), 1))


def mean_azimuth(mesh: Mesh) -> float:
    """Azimuth about z (rad) that the surface faces on average; 0 for a surface that faces all sides alike."""
    facing = np.nansum(mesh.area_vectors, axis=0)
    total = float(np.nansum(mesh.areas))
    return float(np.arctan2(facing[1], facing[0])) if np.hypot(*facing[:2]) > 0.1 * total else 0.0


def unrolled(mesh: Mesh, width: int = 720) -> View:
    """The surface unrolled over azimuth about z (degrees) and height z (mm), seen from outside.

    A closed ring runs from 0° to 360°; an open surface is cut in the middle of its gap. Azimuth increases to the right,
    as seen from outside with z upwards. width : px.
    """
    azimuth = np.degrees(np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]))
    z = mesh.vertices[:, 2]
    cut = _cut(azimuth)
    theta = np.mod(azimuth[mesh.faces] - cut, 360.0)
    theta = np.where((np.ptp(theta, axis=1) > 180.0)[:, None] & (theta < 180.0), theta + 360.0, theta)
    cut -= 360.0 * np.floor((cut + float(np.nanmin(theta))) / 360.0 + 1e-9)  # from 0° on, however it was cut
    left, right = cut + float(np.nanmin(theta)), cut + min(360.0, float(np.nanmax(theta)))
    low, high = float(np.nanmin(z[mesh.faces])), float(np.nanmax(z[mesh.faces]))
    arc = float(np.nanmedian(np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]))) * np.radians(right - left)
    height = int(np.clip(width * (high - low) / max(arc, 1e-6), 0.3 * width, 1.5 * width))
    extent = (left, right, low, high)
    corners = np.stack([theta + cut, z[mesh.faces]], axis=2)
    over = corners - np.array([360.0, 0.0])  # what crosses the cut of a whole ring is drawn at both ends
    twice = np.concatenate([corners, over])
    faces = paint(_in_pixels(twice, extent, (height, width)), np.zeros(len(twice)), (height, width))
    faces = np.where(faces >= 0, faces % len(mesh.faces), -1).astype(np.int32)
    return View(faces, np.zeros(faces.shape, dtype=bool), extent, arc / max(high - low, 1e-6))


def from_side(mesh: Mesh, azimuth: float, height: int = 560, tilt: float = _TILT, extent: Extent | None = None) -> View:
    """The surface seen without perspective from an azimuth (rad) and ``tilt`` (rad) above the horizontal.

    height : px. extent : left, right, bottom, top in mm; the whole surface unless given. Triangles with a lost corner
    are left out.
    """
    towards, right, up = _axes(azimuth, tilt)
    extent = side_extent(mesh, azimuth, tilt) if extent is None else extent
    corners = mesh.vertices[mesh.faces]
    flat = np.stack([corners @ right, corners @ up], axis=2)
    width = max(1, round(height * (extent[1] - extent[0]) / (extent[3] - extent[2])))
    faces = paint(_in_pixels(flat, extent, (height, width)), -(corners @ towards).mean(axis=1), (height, width))
    away = mesh.area_vectors @ towards <= 0
    return View(faces, np.where(faces >= 0, away[faces], False), extent, width / height)


def side_extent(mesh: Mesh, azimuth: float, tilt: float = _TILT) -> Extent:
    """Left, right, bottom and top, mm, of a surface as ``from_side`` shows it, with a margin."""
    _, right, up = _axes(azimuth, tilt)
    corners = mesh.vertices[mesh.faces[mesh.whole_faces()]].reshape(-1, 3)
    flat = corners @ np.stack([right, up], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    margin = 0.02 * float((high - low).max())
    return float(low[0]) - margin, float(high[0]) + margin, float(low[1]) - margin, float(high[1]) + margin


def _axes(azimuth: float, tilt: float) -> tuple[Floats, Floats, Floats]:
    """Unit vectors towards the viewer, to the right and upwards in the picture."""
    towards = np.array([np.cos(azimuth) * np.cos(tilt), np.sin(azimuth) * np.cos(tilt), np.sin(tilt)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return towards, right, np.cross(towards, right)


def through_camera(mesh: Mesh, camera: Camera) -> FaceImage:
    """Numbers of the triangles that a camera sees, per pixel of its image (height, width), −1 for none.

    Triangles with a lost corner and those that face away are left out.
    """
    corners = mesh.vertices[mesh.faces]
    centroids = corners.mean(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        px = camera.project(mesh.vertices)[mesh.faces]
        facing = camera.incidence_cosine(centroids, mesh.normals) > _STEEPEST
    px = np.where(facing[:, None, None], px, np.nan)
    width, height = camera.size
    return paint(px, np.linalg.norm(centroids - camera.centre, axis=1), (height, width))


def _cut(azimuth: Floats) -> float:
    """Azimuth (degrees) at which a surface is cut to be unrolled: the middle of its widest gap, 0 for a closed ring."""
    ordered = np.sort(azimuth[np.isfinite(azimuth)])
    gaps = np.diff(ordered, append=ordered[0] + 360.0)
    widest = int(np.argmax(gaps))
    return float(ordered[widest] + 0.5 * gaps[widest]) if gaps[widest] > 20.0 else 0.0


def _in_pixels(xy: Floats, extent: Extent, shape: tuple[int, int]) -> Floats:
    """Pixels (..., 2) of positions xy (..., 2) on the axes, in a picture whose borders are the extent."""
    left, right, low, high = extent
    x = (xy[..., 0] - left) / (right - left) * shape[1] - 0.5
    y = (high - xy[..., 1]) / (high - low) * shape[0] - 0.5
    return np.stack([x, y], axis=-1)
