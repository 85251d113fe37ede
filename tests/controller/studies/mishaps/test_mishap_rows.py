"""Each mishap changes the images that its name says, and no others."""

import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic_controller.studies.mishaps import changes
from ringdic_controller.studies.mishaps.catalogue import all_rows
from ringdic_controller.studies.mishaps.measurement import PlannedMeasurement
from ringdic_controller.studies.mishaps.rows import RANDOM, MishapRow, calm_row, selected_rows
from ringdic_node.virtual_rig.scenes import SolidSpecimen

ROWS = {row.name: row for row in all_rows()}
CALM = calm_row("arc4").planned(0.1)
MIDDLE = np.array([[0.0, 0.0, 125.0]])


def changed(planned: PlannedMeasurement, kind: str = "specimen") -> dict[str, list[int]]:
    """Cameras whose images of a kind differ from the calm ones, each with the numbers of the captures."""
    found: dict[str, list[int]] = {}
    for position, number in planned.numbered(kind):
        for id_, shot in planned.captures[position][1].items():
            if shot.key != CALM.images(kind, number)[id_].key:
                found.setdefault(id_, []).append(number)
    return found


def test_names_are_unique_and_every_row_but_the_calm_ones_expects_a_name() -> None:
    assert len(ROWS) == len(all_rows()) > 75
    assert all((row.expected is None) == (row.group in ("calm", RANDOM)) for row in ROWS.values())
    assert {row.rig for row in ROWS.values() if row.group != RANDOM} == {"arc4", "ring6", "arc2"}


def test_every_mishap_changes_the_cameras_and_steps_that_it_expects_to_be_named() -> None:
    for row in (each for each in ROWS.values() if each.name.endswith("-arc4") and each.body == "limb"):
        if row.group not in ("moved", "lens", "time"):
            continue
        assert row.expected is not None
        found = changed(row.planned(0.1))
        if row.expected.cameras:
            assert set(found) == set(row.expected.cameras), row.name
            first = min(number for numbers in found.values() for number in numbers)
            assert first in row.expected.steps or (first == 0 and None in row.expected.steps), row.name


@pytest.mark.parametrize(
    ("name", "shift"),
    [
        ("bumped-after-calibration-0.3px-turned-rows-arc4", (0.3, 0.0)),
        ("bumped-after-calibration-5px-turned-columns-arc4", (0.0, 5.0)),
        ("bumped-between-steps-3px-turned-rows-arc4", (3.0, 0.0)),
    ],
)
def test_a_bump_is_of_the_pixels_and_steps_in_its_name(name: str, shift: tuple[float, float]) -> None:
    planned = ROWS[name].planned(0.1)
    steps = [2] if "between" in name else [0, 1, 2]
    assert changed(planned) == {"cam_02": steps}
    assert changed(planned, "board") == changed(planned, "target") == {}
    before, after = (each.images("specimen", 2)["cam_02"].camera for each in (CALM, planned))
    np.testing.assert_allclose((after.project(MIDDLE) - before.project(MIDDLE))[0], shift, atol=1e-3)


def test_orders_of_images_are_mixed_as_their_names_say() -> None:
    images = CALM.images
    swapped = ROWS["exchanged-one-step-arc4"].planned(0.1)
    assert swapped.images("specimen", 1)["cam_02"].key == images("specimen", 1)["cam_03"].key
    assert changed(swapped) == {"cam_02": [1], "cam_03": [1]}
    repeated = ROWS["repeated-step-before-arc4"].planned(0.1).images("specimen", 2)["cam_02"]
    assert repeated.key == images("specimen", 1)["cam_02"].key
    late = ROWS["shows-step-before-arc4"].planned(0.1).images("specimen", 2)["cam_02"]
    assert late.scene == images("specimen", 1)["cam_02"].scene
    assert late.seed != images("specimen", 1)["cam_02"].seed
    gaps = ROWS["each-lacks-another-arc4"].planned(0.1)
    taken = {
        id_: [
            [images("specimen", k)[id_].scene for k in range(3)].index(gaps.images("specimen", n)[id_].scene)
            for n in (0, 1)
        ]
        for id_ in gaps.cameras
    }
    assert taken == {"cam_01": [1, 2], "cam_02": [0, 2], "cam_03": [0, 1], "cam_04": [0, 1]}


def test_a_clock_that_is_off_shows_the_body_later_and_may_say_so() -> None:
    for name, late in (("clock-off-30ms-recorded-arc4", True), ("clock-off-30ms-unrecorded-arc4", False)):
        shots = ROWS[name].planned(0.1).images("specimen", 1)
        times = {id_: shot.time_ns for id_, shot in shots.items()}
        others = [time for id_, time in times.items() if id_ != "cam_02"]
        assert max(others) - min(others) < 1e5
        assert (times["cam_02"] - max(others) > 29e6) == late
        moved, true = (each["cam_02"].scene for each in (shots, CALM.images("specimen", 1)))
        assert isinstance(moved, SolidSpecimen)
        assert isinstance(true, SolidSpecimen)
        assert 0.1 < np.linalg.norm(moved.moved(MIDDLE + 40.0) - true.moved(MIDDLE + 40.0)) < 1.5  # mm


def test_the_rig_file_is_changed_where_it_says_and_no_image_with_it() -> None:
    planned = ROWS["radius-58-arc4"].planned(0.1)
    assert planned.rig_toml == CALM.rig_toml.replace("radius_mm = 57.0", "radius_mm = 58.0")
    assert changed(planned) == changed(planned, "board") == changed(planned, "target") == {}
    with pytest.raises(ValueError, match="'raduis_mm' does not stand once"):
        changes.rig_described({"raduis_mm": 58.0})(CALM)


def test_hairs_and_mosaics_are_in_every_image_of_the_specimen_and_in_no_other() -> None:
    for name in ("hairs-arc4", "raw-mosaic-arc4"):
        planned = ROWS[name].planned(0.1)
        assert changed(planned) == {camera: [0, 1, 2] for camera in CALM.cameras}
        assert changed(planned, "board") == changed(planned, "target") == {}
    scenes = [shot.scene for shot in ROWS["hairs-arc4"].planned(0.1).images("specimen", 2).values()]
    assert all(scene == scenes[0] for scene in scenes)  # the same hairs in all cameras


def test_times_and_nothing_else_are_dated() -> None:
    planned = changes.dated(CALM)
    assert changed(planned) == {}
    assert all(shot.time_ns is not None for shot in planned.images("specimen", 0).values())


def test_rows_are_chosen_by_name_group_rig_or_beginning() -> None:
    rows: list[MishapRow] = all_rows()
    assert [row.name for row in selected_rows(rows, ["radius-58-arc4"])] == ["radius-58-arc4"]
    assert {row.group for row in selected_rows(rows, ["order"])} == {"order"}
    assert {row.rig for row in selected_rows(rows, ["arc2"])} == {"arc2"}
    assert all(row.name.startswith("bumped-between") for row in selected_rows(rows, ["bumped-between"]))
    assert [row.name for row in selected_rows(rows, [])] == [row.name for row in rows if row.group != RANDOM]
    assert len(selected_rows(rows, [RANDOM])) == 100
    with pytest.raises(InputError, match="there is no mishap 'earthquake'"):
        selected_rows(rows, ["earthquake"])


def test_a_row_is_compared_with_the_calm_row_of_its_body_and_rig() -> None:
    for row in ROWS.values():
        calm = row.calm
        assert (calm.rig, calm.body, calm.expected) == (row.rig, row.body, None)
        assert calm.calm.name == calm.name
        assert calm.name in ROWS
        assert (calm.name == row.name) == (row.mishap == "calm" or row.group == RANDOM)
        if row.group != "calm":
            assert row.motion == calm.motion


def test_where_an_image_is_missing_there_is_none() -> None:
    planned = ROWS["image-missing-one-step-arc4"].planned(0.1)
    assert [len(planned.images("specimen", number)) for number in range(3)] == [4, 4, 3]


def test_random_rows_differ_in_cameras_bodies_boards_speckles_and_motions_and_are_the_same_again() -> None:
    drawn, again = (selected_rows(all_rows(), [RANDOM]) for _ in range(2))
    assert [(row.name, row.motion) for row in drawn] == [(row.name, row.motion) for row in again]
    assert len({row.body for row in drawn}) > 10
    assert len({row.rig for row in drawn}) == 7
    first, second = (next(row for row in drawn if row.rig == "arc4" and row.seed > least) for least in (0, 50))
    shots = [row.planned(0.1).images("board", 0)["cam_01"] for row in (first, second)]
    assert not np.allclose(shots[0].camera.t, shots[1].camera.t)
    assert shots[0].scene != shots[1].scene
    assert first.specimens[0].seed != second.specimens[0].seed
