"""The rows of the gallery: a body in a rig, with the motion between its two images."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from ringdic.errors import InputError
from ringdic_node.virtual_rig.bodies import solid_bodies
from ringdic_node.virtual_rig.rig import VirtualRig, arc_rig, paper_rig, two_row_rig
from ringdic_node.virtual_rig.scenes import BoardScene, Scene, SolidMotion, SolidSpecimen, TargetScene

from ringdic_controller.studies.validate.image_cache import RenderedShot

BOARDS = 8  # views of the checkerboard a camera
_SPECKLE_SEED = 12
_DEFOCUS = 1.375  # px; with the lens's 0.6 px, images are blurred by 1.5 px

#: A deformation with strains of 3 to 5 % and a small rigid motion.
MODERATE = SolidMotion(
    stretch=0.03, swell=0.04, swell_z=10.0, swell_width=70.0, twist=4e-4, bend=(2e-4, -1e-4),
    turn_deg=(0.6, -0.5, 1.5), shift=(1.0, -0.6, 0.8),
)  # fmt: skip
#: A rigid motion in all directions.
RIGID = SolidMotion(turn_deg=(1.2, -1.5, 3.0), shift=(1.5, -0.8, 1.2))


@dataclass(frozen=True)
class GalleryRow:
    """A body in a rig and its motion from the first image to the second.

    rig : "ring12", "ring6", "arc4", … variant : added to the row's name. defocus : blur of the images, px.
    """

    body: str
    rig: str
    motion: SolidMotion
    variant: str = ""
    defocus: float = 0.0

    @property
    def name(self) -> str:
        """Name of the row, such as ``limb-turned-40-arc4``."""
        return "-".join(part for part in (self.body, self.variant, self.rig) if part)

    @property
    def specimens(self) -> tuple[SolidSpecimen, SolidSpecimen]:
        """The body before and after its motion."""
        body = solid_bodies()[self.body]()
        before = SolidSpecimen(body, SolidMotion(), _SPECKLE_SEED, self.defocus)
        return before, replace(before, motion=self.motion)


def gallery_rig(name: str, scale: float, seed: int = 0) -> VirtualRig:
    """The cameras of a rig by its name, with images of a scale. seed : of the cameras' scatter."""
    if name == "rows2":
        return two_row_rig(12, 6, scale, seed)
    kind, count = name.rstrip("0123456789"), int(name[len(name.rstrip("0123456789")) :])
    return paper_rig(count, scale, seed) if kind == "ring" else arc_rig(count, 30.0, scale, seed)


def gallery_rows(only: Sequence[str] = ()) -> list[GalleryRow]:
    """The rows of the gallery; with ``only``, those of these names, or of all bodies and rigs of these names.

    Raises InputError for a name that is none of a row, a body or a rig.
    """
    rows = _all_rows()
    for name in only:
        if not any(name in (row.name, row.body, row.rig) for row in rows):
            names = ", ".join(row.name for row in rows)
            raise InputError(f"--only: there is no body, rig or row '{name}' in the gallery; its rows are {names}")
    return [row for row in rows if not only or {row.name, row.body, row.rig} & set(only)]


def _all_rows() -> list[GalleryRow]:
    rows = [
        GalleryRow(body, rig, RIGID if body.startswith("plate") else MODERATE)
        for body, rigs in _RIGS.items()
        for rig in rigs
    ]
    for turn in (10, 20, 40):
        rows.append(GalleryRow("limb", "arc4", SolidMotion(turn_deg=(0.0, 0.0, float(turn))), f"turned-{turn}"))
    rows.append(GalleryRow("limb", "arc4", MODERATE, "blurred", _DEFOCUS))
    return rows


_RIGS: Mapping[str, tuple[str, ...]] = {
    "limb": ("arc4", "ring6", "ring12", "arc2"),
    "limb-tilted": ("arc4", "ring12"),
    "plate-tangent": ("arc4", "ring12", "arc2"),
    "plate-axis": ("arc4", "ring12"),
    "box-90": ("arc4", "ring6", "ring12"),
    "box-100": ("arc4", "ring12"),
    "bean": ("arc4", "ring12"),
    "rod-20": ("arc4", "ring12"),
    "rod-30": ("arc4", "ring12"),
    "rod-75": ("arc4", "ring6", "ring12"),
    "cone": ("arc4", "ring12"),
    "hourglass": ("arc4", "ring12"),
    "foot": ("arc4", "ring12", "rows2"),
    "stump": ("ring12", "rows2"),
    "two-rods": ("arc4", "ring12"),
}


def calibration_scenes(seed: int = 0) -> list[tuple[str, Scene]]:
    """Kind of capture and scene of every calibration image of a rig. seed : of the board's poses."""
    return [*(("board", BoardScene(k, seed)) for k in range(BOARDS)), ("target", TargetScene())]


def rendered_shots(rig: VirtualRig, scenes: Sequence[tuple[str, Scene]]) -> list[tuple[str, dict[str, RenderedShot]]]:
    """Kind of capture and one image by camera id, for each scene; every image has noise of its own."""
    return [
        (
            kind,
            {
                camera.id: RenderedShot(camera, scene, zlib.crc32(f"gallery {kind} {k} {camera.id}".encode()))
                for camera in rig.cameras
            },
        )
        for k, (kind, scene) in enumerate(scenes)
    ]
