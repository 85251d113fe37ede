"""A cache of rendered images of the simulated rig on disk."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
from ringdic_node.virtual_rig.disturbance import CALM, ShotCondition
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.render import STAMP, render
from ringdic_node.virtual_rig.scenes import Scene

PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


@dataclass(frozen=True)
class RenderedShot:
    """Description of an image to render.

    seed : of the sensor's noise. jpeg : quality, or None for a lossless image. condition : exposure, noise and motion
    of the image. time_ns : of the exposure as the record of the capture states it, which changes no image.
    """

    camera: VirtualCamera
    scene: Scene
    seed: int
    jpeg: int | None = None
    condition: ShotCondition = CALM
    time_ns: int | None = None

    @property
    def key(self) -> str:
        """Hash (16 digits) of all that the image depends on: camera, scene, noise, coding, the renderer's code."""
        camera = self.camera
        view = (camera.id, camera.width, camera.height)
        exact = [values.tobytes() for values in (camera.lens, camera.R, camera.t)]
        described = f"{STAMP} {view} {exact} {self.scene!r} {self.seed} {self.jpeg} {self.condition!r}"
        return hashlib.sha256(described.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class ImageCache:
    """A folder of rendered images, each named by a hash of everything that it depends on."""

    folder: Path

    def path(self, shot: RenderedShot) -> Path:
        """File of an image, which may not have been rendered yet."""
        return self.folder / f"{shot.camera.id}-{shot.key}.{'png' if shot.jpeg is None else 'jpg'}"

    def render_missing(
        self, shots: Sequence[RenderedShot], progress: Callable[[float], None] = lambda _: None
    ) -> list[Path]:
        """Render missing images on all cores; returns the file of each image, in the order given."""
        self.folder.mkdir(parents=True, exist_ok=True)
        paths = {self.path(shot): shot for shot in shots}
        missing = [shot for path, shot in paths.items() if not path.is_file()]
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            for done, _ in enumerate(pool.map(self._take, missing), start=1):
                progress(done / len(missing))
        return [self.path(shot) for shot in shots]

    def _take(self, shot: RenderedShot) -> None:
        path = self.path(shot)
        if path.is_file():  # another process was faster
            return
        coding = PNG if shot.jpeg is None else [cv2.IMWRITE_JPEG_QUALITY, shot.jpeg]
        _, coded = cv2.imencode(path.suffix, render(shot.camera, shot.scene, shot.seed, shot.condition), coding)
        aside = path.with_name(f".{path.stem}-{os.getpid()}.partial")
        aside.write_bytes(coded.tobytes())
        aside.replace(path)
