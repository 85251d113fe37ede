"""A measurement on the virtual rig: its images by capture and camera, before they are rendered."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from ringdic_node.virtual_rig.bodies import solid_bodies
from ringdic_node.virtual_rig.scenes import SolidMotion, SolidSpecimen

from ringdic_controller.studies.gallery.rows import calibration_scenes, gallery_rig, rendered_shots
from ringdic_controller.studies.validate.image_cache import RenderedShot

SHARES = (0.0, 0.5, 1.0)  # of the motion, at the reference and at the two steps
_SPECKLE_SEED = 12
Shots = Mapping[str, RenderedShot]
#: Kind of capture and its images by camera, in the order in which they were taken.
Captures = tuple[tuple[str, Shots], ...]


@dataclass(frozen=True)
class PlannedMeasurement:
    """A measurement before its images are rendered. rig_toml : text of the rig file. captures : what is taken."""

    rig_toml: str
    captures: Captures

    @classmethod
    def calm(cls, rig: str, scale: float, specimens: Sequence[SolidSpecimen], seed: int = 0) -> PlannedMeasurement:
        """A measurement without a mishap.

        rig : its name in the gallery. scale : of the images. specimens : the body at the reference and at the steps.
        seed : of the cameras' scatter and the board's poses.
        """
        cameras = gallery_rig(rig, scale, seed)
        scenes = [*calibration_scenes(seed), *(("specimen", specimen) for specimen in specimens)]
        return cls(cameras.rig_toml(), tuple(rendered_shots(cameras, scenes)))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Ids of the cameras."""
        return tuple(self.captures[0][1])

    def numbered(self, kind: str) -> Iterator[tuple[int, int]]:
        """Positions of the captures of a kind in the measurement, each with its number among its kind."""
        for number, position in enumerate(k for k, (each, _) in enumerate(self.captures) if each == kind):
            yield position, number

    def changed_captures(
        self, change: Callable[[int, Shots], Shots], kind: str = "specimen", steps: Sequence[int] | None = None
    ) -> PlannedMeasurement:
        """A copy of the measurement in which some captures of a kind hold other images.

        change : from number and images of a capture to its new images. steps : numbers of the captures, None for all.
        """
        captures = list(self.captures)
        for position, number in self.numbered(kind):
            if steps is None or number in steps:
                captures[position] = (kind, dict(change(number, captures[position][1])))
        return replace(self, captures=tuple(captures))

    def changed_shots(
        self,
        change: Callable[[RenderedShot], RenderedShot],
        cameras: Sequence[str] | None = None,
        steps: Sequence[int] | None = None,
        kind: str = "specimen",
    ) -> PlannedMeasurement:
        """A copy of the measurement in which some images of a kind of capture are described anew.

        change : from an image to the one that is taken in its place. cameras : ids; steps : numbers of the captures
        among their kind; None for all.
        """

        def all_changed(_: int, shots: Shots) -> Shots:
            return {id_: change(shot) if cameras is None or id_ in cameras else shot for id_, shot in shots.items()}

        return self.changed_captures(all_changed, kind, steps)

    def images(self, kind: str, number: int) -> Shots:
        """Images by camera of the capture with this number among its kind."""
        return next(self.captures[position][1] for position, each in self.numbered(kind) if each == number)


def motion_share(motion: SolidMotion, share: float) -> SolidMotion:
    """A share of a motion: its stretches, turns and shifts, at the same places of the body."""
    (bx, by), (tx, ty, tz), (x, y, z) = motion.bend, motion.turn_deg, motion.shift
    return replace(
        motion,
        stretch=share * motion.stretch,
        swell=share * motion.swell,
        twist=share * motion.twist,
        bend=(share * bx, share * by),
        turn_deg=(share * tx, share * ty, share * tz),
        shift=(share * x, share * y, share * z),
    )


def moving_specimens(motion: SolidMotion, body: str = "limb", seed: int = 0) -> tuple[SolidSpecimen, ...]:
    """The body of a name in the gallery at the reference and at the two steps of a motion. seed : of its speckles."""
    solid = solid_bodies()[body]()
    return tuple(SolidSpecimen(solid, motion_share(motion, share), _SPECKLE_SEED + seed) for share in SHARES)
