"""A field laid over the photograph that a camera took at a step."""

from __future__ import annotations

import cv2
import numpy as np

from ringdic.arrays import Image
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera
from ringdic.mesh.mesh import Mesh
from ringdic.pictures.scale import Picture, Scale, looked_up, on_faces
from ringdic.pictures.views import through_camera
from ringdic.results.evaluation import EvaluatedResults
from ringdic.session.folder import Session
from ringdic.session.images import read_gray


def overlay(
    seen: EvaluatedResults, camera_id: str, image: Image, scale: Scale, step: int, opacity: float = 0.65
) -> Picture:
    """The photograph (h, w) with the field over it, (h, w, 3) sRGB.

    camera_id : of a camera of the run. scale : the field's colours. step : at which ``image`` was taken. opacity : of
    the colours, 0 to 1. Triangles are drawn where the camera sees them, where the material was at that step, whatever
    motion the evaluation removes; the photograph stays bare where nothing was measured.

    Raises InputError for a camera that the run does not have, a photograph of another size, an opacity beyond 0 to 1.
    """
    camera = camera_of(seen, camera_id)
    if image.shape != (camera.size[1], camera.size[0]):
        raise InputError(
            f"camera {camera_id}: the photograph is {image.shape[1]} x {image.shape[0]} px, but the camera was "
            f"calibrated at {camera.size[0]} x {camera.size[1]} px; use the photographs of this session"
        )
    if not 0.0 <= opacity <= 1.0:
        raise InputError(f"the opacity of an overlay is from 0 to 1, not {opacity:g}")
    mesh = Mesh(seen.results.vertices[step], seen.results.faces)
    values = on_faces(seen, scale.field, seen.step(step).scalar(scale.field), step)
    drawn = looked_up(through_camera(mesh, camera), values, scale)
    weight = opacity * drawn[..., 3:]
    grey = np.asarray(image, dtype=float) / np.iinfo(image.dtype).max
    return np.asarray(np.rint(255.0 * ((1.0 - weight) * grey[..., None] + weight * drawn[..., :3])), dtype=np.uint8)


def photograph(session: Session, capture_id: str, camera_id: str) -> Image:
    """The photograph of a camera at a capture; InputError where there is none."""
    for capture in session.captures:
        if capture.id == capture_id and camera_id in capture.images:
            return read_gray(capture.images[camera_id])
    raise InputError(f"{session.path}: camera {camera_id} has no image in {capture_id}; choose another camera or step")


def camera_of(seen: EvaluatedResults, camera_id: str) -> Camera:
    """The camera of this id; InputError if the run has none."""
    for camera in seen.results.cameras:
        if camera.id == camera_id:
            return camera
    known = ", ".join(camera.id for camera in seen.results.cameras)
    raise InputError(f"the run has no camera '{camera_id}'; it has {known}")


def with_bar(picture: Picture, scale: Scale) -> Picture:
    """A picture (h, w, 3) with the colour bar to its right."""
    return np.hstack([picture, scale.bar(len(picture))])


def no_larger(picture: Picture, side: int) -> Picture:
    """A picture (h, w, 3) made smaller so that neither side is longer than ``side`` px; 0 leaves it as it is."""
    share = side / max(picture.shape[:2]) if side else 1.0
    if share >= 1.0:
        return picture
    size = max(1, round(picture.shape[1] * share)), max(1, round(picture.shape[0] * share))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
