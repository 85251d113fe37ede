"""What a mishap does to a measurement: to its images, its cameras, or the description of its rig."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from ringdic_node.virtual_rig import disturbance
from ringdic_node.virtual_rig.disturbance import ShotCondition
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.scenes import BoardScene, Damage, SolidSpecimen, TargetScene

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
    """The measurement as it is: nothing goes wrong."""
    return measurement


def all_of(*changes: Change) -> Change:
    """Several changes, one after the other."""

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
    """A change of single images. cameras, steps : those concerned, None for all. kind : of the captures."""
    return lambda measurement: measurement.changed_shots(change, cameras, steps, kind)


def camera_changed(
    change: CameraChange,
    cameras: Sequence[str] | None = None,
    steps: Sequence[int] | None = None,
    kind: str = "specimen",
) -> Change:
    """A change of the cameras themselves in some captures. cameras, steps : those concerned, None for all."""
    return shots_changed(lambda shot: replace(shot, camera=change(shot.camera)), cameras, steps, kind)


def knocked(how: str, px: float, cameras: Sequence[str] | None, steps: Sequence[int] | None = None) -> Change:
    """Cameras knocked before some steps, None for all. how : one of `KNOCKS`. px : shift of their images."""
    return camera_changed(lambda camera: KNOCKS[how](camera, px), cameras, steps)


def refocused(
    factor: float, cameras: Sequence[str] | None, steps: Sequence[int] | None = None, kind: str = "specimen"
) -> Change:
    """Lenses refocused before some captures: their focal lengths are ``factor`` times as long."""
    return camera_changed(partial(disturbance.refocused_camera, factor=factor), cameras, steps, kind)


def taken_otherwise(
    condition: ShotCondition, cameras: Sequence[str] | None = None, steps: Sequence[int] | None = None
) -> Change:
    """Images of the specimen taken with another exposure, more noise, or moved or mirrored."""
    return shots_changed(lambda shot: replace(shot, condition=condition), cameras, steps)


def always_taken_otherwise(condition: ShotCondition, camera: str) -> Change:
    """All images of a camera taken otherwise, those of board and target with them."""

    def change(shot: RenderedShot) -> RenderedShot:
        return replace(shot, condition=condition)

    return all_of(*(shots_changed(change, [camera], kind=kind) for kind in ("board", "target", "specimen")))


def coded_as_jpeg(quality: int) -> Change:
    """Images of the specimen coded as JPEG of a quality."""
    return shots_changed(lambda shot: replace(shot, jpeg=quality))


def flickering(measurement: PlannedMeasurement) -> PlannedMeasurement:
    """Every image of the specimen lit otherwise than the others, by a fifth (standard deviation)."""

    def lit(shot: RenderedShot) -> RenderedShot:
        light = 1.0 + 0.2 * float(np.clip(np.random.default_rng([shot.seed, 50]).normal(), -1.5, 1.0))
        return replace(shot, condition=ShotCondition(light=light))

    return measurement.changed_shots(lit)


def specimen_changed(
    cameras: Sequence[str] | None = None, steps: Sequence[int] | None = None, **values: object
) -> Change:
    """The specimen with other fields, such as ``defocus`` or ``speckle``, as some cameras see it at some steps."""

    def change(shot: RenderedShot) -> RenderedShot:
        assert isinstance(shot.scene, SolidSpecimen)
        return replace(shot, scene=replace(shot.scene, **values))  # type: ignore[arg-type]

    return shots_changed(change, cameras, steps)


def damaged(*damages: Damage) -> Change:
    """Shadows, reflections or bars at each step, the reference first."""
    return all_of(*(specimen_changed(None, [step], damage=each) for step, each in enumerate(damages)))


def target_nudged(offset: tuple[float, float, float], camera: str) -> Change:
    """The target pushed aside before a camera took its image, mm."""
    return shots_changed(lambda shot: replace(shot, scene=TargetScene(offset)), [camera], kind="target")


def board_bowed(bow: float) -> Change:
    """The checkerboard bowed in all its views, mm."""

    def change(shot: RenderedShot) -> RenderedShot:
        assert isinstance(shot.scene, BoardScene)
        return replace(shot, scene=replace(shot.scene, bow=bow))

    return shots_changed(change, kind="board")


def exchanged(first: str, second: str, steps: Sequence[int] | None = None, kind: str = "specimen") -> Change:
    """The images of two cameras filed under each other's names."""

    def swap(_: int, shots: Shots) -> Shots:
        return {**shots, first: shots[second], second: shots[first]}

    return lambda measurement: measurement.changed_captures(swap, kind, steps)


def repeated(camera: str, step: int, of: int) -> Change:
    """A camera that delivers at a step the very image that it took at another."""

    def change(measurement: PlannedMeasurement) -> PlannedMeasurement:
        old = measurement.images("specimen", of)[camera]
        return measurement.changed_shots(lambda _: old, [camera], [step])

    return change


def late_scene(camera: str, step: int, of: int) -> Change:
    """A camera that shows at a step what stood there at another, in an image of its own."""

    def change(measurement: PlannedMeasurement) -> PlannedMeasurement:
        scene = measurement.images("specimen", of)[camera].scene
        return measurement.changed_shots(lambda shot: replace(shot, scene=scene), [camera], [step])

    return change


def gaps_closed(measurement: PlannedMeasurement) -> PlannedMeasurement:
    """Camera k lost the image of step k, and each camera's images were filed one after the other: one step fewer."""
    positions = [position for position, _ in measurement.numbered("specimen")]

    def moved_up(number: int, shots: Shots) -> Shots:
        return {id_: measurement.images("specimen", number + (number >= k))[id_] for k, id_ in enumerate(shots)}

    shorter = measurement.changed_captures(moved_up, steps=range(len(positions) - 1))
    return replace(shorter, captures=shorter.captures[: positions[-1]])


def other_instant(camera: str, share: float, step: int, recorded_ms: float | None) -> Change:
    """A camera that shows the moving body a share of the motion later than the others do.

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
    """All images of the specimen with the time of their exposure, less than 0.1 ms apart in each capture."""
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
    """A camera that delivers no image at some steps."""

    def without(_: int, shots: Shots) -> Shots:
        return {id_: shot for id_, shot in shots.items() if id_ != camera}

    return lambda measurement: measurement.changed_captures(without, steps=steps)


def set_up_again(measurement: PlannedMeasurement) -> PlannedMeasurement:
    """The rig taken down and set up again after the calibration: all cameras turned, shifted and refocused a little."""
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
    """The rig file with other values of the target or board, by names such as ``radius_mm``; each stands in it once."""

    def change(measurement: PlannedMeasurement) -> PlannedMeasurement:
        text = measurement.rig_toml
        for name, value in values.items():
            text, count = re.subn(rf"(?m)^{name} = .*$", f"{name} = {value}", text)
            if count != 1:
                raise ValueError(f"'{name}' does not stand once in the rig file")
        return replace(measurement, rig_toml=text)

    return change
