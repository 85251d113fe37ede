"""Azimuths of the cameras: a rotated target is recognised, exchanged cameras and rotated images are refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.calibration.azimuths import AzimuthCandidates, azimuth_candidates, camera_azimuths
from ringdic.calibration.dots import Dots, find_dots
from ringdic.calibration.labels import column_labels, has_labels
from ringdic.calibration.target import identify_dots, possible_azimuths
from ringdic.errors import InputError
from ringdic.session.rig import Rig, RigCamera, read_rig


def grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


@pytest.fixture(scope="module")
def rig(shared_data) -> Rig:
    return read_rig(shared_data / "rendered_ring" / "limb" / "rig.toml")


@pytest.fixture(scope="module")
def images(shared_data, rig) -> dict[str, np.ndarray]:
    folder = shared_data / "rendered_ring" / "limb" / "target"
    return {camera.id: grey(folder / f"{camera.id}.jpg") for camera in rig.cameras}


@pytest.fixture(scope="module")
def dots(images, rig) -> dict[str, Dots]:
    return {id_: find_dots(image, rig.target) for id_, image in images.items()}


@pytest.fixture(scope="module")
def look(rig, images, dots) -> Callable[..., dict[str, AzimuthCandidates]]:
    """Possible azimuths of all cameras, with nominal ones off by ``off`` degrees and images of other cameras."""

    def seen(
        off: float = 0.0, swapped: dict[str, str] | None = None, **azimuths: float
    ) -> dict[str, AzimuthCandidates]:
        candidates = {}
        for camera in rig.cameras:
            source = (swapped or {}).get(camera.id, camera.id)
            entry = replace(camera, azimuth_deg=azimuths.get(camera.id, camera.azimuth_deg + off))
            candidates[camera.id] = azimuth_candidates(images[source], dots[source], entry, rig.target)
        return candidates

    return seen


def deviations(rig: Rig, azimuths: dict[str, float]) -> np.ndarray:
    return np.array([(azimuths[c.id] - c.azimuth_deg + 180) % 360 - 180 for c in rig.cameras])


def test_an_image_alone_tells_the_azimuth_but_for_the_column(rig, dots) -> None:
    for camera in rig.cameras:
        possible = possible_azimuths(dots[camera.id], rig.target)
        assert np.abs((possible - camera.azimuth_deg + 180) % 360 - 180).min() < 1.5
        # The seam lies between columns 30 and 1, at azimuth -6°.
        assert (len(possible) == 1) == (camera.id in ("cam_12", "cam_01", "cam_02"))


def test_cameras_are_found_where_the_rig_has_them(rig, look) -> None:
    result = camera_azimuths(look(), rig.target)
    assert abs(result.turn_deg) < 1.0
    assert result.findings == ()
    assert np.abs(deviations(rig, result.azimuths)).max() < 1.5


@pytest.mark.parametrize("turn", [36.2, -6.03, 150.0])  # three columns, half of one, a camera's place and more
def test_a_turned_target_is_followed_by_all_cameras(rig, look, turn) -> None:
    result = camera_azimuths(look(off=-turn), rig.target)
    assert result.turn_deg == pytest.approx(turn, abs=1.0)
    assert np.abs(deviations(rig, result.azimuths)).max() < 1.5
    assert "target is turned by" in result.findings[0].sentence


def test_without_the_printed_numbers_those_that_see_the_seam_tell_the_others(rig, look) -> None:
    bare = {id_: replace(each, labels={}) for id_, each in look(off=-36.2).items()}
    result = camera_azimuths(bare, rig.target)
    # The others are taken to be where the rig has them, turned alike: a start good to some degrees.
    assert np.abs(deviations(rig, result.azimuths)).max() < 3.0
    blind = {id_: each for id_, each in bare.items() if len(each.azimuths) > 1}
    assert camera_azimuths(blind, rig.target).azimuths == {
        id_: pytest.approx(each.camera.azimuth_deg % 360) for id_, each in blind.items()
    }


@pytest.mark.parametrize("pair", [("cam_04", "cam_05"), ("cam_03", "cam_08"), ("cam_01", "cam_02")])
def test_exchanged_cameras_are_refused_by_name(rig, look, pair) -> None:
    a, b = pair
    with pytest.raises(
        InputError, match=rf"camera ({a}|{b}) stands at .* where rig.toml has camera ({a}|{b}), .* exchanged"
    ):
        camera_azimuths(look(swapped={a: b, b: a}), rig.target)


@pytest.mark.parametrize("names", [("cam_01",), ("cam_05",), ("cam_09",), ("cam_12", "cam_01", "cam_02")])
def test_mirrored_images_are_refused_by_name(rig, images, dots, names) -> None:
    # The seam is seen by three of the cameras; of the others the printed numbers tell.
    candidates = {}
    for camera in rig.cameras:
        image = np.ascontiguousarray(images[camera.id][:, ::-1]) if camera.id in names else images[camera.id]
        candidates[camera.id] = azimuth_candidates(image, find_dots(image, rig.target), camera, rig.target)
    with pytest.raises(InputError, match=rf"camera .*({'|'.join(names)}): the image of the target is mirrored"):
        camera_azimuths(candidates, rig.target)


def test_exchanged_cameras_of_a_rig_of_two_are_refused(rig, look) -> None:
    seen = look(swapped={"cam_01": "cam_02", "cam_02": "cam_01"})
    with pytest.raises(InputError, match=r"camera cam_0[12] stands at .* where rig.toml has camera cam_0[12]"):
        camera_azimuths({id_: seen[id_] for id_ in ("cam_01", "cam_02")}, rig.target)


def test_one_wrong_azimuth_is_refused_by_name(rig, look) -> None:
    with pytest.raises(InputError, match=r"camera cam_06 stands at azimuth 150°, rig.toml says 165°"):
        camera_azimuths(look(cam_06=165.0), rig.target)


def test_images_that_lie_or_stand_on_their_head_are_refused_with_the_remedy(rig, images) -> None:
    camera: RigCamera = rig.cameras[4]
    for turned, message in (
        (90, r"on its side .* rotation_deg = (90|270)"),
        (180, "upside down: give rotation_deg = 180"),
    ):
        image = np.ascontiguousarray(np.rot90(images[camera.id], -turned // 90))
        result = find_dots(image, rig.target)
        with pytest.raises(InputError, match=rf"camera cam_05: .*{message}"):
            azimuth_candidates(image, result, camera, rig.target)
        righted = azimuth_candidates(image, result, replace(camera, rotation_deg=float(turned)), rig.target)
        assert abs(righted.azimuths[0] - camera.azimuth_deg) < 1.5


def test_a_camera_that_sees_no_target_is_left_to_its_calibration(rig, images, dots) -> None:
    empty = dots["cam_05"][np.arange(5)]
    result = azimuth_candidates(images["cam_05"], empty, rig.cameras[4], rig.target)
    assert result.azimuths == ()
    assert camera_azimuths({"cam_05": result}, rig.target).azimuths == {}


def test_numbers_are_seen_where_they_are_printed(shared_data, rig) -> None:
    real = replace(rig.target, columns=14)
    for camera, azimuth in (("201", 61.0), ("202", 92.0)):
        image = grey(shared_data / "multidic_rig" / "calibration" / f"{camera}.jpg")
        observed = identify_dots(find_dots(image, real), real, azimuth)
        assert has_labels(column_labels(image, observed, real))
        assert not has_labels(column_labels(image, observed, real, below=True))
