"""Calibration of single cameras: control points are reconstructed, on the real pair and on the rendered ring."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.calibration import dlt
from ringdic.calibration.camera_calibration import CameraCalibration, calibrate_camera
from ringdic.calibration.quality import camera_quality, reconstruction_error
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.session.rig import Rig, RigCamera, read_rig


def grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


def lift(cameras: list[Camera], px: list[np.ndarray]) -> np.ndarray:
    """Linear triangulation: two equations a camera, least squares. (n, 3)."""
    points = []
    for place in zip(*(camera.undistort(p) for camera, p in zip(cameras, px, strict=True)), strict=True):
        rows = [c.P[k] - u[k] * c.P[2] for c, u in zip(cameras, place, strict=True) for k in (0, 1)]
        points.append(np.linalg.lstsq(np.array(rows)[:, :3], -np.array(rows)[:, 3], rcond=None)[0])
    return np.array(points)


def control_points(a: CameraCalibration, b: CameraCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Nominal and reconstructed positions of the dots both cameras see."""
    index = {key: i for i, key in enumerate(zip(a.dots.rows.tolist(), a.dots.columns.tolist(), strict=True))}
    both = [
        (index[key], j)
        for j, key in enumerate(zip(b.dots.rows.tolist(), b.dots.columns.tolist(), strict=True))
        if key in index
    ]
    i, j = np.array(both).T
    return a.dots.xyz[i], lift([a.camera, b.camera], [a.dots.px[i], b.dots.px[j]])


@pytest.fixture(scope="module")
def ring_rig(shared_data) -> Rig:
    return read_rig(shared_data / "rendered_ring" / "limb" / "rig.toml")


def calibrate_ring(shared_data: Path, rig: Rig, camera: str) -> CameraCalibration:
    folder = shared_data / "rendered_ring" / "limb"
    boards = [grey(path) for path in sorted((folder / "board" / camera).glob("*.jpg"))]
    return calibrate_camera(rig, camera, boards, grey(folder / "target" / f"{camera}.jpg"))


@pytest.fixture(scope="module")
def ring(shared_data, ring_rig) -> list[CameraCalibration]:
    """Three adjacent cameras, the seam of the target in view."""
    return [calibrate_ring(shared_data, ring_rig, camera) for camera in ("cam_12", "cam_01", "cam_02")]


@pytest.fixture(scope="module")
def real(shared_data, ring_rig) -> tuple[Rig, dict[str, list[np.ndarray]], dict[str, np.ndarray]]:
    """The real pair's rig, nine boards and the target of each camera."""
    rig = replace(
        ring_rig,
        target=replace(ring_rig.target, columns=14),
        cameras=(RigCamera("201", 61.0), RigCamera("202", 92.0)),
        pairs=(("201", "202"),),
    )
    folder = shared_data / "multidic_rig"
    boards = {c: [grey(p) for p in sorted((folder / "checkerboard" / c).glob("*.jpg"))[::2]] for c in ("201", "202")}
    return rig, boards, {c: grey(folder / "calibration" / f"{c}.jpg") for c in ("201", "202")}


def test_control_points_of_the_real_pair_come_back_as_in_the_paper(real):
    rig, boards, targets = real
    pair = [calibrate_camera(rig, c, boards[c], targets[c]) for c in ("201", "202")]
    error = reconstruction_error(*control_points(*pair))
    assert error.points >= 100
    assert error.rms < 0.07
    assert error.mean < 0.01
    bare = [calibrate_camera(rig, c, [], targets[c], distortion=False) for c in ("201", "202")]
    assert all(calibration.camera.intrinsics is None for calibration in bare)
    # The lens is what makes the difference: 0.4 mm without it (Solav et al. 2018, table 2: 0.379).
    assert 0.3 < reconstruction_error(*control_points(*bare)).rms < 0.5


def test_control_points_of_the_rendered_ring_come_back(ring):
    for a, b in ((ring[0], ring[1]), (ring[1], ring[2])):
        error = reconstruction_error(*control_points(a, b))
        assert error.points >= 100
        assert error.rms < 0.03
        assert error.mean < 0.003


def test_lens_and_place_of_a_rendered_camera_are_the_true_ones(ring, shared_data):
    truth = json.loads((shared_data / "rendered_ring" / "cameras_truth.json").read_text())["cameras"]
    for calibration in ring:
        true = next(entry for entry in truth if entry["name"] == calibration.camera.id)
        centre = -np.array(true["R"]).T @ np.array(true["t"])
        # Centroids are not the centres' projections; the DLT gives the difference to the distance, 0.2 %.
        assert np.linalg.norm(calibration.camera.centre - centre) < 1.0
        lens = calibration.camera.intrinsics
        assert lens is not None
        K = np.array([[true["fx"], true["skew"], true["cx"]], [0, true["fy"], true["cy"]], [0, 0, 1]])
        lens_true = Intrinsics(K, np.array(true["dist_k1k2p1p2k3"]), lens.size)
        x, y = np.meshgrid(np.linspace(300, 930, 8), np.linspace(250, 1400, 12))
        px = np.column_stack([x.ravel(), y.ravel()])
        rays = [(each.to_undistorted(px) - each.K[:2, 2]) / each.K[[0, 1], [0, 1]] for each in (lens, lens_true)]
        # Apart from a rotation of the camera, rays on the target agree to a tenth of a pixel.
        offset = (rays[0] - rays[1]) * 1303
        assert np.sqrt(np.mean(np.sum((offset - offset.mean(axis=0)) ** 2, axis=1))) < 0.1
        assert calibration.residual_rms < 0.05


def test_a_calibration_survives_json(ring):
    stored = json.loads(json.dumps(ring[1].to_dict()))
    again = CameraCalibration.from_dict(stored)
    assert again.to_dict() == ring[1].to_dict()
    points = again.dots.xyz
    assert np.array_equal(again.camera.project(points), ring[1].camera.project(points))


def test_a_row_of_figures_tells_the_camera(ring):
    row = camera_quality(ring[1])
    assert row.camera == "cam_01"
    assert row.dots == len(ring[1].dots) >= 140
    assert set(row.columns) >= {1, 2, 3, 28, 29, 30}
    assert (row.board_views, row.board_views_used) == (5, 5)
    assert row.board_rms is not None
    assert row.board_rms < 0.06


def test_given_intrinsics_need_no_boards(ring, ring_rig, shared_data):
    image = grey(shared_data / "rendered_ring" / "limb" / "target" / "cam_01.jpg")
    lens = ring[1].camera.intrinsics
    again = calibrate_camera(ring_rig, "cam_01", [], image, intrinsics=lens)
    assert again.fit is None
    assert np.array_equal(again.camera.P, ring[1].camera.P)
    with pytest.raises(InputError, match=r"camera cam_01: its intrinsics are for images of 1232 x 1640"):
        calibrate_camera(ring_rig, "cam_01", [], image[:-10], intrinsics=lens)


def test_bad_images_are_refused_with_the_camera_s_name(ring_rig, shared_data):
    folder = shared_data / "rendered_ring" / "limb"
    target = grey(folder / "target" / "cam_01.jpg")
    board = grey(folder / "board" / "cam_01" / "000.jpg")
    with pytest.raises(InputError, match=r"camera cam_01: the checkerboard was found in 0 of 2 board images"):
        calibrate_camera(ring_rig, "cam_01", [target, target], target)
    with pytest.raises(InputError, match=r"camera cam_01: 0 dots"):
        calibrate_camera(ring_rig, "cam_01", [], board, distortion=False)


def test_one_pose_seen_again_and_again_is_not_a_lens(ring_rig, shared_data):
    folder = shared_data / "rendered_ring" / "limb"
    target = grey(folder / "target" / "cam_01.jpg")
    facing = grey(folder / "board" / "cam_02" / "000.jpg")
    with pytest.raises(ComputationError, match=r"camera cam_01: .* do not determine its focal length"):
        calibrate_camera(ring_rig, "cam_01", [facing] * 3, target)


def test_reconstruction_error_follows_its_definition():
    true = np.zeros((4, 3))
    reconstructed = np.array([[0.3, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [np.nan, 0, 0]])
    error = reconstruction_error(true, reconstructed)
    assert error.points == 3
    assert np.allclose(error.mean_vector, [0.4 / 3, 0.2 / 3, 0])
    assert error.mean == pytest.approx(np.hypot(0.4, 0.2) / 3)
    assert error.rms == pytest.approx(np.sqrt((0.09 + 0.01 + 0.04) / 3))
    assert reconstruction_error(true, np.full((4, 3), np.nan)).points == 0


def test_held_out_dots_are_predicted_by_the_others(ring) -> None:
    each = ring[0]
    fold = (each.dots.rows + 2 * each.dots.columns) % 5
    out = fold == fold[0]
    L = dlt.solve_dlt(each.dots.xyz[~out], each.camera.undistort(each.dots.px[~out]))
    others = replace(each.camera, P=dlt.to_projection(L))
    assert np.allclose(each.held_out[out], each.dots.px[out] - others.project(each.dots.xyz[out]), rtol=0, atol=1e-9)
    # A dot that took part pulls the camera to itself.
    own = each.dots.px - each.camera.project(each.dots.xyz)
    assert 1.0 < np.linalg.norm(each.held_out) / np.linalg.norm(own) < 1.2


def test_miscounted_squares_are_told_by_their_number(ring_rig, shared_data) -> None:
    folder = shared_data / "rendered_ring" / "limb"
    boards = [grey(folder / "board" / "cam_05" / f"{view:03d}.jpg") for view in range(3)]
    target = grey(folder / "target" / "cam_05.jpg")
    miscounted = replace(ring_rig, board=replace(ring_rig.board, squares=(14, 19)))  # its inner corners
    with pytest.raises(InputError, match=r"camera cam_05: .* a checkerboard of 15 x 20 squares, .* says 14 x 19"):
        calibrate_camera(miscounted, "cam_05", boards, target)
