"""Why two cameras do not match, told from rendered scenes in which one thing is wrong."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ringdic.charts.depth_map import DepthImages, measure_depths
from ringdic.charts.evidence import MatchEvidence, match_evidence
from ringdic.charts.exchanged import ConfusedImages, confusion_findings, exchanged_or_mirrored, without_consequences
from ringdic.charts.plane_sweep import DepthRange
from ringdic.correlation import CorrelationSettings
from ringdic.findings import Finding, Verdict
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic_node.virtual_rig.render import render
from ringdic_node.virtual_rig.rig import paper_rig
from ringdic_node.virtual_rig.scenes.specimen import Limb, Specimen

SCALE = 0.2
SETTINGS = CorrelationSettings(radius=10, step=5)
VIRTUAL = paper_rig(12, SCALE).cameras[:2]


def calibrated(camera) -> Camera:
    """A virtual camera as a perfect calibration has it."""
    lens = Intrinsics(camera.K, np.array(camera.distortion), (camera.width, camera.height))
    P = lens.K_undistorted @ np.column_stack([camera.R, camera.t])
    return Camera(camera.id, P / P[2, 3], lens.size, lens)


CAMERAS = [calibrated(camera) for camera in VIRTUAL]
SPACE = DepthRange.of([calibrated(camera) for camera in paper_rig(12, SCALE).cameras])


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [render(camera, Specimen(Limb(), 0, seed=4), seed=7 + k) for k, camera in enumerate(VIRTUAL)]


def evidence(images, k=0, cameras=CAMERAS, space=SPACE, mask=None) -> MatchEvidence | None:
    reduced = DepthImages.of(cameras, lambda c: images[c], SETTINGS)
    depth_map = measure_depths(reduced, k, (1 - k,), space, mask)
    return match_evidence(reduced, depth_map, k, 1 - k, space, mask)


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, 1.5, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def test_cameras_that_match_need_no_evidence(images) -> None:
    assert evidence(images) is None


def test_a_blurred_image_is_told_by_its_blur(images, figures) -> None:
    blurred = noisy(cv2.GaussianBlur(images[0].astype(float), (0, 0), 6.0), 3)
    found = evidence([blurred, images[1]])
    figures("blur of 6 px of one camera of two, found", f"{found.blur:.2f} px", "6 ± 1.2")
    assert found.blur == pytest.approx(6.0, abs=1.2)
    assert f"its image is blurred by {found.blur:.1f} px against camera cam_02; focus it" in found.sentence
    other = evidence([blurred, images[1]], k=1)
    assert other.blur == pytest.approx(-found.blur, abs=0.5)
    assert f"the image of camera cam_01 is blurred by {abs(other.blur):.1f} px" in other.sentence


def test_a_camera_that_moved_is_told_by_its_epipolar_offset(images, figures) -> None:
    """Its image is 6 px above where the calibration has it; epipolar lines of a ring lie nearly level."""
    moved = np.roll(images[1], 6, axis=0)
    found = evidence([images[0], moved])
    figures("epipolar offset of an image 6 px off, found", f"{abs(found.offset):.2f} px", "6 ± 0.5")
    assert abs(found.offset) == pytest.approx(6.0, abs=0.5)
    assert f"lie {abs(found.offset):.1f} px off the epipolar lines, 1 px are allowed" in found.sentence
    assert abs(found.blur) < 0.5


def test_a_mask_on_the_background_is_told_by_what_it_holds(images) -> None:
    mask = np.zeros(images[0].shape, bool)
    mask[:, : images[0].shape[1] // 5] = True
    found = evidence(images, mask=mask)
    assert found.matches > 100
    assert found.in_mask == 0
    assert f"its mask holds 0 of the {found.matches} features; draw it on the specimen" in found.sentence


def test_a_body_outside_the_range_of_depths_is_told_by_its_depth(images, figures) -> None:
    """The limb has a radius of about 45 mm about the point where the axes meet."""
    middle = float(np.linalg.norm(CAMERAS[0].centre - SPACE.centre))
    nearer = replace(SPACE, centre=CAMERAS[0].centre + 0.4 * (SPACE.centre - CAMERAS[0].centre), reach=0.3)
    found = evidence(images, space=nearer)
    figures("depth of a body outside the range searched", f"{found.near:.0f} to {found.far:.0f} mm", "truth about it")
    assert middle - 70.0 < found.near < found.far < middle
    assert found.in_range == 0
    assert f"lie at depths of {found.near:.0f} to {found.far:.0f} mm" in found.sentence


def test_a_camera_that_looks_at_a_bare_wall_is_told_by_its_contrast(images) -> None:
    wall = noisy(np.tile(np.linspace(60.0, 140.0, images[0].shape[1]), (images[0].shape[0], 1)), 5)
    found = evidence([wall, images[1]])
    assert found.matches == 0
    assert found.contrast < 0.3 * found.partner_contrast
    assert f"the contrast of its image is {found.contrast:.1f} grey levels a px" in found.sentence


def test_a_camera_that_looks_at_something_else_is_told_by_its_matches(images) -> None:
    elsewhere = render(VIRTUAL[0], Specimen(Limb(), 0, seed=99), seed=3)
    found = evidence([elsewhere, images[1]])
    assert found.matches == 0
    assert abs(found.blur) < 1.0
    assert "0 features of its image are found in that of camera cam_02" in found.sentence


def test_exchanged_images_are_told_with_both_cameras(images) -> None:
    found = evidence(images[::-1])
    assert "the image of camera cam_01 shows what camera cam_02 would" in found.sentence


def test_an_image_of_a_third_camera_is_told_of_from_either_side() -> None:
    """The second and the third of three cameras are exchanged; the first has its own image."""
    rig = paper_rig(12, SCALE).cameras[:3]
    cameras = [calibrated(camera) for camera in rig]
    taken = [render(camera, Specimen(Limb(), 0, seed=4), seed=7 + k) for k, camera in enumerate(rig)]
    reduced = DepthImages.of(cameras, lambda c: taken[(0, 2, 1)[c]], SETTINGS)
    confused = []
    for k, partner in ((0, 1), (1, 0), (1, 2)):
        found = exchanged_or_mirrored(reduced, k, partner, SPACE)
        assert found.kind == "exchanged"
        assert set(found.cameras) == {"cam_02", "cam_03"}
        confused.append(found)
    (finding,) = confusion_findings([*confused, ConfusedImages("exchanged", ("cam_01", "cam_02"))], "0001-specimen")
    assert (finding.code, finding.cameras, finding.step) == ("images-exchanged", ("cam_02", "cam_03"), "0001-specimen")
    assert finding.verdict is Verdict.DO_NOT_USE
    calm = DepthImages.of(cameras, lambda c: taken[c], SETTINGS)
    assert [exchanged_or_mirrored(calm, k, partner, SPACE) for k, partner in ((0, 1), (1, 2), (2, 1))] == [None] * 3


def test_mirrored_images_are_told_by_their_camera(images) -> None:
    mirrored = [np.ascontiguousarray(image[:, ::-1]) for image in images]
    assert "the image of camera cam_01 is mirrored" in evidence([mirrored[0], images[1]]).sentence
    assert "the image of camera cam_01 is mirrored" in evidence([mirrored[0], images[1]], k=1).sentence
    both = evidence(mirrored)
    assert "cam_01, like that of camera cam_02, is mirrored" in both.sentence
    (finding,) = confusion_findings([both.confused], "0001-specimen")
    assert (finding.code, finding.cameras) == ("image-turned", ("cam_01", "cam_02"))


def test_an_image_that_is_upside_down_is_told_by_its_camera(images) -> None:
    turned = np.ascontiguousarray(images[0][::-1, ::-1])
    for k in (0, 1):
        found = evidence([turned, images[1]], k=k)
        assert "the image of camera cam_01 is upside down" in found.sentence
    (finding,) = confusion_findings([found.confused], "0001-specimen")
    assert (finding.code, finding.cameras) == ("image-turned", ("cam_01",))


def test_what_follows_from_exchanged_images_is_not_said_beside_them() -> None:
    confused = [ConfusedImages("exchanged", ("cam_01", "cam_02"))]
    lens = Finding("image-blurred", "focus camera cam_03", ("cam_03",), "0002-specimen")
    follow = [
        Finding("camera-unmatched", f"camera cam_01 does not match: {confused[0].sentence} (0 matched)", ("cam_01",)),
        Finding("camera-moved-unknown", "lines of sight miss one another", ("cam_01", "cam_04"), "0001-specimen"),
        Finding("camera-moved", "camera cam_04 moved", ("cam_04",), "0002-specimen"),
    ]
    assert without_consequences([lens, *follow], confused) == [lens]
    assert without_consequences([lens, *follow], []) == [lens, *follow]
