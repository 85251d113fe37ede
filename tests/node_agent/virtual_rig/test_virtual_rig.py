"""The simulated rig: its mathematics against itself, its images against its own truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ringdic.correlation import CorrelationSettings, correlate_points, prepare_current, prepare_reference
from ringdic_node.virtual_rig.body import approach
from ringdic_node.virtual_rig.lens import VirtualCamera, distort, ideal_of_pixel
from ringdic_node.virtual_rig.render import radiance, render
from ringdic_node.virtual_rig.rig import paper_rig, write_truth
from ringdic_node.virtual_rig.scenes import BoardScene, Cylinder, Limb, Specimen, TargetScene, scene
from ringdic_node.virtual_rig.sensor import FULL_WELL, READ_NOISE, expose, srgb_coded
from ringdic_node.virtual_rig.texture import speckle
from scipy.stats import norm

SCALE = 0.25
RIG = paper_rig(12, SCALE, seed=3)
CAMERA = RIG.cameras[1]


def linear(image: np.ndarray) -> np.ndarray:
    """Inverse of the sRGB coding."""
    coded = image / 255.0
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("camera", [camera for seed in range(4) for camera in paper_rig(12, SCALE, seed).cameras])
def test_no_lens_folds_the_image_over(camera: VirtualCamera) -> None:
    lens = camera.lens
    for u in (0.0, camera.width - 1.0):
        for v in (0.0, camera.height - 1.0):
            x, y, xu, xv, yu, yv = ideal_of_pixel(u, v, lens, (u - lens[3]) / lens[0], (v - lens[4]) / lens[1])
            assert abs(x) < 1
            assert abs(y) < 1
            assert xu * yv - xv * yu > 0


def test_the_lens_inverts_itself_all_over_the_image() -> None:
    lens = CAMERA.lens
    for u in np.linspace(0, CAMERA.width, 7):
        for v in np.linspace(0, CAMERA.height, 7):
            x, y, *_ = ideal_of_pixel(u, v, lens, (u - lens[3]) / lens[0], (v - lens[4]) / lens[1])
            a, b = distort(x, y, lens)
            assert lens[0] * a + lens[2] * b + lens[3] == pytest.approx(u, abs=1e-9)
            assert lens[1] * b + lens[4] == pytest.approx(v, abs=1e-9)


def test_the_lens_derivatives_are_those_of_its_inverse() -> None:
    lens, h = CAMERA.lens, 1e-4
    x, y, xu, xv, yu, yv = ideal_of_pixel(100.0, 700.0, lens, 0.0, 0.0)
    right, below = ideal_of_pixel(100.0 + h, 700.0, lens, x, y), ideal_of_pixel(100.0, 700.0 + h, lens, x, y)
    np.testing.assert_allclose([xu, yu], [(right[0] - x) / h, (right[1] - y) / h], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose([xv, yv], [(below[0] - x) / h, (below[1] - y) / h], rtol=1e-4, atol=1e-9)


def test_the_scale_keeps_what_a_pixel_shows() -> None:
    large, small = paper_rig(12, 1.0, seed=3).cameras[4], paper_rig(12, 0.5, seed=3).cameras[4]
    xyz = np.array([[10.0, 50.0, 100.0], [-40.0, 20.0, 30.0]])
    # The centre of pixel k of the small image is the corner between pixels 2k and 2k + 1 of the large one.
    np.testing.assert_allclose((large.project(xyz) + 0.5) / 2 - 0.5, small.project(xyz), atol=1e-9)


@pytest.mark.parametrize("surface", [Cylinder(), Limb()])
def test_derivatives_are_those_of_the_positions(surface: Cylinder | Limb) -> None:
    theta, z, h = np.linspace(0, 6, 20), np.linspace(5, 245, 20), 1e-5
    tangents = surface.tangents(theta, z, 4)
    by_theta = (surface.position(theta + h, z, 4) - surface.position(theta - h, z, 4)) / (2 * h)
    by_z = (surface.position(theta, z + h, 4) - surface.position(theta, z - h, 4)) / (2 * h)
    np.testing.assert_allclose(tangents[:, 0], by_theta, atol=1e-7)
    np.testing.assert_allclose(tangents[:, 1], by_z, atol=1e-7)


def test_stretches_bound_the_elongation_of_every_fibre() -> None:
    limb, h = Limb(), 1e-4
    theta, z = np.linspace(0.1, 6.1, 12), np.linspace(10, 240, 12)
    low, high = limb.stretches(theta, z, 5)
    ratios = []
    for angle in np.radians(np.arange(0, 180, 0.5)):
        a, b = h * np.cos(angle) / 57.0, h * np.sin(angle)
        ends = [limb.position(theta + a, z + b, step) - limb.position(theta - a, z - b, step) for step in (0, 5)]
        ratios.append(np.linalg.norm(ends[1], axis=1) / np.linalg.norm(ends[0], axis=1))
    np.testing.assert_allclose(np.min(ratios, axis=0), low, atol=5e-5)
    np.testing.assert_allclose(np.max(ratios, axis=0), high, atol=5e-5)
    assert 1.10 < high.max() < 1.25  # the stated load


def test_a_rigid_cylinder_does_not_stretch() -> None:
    low, high = Cylinder().stretches(np.linspace(0, 6, 9), np.linspace(20, 200, 9), 7)
    np.testing.assert_allclose([low, high], 1.0, atol=1e-12)


@pytest.mark.parametrize("surface", [Cylinder(), Limb()])
def test_a_point_off_the_surface_is_named_and_measured(surface: Cylinder | Limb) -> None:
    theta, z = np.linspace(-3, 3, 30), np.linspace(10, 240, 30)
    tangents = surface.tangents(theta, z, 2)
    normals = np.cross(tangents[:, 0], tangents[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = surface.material_coordinates(surface.position(theta, z, 2) + 0.8 * normals, 2)
    np.testing.assert_allclose(found[0], theta, atol=1e-9)
    np.testing.assert_allclose(found[1], z, atol=1e-7)
    np.testing.assert_allclose(found[2], 0.8, atol=1e-9)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (5.0, 0.0, 0.0)])
def test_the_dots_are_where_their_centres_project(offset: tuple[float, float, float]) -> None:
    image = linear(render(CAMERA, TargetScene(offset), 5))
    centres = TargetScene(offset).dots()
    outwards = (centres - offset) * [1, 1, 0] / 57.0
    towards = CAMERA.centre - centres
    frontal = np.sum(outwards * towards, axis=-1) / np.linalg.norm(towards, axis=-1) > np.cos(np.radians(35))
    assert frontal.sum() > 60
    errors = []
    for px in CAMERA.project(centres[frontal]):
        x0, y0 = np.round(px).astype(int)
        patch = image[y0 - 8 : y0 + 9, x0 - 8 : x0 + 9]
        dark = np.clip(1 - patch / np.percentile(patch, 80) - 0.1, 0, None)
        y, x = np.mgrid[-8:9, -8:9]
        errors.append([x0 + np.sum(x * dark) / dark.sum() - px[0], y0 + np.sum(y * dark) / dark.sum() - px[1]])
    # A dot's image has its centroid up to 0.24 px at full scale (0.06 px here) from its centre's projection.
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) < 0.06


@pytest.mark.parametrize("bow", [0.0, -4.0])
def test_the_corners_are_where_the_board_truth_says(bow: float) -> None:
    board = BoardScene(2, 3, bow)
    image = render(CAMERA, board, 5)
    truth = board.corners(CAMERA).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    found = cv2.cornerSubPix(image, truth.reshape(-1, 1, 2).copy(), (4, 4), (-1, -1), stop).reshape(-1, 2)
    error = found - truth
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.08
    assert np.linalg.norm(error.mean(axis=0)) < 0.02  # no shift of the whole image
    shift = np.linalg.norm(truth - BoardScene(2, 3).corners(CAMERA), axis=1).max()
    per_mm = CAMERA.K[0, 0] / 290.0  # px, at the least distance; no board is seen at more than 50°
    assert shift <= 1.1 * per_mm * abs(bow) * np.tan(np.radians(50.0)) + 1e-3
    assert (shift > 1.0) == (bow != 0.0)


@pytest.mark.parametrize("step", [0, 5])
def test_every_material_point_of_the_limb_is_shown_where_its_truth_projects(step: int) -> None:
    limb = Limb()
    rng = np.random.default_rng(step)
    theta, z = rng.uniform(0, 2 * np.pi, 20000), rng.uniform(8, 242, 20000)
    dark = np.array([speckle(57.0 * a, b, 0.08, 0.08, 3) for a, b in zip(theta, z, strict=True)])
    xyz, tangents = limb.position(theta, z, step), limb.tangents(theta, z, step)
    normals = np.cross(tangents[:, 0], tangents[:, 1])
    towards = CAMERA.centre - xyz
    cosine = np.sum(normals * towards, axis=1) / np.linalg.norm(normals, axis=1) / np.linalg.norm(towards, axis=1)
    clear = (cosine > 0.7) & ((dark == 1.0) | (dark == 0.0))  # 0.45 mm about the point all dark or all white
    x, y = np.rint(CAMERA.project(xyz[clear])).astype(int).T
    seen = radiance(CAMERA, Specimen(limb, step, seed=3))[y, x] / (0.40 + 0.60 * cosine[clear])
    assert clear.sum() > 400
    assert (dark[clear] == 1.0).sum() > 50
    np.testing.assert_array_equal(seen < 0.35, dark[clear] == 1.0)


@pytest.mark.parametrize("step", [0, 5])
def test_a_ray_that_grazes_the_limb_is_told_from_one_that_misses(step: int) -> None:
    limb = Limb()
    theta, z = np.meshgrid(np.linspace(0, 6, 25), np.linspace(0, 250, 11))
    xyz, tangents = (f(theta.ravel(), z.ravel(), step) for f in (limb.position, limb.tangents))
    along = tangents[:, 0] / np.linalg.norm(tangents[:, 0], axis=1, keepdims=True)
    normals = np.cross(along, tangents[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for height in (0.3, -0.3):  # of the ray above the surface where it is parallel to it
        origins = xyz + height * normals - 300.0 * along
        clearances = [approach(o, d, limb.parameters(step))[0] for o, d in zip(origins, along, strict=True)]
        np.testing.assert_allclose(clearances, height, atol=0.06)  # along the radius, not along the normal


@pytest.mark.parametrize(("ds", "dz"), [(0.07, 0.07), (0.14, 0.07)])
def test_speckles_are_seen_as_the_mean_over_the_point_spread(ds: float, dz: float) -> None:
    rng = np.random.default_rng(1)
    parts = norm.ppf((np.arange(12) + 0.5) / 12)
    errors = []
    for s, z in rng.uniform([0, 10], [350, 240], (2000, 2)):
        fine = np.mean([speckle(s + ds * a, z + dz * b, ds / 6, dz / 6, 4) for a in parts for b in parts])
        errors.append(speckle(s, z, ds, dz, 4) - fine)
    assert abs(np.mean(errors)) < 0.002
    assert np.std(errors) < 0.012  # overlapping disks and corners between them; edges alone are exact


def test_a_subset_moves_as_its_material_does_to_a_thousandth_of_a_pixel() -> None:
    # What is blurred after sampling only aliases: 0.005 px at half a pixel of motion.
    full = paper_rig(12, 1.0, seed=3).cameras[0]
    K = full.K - np.array([[0, 0, full.width / 2 - 150], [0, 0, full.height / 2 - 150], [0, 0, 0]])
    window = replace(full, K=K, width=300, height=300)
    cylinder = Cylinder(per_step=(0.0, 0.0, 0.05))
    before, after = (255 * srgb_coded(radiance(window, Specimen(cylinder, step))) for step in (0, 1))
    facing = np.arctan2(full.centre[1], full.centre[0])
    theta, z = np.meshgrid(facing + np.linspace(-0.3, 0.3, 60), np.linspace(60, 200, 150))
    xy, moved = (window.project(cylinder.position(theta.ravel(), z.ravel(), step)) for step in (0, 1))
    inside = ((xy > 25) & (xy < 275)).all(axis=1)
    settings = CorrelationSettings(radius=20, step=10)
    start = np.zeros((inside.sum(), 6))
    start[:, :2] = (moved - xy)[inside]
    current = prepare_current(after, settings=settings)
    found = correlate_points(prepare_reference(before, None, settings), current, xy[inside], settings, start=start)
    assert inside.sum() > 200
    error = found.uv - (moved - xy)[inside]
    assert np.abs(error.mean(axis=0)).max() < 0.0005
    assert error.std(axis=0).max() < 0.001


def test_the_views_of_the_board_fill_the_image() -> None:
    for camera in RIG.cameras:
        boards = [scene("board", index, seed=3) for index in range(8)]
        px = np.concatenate([board.corners(camera) for board in boards])
        assert (px > 0).all()
        assert (px < [camera.width - 1, camera.height - 1]).all()
        counts, _, _ = np.histogram2d(*px.T, bins=(6, 8), range=((0, camera.width), (0, camera.height)))
        assert (counts > 0).mean() > 0.8
        tilts = [np.degrees(np.arccos(abs(board.pose(camera)[0][2, 2]))) for board in boards]
        assert min(tilts) > 20  # tilt is what tells focal length from distance
        assert max(tilts) < 50


def test_noise_is_the_stated_shot_and_read_noise() -> None:
    level = 0.4
    images = [linear(expose(np.full((200, 300), level, np.float32), seed)) for seed in (1, 2)]
    electrons = (images[0] - images[1])[80:120, 130:170] * FULL_WELL  # the middle, without vignetting
    expected = np.sqrt(2 * (level * FULL_WELL + READ_NOISE**2))
    assert electrons.std() == pytest.approx(expected, rel=0.06)  # 1,600 samples: 1.8 %, and 8-bit rounding


def test_the_same_seed_gives_the_same_image_and_another_does_not() -> None:
    small = paper_rig(4, 0.06, seed=1).cameras[0]
    first, again, other = (render(small, scene("specimen", 1, seed=1), seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.1


def test_the_speckles_are_seamless_and_about_two_fifths_dark() -> None:
    flat = radiance(paper_rig(12, 0.25, seed=0).cameras[0], scene("specimen", 0, "cylinder"))
    white, black = np.percentile(flat[300:500, 280:340], [99, 1])
    dark = (white - flat[300:500, 280:340].mean()) / (white - black)
    assert 0.3 < dark < 0.5


@pytest.mark.parametrize(
    ("kind", "index", "specimen", "sentence"),
    [("face", 0, "limb", "no scene of kind"), ("board", -1, "limb", "counted from 0"), ("static", 0, "arm", "'arm'")],
)
def test_a_scene_that_does_not_exist_is_refused(kind: str, index: int, specimen: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        scene(kind, index, specimen)


def test_the_truth_file_names_every_camera(tmp_path) -> None:
    assert write_truth(RIG, tmp_path).read_text().count('"id"') == 12
