"""What a mishap does to a measurement: to its images, its cameras, or the description of its rig."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from ringdic_node.virtual_rig import disturbance
from ringdic_node.virtual_rig.disturbance import ShotCondition
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.scenes import BoardScene, Damage, SolidSpecimen, TargetScene
from ringdic_node.virtual_rig.solid_damage import grown_hairs

from ringdic_controller.studies.mishaps.measurement import PlannedMeasurement, Shots, motion_share
from ringdic_controller.studies.validate.image_cache import RenderedShot

Change = Callable[[PlannedMeasurement], PlannedMeasurement]
CameraChange = Callable[[VirtualCamera], VirtualCamera]

#: How a camera may be knocked: by a name, the camera after it, from the camera and the shift of its image in px.
KNOCKS: dict[str, Callable[[VirtualCamera, float], VirtualCamera]] = {
    "turned-rows": lambda camera, px: disturbance.turned_camera(camera, px, 0.0),
    "turned-columns": lambda camera, px: disturbance.turned_camera(camera, 0.0, px),
    "shifted-rows": lambda camera, px: disturbance.shifted_camera(camera, px, 0.0),
    "shifted-columns": lambda camera, px: disturbance.shifted_camera(camera, 0.0, px),
    "rolled": disturbance.rolled_camera,
    "retracted": disturbance.retracted_camera,
}


def unchanged(measurement: PlannedMeasurement) -> PlannedMeasurement:
    """A change that leaves the measurement as it is: nothing goes wrong."""
    return measurement


def all_of(*changes: Change) -> Change:
    """A change that makes several changes of a measurement, one after the other."""

    def change(measurement: PlannedMeasurement) -> PlannedMeasurement:
        for each in changes:
            measurement = each(measurement)
        return measurement

    return change


def shots_changed(
    change: Callable[[RenderedShot], RenderedShot],
    cameras: Sequence[str] | None = None,
    steps: Sequence[int] | None = None,
    kind: str = "specimen",
) -> Change:
    """A change that describes single images of the measurement anew.

    change : from an image to the one that is taken in its place. cameras : ids; steps : numbers of the captures among
    their kind, the reference 0; None for all. kind : of the captures, "board", "target" or "specimen".
    """
    return lambda measurement: measurement.changed_shots(change, cameras, steps, kind)


def camera_changed(
    change: CameraChange,
    cameras: Sequence[str] | None = None,
    steps: Sequence[int] | None = None,
    kind: str = "specimen",
) -> Change:
    """A change that puts other cameras, such as knocked ones, in the place of those that take some captures.

    cameras : ids; steps : numbers of the captures, the reference 0; None for all. kind : of the captures.
    """
    return shots_changed(lambda shot: replace(shot, camera=change(shot.camera)), cameras, steps, kind)


def knocked(how: str, px: float, cameras: Sequence[str] | None, steps: Sequence[int] | None = None) -> Change:
    """A change that knocks cameras before some captures of the specimen.

    how : one of `KNOCKS`. px : shift of their images. cameras : ids; steps : numbers of the captures, the reference 0;
    None for all.
    """
    return camera_changed(lambda camera: KNOCKS[how](camera, px), cameras, steps)


def refocused(
    factor: float, cameras: Sequence[str] | None, steps: Sequence[int] | None = None, kind: str = "specimen"
) -> Change:
    """A change that refocuses lenses before some captures: their focal lengths become ``factor`` times as long.

    cameras : ids; steps : numbers of the captures among their kind, None for all. kind : of the captures.
    """
    return camera_changed(partial(disturbance.refocused_camera, factor=factor), cameras, steps, kind)


def taken_otherwise(
    condition: ShotCondition, cameras: Sequence[str] | None = None, steps: Sequence[int] | None = None
) -> Change:
    """A change that takes images of the specimen under another condition, such as another exposure, or mirrored.

    cameras : ids; steps : numbers of the captures, the reference 0; None for all.
    """
    return shots_changed(lambda shot: replace(shot, condition=condition), cameras, steps)


def always_taken_otherwise(condition: ShotCondition, camera: str) -> Change:
    """A change that takes every image of a camera, of board, target and specimen, under another condition."""

    def change(shot: RenderedShot) -> RenderedShot:
        return replace(shot, condition=condition)

    return all_of(*(shots_changed(change, [camera], kind=kind) for kind in ("board", "target", "specimen")))


def coded_as_jpeg(quality: int) -> Change:
    """A change that stores the images of the specimen as JPEG files of a quality, 0 to 100."""
    return shots_changed(lambda shot: replace(shot, jpeg=quality))


def flickering(measurement: PlannedMeasurement) -> PlannedMeasurement:
    """A change that gives every image of the specimen a light of its own, which scatters by a fifth of the calm one."""

    def lit(shot: RenderedShot) -> RenderedShot:
        light = 1.0 + 0.2 * float(np.clip(np.random.default_rng([shot.seed, 50]).normal(), -1.5, 1.0))
        return replace(shot, condition=ShotCondition(light=light))

    return measurement.changed_shots(lit)


def specimen_changed(
    cameras: Sequence[str] | None = None, steps: Sequence[int] | None = None, **values: object
) -> Change:
    """A change that gives the specimen other properties, as some cameras see it at some steps.

    cameras : ids; steps : numbers of the captures, the reference 0; None for all. values : fields of `SolidSpecimen`,
    such as ``defocus`` (px) or ``speckle``.
    """

    def change(shot: RenderedShot) -> RenderedShot:
        assert isinstance(shot.scene, SolidSpecimen)
        return replace(shot, scene=replace(shot.scene, **values))  # type: ignore[arg-type]

    return shots_changed(change, cameras, steps)


def hairy(count: int) -> Change:
    """A change that lays dark hairs on the specimen, at random places, which move with its skin. count : of hairs."""

    def change(shot: RenderedShot) -> RenderedShot:
        assert isinstance(shot.scene, SolidSpecimen)
        hairs = _hairs(shot.scene.solid, count, shot.scene.seed)
        return replace(shot, scene=replace(shot.scene, damage=Damage(hairs=hairs)))

    return shots_changed(change)


_hairs = lru_cache(grown_hairs)


def damaged(*damages: Damage) -> Change:
    """A change that adds shadows, reflections or bars to the specimen, for each step, the reference first."""
    return all_of(*(specimen_changed(None, [step], damage=each) for step, each in enumerate(damages)))


def target_nudged(offset: tuple[float, float, float], camera: str) -> Change:
    """A change that pushes the target aside before one camera takes its image of it. offset : mm, in the world."""
    return shots_changed(lambda shot: replace(shot, scene=TargetScene(offset)), [camera], kind="target")


def board_bowed(bow: float) -> Change:
    """A change that bows the checkerboard in all its views. bow : mm, of its middle."""

    def change(shot: RenderedShot) -> RenderedShot:
        assert isinstance(shot.scene, BoardScene)
        return replace(shot, scene=replace(shot.scene, bow=bow))

    return shots_changed(change, kind="board")


def exchanged(first: str, second: str, steps: Sequence[int] | None = None, kind: str = "specimen") -> Change:
    """A change that files the images of two cameras under each other's names.

    steps : numbers of the captures among their kind, None for all. kind : of the captures.
    """

    def swap(_: int, shots: Shots) -> Shots:
        return {**shots, first: shots[second], second: shots[first]}

    return lambda measurement: measurement.changed_captures(swap, kind, steps)


def repeated(camera: str, step: int, of: int) -> Change:
    """A change by which a camera delivers at a step the very image that it took at another step, numbered ``of``."""

    def change(measurement: PlannedMeasurement) -> PlannedMeasurement:
        old = measurement.images("specimen", of)[camera]
        return measurement.changed_shots(lambda _: old, [camera], [step])

    return change


def late_scene(camera: str, step: int, of: int) -> Change:
    """A change by which a camera shows at a step, in an image of its own, the body as it was at step ``of``."""

    def change(measurement: PlannedMeasurement) -> PlannedMeasurement:
        scene = measurement.images("specimen", of)[camera].scene
        return measurement.changed_shots(lambda shot: replace(shot, scene=scene), [camera], [step])

    return change


def gaps_closed(measurement: PlannedMeasurement) -> PlannedMeasurement:
    """A change by which camera k loses its image of step k and files those after it one step earlier."""
    positions = [position for position, _ in measurement.numbered("specimen")]

    def moved_up(number: int, shots: Shots) -> Shots:
        return {id_: measurement.images("specimen", number + (number >= k))[id_] for k, id_ in enumerate(shots)}

    shorter = measurement.changed_captures(moved_up, steps=range(len(positions) - 1))
    return replace(shorter, captures=shorter.captures[: positions[-1]])


def other_instant(camera: str, share: float, step: int, recorded_ms: float | None) -> Change:
    """A change by which a camera shows the moving body, at a step, a share of the whole motion later than the others.

    recorded_ms : lateness that the record of the capture states, ms; None where it states no times.
    """

    def change(measurement: PlannedMeasurement) -> PlannedMeasurement:
        whole = measurement.images("specimen", len(list(measurement.numbered("specimen"))) - 1)[camera].scene
        assert isinstance(whole, SolidSpecimen)
        scene = measurement.images("specimen", step)[camera].scene
        assert isinstance(scene, SolidSpecimen)
        reached = 0.5 * step + share
        moved = replace(scene, motion=motion_share(whole.motion, reached))
        changed = measurement.changed_shots(lambda shot: replace(shot, scene=moved), [camera], [step])
        return changed if recorded_ms is None else _dated(changed, camera, step, recorded_ms)

    return change


def dated(measurement: PlannedMeasurement) -> PlannedMeasurement:
    """A change that records the times of all exposures of the specimen, less than 0.1 ms apart in each capture."""
    return _dated(measurement, "", 0, 0.0)


def _dated(measurement: PlannedMeasurement, late: str, step: int, late_ms: float) -> PlannedMeasurement:
    def date(number: int, shots: Shots) -> Shots:
        base = 1_700_000_000_000_000_000 + number * 2_000_000_000
        return {
            id_: replace(
                shot,
                time_ns=base
                + zlib.crc32(f"{number} {id_}".encode()) % 100_000
                + round(1e6 * late_ms) * (id_ == late and number == step),
            )
            for id_, shot in shots.items()
        }

    return measurement.changed_captures(date)


def camera_missing(camera: str, steps: Sequence[int]) -> Change:
    """A change by which a camera delivers no image at some steps. steps : numbers of the captures, the reference 0."""

    def without(_: int, shots: Shots) -> Shots:
        return {id_: shot for id_, shot in shots.items() if id_ != camera}

    return lambda measurement: measurement.changed_captures(without, steps=steps)


def set_up_again(measurement: PlannedMeasurement) -> PlannedMeasurement:
    """A change that sets up the rig again after the calibration: all cameras turn, shift and refocus a little."""
    change: Change = unchanged
    for number, camera in enumerate(measurement.cameras):
        rows, columns, aside, focus = np.random.default_rng([number, 88]).normal(size=4)
        change = all_of(
            change,
            knocked("turned-rows", 8.0 * rows, [camera]),
            knocked("turned-columns", 8.0 * columns, [camera]),
            knocked("shifted-rows", 8.0 * aside, [camera]),
            refocused(1.0 + 0.003 * focus, [camera]),
        )
    return change(measurement)


def rig_described(values: Mapping[str, float | str]) -> Change:
    """A change of the rig file alone: other measures of target or board than those that the images show.

    values : by their names in the rig file, such as ``radius_mm``, which must stand in it once.
    """

    def change(measurement: PlannedMeasurement) -> PlannedMeasurement:
        text = measurement.rig_toml
        for name, value in values.items():
            text, count = re.subn(rf"(?m)^{name} = .*$", f"{name} = {value}", text)
            if count != 1:
                raise ValueError(f"'{name}' does not stand once in the rig file")
        return replace(measurement, rig_toml=text)

    return change
