"""Bundle adjustment on images: the rendered ring against its truth, the real pair against the calibration by DLT.

One table of figures for both ways: control points, diameter, the target moved by 5 mm.
"""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.calibration.bundle import bundle_adjustment, centroid_shift
from ringdic.calibration.calibrated_rig import calibrate_rig, control_points
from ringdic.calibration.camera_calibration import CameraCalibration, calibrate_camera
from ringdic.calibration.dots import find_dots
from ringdic.calibration.target import DotObservations, identify_dots
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.triangulation import reprojection_residuals, triangulate
from ringdic.session.folder import Capture, Session
from ringdic.session.records import CaptureRecord
from ringdic.session.rig import Rig, RigCamera, read_rig
from ringdic.settings import CalibrationGroup
from scipy.optimize import least_squares

MOVED = np.array([5.0, 0.0, 0.0])


def grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


@dataclass(frozen=True)
class Ways:
    """The calibration by DLT and the adjusted one."""

    dlt: dict[str, CameraCalibration]
    bundle: dict[str, CameraCalibration]


@pytest.fixture(scope="module")
def folder(shared_data) -> Path:
    return shared_data / "rendered_ring"


@pytest.fixture(scope="module")
def rig(folder) -> Rig:
    return read_rig(folder / "limb" / "rig.toml")


def calibrated(folder: Path, rig: Rig, camera: str) -> CameraCalibration:
    boards = [grey(path) for path in sorted((folder / "limb" / "board" / camera).glob("*.jpg"))]
    return calibrate_camera(rig, camera, boards, grey(folder / "limb" / "target" / f"{camera}.jpg"))


@pytest.fixture(scope="module")
def ways(folder, rig) -> Ways:
    names = [camera.id for camera in rig.cameras]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        start = dict(zip(names, pool.map(lambda name: calibrated(folder, rig, name), names), strict=True))
    return Ways(start, bundle_adjustment(start, rig.target)[0])


@pytest.fixture(scope="module")
def true_cameras(folder) -> dict[str, Camera]:
    cameras = {}
    for true in json.loads((folder / "cameras_truth.json").read_text())["cameras"]:
        K = np.array([[true["fx"], true["skew"], true["cx"]], [0, true["fy"], true["cy"]], [0, 0, 1]])
        lens = Intrinsics(K, np.array(true["dist_k1k2p1p2k3"]), (1232, 1640))
        P = lens.K_undistorted @ np.column_stack([true["R"], true["t"]])
        cameras[true["name"]] = Camera(true["name"], P / P[2, 3], (1232, 1640), lens)
    return cameras


def pairs(rig: Rig) -> list[tuple[str, str]]:
    assert len(rig.pairs) == 12
    return list(rig.pairs)


def fitted_diameter(cloud: np.ndarray, z: float) -> tuple[float, float]:
    """Diameter of the least-squares cylinder and standard deviation of the points' diameters, mm."""

    def misfit(q: np.ndarray) -> np.ndarray:
        axis = np.array([q[2], q[3], 1.0]) / np.linalg.norm([q[2], q[3], 1.0])
        offset = cloud - [q[0], q[1], z]
        return np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=1) - q[4]

    results = least_squares(misfit, [0, 0, 0, 0, 57.0], x_scale=[1, 1, 0.01, 0.01, 1])
    return 2 * results.x[4], 2 * float(results.fun.std())


def diameter_bias(rig: Rig, true: dict[str, Camera], cameras: dict[str, CameraCalibration]) -> float:
    """Diameter of 114 mm seen exactly, triangulated by neighbours, minus 114. mm."""
    angle, z = (a.ravel() for a in np.meshgrid(np.arange(0, 2 * np.pi, np.pi / 60), np.linspace(15, 235, 12)))
    normals = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    xyz = 57 * normals + np.outer(z, [0, 0, 1])
    points = []
    for pair in pairs(rig):
        both = np.min([true[id_].incidence_cosine(xyz, normals) for id_ in pair], axis=0) > 0.5
        px = np.stack([true[id_].project(xyz[both]) for id_ in pair])
        points.append(triangulate([cameras[id_].camera for id_ in pair], px))
    return fitted_diameter(np.concatenate(points), 124.0)[0] - 114.0


def stage(
    rig: Rig, cameras: dict[str, CameraCalibration], moved: dict[str, DotObservations], patches: bool
) -> tuple[float, float]:
    """Length of the mean displacement of all dots, and RMS of the superimposed ones' distances. mm."""
    displacements, residuals = [], []
    for pair in pairs(rig):
        before, after = [cameras[id_] for id_ in pair], [moved[id_] for id_ in pair]
        lists = [c.dots for c in before] + after
        places = [
            {key: i for i, key in enumerate(zip(d.rows.tolist(), d.columns.tolist(), strict=True))} for d in lists
        ]
        common = sorted(set.intersection(*(set(place) for place in places)))
        chosen = [[place[key] for key in common] for place in places]
        lenses = [c.camera for c in before]
        X = triangulate(lenses, np.stack([c.dot_centres[i] for c, i in zip(before, chosen[:2], strict=True)]))
        px = np.stack([d.px[i] for d, i in zip(after, chosen[2:], strict=True)])
        if patches:
            names = [np.array(name) for name in zip(*common, strict=True)]
            px = px - np.stack([centroid_shift(each, rig.target, *names, translation=MOVED) for each in lenses])
        Y = triangulate(lenses, px)
        a, b = X - X.mean(axis=0), Y - Y.mean(axis=0)
        U, _, Vt = np.linalg.svd(a.T @ b)
        residuals.append(b - a @ U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt)
        displacements.append(Y - X)
    length = float(np.linalg.norm(np.concatenate(displacements).mean(axis=0)))
    return length, float(np.sqrt(np.mean(np.sum(np.concatenate(residuals) ** 2, axis=1))))


def test_the_rendered_ring_is_right_in_every_figure(folder, rig, ways, true_cameras, figures) -> None:
    moved = {
        camera.id: identify_dots(
            find_dots(grey(folder / "target_moved_5mm" / f"{camera.id}.jpg"), rig.target),
            rig.target,
            camera.azimuth_deg,
            camera=camera.id,
            intrinsics=ways.dlt[camera.id].camera.intrinsics,
        )
        for camera in rig.cameras
    }
    results = {}
    for name, cameras in (("dlt", ways.dlt), ("bundle", ways.bundle)):
        rms = np.sqrt(np.mean([control_points(cameras[a], cameras[b]).rms ** 2 for a, b in pairs(rig)]))
        bias = diameter_bias(rig, true_cameras, cameras)
        length, superimposed = stage(rig, cameras, moved, patches=name == "bundle")
        centre = max(np.linalg.norm(cameras[id_].camera.centre - true.centre) for id_, true in true_cameras.items())
        results[name] = (float(rms), bias, length, superimposed, float(centre))
        figures(f"rendered ring, {name}: control points, superimposed, mm", f"{rms:.4f}, {superimposed:.4f}", "0.01")
        figures(f"rendered ring, {name}: diameter bias, 5 mm, mm", f"{bias:+.4f}, {length:.4f}", "0.003, 5 ± 0.001")
    rms, bias, length, superimposed, centre = results["bundle"]
    assert rms < 0.006
    assert abs(bias) < 0.001
    assert length == pytest.approx(5.0, abs=0.001)
    assert superimposed < 0.008
    assert centre < 0.1
    rms, bias, length, superimposed, centre = results["dlt"]
    # The reconstruction error does not show the bias that the length and the diameter show.
    assert rms < 0.007
    assert superimposed < 0.008
    assert bias > 0.07
    assert 5.003 < length < 5.007


def test_the_real_pair_is_better_than_the_paper_s_way(shared_data, rig, figures) -> None:
    folder = shared_data / "multidic_rig"
    real = replace(
        rig,
        target=replace(rig.target, columns=14),
        cameras=(RigCamera("201", 61.0), RigCamera("202", 92.0)),
        pairs=(("201", "202"),),
    )
    start = {
        id_: calibrate_camera(
            real,
            id_,
            [grey(path) for path in sorted((folder / "checkerboard" / id_).glob("*.jpg"))],
            grey(folder / "calibration" / f"{id_}.jpg"),
        )
        for id_ in ("201", "202")
    }
    bundle, fit = bundle_adjustment(start, real.target)
    reference = np.load(folder / "reference.npz")
    speckles = np.stack([reference["points2d_201"][0], reference["points2d_202"][0]])
    results = {}
    for name, cameras in (("dlt", start), ("bundle", bundle)):
        both = [cameras["201"], cameras["202"]]
        own = [replace(each, held_out=None) for each in both]
        lenses = [each.camera for each in both]
        cloud = triangulate(lenses, speckles)
        across = float(np.sqrt(np.mean(reprojection_residuals(lenses, cloud, speckles)[..., 1] ** 2)))
        diameter, scatter = fitted_diameter(cloud, 124.0)
        results[name] = (
            control_points(*both).rms,
            control_points(*own).rms,
            across,
            diameter,
            scatter,
        )
        figures(
            f"real pair, {name}: control points held out, and not, mm",
            "{:.4f}, {:.4f}".format(*results[name]),
            "0.07",
        )
        figures(f"real pair, {name}: speckles off the epipolar line, px", f"{across:.3f}", "")
        figures(f"real pair, {name}: diameter, its STD, mm", f"{diameter:.3f}, {scatter:.3f}", "114 ± 0.05, 0.041")
    assert results["bundle"][0] < results["dlt"][0] < 0.07
    assert results["bundle"][1] < 0.02
    # Points that took no part in the calibration: another specimen in later images.
    assert results["bundle"][2] < 0.75 * results["dlt"][2]
    assert results["bundle"][3] == pytest.approx(114.0, abs=0.05)
    assert results["bundle"][4] < results["dlt"][4]
    assert 0.01 < fit.print_sigma < 0.05


@pytest.fixture
def session(folder, rig, tmp_path) -> Session:
    """Three neighbours of the rendered ring."""
    names = ("cam_12", "cam_01", "cam_02")
    some = replace(rig, cameras=tuple(rig.camera(name) for name in names), pairs=(names[:2], names[1:]))

    def capture(number: int, kind: str, images: dict[str, Path]) -> Capture:
        record = CaptureRecord(f"{number:04d}-{kind}", number, kind, "three", "closed")
        return Capture(record.capture_id, number, kind, tmp_path, images, record)

    boards = [
        capture(k + 1, "board", {name: folder / "limb" / "board" / name / f"{k:03d}.jpg" for name in names})
        for k in range(5)
    ]
    target = capture(6, "target", {name: folder / "limb" / "target" / f"{name}.jpg" for name in names})
    return Session(tmp_path, "three", some, (*boards, target))


def test_a_session_is_calibrated_as_its_settings_say_and_once(session, rig, ways) -> None:
    reports: list[tuple[float, str]] = []
    plain = calibrate_rig(session, CalibrationGroup(method="dlt"), lambda done, who: reports.append((done, who)))
    assert plain.bundle is None
    assert reports[-1] == (1.0, "camera cam_02")
    first = calibrate_rig(session, CalibrationGroup(method="bundle"), lambda done, who: reports.append((done, who)))
    assert reports[-1] == (1.0, "all cameras together")
    assert first.bundle is not None
    assert first.bundle.cameras == ("cam_12", "cam_01", "cam_02")
    stored = {path: path.stat().st_mtime_ns for path in (session.path / "calibration").iterdir()}
    assert sum(path.name.startswith("bundle-") for path in stored) == 1
    assert sum(path.name.startswith("survey-") for path in stored) == 1
    assert sum(path.name.startswith("contradictions-") for path in stored) >= 1
    assert len(stored) - sum(path.name.startswith("contradictions-") for path in stored) == 5  # one start for both
    again = calibrate_rig(session, CalibrationGroup(method="bundle"))
    assert {path: path.stat().st_mtime_ns for path in (session.path / "calibration").iterdir()} == stored
    assert again.bundle is not None
    assert again.bundle.to_dict() == first.bundle.to_dict()
    for id_, calibration in first.cameras.items():
        assert again.cameras[id_].to_dict() == calibration.to_dict()
        assert np.array_equal(plain.cameras[id_].camera.P, ways.dlt[id_].camera.P)
        assert not np.array_equal(calibration.camera.P, plain.cameras[id_].camera.P)
    loose = calibrate_rig(session, CalibrationGroup(method="bundle", print_error_mm=0.0, radius_error_mm=0.05))
    assert loose.bundle is not None
    assert loose.bundle.print_sigma == 0.0
    assert loose.bundle.sheet.radius == pytest.approx(57.0, abs=0.005)


def test_a_session_s_lenses_have_the_terms_that_its_settings_allow(session) -> None:
    ring = calibrate_rig(session, CalibrationGroup(radial_terms=2, skew=False, terms="criterion"))
    assert {row.lens_terms for row in ring.quality} <= {"2 radial terms, tangential", "2 radial terms"}
    assert all("information criterion" in row.lens_reason for row in ring.quality)
    assert all(each.camera.intrinsics.K[0, 1] == 0 for each in ring.cameras.values())
    assert all(each.views == tuple(f"{k:04d}-board" for k in range(1, 6)) for each in ring.cameras.values())
    assert [row.pair for row in ring.pairs] == [("cam_12", "cam_01"), ("cam_01", "cam_02")]
    assert all(row.rms < 0.03 for row in ring.pairs)
    assert any("the lens rests on 5 board views" in sentence for sentence in ring.advice)


def test_a_session_whose_cameras_are_exchanged_is_refused(session, folder) -> None:
    target = session.of_kind("target")[0]
    images = dict(target.images)
    images["cam_12"], images["cam_02"] = images["cam_02"], images["cam_12"]
    others = tuple(each for each in session.captures if each.kind != "target")
    wrong = replace(session, captures=(*others, replace(target, images=images)))
    with pytest.raises(InputError, match=r"cam_12 stands at azimuth 30°, where rig.toml has camera cam_02"):
        calibrate_rig(wrong, CalibrationGroup())


def test_a_session_whose_lenses_were_touched_is_told_so(session, folder) -> None:
    # The boards of one camera with those of another: lenses that differ by some pixels.
    boards = [
        replace(
            capture,
            images={**capture.images, "cam_01": folder / "limb" / "board" / "cam_05" / capture.images["cam_01"].name},
        )
        if capture.kind == "board"
        else capture
        for capture in session.captures
    ]
    ring = calibrate_rig(replace(session, captures=tuple(boards)), CalibrationGroup(method="bundle"))
    assert [finding.code for finding in ring.findings] == ["lens-contradicts-target"]
    assert ring.findings[0].cameras == ("cam_01",)
    assert "check that the board is flat" in ring.findings[0].sentence


def test_a_session_without_a_target_is_refused(session) -> None:
    bare = replace(session, captures=session.of_kind("board"))
    with pytest.raises(InputError, match="no capture of the calibration target"):
        calibrate_rig(bare, CalibrationGroup(method="bundle"))
