"""Bundle adjustment: exact on exact data, with errors of the stated size, without the bias of the DLT."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from ring_of_numbers import (
    NAMES,
    SIZE,
    TARGET,
    camera_on_the_ring,
    lens_from_boards,
    lens_values,
    observed,
    outline_centroids,
    pose,
    turned,
)
from ringdic.calibration.bundle import BundleFit, TargetPrior, bundle_adjustment, centroid_shift
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.intrinsics import IntrinsicsFit
from ringdic.calibration.patch import DotViews, PrintedSheet, patch_jacobians, project_patches, quadrature, sheet_points
from ringdic.calibration.quality import pair_quality
from ringdic.calibration.target import dot_points
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.triangulation import triangulate
from scipy.optimize import least_squares


@pytest.fixture(scope="module")
def true_cameras() -> dict[str, Camera]:
    rng = np.random.default_rng(1)
    return {name: camera_on_the_ring(name, 30.0 * number, rng) for number, name in enumerate(NAMES)}


@pytest.fixture(scope="module")
def half_ring(true_cameras) -> dict[str, Camera]:
    return {name: true_cameras[name] for name in NAMES[:6]}


@pytest.fixture(scope="module")
def fits(true_cameras) -> dict[str, IntrinsicsFit]:
    """Every lens, fitted to ten views of the board."""
    rng = np.random.default_rng(2)
    return {name: lens_from_boards(camera.intrinsics, 0.03, rng) for name, camera in true_cameras.items()}


def seen_by_all(true_cameras, fits, seed: int, noise: float = 0.01, print_error: float = 0.0, **options) -> dict:
    rng = np.random.default_rng(seed)
    errors = print_error * rng.normal(size=(TARGET.rows, TARGET.columns, 2))
    return {
        name: observed(camera, fits[name].intrinsics, fits[name], noise, rng, print_errors=errors, **options)
        for name, camera in true_cameras.items()
    }


def diameter_error(true_cameras: dict[str, Camera], cameras: dict[str, CameraCalibration]) -> float:
    """Diameter of a cylinder of 114 mm seen exactly and triangulated by neighbours, minus 114. mm."""
    angle, z = (a.ravel() for a in np.meshgrid(np.arange(0, 2 * np.pi, np.pi / 60), np.linspace(15, 235, 12)))
    normals = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    xyz = 57 * normals + np.outer(z, [0, 0, 1])
    names, points = list(true_cameras), []
    following = [*names[1:], *(names[:1] if len(names) == 12 else [])]
    for a, b in zip(names, following, strict=False):
        pair = [true_cameras[a], true_cameras[b]]
        both = np.min([camera.incidence_cosine(xyz, normals) for camera in pair], axis=0) > 0.5
        px = np.stack([camera.project(xyz[both]) for camera in pair])
        points.append(triangulate([cameras[a].camera, cameras[b].camera], px))
    cloud = np.concatenate(points)

    def misfit(q: np.ndarray) -> np.ndarray:
        axis = np.array([q[2], q[3], 1.0]) / np.linalg.norm([q[2], q[3], 1.0])
        offset = cloud - [q[0], q[1], 124.0]
        return np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=1) - q[4]

    return 2 * (least_squares(misfit, [0, 0, 0, 0, 57.0], x_scale=[1, 1, 0.01, 0.01, 1]).x[4] - 57.0)


def pulls(true: Camera, estimate: Camera, sigma: np.ndarray) -> np.ndarray:
    """Errors of the sixteen parameters in units of their stated standard errors."""
    (R, t), (R_true, t_true) = pose(estimate), pose(true)
    omega = cv2.Rodrigues(R @ R_true.T)[0].ravel()
    lens = lens_values(estimate.intrinsics) - lens_values(true.intrinsics)
    return np.concatenate([lens, omega, t - turned(omega) @ t_true + (turned(omega) - np.eye(3)) @ t_true]) / sigma


@pytest.mark.parametrize("shape", ["square", "circle"])
def test_the_centroid_of_a_patch_is_that_of_its_outline(true_cameras, shape) -> None:
    camera = true_cameras["c01"]
    sz = np.column_stack([np.linspace(-52, 52, 9), np.linspace(10, 238, 9)])  # up to 52° round the cylinder
    R, t = pose(camera)
    inner = np.tile(lens_values(camera.intrinsics), (9, 1))
    views = DotViews(inner, np.tile(R, (9, 1, 1)), np.tile(t, (9, 1)), sz, 57.0)
    outline = outline_centroids(camera, sz, 57.0, shape, 4.0)
    assert np.abs(project_patches(views, shape, 4.0) - outline).max() < 2e-5
    angle = sz[:, 0] / 57
    centre = camera.project(np.column_stack([57 * np.cos(angle), 57 * np.sin(angle), sz[:, 1]]))
    assert 0.15 < np.linalg.norm(outline - centre, axis=1).max() < 0.6
    assert quadrature(shape, 4.0)[1].sum() == pytest.approx(1.0)


def test_centroids_of_a_moved_target_are_known_too(true_cameras) -> None:
    camera, rows, columns = true_cameras["c03"], np.array([1, 8, 20]), np.array([4, 6, 8])
    R, t = turned(np.array([0.01, -0.02, 0.03])), np.array([5.0, 1.0, -2.0])
    sz = sheet_points(TARGET, PrintedSheet.nominal(TARGET), rows, columns)
    M = np.column_stack([R, t])
    moved = Camera("moved", camera.P @ np.vstack([M, [0, 0, 0, 1]]), SIZE, camera.intrinsics)
    centre = camera.project(dot_points(TARGET, rows, columns) @ R.T + t)
    truth = outline_centroids(moved, sz, 57.0, "square", 4.0) - centre
    estimate = centroid_shift(camera, TARGET, rows, columns, rotation=R, translation=t)
    assert np.allclose(estimate, truth, rtol=0, atol=2e-5)
    still = centroid_shift(camera, TARGET, rows, columns)
    assert np.abs(still - estimate).max() > 1e-3
    bare = replace(camera, intrinsics=None)
    flat = outline_centroids(bare, sz, 57.0, "square", 4.0) - bare.project(dot_points(TARGET, rows, columns))
    assert np.allclose(centroid_shift(bare, TARGET, rows, columns), flat, rtol=0, atol=2e-5)


def test_derivatives_of_a_patch_are_those_of_differences(true_cameras) -> None:
    R, t = pose(true_cameras["c02"])
    values = lens_values(true_cameras["c02"].intrinsics)

    def centroid(x: np.ndarray) -> np.ndarray:
        views = DotViews(
            (values + x[:10])[None],
            (turned(x[10:13]) @ R)[None],
            (t + x[13:16])[None],
            np.array([[30.0, 60.0]]) + x[16:18],
            57.0 + x[18],
        )
        return project_patches(views, "square", 4.0)[0]

    views = DotViews(values[None], R[None], t[None], np.array([[30.0, 60.0]]), 57.0)
    px, inner, by_pose, by_sz, by_radius = patch_jacobians(views, "square", 4.0)
    exact = np.concatenate([inner, by_pose, by_sz, by_radius], axis=-1)[0]
    steps = np.concatenate([np.full(5, 1e-2), np.full(5, 1e-4), np.full(3, 1e-5), np.full(6, 1e-3)])
    for k, h in enumerate(steps):
        x = np.zeros(19)
        x[k] = h
        difference = (centroid(x) - centroid(-x)) / (2 * h)
        # The derivatives' rule has four nodes, the centroid's sixteen.
        assert np.linalg.norm(exact[:, k] - difference) < 2e-6 * np.linalg.norm(difference) + 2e-6, k
    assert np.allclose(px[0], centroid(np.zeros(19)), rtol=0, atol=1e-9)


def test_a_perfect_world_comes_back(true_cameras) -> None:
    rng = np.random.default_rng(3)
    some = {name: true_cameras[name] for name in NAMES[:4]}
    perfect = {name: lens_from_boards(camera.intrinsics, 0.0, rng) for name, camera in some.items()}
    start = seen_by_all(some, perfect, 4, noise=0.0, points=8000)
    cameras, fit = bundle_adjustment(start, TARGET)
    for name, true in some.items():
        # The outline and the rule of sixteen nodes agree to 5e-8 px.
        assert np.linalg.norm(cameras[name].camera.centre - true.centre) < 1e-6
        error = lens_values(cameras[name].camera.intrinsics) - lens_values(true.intrinsics)
        assert np.abs(error).max() < 1e-5
        assert np.abs(cameras[name].residuals).max() < 2e-7
        assert np.linalg.norm(start[name].camera.centre - true.centre) > 0.2  # the DLT's own answer
    assert np.abs(fit.offsets).max() < 1e-6
    shift = cameras["c01"].dots.px - true_cameras["c01"].project(cameras["c01"].dots.xyz)
    assert np.allclose(cameras["c01"].centroid_shift, shift, rtol=0, atol=1e-4)


@pytest.mark.parametrize("shape", ["square", "circle"])
def test_the_diameter_is_right_where_the_dlt_s_is_not(request, fits, shape, figures) -> None:
    true_cameras = request.getfixturevalue("true_cameras" if shape == "square" else "half_ring")
    target = replace(TARGET, dot_shape=shape)
    start = seen_by_all(true_cameras, fits, 5, target=target)
    cameras, fit = bundle_adjustment(start, target)
    before, after = diameter_error(true_cameras, start), diameter_error(true_cameras, cameras)
    figures(f"diameter bias, {shape} dots: DLT, bundle, µm", f"{before * 1e3:.1f}, {after * 1e3:.2f}", "> 50, 3")
    assert 0.05 < before < 0.12
    assert abs(after) < 0.003
    assert fit.px_sigma == pytest.approx(0.01, rel=0.1)
    assert fit.print_sigma < 0.002
    # About three hundred numbers for each camera, of variance one but for Huber's weights.
    assert np.abs(fit.chi2 - 1).max() < 0.35
    assert 1.0 <= fit.lens_scale < 1.3


def test_print_errors_are_found_and_leave_the_diameter_alone(true_cameras, fits, figures) -> None:
    start = seen_by_all(true_cameras, fits, 6, print_error=0.03)
    cameras, fit = bundle_adjustment(start, TARGET)
    after = diameter_error(true_cameras, cameras)
    figures("diameter bias, prints off by 0.03 mm, bundle, µm", f"{after * 1e3:.2f}", "5")
    assert abs(after) < 0.005
    assert fit.print_sigma == pytest.approx(0.03, rel=0.12)
    assert fit.px_sigma == pytest.approx(0.01, rel=0.12)
    truth = np.random.default_rng(6).normal(size=(20, 30, 2))[fit.rows - 1, fit.columns - 1] * 0.03
    error = fit.offsets - truth
    # A motion of the whole print cannot be separated from one of the world.
    assert np.sqrt(np.mean((error - error.mean(axis=0)) ** 2)) < 0.004
    assert np.abs(error / fit.offsets_sigma).max() < 5


def test_a_target_of_another_size_is_measured_where_that_is_allowed(half_ring, fits) -> None:
    sheet = PrintedSheet(57.02, 12.01, 0.001)
    start = seen_by_all(half_ring, fits, 7, print_error=0.01, sheet=sheet)
    cameras, fit = bundle_adjustment(start, TARGET, TargetPrior(radius=0.1, pitch=0.05, tilt=0.01))
    error = np.array([fit.sheet.radius, fit.sheet.pitch, fit.sheet.tilt]) - [57.02, 12.01, 0.001]
    assert (np.abs(error) < 4 * fit.sheet_sigma).all()
    assert fit.sheet_sigma[0] < 0.004
    assert fit.sheet.seam(TARGET) == pytest.approx(2 * np.pi * 57.02 - 29 * 12.01, abs=0.02)
    figures = fit.figures(TARGET)
    assert figures["radius_mm"] == pytest.approx(57.02, abs=4 * figures["radius_sigma_mm"])
    assert figures["tilt_deg"] == pytest.approx(np.degrees(0.001), abs=4 * figures["tilt_sigma_deg"])
    assert [row["camera"] for row in figures["cameras"]] == list(half_ring)
    assert all(0 < row["focal_sigma_px"][0] < 1 for row in figures["cameras"])
    assert abs(diameter_error(half_ring, cameras)) < 0.005
    held, _ = bundle_adjustment(start, TARGET)
    assert diameter_error(half_ring, held) < -0.03  # a radius believed 0.02 too small makes everything so


def test_stated_uncertainties_are_true(true_cameras) -> None:
    estimate, prints = [], []
    some = {name: true_cameras[name] for name in NAMES[:4]}
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        fits = {name: lens_from_boards(camera.intrinsics, 0.03, rng) for name, camera in some.items()}
        cameras, fit = bundle_adjustment(seen_by_all(some, fits, 200 + seed, print_error=0.02), TARGET)
        estimate += [
            pulls(true, cameras[name].camera, sigma)
            for (name, true), sigma in zip(some.items(), fit.camera_sigma, strict=True)
        ]
        prints.append(fit.print_sigma)
    # Six independent draws of sixty-four correlated numbers.
    assert 0.75 < np.sqrt(np.mean(np.square(estimate))) < 1.25
    assert np.abs(estimate).max() < 5
    assert np.mean(prints) == pytest.approx(0.02, rel=0.08)


def test_gross_errors_are_left_out_and_counted(half_ring, fits) -> None:
    start = seen_by_all(half_ring, fits, 8)
    clean, _ = bundle_adjustment(start, TARGET)
    px = start["c03"].dots.px.copy()
    px[[5, 50, 90]] += [0.6, -0.5]
    start["c03"] = replace(start["c03"], dots=replace(start["c03"].dots, px=px))
    cameras, _ = bundle_adjustment(start, TARGET)
    assert cameras["c03"].left_out - clean["c03"].left_out == 3
    assert len(cameras["c03"].dots) == len(px) - cameras["c03"].left_out
    assert np.linalg.norm(cameras["c03"].camera.centre - clean["c03"].camera.centre) < 0.02


def test_a_lens_that_contradicts_the_target_is_told(half_ring, fits) -> None:
    rng = np.random.default_rng(9)
    lens = half_ring["c04"].intrinsics
    K = lens.K.copy()
    K[:2, :2] *= 1.004  # refocused after the boards
    other = {**fits, "c04": lens_from_boards(replace(lens, K=K), 0.03, rng)}
    _, fit = bundle_adjustment(seen_by_all(half_ring, other, 10), TARGET)
    assert fit.cameras[int(np.argmax(fit.lens_chi2))] == "c04"
    assert fit.lens_chi2.max() > 10
    _, good = bundle_adjustment(seen_by_all(half_ring, fits, 10), TARGET)
    assert good.lens_chi2.max() < 4


def test_a_camera_that_is_worse_than_the_others_is_told(half_ring, fits) -> None:
    start = seen_by_all(half_ring, fits, 10)
    shaken = start["c02"].dots
    px = shaken.px + np.random.default_rng(5).normal(0, 0.025, shaken.px.shape)
    start["c02"] = replace(start["c02"], dots=replace(shaken, px=px))
    _, fit = bundle_adjustment(start, TARGET)
    others = [value for id_, value in zip(fit.cameras, fit.chi2, strict=True) if id_ != "c02"]
    assert fit.chi2[1] > 2.5 * max(others)


def test_a_given_lens_is_held_and_a_bare_camera_needs_none(true_cameras) -> None:
    rng = np.random.default_rng(11)
    some = {name: true_cameras[name] for name in NAMES[:3]}
    start = {name: observed(camera, camera.intrinsics, None, 0.01, rng) for name, camera in some.items()}
    cameras, fit = bundle_adjustment(start, TARGET)
    for name, true in some.items():
        assert np.array_equal(lens_values(cameras[name].camera.intrinsics), lens_values(true.intrinsics))
        assert np.linalg.norm(cameras[name].camera.centre - true.centre) < 0.03
    assert np.isnan(fit.lens_chi2).all()
    assert not fit.camera_sigma[:, :10].any()

    pinholes = {}
    for name, camera in some.items():
        lens = Intrinsics(camera.intrinsics.K_undistorted, np.zeros(5), SIZE)
        pinholes[name] = observed(replace(camera, intrinsics=lens), None, None, 0.001, rng)
    cameras, _ = bundle_adjustment(pinholes, TARGET)
    for name, true in some.items():
        assert cameras[name].camera.intrinsics is None
        assert np.linalg.norm(cameras[name].camera.centre - true.centre) < 0.1
        assert np.linalg.norm(pinholes[name].camera.centre - true.centre) > 0.2


def test_a_camera_that_is_none_is_refused(half_ring, fits) -> None:
    start = seen_by_all(half_ring, fits, 12)
    nonsense = np.random.default_rng(13).normal(0, 20, start["c02"].dots.px.shape)
    start["c02"] = replace(start["c02"], dots=replace(start["c02"].dots, px=start["c02"].dots.px + nonsense))
    with pytest.raises(ComputationError, match="camera c02: only"):
        bundle_adjustment(start, TARGET)


def test_the_adjustment_survives_json(true_cameras, fits) -> None:
    start = seen_by_all({name: true_cameras[name] for name in NAMES[:2]}, fits, 14)
    start["c02"] = replace(start["c02"], fit=None)
    cameras, fit = bundle_adjustment(start, TARGET)
    again = BundleFit.from_dict(json.loads(json.dumps(fit.to_dict())))
    assert again.to_dict() == fit.to_dict()
    stored = CameraCalibration.from_dict(json.loads(json.dumps(cameras["c01"].to_dict())))
    assert stored.to_dict() == cameras["c01"].to_dict()
    assert np.array_equal(stored.dot_centres, cameras["c01"].dot_centres)


def without_a_dot(each: CameraCalibration, row: int, column: int) -> CameraCalibration:
    kept = (each.dots.rows != row) | (each.dots.columns != column)
    shift = each.centroid_shift[kept]
    return replace(each, dots=each.dots.subset(kept), residuals=each.residuals[kept], centroid_shift=shift)


@pytest.mark.parametrize("print_error", [0.0, 0.03])
def test_held_out_dots_are_those_of_an_adjustment_without_them(true_cameras, fits, print_error) -> None:
    some = {name: true_cameras[name] for name in NAMES[:3]}
    start = seen_by_all(some, fits, 15, print_error=print_error)
    cameras, _ = bundle_adjustment(start, TARGET)
    for row, column in [(10, 3), (1, 1), (20, 5)]:  # inside, in a corner, at the upper edge
        without, _ = bundle_adjustment({id_: without_a_dot(each, row, column) for id_, each in start.items()}, TARGET)
        for id_, each in cameras.items():
            place = np.flatnonzero((each.dots.rows == row) & (each.dots.columns == column))
            if not len(place):
                continue
            camera, at = without[id_].camera, (np.array([row]), np.array([column]))
            predicted = camera.project(dot_points(TARGET, *at)) + centroid_shift(camera, TARGET, *at)
            # To the first order of what one dot changes, a tenth of a pixel at most.
            assert np.allclose(each.held_out[place], each.dots.px[place] - predicted, rtol=0, atol=1e-3)
            assert print_error == 0 or np.linalg.norm(each.held_out[place]) > 2 * np.linalg.norm(each.residuals[place])


def test_control_points_do_not_judge_themselves(true_cameras, fits) -> None:
    # A print 0.5 % too large: the adjustment fits its own dots, and those that it did not see tell the truth.
    some = {name: true_cameras[name] for name in NAMES[:3]}
    scaled = replace(TARGET, row_spacing_mm=12.06, column_spacing_mm=12.06)
    cameras, _ = bundle_adjustment(seen_by_all(some, fits, 16, target=scaled), TARGET)
    pair = [cameras["c01"], cameras["c02"]]
    own = [replace(each, held_out=None) for each in pair]
    assert pair_quality(*own)[0].rms < 0.02
    assert pair_quality(*pair)[0].rms > 0.1
    calm, _ = bundle_adjustment(seen_by_all(some, fits, 16), TARGET)
    assert pair_quality(calm["c01"], calm["c02"])[0].rms < 0.006
