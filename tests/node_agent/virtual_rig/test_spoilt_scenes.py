"""What spoils images lies in them where its truth says: print errors, worn speckles, reflections, bars."""

import cv2
import numpy as np
import pytest
from ringdic_node.virtual_rig.render import radiance
from ringdic_node.virtual_rig.rig import paper_rig
from ringdic_node.virtual_rig.scenes import Bar, Cylinder, Damage, Limb, Specimen, SpoiltPatch, TargetScene
from ringdic_node.virtual_rig.sensor import POINT_SPREAD

CAMERA = paper_rig(12, 0.25, seed=3).cameras[1]
LIMB = Limb()


def seen(step: int, damage: Damage) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Material coordinates that the camera faces, their places, normals and pixels (x, y)."""
    theta, z = (a.ravel() for a in np.meshgrid(np.linspace(0, 2 * np.pi, 300), np.linspace(15, 235, 200)))
    xyz, tangents = LIMB.position(theta, z, step), LIMB.tangents(theta, z, step)
    normals = np.cross(tangents[:, 0], tangents[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    towards = CAMERA.centre - xyz
    facing = np.sum(normals * towards, axis=1) > 0.5 * np.linalg.norm(towards, axis=1)
    return theta[facing], z[facing], xyz[facing], normals[facing], np.rint(CAMERA.project(xyz[facing])).astype(int)


def changed(step: int, damage: Damage, px: np.ndarray) -> np.ndarray:
    """By how much the damage changes the radiance at pixels."""
    clean, spoilt = (radiance(CAMERA, Specimen(LIMB, step, 3, each)) for each in (Damage(), damage))
    return (spoilt - clean)[px[:, 1], px[:, 0]]


@pytest.mark.parametrize("step", [0, 3])
def test_bars_and_reflections_are_where_the_truth_says(step: int) -> None:
    azimuth = np.arctan2(CAMERA.centre[1], CAMERA.centre[0])
    lamp = (500 * np.cos(azimuth + 0.6), 500 * np.sin(azimuth + 0.6), 200.0)
    side = [95 * np.cos(azimuth + 0.25), 95 * np.sin(azimuth + 0.25)]
    damage = Damage(lamps=(lamp,), bars=(Bar((*side, 20.0), (*side, 110.0), 6.0),))
    _, _, xyz, normals, px = seen(step, damage)
    told = damage.spoilt(CAMERA.centre, xyz, normals)
    change = np.abs(changed(step, damage, px))
    assert 0.02 < told.mean() < 0.2
    assert (change[told] > 0.02).mean() > 0.9  # a dark speckle behind a dark bar changes little
    assert (change[~told] > 0.35).mean() < 0.005  # pixels at the rims


def test_a_bar_behind_the_body_is_not_seen() -> None:
    azimuth = np.arctan2(CAMERA.centre[1], CAMERA.centre[0])
    behind = [-95 * np.cos(azimuth), -95 * np.sin(azimuth)]
    damage = Damage(bars=(Bar((*behind, 20.0), (*behind, 200.0), 6.0),))
    _, _, _, _, px = seen(0, damage)
    assert np.abs(changed(0, damage, px)).max() == 0.0


def test_worn_speckles_are_missing_on_the_material_that_lost_them() -> None:
    azimuth = np.arctan2(CAMERA.centre[1], CAMERA.centre[0])
    damage = Damage(patches=(SpoiltPatch(azimuth - 0.2, 120.0, 12.0, 18.0),))
    theta, z, _, _, px = seen(4, damage)
    worn, change = damage.worn(theta, z), changed(4, damage, px)
    assert worn.sum() * (220 / 200) * (2 * np.pi * 57 / 300) == pytest.approx(np.pi * 12 * 18, rel=0.05)  # mm²
    assert (change >= -1e-6).all()  # what is worn off was dark
    assert 0.25 < (change[worn] > 0.2).mean() < 0.6  # the share of the speckles
    assert (change[~worn] > 0.3).mean() < 0.002


def test_a_patch_round_the_seam_is_whole() -> None:
    damage = Damage(patches=(SpoiltPatch(0.0, 100.0, 10.0, 10.0),))
    theta = np.array([0.1, 2 * np.pi - 0.1, -0.1, 0.25])
    np.testing.assert_array_equal(damage.worn(theta, np.full(4, 100.0)), [True, True, True, False])


def test_printed_dots_are_off_their_places_by_what_is_told() -> None:
    exact, printed = TargetScene(), TargetScene(print_error=0.15, seed=2)
    error = printed.dots() - exact.dots()
    assert np.linalg.norm(error, axis=-1).std() > 0
    assert np.std(printed.prints()) == pytest.approx(0.15, rel=0.1)  # 1,200 numbers
    centres = exact.dots()
    towards = CAMERA.centre - centres
    frontal = np.sum(centres * [1, 1, 0] / 57 * towards, axis=-1) > np.cos(0.5) * np.linalg.norm(towards, axis=-1)
    moved = []
    for scene in (exact, printed):
        dark = 1 - radiance(CAMERA, scene).astype(float)
        centroids = []
        for x0, y0 in np.rint(CAMERA.project(centres[frontal])).astype(int):
            patch = dark[y0 - 8 : y0 + 9, x0 - 8 : x0 + 9]
            patch = np.clip(patch - np.percentile(patch, 20) - 0.1, 0, None)
            y, x = np.mgrid[-8:9, -8:9]
            centroids.append([np.sum(x * patch), np.sum(y * patch)] / patch.sum())
        moved.append(np.array(centroids))
    expected = CAMERA.project(printed.dots()[frontal]) - CAMERA.project(centres[frontal])
    error = moved[1] - moved[0] - expected
    assert np.std(expected) > 0.25  # 0.15 mm are 0.35 px here
    assert np.sqrt(np.mean(error**2)) < 0.04  # centroids above a threshold, of dots nine pixels wide
    assert abs(np.mean(error)) < 0.01


def test_a_print_error_beyond_reason_is_refused() -> None:
    with pytest.raises(ValueError, match=r"between 0 and 0\.2"):
        TargetScene(print_error=0.5)


def test_a_finely_sampled_body_looks_as_the_mean_of_its_parts() -> None:
    fine = paper_rig(12, 0.6, seed=3).cameras[1]
    small = paper_rig(12, 0.3, seed=3).cameras[1]
    scene = Specimen(Cylinder(), 0, 3)
    one, four = radiance(fine, scene), radiance(small, scene)
    height, width = four.shape
    # The lens blurs by so many pixels, of whatever size: the small ones are blurred up to the large ones.
    one = cv2.GaussianBlur(one, (0, 0), 2 * POINT_SPREAD * np.sqrt(1 - 1 / 4))
    mean = one[: 2 * height, : 2 * width].reshape(height, 2, width, 2).mean(axis=(1, 3))
    middle = slice(height // 3, 2 * height // 3), slice(2 * width // 5, 3 * width // 5)
    error = (mean - four)[middle]
    assert np.std(four[middle]) > 0.2
    assert np.std(error) < 0.015
    assert abs(np.mean(error)) < 0.002  # where disks overlap, the dark that they share depends on the blur
