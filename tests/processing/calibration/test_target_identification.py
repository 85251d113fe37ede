"""Identification of every dot: rendered cameras against truth, the real pair against MultiDIC's centroids."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.calibration import dlt
from ringdic.calibration.dots import Dots, find_dots
from ringdic.calibration.target import DotObservations, dot_points, identify_dots
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera
from ringdic.session.rig import RigCamera, Target, read_rig

REAL_TARGET = Target("dot-cylinder", 57.0, 20, 12.0, 10.0, 14, 12.0, 4.0)


def grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


@pytest.fixture(scope="module")
def ring(shared_data):
    """Target, cameras, their images, and true projections (12, 20, 30, 2) of the dots' centres."""
    folder = shared_data / "rendered_ring" / "limb"
    rig = read_rig(folder / "rig.toml")
    images = {camera.id: grey(folder / "target" / f"{camera.id}.jpg") for camera in rig.cameras}
    truth = np.load(folder / "target_truth.npz")["projected_px"]
    return rig.target, rig.cameras, images, dict(zip(images, truth, strict=True))


def distances(observations: DotObservations, truth: np.ndarray) -> np.ndarray:
    """Distance of each dot from the true projection of the dot as which it was identified, px."""
    return np.linalg.norm(observations.px - truth[observations.rows - 1, observations.columns - 1], axis=1)


def test_points_of_the_target_follow_the_convention_of_the_world(shared_data):
    reference = np.load(shared_data / "multidic_rig" / "reference.npz")["calib_object_xyz"]
    rows, columns = np.mgrid[1:21, 1:15]
    assert np.allclose(dot_points(REAL_TARGET, rows.ravel(), columns.ravel()).reshape(20, 14, 3), reference, atol=1e-9)


def test_all_twelve_rendered_cameras_number_their_dots_rightly(ring):
    target, cameras, images, truth = ring
    for camera in cameras:
        observations = identify_dots(find_dots(images[camera.id], target), target, camera.azimuth_deg, camera=camera.id)
        assert len(observations) >= 140
        assert set(observations.rows.tolist()) == set(range(1, 21))
        # Neighbouring dots are 20 px and more apart; the centroid is not quite the centre's projection.
        assert distances(observations, truth[camera.id]).max() < 0.5
        assert np.array_equal(observations.xyz, dot_points(target, observations.rows, observations.columns))
        assert abs(observations.azimuth_deg - camera.azimuth_deg + 180) % 360 - 180 < 1.5


@pytest.mark.parametrize("camera_index", [0, 3])  # the seam in view, and far from it
def test_a_nominal_azimuth_is_enough_to_five_degrees(ring, camera_index):
    target, cameras, images, truth = ring
    camera: RigCamera = cameras[camera_index]
    dots = find_dots(images[camera.id], target)
    for offset in (-5.0, 5.0):
        observations = identify_dots(dots, target, camera.azimuth_deg + offset, camera=camera.id)
        assert distances(observations, truth[camera.id]).max() < 0.5


def test_an_azimuth_half_way_between_columns_is_refused_where_nothing_else_tells(ring):
    target, _, images, _ = ring
    dots = find_dots(images["cam_05"], target)
    observations = identify_dots(dots, target, 120.0)
    half_way = observations.azimuth_deg + math.degrees(target.column_angle) / 2
    with pytest.raises(InputError, match=r"camera x: its nominal azimuth .* half-way between two numberings"):
        identify_dots(dots, target, half_way, camera="x")


def test_turned_images_give_the_same_dots(ring):
    target, _, images, truth = ring
    image, wanted = images["cam_02"], truth["cam_02"]
    height, width = image.shape
    turned = {
        90: np.stack([height - 1 - wanted[..., 1], wanted[..., 0]], axis=-1),
        180: np.array([width - 1, height - 1]) - wanted,
        270: np.stack([wanted[..., 1], width - 1 - wanted[..., 0]], axis=-1),
    }
    for degrees, places in turned.items():
        dots = find_dots(np.ascontiguousarray(np.rot90(image, -degrees // 90)), target)
        observations = identify_dots(dots, target, 30.0, rotation_deg=degrees)
        assert len(observations) >= 140
        assert distances(observations, places).max() < 0.5


@pytest.mark.parametrize("scale", [0.5, 0.35])
def test_small_images_serve(ring, scale):
    target, _, images, truth = ring
    small = cv2.resize(images["cam_05"], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    factor = np.array(small.shape[::-1]) / np.array(images["cam_05"].shape[::-1])
    observations = identify_dots(find_dots(small, target), target, 120.0)
    assert len(observations) >= 140
    assert distances(observations, (truth["cam_05"] + 0.5) * factor - 0.5).max() < 0.5


def test_missing_dots_and_an_occluder_shift_no_number(ring):
    target, _, images, truth = ring
    dots = find_dots(images["cam_11"], target)
    rng = np.random.default_rng(1)
    left = dots[np.flatnonzero(rng.random(len(dots)) > 0.12)]
    behind = np.abs(left.px - [690, 700]).max(axis=1) < 90
    left = left[np.flatnonzero(~behind)]
    observations = identify_dots(left, target, 300.0)
    assert 90 < len(observations) < 140
    assert distances(observations, truth["cam_11"]).max() < 0.5


def test_stray_spots_are_no_dots(ring):
    target, _, images, truth = ring
    dots = find_dots(images["cam_08"], target)
    rng = np.random.default_rng(4)
    stray = Dots(
        np.vstack([dots.px, rng.uniform([0, 0], dots.size, (300, 2))]),
        np.append(dots.width, rng.uniform(8, 20, 300)),
        np.append(dots.height, rng.uniform(8, 20, 300)),
        np.append(dots.contrast, np.full(300, 0.9)),
        dots.size,
    )
    observations = identify_dots(stray, target, 210.0)
    assert len(observations) >= 120
    assert np.median(distances(observations, truth["cam_08"])) < 0.2
    assert np.mean(distances(observations, truth["cam_08"]) < 0.5) > 0.97


def test_a_hidden_or_miscounted_row_is_refused(ring):
    target, _, images, _ = ring
    image = images["cam_05"].copy()
    image[:330] = 20
    with pytest.raises(InputError, match=r"camera c: 19 rows of dots are seen .* says 20"):
        identify_dots(find_dots(image, target), target, 120.0, camera="c")
    fewer = replace(target, rows=19)
    with pytest.raises(InputError, match="20 rows of dots are seen"):
        identify_dots(find_dots(images["cam_05"], fewer), fewer, 120.0)


@pytest.mark.parametrize("rotation", [0, 90])
@pytest.mark.parametrize("cut", [slice(420, None), slice(0, 1160)])  # some rows above and below are outside
def test_rows_number_themselves_where_the_image_shows_an_end_of_the_target(ring, cut, rotation):
    target, _, images, truth = ring
    part = np.ascontiguousarray(np.rot90(images["cam_05"][cut], -rotation // 90))
    observations = identify_dots(find_dots(part, target), target, 120.0, rotation_deg=rotation)
    assert len(observations) > 90
    assert observations.rows.max() - observations.rows.min() < 18
    places = truth["cam_05"] - [0, cut.start or 0]
    if rotation:
        places = np.stack([part.shape[1] - 1 - places[..., 1], places[..., 0]], axis=-1)
    assert distances(observations, places).max() < 0.5


def test_rows_without_an_end_in_view_need_the_camera_s_height(ring):
    target, _, images, truth = ring
    dots = find_dots(images["cam_05"][430:1150], target)
    with pytest.raises(InputError, match=r"camera c: 1\d rows .* neither the lowest nor the highest .* height_mm"):
        identify_dots(dots, target, 120.0, camera="c")
    whole = identify_dots(find_dots(images["cam_05"], target), target, 120.0)
    height = float(dlt_centre(whole)[2])
    for off in (-4.0, 4.0):
        observations = identify_dots(dots, target, 120.0, height_mm=height + off)
        assert distances(observations, truth["cam_05"] - [0, 430]).max() < 0.5


def dlt_centre(observations: DotObservations) -> np.ndarray:
    return Camera("", dlt.to_projection(dlt.solve_dlt(observations.xyz, observations.px)), (1, 1)).centre


def test_too_few_dots_are_counted_for_the_operator(ring, shared_data):
    target, _, images, _ = ring
    dots = find_dots(images["cam_05"], target)
    with pytest.raises(InputError, match=r"camera 7: \d+ dots in \d+ columns .* at least 24 in 3 columns"):
        identify_dots(dots[np.arange(12)], target, 120.0, camera="7")
    board = grey(shared_data / "rendered_ring/limb/board/cam_05/000.jpg")
    with pytest.raises(InputError, match="0 dots in 0 columns"):
        identify_dots(find_dots(board, target), target, 120.0)


@pytest.mark.parametrize(("camera", "azimuth"), [("201", 61.0), ("202", 92.0)])
def test_the_real_pair_agrees_with_multidic_but_for_its_bias(shared_data, camera, azimuth):
    folder = shared_data / "multidic_rig"
    reference = np.load(folder / "reference.npz")
    observations = identify_dots(
        find_dots(grey(folder / "calibration" / f"{camera}.jpg"), REAL_TARGET), REAL_TARGET, azimuth
    )
    assert set(reference[f"calib_columns_{camera}"].tolist()) <= set(observations.columns.tolist())
    xyz = reference[f"calib_points_xyz_{camera}"]
    same = np.linalg.norm(observations.xyz[:, None] - xyz, axis=-1) < 1e-6
    assert same.any(axis=0).mean() > 0.98
    ours, theirs = np.nonzero(same)
    # MultiDIC's centroids are a third of a pixel too small; sheen on the ink of single dots is weighed differently.
    difference = observations.px[ours] - (reference[f"calib_centroids_{camera}"][theirs] + 1 / 3)
    assert np.abs(np.median(difference, axis=0)).max() < 0.07
    assert np.abs(difference).max() < 0.5
    assert np.sqrt(np.mean(difference**2)) < 0.15


def test_observations_survive_json(ring):
    target, _, images, _ = ring
    observations = identify_dots(find_dots(images["cam_01"], target), target, 0.0, camera="cam_01")
    assert DotObservations.from_dict(observations.to_dict()).to_dict() == observations.to_dict()


def test_glare_on_dots_costs_those_dots_and_no_others(ring):
    target, _, images, truth = ring
    image = images["cam_05"].astype(float)
    clean = identify_dots(find_dots(images["cam_05"], target), target, 120.0)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    hit = clean.px[5 : len(clean) : 11]  # a lamp's image over the edge of every eleventh dot
    for u, v in hit + np.array([8.0, -5.0]):
        near = np.hypot(x - u, y - v)
        image = np.maximum(image, 255 * np.clip(2.0 - near / 8.0, 0, 1))
    observations = identify_dots(find_dots(image.astype(np.uint8), target), target, 120.0)
    assert len(observations) > len(clean) - len(hit) - 3
    _, inliers = dlt.solve_dlt_robust(observations.xyz, observations.px, sigmas=5.0, floor=0.3)
    off = distances(observations, truth["cam_05"])
    hidden = np.linalg.norm(observations.px[:, None] - hit, axis=2).min(axis=1) < 10
    assert off[~hidden].max() < 0.5
    assert inliers[~hidden].mean() > 0.95
    assert (off[inliers & hidden] < 1.0).all()
