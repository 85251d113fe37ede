"""Reading of a session's images by tasks, with a cache, and digests of the image files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ringdic.arrays import Image
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera
from ringdic.session.folder import Capture, Session
from ringdic.session.mosaic import read_level_gray
from ringdic.tasks import file_digest, process_memory


def step_image(path: Path, camera: Camera, *, again: bool = True) -> Image:
    """The grey levels, (height, width), of an image file of a camera.

    again : whether other tasks need it too, so that it is kept in memory.
    Raises InputError where its size is not the one at which the camera was calibrated.
    """
    grey = process_memory.image(path) if again else read_level_gray(path)
    width, height = camera.size
    if grey.shape != (height, width):
        raise InputError(
            f"{path}: {grey.shape[1]} x {grey.shape[0]} px, but camera {camera.id} was calibrated at "
            f"{width} x {height} px; capture board, target and specimen at one size"
        )
    return grey


@dataclass(frozen=True)
class Digests:
    """Digests of a session's images and masks, each computed once. known : the digests so far, by path."""

    session: Session
    known: dict[Path, str] = field(default_factory=dict)

    def image(self, capture: Capture, id_: str) -> str | None:
        """Digest of a camera's image in a capture; None where there is no such image."""
        path = capture.images.get(id_)
        if path is None:
            return None
        if path not in self.known:
            self.known[path] = file_digest(path, capture.record.cameras.get(id_))
        return self.known[path]

    def mask(self, id_: str) -> str | None:
        """Digest of the region of interest drawn for a camera; None where none was drawn."""
        path = self.session.mask(id_)
        if path is None:
            return None
        if path not in self.known:
            self.known[path] = file_digest(path)
        return self.known[path]
