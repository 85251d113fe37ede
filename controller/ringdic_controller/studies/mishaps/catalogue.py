"""All mishaps that are tried, by groups of those that are alike."""

from __future__ import annotations

from collections.abc import Iterator

from ringdic_node.virtual_rig.disturbance import ShotCondition
from ringdic_node.virtual_rig.scenes import Bar, Damage, Shadow, SolidMotion

from ringdic_controller.studies.mishaps import changes
from ringdic_controller.studies.mishaps.changes import Change
from ringdic_controller.studies.mishaps.rows import Expectation, MishapRow, calm_row, random_rows, usual_motion

_MIDDLE, _END = "cam_02", "cam_01"
_NEIGHBOUR, _PLATE = "cam_03", "plate-tangent"
# Words of which one must occur in what is said about a mishap of the rig, of time, or of all images.
_TARGET = ("target", "dot", "print", "rig.toml", "radius", "spacing", "scale", "unit")
_BOARD = ("board", "square", "checker")
_INSTANT = ("instant", "time", "moment", "order", "frame", "synchron", "same step")
_BLUR = ("blur", "smear", "focus", "sharp")
_LIGHT = ("clip", "overexpos", "saturat", "bright", "exposure", "glare", "reflect", "shadow", "light")
_PATTERN = ("speckle", "pattern", "texture")
_REPEATS = ("repeat", "period")
_HIDDEN = ("hidden", "hides", "in front", "cable", "cover", "contradict")

# Seen by all cameras of an arc about 45°; it moves from step to step.
_GLARE = tuple(Damage(lamps=((250.0, 350.0, z),)) for z in (250.0, 180.0, 110.0))
_SHADOWS = tuple(Damage(shadows=(Shadow((0.0, 0.0, 1.0), z),)) for z in (60.0, 110.0, 160.0))
_HAIRS = 300  # on the whole limb: as on a leg with few
_CABLE = Damage(bars=(Bar((72.0, 62.0, -150.0), (62.0, 72.0, 400.0), 2.5),))


def all_rows() -> list[MishapRow]:
    """The rows of the study, those without a mishap first, the random ones last."""
    return [
        *_calm(), *_knocked_before(), *_knocked_between(), *_moved_rest(), *_lenses(), *_orders(), *_targets(),
        *_images(), *_patterns(), *_times(), *_other_rigs(), *random_rows(100),
    ]  # fmt: skip


def _calm() -> Iterator[MishapRow]:
    for rig in ("arc4", "ring6", "arc2"):
        yield calm_row(rig)
    yield calm_row("arc4", _PLATE)
    held: list[tuple[str, Change, tuple[str, ...]]] = [
        ("exposure-half", changes.taken_otherwise(ShotCondition(light=0.5)), ()),
        ("exposure-double", changes.taken_otherwise(ShotCondition(light=2.0)), _LIGHT),
        ("flicker", changes.flickering, ()),
        ("noise-threefold", changes.taken_otherwise(ShotCondition(noise=3.0)), ()),
        ("jpeg-60", changes.coded_as_jpeg(60), ()),
        ("raw-mosaic", changes.taken_otherwise(ShotCondition(mosaic=True)), ()),
        ("hairs", changes.hairy(_HAIRS), ()),
        ("board-squares-11mm", changes.rig_described({"square_mm": 11.0}), ()),
        ("times-recorded", changes.dated, ()),
    ]
    for name, change, tolerated in held:
        yield MishapRow("calm", name, "arc4", change, None, tolerated)
    yield MishapRow("calm", "stretch-50pct", "arc4", changes.unchanged, None, motion=SolidMotion(stretch=0.5))


def _knocked(when: str, how: str, px: float, rig: str, camera: str, step: int | None, body: str = "limb") -> MishapRow:
    """A camera knocked after the calibration (step None), or before a step."""
    place = "" if camera == _MIDDLE else "-end"
    steps = None if step is None else range(step, 3)
    allowed: tuple[int | None, ...] = (None, 0) if step is None else (step,)
    return MishapRow(
        "moved", f"bumped-{when}-{px:g}px-{how}{place}", rig,
        changes.knocked(how, px, [camera], steps and list(steps)),
        Expectation((camera,), allowed, in_doubt=rig == "arc2"), motion=usual_motion(body), body=body,
    )  # fmt: skip


def _knocked_before() -> Iterator[MishapRow]:
    when = "after-calibration"
    for px in (0.3, 1.0, 3.0, 5.0):
        for how in ("turned-rows", "turned-columns"):
            yield _knocked(when, how, px, "arc4", _MIDDLE, None)
    for how, px, camera in (
        ("turned-rows", 1.0, _END), ("turned-columns", 3.0, _END), ("shifted-rows", 3.0, _MIDDLE),
        ("shifted-columns", 1.0, _MIDDLE), ("rolled", 3.0, _MIDDLE), ("retracted", 3.0, _MIDDLE),
    ):  # fmt: skip
        yield _knocked(when, how, px, "arc4", camera, None)
    for rig in ("ring6", "arc2"):
        yield _knocked(when, "turned-rows", 3.0, rig, _MIDDLE, None)
        yield _knocked(when, "turned-columns", 1.0, rig, _MIDDLE, None)
    for how, px in (("turned-rows", 3.0), ("turned-columns", 1.0)):
        yield _knocked(when, how, px, "arc4", _MIDDLE, None, _PLATE)


def _knocked_between() -> Iterator[MishapRow]:
    when = "between-steps"
    for px in (0.3, 1.0, 3.0, 5.0):
        for how in ("turned-rows", "turned-columns"):
            yield _knocked(when, how, px, "arc4", _MIDDLE, 2)
    for how, px, camera in (
        ("turned-rows", 1.0, _END), ("shifted-rows", 1.0, _MIDDLE), ("shifted-columns", 3.0, _MIDDLE),
        ("rolled", 3.0, _MIDDLE),
    ):  # fmt: skip
        yield _knocked(when, how, px, "arc4", camera, 2)
    for rig in ("ring6", "arc2"):
        yield _knocked(when, "turned-rows", 1.0, rig, _MIDDLE, 2)
        yield _knocked(when, "turned-columns", 3.0, rig, _MIDDLE, 2)
    yield _knocked(when, "turned-rows", 1.0, "arc4", _MIDDLE, 2, _PLATE)


def _moved_rest() -> Iterator[MishapRow]:
    """Several cameras knocked, and one knocked for a single step."""
    both = changes.all_of(
        changes.knocked("turned-rows", 1.5, [_MIDDLE]), changes.knocked("turned-columns", -1.5, [_NEIGHBOUR])
    )
    yield MishapRow("moved", "bumped-two-cameras-1.5px", "arc4", both, Expectation((_MIDDLE, _NEIGHBOUR), (None, 0)))
    once = changes.knocked("turned-rows", 1.0, [_MIDDLE], [1])
    yield MishapRow("moved", "bumped-for-one-step-1px", "arc4", once, Expectation((_MIDDLE,), (1,)))
    every = Expectation(words=("calibrat", "moved", "set up"))
    yield MishapRow("moved", "set-up-again-after-calibration", "arc4", changes.set_up_again, every)


def _lenses() -> Iterator[MishapRow]:
    for percent in (0.2, 1.0):
        change = changes.refocused(1.0 + percent / 100.0, [_MIDDLE])
        yield MishapRow("lens", f"refocused-{percent:g}pct", "arc4", change, Expectation((_MIDDLE,), (None, 0)))
    every = changes.refocused(1.002, None)
    yield MishapRow("lens", "refocused-all-0.2pct", "arc4", every, Expectation(words=("focus", "lens", "focal")))
    late = changes.refocused(1.002, [_MIDDLE], [2])
    yield MishapRow("lens", "refocused-between-steps-0.2pct", "arc4", late, Expectation((_MIDDLE,), (2,)))
    early = changes.all_of(changes.refocused(1.01, [_MIDDLE]), changes.refocused(1.01, [_MIDDLE], kind="target"))
    yield MishapRow("lens", "refocused-after-boards-1pct", "arc4", early, Expectation((_MIDDLE,), (None,)))


def _orders() -> Iterator[MishapRow]:
    a, b = _MIDDLE, _NEIGHBOUR
    mirrored, turned = ShotCondition(mirrored=True), ShotCondition(upside_down=True)
    both, one = Expectation((a, b), (None, 0)), Expectation((a,), (2,))
    for name, change, expected in (
        ("exchanged-all-steps", changes.exchanged(a, b), both),
        ("exchanged-reference", changes.exchanged(a, b, [0]), both),
        ("exchanged-one-step", changes.exchanged(a, b, [1]), Expectation((a, b), (1,))),
        ("exchanged-targets", changes.exchanged(a, b, kind="target"), Expectation((a, b))),
        ("exchanged-boards", changes.exchanged(a, b, kind="board"), Expectation((a, b))),
        ("repeated-reference", changes.repeated(a, 2, 0), one),
        ("repeated-step-before", changes.repeated(a, 2, 1), one),
        ("shows-step-before", changes.late_scene(a, 2, 1), one),
        ("reference-shows-next-step", changes.late_scene(a, 0, 1), Expectation((a,), (None, 0))),
        ("each-lacks-another", changes.gaps_closed, Expectation(words=_INSTANT)),
        ("mirrored-one", changes.taken_otherwise(mirrored, [a]), Expectation((a,), (None, 0))),
        ("mirrored-one-always", changes.always_taken_otherwise(mirrored, a), Expectation((a,), (None, 0))),
        ("upside-down-one", changes.taken_otherwise(turned, [a]), Expectation((a,), (None, 0))),
        ("upside-down-one-always", changes.always_taken_otherwise(turned, a), Expectation((a,), (None, 0))),
        ("mirrored-all", changes.taken_otherwise(mirrored), Expectation(words=("mirror",))),
    ):
        yield MishapRow("order", name, "arc4", change, expected)


def _targets() -> Iterator[MishapRow]:
    small = 1.0 / 1.005  # the rig file states less than what was printed
    every = {"row_spacing_mm": 12.0 * small, "column_spacing_mm": 12.0 * small, "dot_size_mm": 4.0 * small}
    centimetres = {
        "radius_mm": 5.7, "row_spacing_mm": 1.2, "first_row_z_mm": 1.0, "column_spacing_mm": 1.2, "dot_size_mm": 0.4,
    }  # fmt: skip
    for name, values in (
        ("print-0.5pct-large", every),
        ("print-rows-0.5pct-large", {"row_spacing_mm": 12.0 * small}),
        ("radius-58", {"radius_mm": 58.0}),
        ("row-spacing-13", {"row_spacing_mm": 13.0}),
        ("column-spacing-11.5", {"column_spacing_mm": 11.5}),
        ("radius-in-cm", {"radius_mm": 5.7}),
        ("target-in-cm", centimetres),
    ):
        yield MishapRow("target", name, "arc4", changes.rig_described(values), Expectation(words=_TARGET))
    for bow in (1.0, 3.0):
        change = changes.board_bowed(bow)
        yield MishapRow("target", f"board-bowed-{bow:g}mm", "arc4", change, Expectation(words=(*_BOARD, "flat")))
    nudged = changes.target_nudged((0.5, 0.5, 0.0), _MIDDLE)
    yield MishapRow("target", "target-nudged-for-one-camera", "arc4", nudged, Expectation((_MIDDLE,), (None, 0)))
    squares = changes.rig_described({"squares": "[14, 20]"})
    yield MishapRow("target", "board-squares-14-by-20", "arc4", squares, Expectation(words=_BOARD))


def _images() -> Iterator[MishapRow]:
    middle = [_MIDDLE]
    smear, slight, bright = ShotCondition(smear=(6.0, 2.0)), ShotCondition(smear=(3.0, 1.0)), ShotCondition(light=4.0)
    dark = ShotCondition(light=0.01)
    one_step, whole = Expectation((_MIDDLE,), (2,)), Expectation((_MIDDLE,), (None, 0))
    for name, change, expected in (
        ("motion-blur-one-step", changes.taken_otherwise(smear, None, [2]), Expectation((), (2,), _BLUR)),
        ("motion-blur-one-camera", changes.taken_otherwise(slight, middle, [2]), one_step),
        ("motion-blur-one-camera-reference", changes.taken_otherwise(slight, middle, [0]), whole),
        ("defocus-one-camera-one-step", changes.specimen_changed(middle, [2], defocus=2.0), one_step),
        ("defocus-one-camera", changes.specimen_changed(middle, defocus=2.0), whole),
        ("defocus-all", changes.specimen_changed(defocus=2.0), Expectation(words=_BLUR)),
        ("overexposed-one-camera-one-step", changes.taken_otherwise(bright, middle, [2]), one_step),
        ("overexposed-all", changes.taken_otherwise(bright), Expectation(words=_LIGHT)),
        ("dark-one-camera-one-step", changes.taken_otherwise(dark, middle, [2]), one_step),
        ("image-missing-one-step", changes.camera_missing(_MIDDLE, [2]), one_step),
        ("image-missing-reference", changes.camera_missing(_MIDDLE, [0]), whole),
        ("glare-moving", changes.damaged(*_GLARE), Expectation(words=_LIGHT)),
        ("shadow-moving", changes.damaged(*_SHADOWS), Expectation(words=_LIGHT)),
        ("cable-in-view", changes.damaged(_CABLE, _CABLE, _CABLE), Expectation(words=_HIDDEN)),
        ("cable-in-view-one-step", changes.damaged(Damage(), Damage(), _CABLE), Expectation((), (2,), _HIDDEN)),
    ):
        yield MishapRow("image", name, "arc4", change, expected)


def _patterns() -> Iterator[MishapRow]:
    for name, size in (("speckles-of-28px", 6.5), ("speckles-of-16px", 3.7), ("speckles-of-1.5px", 0.33)):
        change = changes.specimen_changed(speckle=size)
        yield MishapRow("pattern", name, "arc4", change, Expectation(words=_PATTERN))
    for body in ("limb", _PLATE):
        yield MishapRow(
            "pattern", "repeating-pattern", "arc4", changes.specimen_changed(period=9.0), Expectation(words=_REPEATS),
            motion=usual_motion(body), body=body,
        )  # fmt: skip


def _times() -> Iterator[MishapRow]:
    for name, recorded in (("clock-off-30ms-recorded", 30.0), ("clock-off-30ms-unrecorded", 0.0)):
        change = changes.other_instant(_MIDDLE, 0.2, 1, recorded)
        yield MishapRow("time", name, "arc4", change, Expectation((_MIDDLE,), (1,)))


def _other_rigs() -> Iterator[MishapRow]:
    """Mishaps of the other groups in a closed ring, where two cameras must tell, and of a flat body."""
    a, b = _MIDDLE, _NEIGHBOUR
    whole: tuple[int | None, ...] = (None, 0)
    radius = changes.rig_described({"radius_mm": 58.0})
    mirrored = changes.taken_otherwise(ShotCondition(mirrored=True), [a])
    for group, name, rig, change, expected in (
        ("lens", "refocused-1pct", "ring6", changes.refocused(1.01, [a]), Expectation((a,), whole)),
        ("order", "exchanged-all-steps", "ring6", changes.exchanged(a, b), Expectation((a, b), whole)),
        ("order", "repeated-reference", "ring6", changes.repeated(a, 2, 0), Expectation((a,), (2,))),
        ("target", "radius-58", "ring6", radius, Expectation(words=_TARGET)),
        ("lens", "refocused-1pct", "arc2", changes.refocused(1.01, [a]), Expectation((a,), whole, in_doubt=True)),
        ("order", "exchanged-all-steps", "arc2", changes.exchanged(_END, a), Expectation((_END, a), whole)),
        ("order", "shows-step-before", "arc2", changes.late_scene(a, 2, 1), Expectation((a,), (2,), in_doubt=True)),
        ("order", "mirrored-one", "arc2", mirrored, Expectation((a,), whole, in_doubt=True)),
        ("target", "radius-58", "arc2", radius, Expectation(words=_TARGET)),
    ):
        yield MishapRow(group, name, rig, change, expected)
    flat: tuple[tuple[str, Change, Expectation], ...] = (
        ("each-lacks-another", changes.gaps_closed, Expectation(words=_INSTANT)),
        ("shows-step-before", changes.late_scene(a, 2, 1), Expectation((a,), (2,))),
    )
    for name, change, expected in flat:
        yield MishapRow("order", name, "arc4", change, expected, motion=usual_motion(_PLATE), body=_PLATE)
