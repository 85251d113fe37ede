"""Animations of a field over the steps, as GIF or MP4."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from ringdic.errors import ComputationError, InputError
from ringdic.mesh.mesh import Mesh
from ringdic.pictures.overlay import no_larger, overlay, photograph, with_bar
from ringdic.pictures.scale import Picture, Scale, face_colours, on_faces
from ringdic.pictures.views import Extent, from_side, side_extent
from ringdic.results.evaluation import EvaluatedResults
from ringdic.session.folder import Session

_STRIP = 26  # px, of the line of text over a frame
_INSIDE = (219, 222, 227)


def overlay_frames(
    results: EvaluatedResults, session: Session, camera_id: str, scale: Scale, side: int = 720, opacity: float = 0.65
) -> Iterator[Picture]:
    """Frames of an animation, one per step: a camera's photograph with the field over it, colour bar and step name.

    side : px, longest side of a frame. opacity : of the colours, 0 to 1. Frames are (height, width, 3) sRGB.
    """
    for step, name in enumerate(results.steps):
        picture = overlay(results, camera_id, photograph(session, name, camera_id), scale, step, opacity)
        yield _framed(no_larger(picture, side), scale, f"{step}: {name}, camera {camera_id}")


def surface_frames(results: EvaluatedResults, scale: Scale, azimuth: float, side: int = 720) -> Iterator[Picture]:
    """Frames of an animation, one per step: the coloured surface seen from an azimuth (rad).

    The surface is drawn where it stood, or freed of its rigid motion if the evaluation removes it. side : px, height of
    a frame. Frames are (height, width, 3) sRGB. Raises ComputationError if no step has a measured triangle.
    """
    meshes = [Mesh(results.positions(step), results.results.faces) for step in range(len(results.steps))]
    extents = np.array([side_extent(mesh, azimuth) for mesh in meshes if mesh.whole_faces().any()])
    if not len(extents):
        raise ComputationError("no step of the run has a measured triangle; there is nothing to draw")
    low, high = extents.min(axis=0), extents.max(axis=0)
    common: Extent = (float(low[0]), float(high[1]), float(low[2]), float(high[3]))
    for step, mesh in enumerate(meshes):
        view = from_side(mesh, azimuth, height=2 * side, extent=common)  # twice as fine, for smooth rims
        values = on_faces(results, scale.field, step)
        drawn = face_colours(view.faces, values, scale)
        picture = np.where(drawn[..., 3:] > 0, np.rint(255.0 * drawn[..., :3]), 255.0).astype(np.uint8)
        picture[view.inside] = _INSIDE
        yield _framed(no_larger(picture, side), scale, f"{step}: {results.steps[step]}")


def write_animation(path: Path, frames: Sequence[Picture], seconds: float = 0.8) -> None:
    """Write frames (h, w, 3) of one size as GIF or MP4, by the file's ending; each is shown for ``seconds``.

    Raises InputError for another ending, no frames or a time not above 0; ComputationError where this machine's OpenCV
    cannot write MP4.
    """
    path = Path(path)
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise InputError(f"{path}: an animation is a .gif or an .mp4 file; give its name such an ending")
    if not frames or not 0.02 <= seconds <= 60:
        raise InputError(f"{path}: an animation needs frames, each shown for 0.02 to 60 s, not {seconds:g}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder is not there; make it first")
    if path.suffix.lower() == ".gif":
        _write_gif(path, frames, seconds)
    else:
        _write_mp4(path, frames, seconds)


def _write_gif(path: Path, frames: Sequence[Picture], seconds: float) -> None:
    """Write a GIF whose frames share one palette, so that colours do not flicker."""
    together = Image.fromarray(np.vstack([frame[::4, ::4] for frame in frames]))
    palette = together.quantize(256, dither=Image.Dither.NONE)
    pictures = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(1000 * seconds), loop=0)


def _write_mp4(path: Path, frames: Sequence[Picture], seconds: float) -> None:
    height, width = (2 * (side // 2) for side in frames[0].shape[:2])  # the format knows even sizes only
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 1.0 / seconds, (width, height))
    if not film.isOpened():
        raise ComputationError(f"{path}: this machine's OpenCV cannot write MP4; write a .gif file")
    for frame in frames:
        film.write(np.ascontiguousarray(frame[:height, :width, ::-1]))
    film.release()


def _framed(picture: Picture, scale: Scale, text: str) -> Picture:
    """A picture with its colour bar and a line of text above."""
    drawn = with_bar(picture, scale)
    strip = Image.new("RGB", (drawn.shape[1], _STRIP), "white")
    font = ImageFont.truetype(findfont("DejaVu Sans"), 14)
    ImageDraw.Draw(strip).text((6, 4), text, fill="black", font=font)
    return np.vstack([np.asarray(strip), drawn])
