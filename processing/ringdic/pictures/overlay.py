"""Overlays: a field drawn over the photograph that a camera took at a step."""

from __future__ import annotations

import cv2
import numpy as np

from ringdic.arrays import Image
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera
from ringdic.mesh.mesh import Mesh
from ringdic.pictures.scale import Picture, Scale, face_colours, on_faces
from ringdic.pictures.views import through_camera
from ringdic.results.evaluation import EvaluatedResults
from ringdic.session.folder import Session
from ringdic.session.images import read_gray


def overlay(
    results: EvaluatedResults, camera_id: str, image: Image, scale: Scale, step: int, opacity: float = 0.65
) -> Picture:
    """A photograph with a field drawn over it, (height, width, 3) uint8 sRGB.

    camera_id : of a camera of the run. image : (height, width) grey levels, that camera's photograph of ``step``.
    scale : colours of the field. opacity : of the colours, 0 to 1. Triangles are drawn where the material was at that
    step, whatever motion the evaluation removes; the photograph stays bare where nothing was measured.

    Raises InputError for a camera that the run does not have, a photograph of another size, an opacity beyond 0 to 1.
    """
    camera = camera_of(results, camera_id)
    if image.shape != (camera.size[1], camera.size[0]):
        raise InputError(
            f"camera {camera_id}: the photograph is {image.shape[1]} x {image.shape[0]} px, but the camera was "
            f"calibrated at {camera.size[0]} x {camera.size[1]} px; use the photographs of this session"
        )
    if not 0.0 <= opacity <= 1.0:
        raise InputError(f"the opacity of an overlay is from 0 to 1, not {opacity:g}")
    mesh = Mesh(results.results.vertices[step], results.results.faces)
    values = on_faces(results, scale.field, step)
    drawn = face_colours(through_camera(mesh, camera), values, scale)
    weight = opacity * drawn[..., 3:]
    grey = np.asarray(image, dtype=float) / np.iinfo(image.dtype).max
    return np.asarray(np.rint(255.0 * ((1.0 - weight) * grey[..., None] + weight * drawn[..., :3])), dtype=np.uint8)


def photograph(session: Session, capture_id: str, camera_id: str) -> Image:
    """Photograph of a camera at a capture, (height, width) grey levels. Raises InputError where there is none."""
    for capture in session.captures:
        if capture.id == capture_id and camera_id in capture.images:
            return read_gray(capture.images[camera_id])
    raise InputError(f"{session.path}: camera {camera_id} has no image in {capture_id}; choose another camera or step")


def camera_of(results: EvaluatedResults, camera_id: str) -> Camera:
    """The calibrated camera of an id. Raises InputError if the run has none."""
    for camera in results.results.cameras:
        if camera.id == camera_id:
            return camera
    known = ", ".join(camera.id for camera in results.results.cameras)
    raise InputError(f"the run has no camera '{camera_id}'; it has {known}")


def with_bar(picture: Picture, scale: Scale) -> Picture:
    """A picture (height, width, 3), uint8 sRGB, extended by the colour bar at its right."""
    return np.hstack([picture, scale.bar(len(picture))])


def no_larger(picture: Picture, side: int) -> Picture:
    """A picture (height, width, 3) scaled down so that neither side is longer than ``side`` px; 0: not scaled."""
    share = side / max(picture.shape[:2]) if side else 1.0
    if share >= 1.0:
        return picture
    size = max(1, round(picture.shape[1] * share)), max(1, round(picture.shape[0] * share))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
