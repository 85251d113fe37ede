"""A rendered measurement as a folder of images, in the form that ``ringdic import`` reads."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ringdic_node.cameras.camera import Frame
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.render import render
from ringdic_node.virtual_rig.rig import VirtualRig, write_truth
from ringdic_node.virtual_rig.scenes import scene


@dataclass(frozen=True)
class Measurement:
    """The images that each camera takes in a rendered measurement: how many of each kind, and of which specimen.

    boards : views of the checkerboard. steps : deformed steps after the reference. at_rest : further images of the
    undeformed specimen. specimen : "limb" or "cylinder". seed : of the speckles, the board's poses and the noise.
    """

    boards: int = 8
    steps: int = 2
    at_rest: int = 0
    specimen: str = "limb"
    seed: int = 0

    def images(self, camera: str) -> Iterator[tuple[str, str, int]]:
        """List the images of one camera: path within the folder, capture kind, number of the scene."""
        for view in range(self.boards):
            yield f"board/{camera}/{view:02d}.pgm", "board", view
        yield f"target/{camera}.pgm", "target", 0
        for step in range(self.steps + 1):
            yield f"specimen/{camera}/{step:02d}.pgm", "specimen", step
        for view in range(self.at_rest):
            yield f"static/{camera}/{view:02d}.pgm", "static", view

    def image(self, camera: VirtualCamera, kind: str, number: int) -> Frame:
        """Render the image of scene ``number`` of a capture kind by a camera, with noise of its own seed."""
        noise = zlib.crc32(f"{self.seed}/{camera.id}/{kind}/{number}".encode())
        pixels = render(camera, scene(kind, number, specimen=self.specimen, seed=self.seed), noise)
        return Frame(pixels=pixels, time_ns=0)


def write_folder(
    folder: Path, rig: VirtualRig, measurement: Measurement, progress: Callable[[int, int], None] = lambda *_: None
) -> None:
    """Render all images of a measurement into a folder, with ``rig.toml`` and the true cameras beside them.

    The images are binary PGM files. ``progress`` is called with the number of images written and their total.
    Raises FileExistsError if the folder exists.
    """
    folder = Path(folder)
    folder.mkdir(parents=True)
    (folder / "rig.toml").write_text(rig.rig_toml(), encoding="utf-8")
    write_truth(rig, folder)
    shots = [(camera, *image) for camera in rig.cameras for image in measurement.images(camera.id)]
    for done, (camera, name, kind, number) in enumerate(shots, start=1):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"".join(measurement.image(camera, kind, number).pgm()))
        progress(done, len(shots))
