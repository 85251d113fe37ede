"""A calibration that contradicts itself is named with the amount by which it does, and a calm one says nothing.

Cameras, boards and targets are made of numbers (`ring_of_numbers`); what the rig file says is then wrong by a known
amount, or the lens that sees the target is another one than the boards'.
"""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from ring_of_numbers import BOARD, NAMES, SIZE, TARGET, camera_on_the_ring, lens_from_boards, observed, pose
from ringdic.calibration import dlt
from ringdic.calibration.bundle import bundle_adjustment
from ringdic.calibration.calibrated_rig import calibrate_rig
from ringdic.calibration.camera_calibration import CameraCalibration, calibrate_camera
from ringdic.calibration.contradictions import ExpectedErrors, contradictions
from ringdic.calibration.intrinsics import calibrate_intrinsics
from ringdic.calibration.target import dot_points
from ringdic.calibration.target_measures import target_measures
from ringdic.findings import CODES, Finding, Verdict
from ringdic.geometry.camera import Camera
from ringdic.session.folder import open_session
from ringdic.session.images import read_gray
from ringdic.session.importing import import_images
from ringdic.session.rig import RigCamera, Target, read_rig
from ringdic.settings import CalibrationGroup

Session = dict[str, CameraCalibration]


@cache
def true_camera(name: str) -> Camera:
    return camera_on_the_ring(name, 30.0 * NAMES.index(name), np.random.default_rng(NAMES.index(name)))


@cache
def boards(name: str):
    return lens_from_boards(true_camera(name).intrinsics, 0.03, np.random.default_rng(50 + NAMES.index(name)))


def refocused(camera: Camera, factor: float) -> Camera:
    """The camera with its focal lengths multiplied."""
    (R, t), K = pose(camera), camera.intrinsics.K.copy()
    K[:2, :2] *= factor
    lens = replace(camera.intrinsics, K=K)
    P = lens.K_undistorted @ np.column_stack([R, t])
    return replace(camera, P=P / P[2, 3], intrinsics=lens)


def session(
    count: int,
    seed: int,
    true: Target = TARGET,
    *,
    stated: Target = TARGET,
    print_error: float = 0.0,
    noise: float = 0.01,
    focus: dict[str, float] | None = None,
) -> Session:
    """Cameras that see the true target, each calibrated alone, as if it had the stated measures."""
    rng = np.random.default_rng(seed)
    errors = print_error * rng.normal(size=(true.rows, true.columns, 2))
    result = {}
    for name in NAMES[:count]:
        camera = refocused(true_camera(name), (focus or {}).get(name, 1.0))
        each = observed(camera, camera.intrinsics, boards(name), noise, rng, target=true, print_errors=errors)
        xyz, lens = dot_points(stated, each.dots.rows, each.dots.columns), boards(name).intrinsics
        P = dlt.to_projection(dlt.solve_dlt(xyz, lens.to_undistorted(each.dots.px)))
        result[name] = replace(each, camera=Camera(name, P, SIZE, lens), dots=replace(each.dots, xyz=xyz))
    return result


def only(findings: tuple[Finding, ...]) -> Finding:
    assert len(findings) == 1, [each.sentence for each in findings]
    return findings[0]


WRONG = {
    "rows 0.5 % too far apart": ({"row_spacing_mm": 12.06}, "rows", 0.005, "row_spacing_mm 12.06"),
    "rows 0.5 % too close": ({"row_spacing_mm": 11.94}, "rows", -0.005, "row_spacing_mm 11.94"),
    "radius 0.5 % larger": ({"radius_mm": 57.285}, "radius", 0.005, "radius_mm 57.28"),
    "print 0.5 % larger": (
        {"row_spacing_mm": 12.06, "column_spacing_mm": 12.06},
        "radius",
        1 / 1.005 - 1,
        "printed 0.50 % too large",
    ),
    "columns 0.5 % wider": ({"column_spacing_mm": 12.06}, "columns", 0.005, "column_spacing_mm 12.06"),
    "columns 1 % narrower": ({"column_spacing_mm": 11.88}, "columns", -0.01, "column_spacing_mm 11.88"),
    "radius 58 for 57": ({"radius_mm": 58.0}, "radius", 1 / 57, "radius_mm 58.00"),
}


@pytest.mark.parametrize("print_error", [0.0, 0.03])
@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_measure_is_named_with_its_amount(case, print_error) -> None:
    measures, wrong, off, words = WRONG[case]
    calibrations = session(3, 1, replace(TARGET, **measures), print_error=print_error)
    result = target_measures(calibrations, TARGET)
    assert result.wrong == wrong
    # Twice the smallest print errors' shift of a mean is allowed beside four standard errors.
    assert result.off == pytest.approx(off, abs=4 * result.sigma + 5e-5)
    assert result.sigma < 0.001
    finding = only(contradictions(calibrations, TARGET))
    assert finding.code == "target-measures"
    assert finding.verdict is Verdict.DO_NOT_USE
    assert finding.value == pytest.approx(100 * result.off)
    assert abs(finding.value) > finding.limit
    if not print_error:
        assert words in finding.sentence


def test_two_wrong_measures_are_both_told() -> None:
    true = replace(TARGET, radius_mm=57.5, column_spacing_mm=11.9)
    result = target_measures(session(3, 2, true), TARGET)
    assert result.wrong == "radius and columns"
    assert result.sheet.radius == pytest.approx(57.5, abs=0.01)
    assert result.sheet.pitch == pytest.approx(11.9, abs=0.002)


def test_stated_errors_of_the_measures_are_true() -> None:
    true = replace(TARGET, column_spacing_mm=12.06)
    results = [target_measures(session(3, seed, true, print_error=0.03), TARGET) for seed in range(12)]
    pulls = np.array([(each.off - 0.005) / each.sigma for each in results])
    # Of twelve draws; neighbours see the same print errors, for which the errors are enlarged.
    assert 0.3 < np.sqrt(np.mean(pulls**2)) < 1.6


def test_a_target_larger_as_a_whole_cannot_be_told() -> None:
    # Every measure and every distance 0.5 % larger gives the same images, and so does not contradict anything.
    larger = replace(
        TARGET, radius_mm=57.285, row_spacing_mm=12.06, first_row_z_mm=10.05, column_spacing_mm=12.06, dot_size_mm=4.02
    )
    calibrations = session(3, 3, larger)
    assert contradictions(calibrations, TARGET) == ()
    # The cameras come out at other distances, as nothing tells the scale of the world.
    distances = [np.linalg.norm(each["c01"].camera.centre[:2]) for each in (calibrations, session(3, 3))]
    assert distances[0] < distances[1] - 1.0


@pytest.mark.parametrize("unit", [10.0, 25.4])
def test_measures_in_other_units_are_named_by_the_distance_of_the_boards(unit) -> None:
    measures = ("radius_mm", "row_spacing_mm", "first_row_z_mm", "column_spacing_mm", "dot_size_mm")
    stated = replace(TARGET, **{name: getattr(TARGET, name) / unit for name in measures})
    finding = only(contradictions(session(2, 13, stated=stated), stated))
    assert finding.code == "world-scale"
    # The boards are held at 320 mm, the cameras stand 293 mm from the target.
    assert finding.value == pytest.approx(unit * 320 / 293, rel=0.06)


def test_a_target_scaled_as_a_whole_is_named_where_the_distance_was_measured() -> None:
    calibrations = session(2, 14)
    assert contradictions(calibrations, TARGET, distances={"c01": 350.0, "c02": 360.0}) == ()
    finding = only(contradictions(calibrations, TARGET, distances={"c01": 350.0, "c02": 250.0}))
    assert finding.code == "world-scale"
    assert finding.cameras == ("c02",)
    assert finding.value == pytest.approx(350 / 250, rel=0.03)


def test_what_the_rig_file_states_to_be_unsure_is_no_contradiction() -> None:
    calibrations = session(3, 1, replace(TARGET, radius_mm=57.285))
    assert only(contradictions(calibrations, TARGET)).code == "target-measures"
    assert contradictions(calibrations, TARGET, ExpectedErrors(radius=0.2)) == ()


@pytest.mark.parametrize(("factor", "print_error"), [(1.002, 0.0), (0.998, 0.0), (1.01, 0.0), (1.01, 0.02)])
def test_a_refocused_lens_is_named(factor, print_error) -> None:
    calibrations = session(3, 4, print_error=print_error, focus={"c02": factor})
    finding = only(contradictions(calibrations, TARGET))
    assert finding.code == "camera-refocused"
    assert finding.cameras == ("c02",)
    assert finding.value == pytest.approx(100 * (factor - 1), abs=0.02 if print_error == 0 else 0.4)
    assert f"c02: focal length {finding.value:+.2f} %" in finding.sentence


def test_lenses_all_refocused_are_not_taken_for_a_wrong_target() -> None:
    finding = only(contradictions(session(3, 4, focus=dict.fromkeys(NAMES, 1.01)), TARGET))
    assert finding.code == "camera-refocused"
    assert finding.cameras == ("c01", "c02", "c03")


def test_a_wrong_target_and_a_refocused_lens_are_both_named() -> None:
    true = replace(TARGET, row_spacing_mm=12.06)
    findings = contradictions(session(4, 5, true, focus={"c03": 1.01}), TARGET)
    assert {each.code: each.cameras for each in findings if each.code != "target-measures"} == {
        "camera-refocused": ("c03",)
    }
    assert 0.45 < findings[0].value < 0.55


def with_board_of(each: CameraCalibration, other: CameraCalibration) -> CameraCalibration:
    return replace(each, fit=other.fit, camera=replace(each.camera, intrinsics=other.camera.intrinsics))


def test_exchanged_boards_are_named() -> None:
    calibrations = session(3, 6)
    first, second = calibrations["c01"], calibrations["c02"]
    exchanged = {**calibrations, "c01": with_board_of(first, second), "c02": with_board_of(second, first)}
    finding = only(contradictions(exchanged, TARGET))
    assert finding.code == "wrong-board"
    assert finding.cameras == ("c01", "c02")
    assert "that of the boards of camera c02 fits c01" in finding.sentence


@pytest.mark.parametrize(("flip", "words"), [(0, "left to right"), (1, "top to bottom"), (None, "turned by 180°")])
def test_boards_that_are_turned_over_are_named(flip, words) -> None:
    calibrations = session(3, 7)
    rng = np.random.default_rng(8)
    lens = true_camera("c02").intrinsics
    board = np.column_stack([BOARD - BOARD.mean(axis=0), np.zeros(len(BOARD))])
    views = []
    for _ in range(10):
        R = cv2.Rodrigues(rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.3])[0]
        points = board @ R.T + rng.uniform(-1, 1, 3) * [20, 30, 40] + [0, 0, 320]
        px = lens.distort_normalised(points[:, :2] / points[:, 2:]) @ lens.K[:2, :2].T + lens.K[:2, 2]
        for axis in (0, 1) if flip is None else (flip,):
            px[:, axis] = SIZE[axis] - 1 - px[:, axis]
        views.append(px + 0.03 * rng.normal(size=px.shape))
    fit = calibrate_intrinsics(views, BOARD, SIZE, radial=3, drop_percentile=100)
    each = calibrations["c02"]
    calibrations["c02"] = replace(each, fit=fit, camera=replace(each.camera, intrinsics=fit.intrinsics))
    finding = only(contradictions(calibrations, TARGET))
    assert finding.code == "images-mirrored"
    assert finding.cameras == ("c02",)
    assert words in finding.sentence


def test_a_bent_board_is_named_and_does_not_contradict() -> None:
    calibrations = session(3, 11)
    x = (BOARD - BOARD.mean(axis=0))[:, 0]
    heights = 0.4 * (x * x - np.min(x * x)) / np.ptp(x * x)
    fit = lens_from_boards(true_camera("c03").intrinsics, 0.03, np.random.default_rng(12), heights)
    each = calibrations["c03"]
    calibrations["c03"] = replace(each, fit=fit, camera=replace(each.camera, intrinsics=fit.intrinsics))
    finding = only(contradictions(calibrations, TARGET))
    assert finding.code == "board-not-flat"
    assert finding.verdict is Verdict.LOOK
    assert finding.cameras == ("c03",)
    assert finding.value == pytest.approx(0.4, abs=0.01)


def test_a_stretched_board_is_named_and_not_taken_for_a_wrong_target() -> None:
    calibrations = session(3, 11)
    rng = np.random.default_rng(13)
    for name, each in calibrations.items():
        fit = lens_from_boards(true_camera(name).intrinsics, 0.03, rng, stretch=0.005)
        calibrations[name] = replace(each, fit=fit, camera=replace(each.camera, intrinsics=fit.intrinsics))
    finding = only(contradictions(calibrations, TARGET))
    assert finding.code == "board-not-square"
    assert finding.cameras == ("c01", "c02", "c03")
    assert finding.value == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(("print_error", "code"), [(0.15, "print-errors"), (0.4, "print-errors-large")])
def test_a_bad_print_is_told_by_its_size(print_error, code) -> None:
    finding = only(contradictions(session(2, 9, print_error=print_error), TARGET))
    assert finding.code == code
    assert finding.value == pytest.approx(print_error, rel=0.15)
    assert CODES["print-errors"][0] is Verdict.LOOK
    assert CODES["print-errors-large"][0] is Verdict.DO_NOT_USE


def test_a_lens_from_a_file_and_a_camera_without_are_judged_too() -> None:
    filed = {name: replace(each, fit=None) for name, each in session(3, 10, focus={"c02": 1.01}).items()}
    finding = only(contradictions(filed, TARGET))
    assert finding.code == "camera-refocused"
    assert "than the intrinsics" in finding.sentence

    def bare(calibrations: Session) -> Session:
        return {
            name: replace(each, fit=None, camera=replace(each.camera, intrinsics=None))
            for name, each in calibrations.items()
        }

    assert contradictions(bare(session(3, 10)), TARGET) == ()
    # Pixels are square, so a camera without a lens sees rows 4 % too far apart.
    finding = only(contradictions(bare(session(3, 10, replace(TARGET, row_spacing_mm=12.5))), TARGET))
    assert finding.code == "target-measures"


@pytest.mark.parametrize("seed", range(12))
def test_a_calm_rig_says_nothing(seed) -> None:
    """Prints of several qualities, few boards, half a target: all within what the standard errors allow."""
    rng = np.random.default_rng(900 + seed)
    calibrations = session(
        (2, 3, 4)[seed % 3], 300 + seed, print_error=(0.0, 0.01, 0.03, 0.05)[seed % 4], noise=(0.005, 0.03)[seed % 2]
    )
    for name, each in calibrations.items():
        fit = lens_from_boards(true_camera(name).intrinsics, 0.05, rng)
        kept = each.dots.rows <= (20, 11)[seed // 6]
        calibrations[name] = replace(
            each,
            fit=fit,
            camera=replace(each.camera, intrinsics=fit.intrinsics),
            dots=each.dots.subset(kept),
            residuals=each.residuals[kept],
            centroid_shift=each.centroid_shift[kept],
        )
    assert contradictions(calibrations, TARGET) == ()
    result = target_measures(calibrations, TARGET)
    for each in result.evidence:
        # χ² of ten: below 46 but for one in 10⁶.
        assert each.distance(result.change) < 46
        off, sigma = each.focal_gap(result.change)
        assert abs(off) < 4.9 * sigma


def test_the_bundle_absorbs_what_is_named() -> None:
    # Why the finding is needed: a scaled print becomes print errors, and the bundle's own residuals stay small.
    calibrations = session(3, 1, replace(TARGET, row_spacing_mm=12.06, column_spacing_mm=12.06))
    _, fit = bundle_adjustment(calibrations, TARGET)
    assert fit.print_sigma > 0.1
    assert fit.px_sigma < 0.05
    assert only(contradictions(calibrations, TARGET)).code == "target-measures"


CASES = {"rig_r58.toml": ("radius_mm 57.0", 57 / 58 - 1), "rig_row13.toml": ("row_spacing_mm 12.0", 12 / 13 - 1)}


@pytest.mark.shared
@pytest.mark.parametrize("method", ["dlt", "bundle"])
@pytest.mark.parametrize("rig_file", [None, *CASES])
def test_wrong_measures_of_rendered_images_are_named(shared_cases, tmp_path, rig_file, method) -> None:
    source = tmp_path / "in"
    source.mkdir()
    for part in ("board", "target", "specimen"):
        (source / part).symlink_to(shared_cases / "target_measures_wrong" / "in" / part)
    rig = "in/rig.toml" if rig_file is None else rig_file
    (source / "rig.toml").write_text((shared_cases / "target_measures_wrong" / rig).read_text())
    calibrated = calibrate_rig(
        open_session(import_images(source, tmp_path / "session")), CalibrationGroup(method=method)
    )
    if rig_file is None:
        assert calibrated.findings == ()
        return
    words, off = CASES[rig_file]
    finding = only(calibrated.findings)
    assert finding.code == "target-measures"
    assert words in finding.sentence
    assert finding.value == pytest.approx(100 * off, abs=0.03)


@pytest.mark.shared
def test_the_lens_of_a_bent_board_of_the_real_pair_is_no_contradiction(shared_data) -> None:
    folder = shared_data / "multidic_rig"
    rig = read_rig(shared_data / "rendered_ring" / "limb" / "rig.toml")
    rig = replace(
        rig,
        target=replace(rig.target, columns=14),
        cameras=(RigCamera("201", 61.0), RigCamera("202", 92.0)),
        pairs=(("201", "202"),),
    )
    calibrations = {
        name: calibrate_camera(
            rig,
            name,
            [read_gray(path) for path in sorted((folder / "checkerboard" / name).glob("*.jpg"))],
            read_gray(folder / "calibration" / f"{name}.jpg"),
        )
        for name in ("201", "202")
    }
    assert contradictions(calibrations, rig.target) == ()
