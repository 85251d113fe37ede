"""The scenes of each experiment, and the images that are taken of them.

``boards``     the checkerboard, for every session
``target``     the calibration cylinder; ``moved`` 5 mm along x (Fig. 6); ``printed`` with errors of the print
``cylinder``   speckled, 114.00 mm, in steps of 0.1 mm along x (Fig. 7)
``limb``       deforming in steps of a fifth of its load (Fig. 9)
``spoilt``     the limb behind bars, with reflections and worn speckles, as JPEG
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

from ringdic_node.virtual_rig.rig import VirtualRig, paper_rig
from ringdic_node.virtual_rig.scenes import (
    Bar,
    BoardScene,
    Cylinder,
    Damage,
    Limb,
    Scene,
    Specimen,
    SpoiltPatch,
    TargetScene,
)

from ringdic_controller.studies.validate.image_cache import RenderedShot

STAGE = (5.0, 0.0, 0.0)  # mm, by which the target is moved
PRINT_ERROR = 0.03  # mm, of every dot in each direction
JPEG = 88  # quality of the spoilt images
_SPECKLE_SEED = 7

_WORN = (SpoiltPatch(0.9, 60.0, 9.0, 9.0), SpoiltPatch(3.6, 150.0, 14.0, 10.0), SpoiltPatch(5.4, 200.0, 10.0, 16.0))
_DROPPED = (SpoiltPatch(2.2, 90.0, 12.0, 12.0), SpoiltPatch(4.6, 110.0, 8.0, 14.0))
_LAMPS = ((460.0, 195.0, 250.0), (-430.0, 260.0, 60.0), (40.0, -500.0, 180.0))


@dataclass(frozen=True)
class Scenery:
    """The scenes of all experiments: the paper's rig at a scale, and the numbers of views and steps.

    boards : views of the checkerboard a camera. cylinder, limb : steps after the reference. spoilt_step : the step of
    the limb at which its spoilt images are taken, after the spoilt reference.
    """

    scale: float = 1.0
    cameras: int = 12
    boards: int = 12
    cylinder: int = 10
    limb: int = 5
    spoilt_step: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.boards, self.cylinder, self.limb, self.spoilt_step) < 1:
            raise ValueError("every experiment needs at least one view or step")

    @property
    def rig(self) -> VirtualRig:
        """The simulated cameras."""
        return paper_rig(self.cameras, self.scale, self.seed)

    def scenes(self, name: str) -> list[Scene]:
        """The scenes of one experiment, in order."""
        if name == "boards":
            return [BoardScene(k, self.seed) for k in range(self.boards)]
        if name == "target":
            return [TargetScene()]
        if name == "moved":
            return [TargetScene(STAGE)]
        if name == "printed":
            return [TargetScene(print_error=PRINT_ERROR, seed=self.seed)]
        if name == "cylinder":
            return [Specimen(Cylinder(), step, _SPECKLE_SEED) for step in range(self.cylinder + 1)]
        if name == "limb":
            return [Specimen(Limb(), step, _SPECKLE_SEED) for step in range(self.limb + 1)]
        if name == "spoilt":
            return [Specimen(Limb(), step, _SPECKLE_SEED, _damage(later=step > 0)) for step in (0, self.spoilt_step)]
        raise ValueError(f"there is no experiment '{name}'")

    def shots(self, name: str) -> list[Mapping[str, RenderedShot]]:
        """The images of one experiment: for each scene, one image by camera id."""
        jpeg = JPEG if name == "spoilt" else None
        return [
            {
                camera.id: RenderedShot(camera, scene, zlib.crc32(f"{self.seed} {name} {k} {camera.id}".encode()), jpeg)
                for camera in self.rig.cameras
            }
            for k, scene in enumerate(self.scenes(name))
        ]


def _damage(later: bool) -> Damage:
    """Worn speckles, lamps and bars at the reference, or at a later step with more worn speckles and moved bars."""
    turn = 0.35 if later else 0.0
    cable = Bar(_about(1.2 + turn, 92.0, 20.0), _about(1.6 + turn, 92.0, 230.0), 4.0)
    hand = Bar(_about(4.0 - turn, 110.0, 70.0), _about(4.0 - turn, 110.0, 100.0), 14.0)
    return Damage(_WORN + (_DROPPED if later else ()), _LAMPS, (cable, hand))


def _about(angle: float, radius: float, z: float) -> tuple[float, float, float]:
    return radius * math.cos(angle), radius * math.sin(angle), z
