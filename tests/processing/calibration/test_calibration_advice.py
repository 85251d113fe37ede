"""Figures of cameras and pairs are true, and advice is given where it helps and nowhere else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ringdic.calibration.advice import camera_advice, pair_advice
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.intrinsics import calibrate_intrinsics
from ringdic.calibration.parameters import CameraParameters
from ringdic.calibration.quality import camera_quality, pair_quality
from ringdic.calibration.target import DotObservations, dot_points
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.session.rig import Target

TARGET = Target("dot-cylinder", 57.0, 20, 12.0, 10.0, 30, 12.0, 4.0)
SIZE = (1232, 1640)
LENS = Intrinsics(
    np.array([[1303.5, -0.8, 624.0], [0, 1306.1, 811.0], [0, 0, 1]]), np.array([0.17, -0.2, 4e-4, -3e-4, -0.1]), SIZE
)
BOARD = np.stack(np.meshgrid(np.arange(14) * 10.0, np.arange(19) * 10.0), axis=-1).reshape(-1, 2)


def views(count: int, seed: int, spread: float = 1.0) -> list[np.ndarray]:
    """Corners of the board in views all over the image; spread 0: always small and in the middle."""
    rng = np.random.default_rng(seed)
    board = np.column_stack([BOARD - BOARD.mean(axis=0), np.zeros(len(BOARD))])
    corners = []
    for k in range(count):
        R, _ = cv2.Rodrigues(rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.4])
        corner = spread * 55.0 * np.array([(-1) ** k, (-1) ** (k // 2)])
        camera = board @ R.T + [*corner, 360 + 350 * (1 - spread)]
        px = LENS.distort_normalised(camera[:, :2] / camera[:, 2:]) @ LENS.K[:2, :2].T + LENS.K[:2, 2]
        corners.append(px + rng.normal(0, 0.03, px.shape))
    return corners


def calibrated(name: str, azimuth_deg: float, corners: list[np.ndarray]) -> CameraCalibration:
    """A camera on the ring that measures the dots in front of it exactly."""
    a = np.deg2rad(azimuth_deg)
    centre = np.array([350 * np.cos(a), 350 * np.sin(a), 124.0])
    R = np.array([[-np.sin(a), np.cos(a), 0], [0, 0, -1], [-np.cos(a), -np.sin(a), 0]])
    camera = CameraParameters(np.array([1303.5, 1306.1, -0.8, 624.0, 811.0, *LENS.distortion]), R, -R @ centre).camera(
        Camera(name, np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]]), SIZE, LENS)
    )
    rows, columns = (axis.ravel() for axis in np.mgrid[1:21, 1:31])
    xyz = dot_points(TARGET, rows, columns)
    seen = camera.incidence_cosine(xyz, xyz * [1 / 57, 1 / 57, 0]) > 0.6
    px = camera.project(xyz[seen])
    dots = DotObservations(name, rows[seen], columns[seen], px, xyz[seen], azimuth_deg, float("inf"))
    fit = calibrate_intrinsics(corners, BOARD, SIZE)
    names = tuple(f"{k + 1:04d}-board" for k in range(len(corners)))
    return CameraCalibration(camera, dots, np.zeros((len(px), 2)), 0, fit, np.zeros((len(px), 2)), names)


@pytest.fixture(scope="module")
def good() -> CameraCalibration:
    return calibrated("203", 60.0, views(12, 1))


def advice(calibration: CameraCalibration, azimuth_deg: float = 60.0) -> str:
    return "\n".join(camera_advice(calibration, camera_quality(calibration, azimuth_deg)))


def test_a_good_calibration_needs_no_advice(good) -> None:
    assert advice(good) == ""
    row = camera_quality(good, 58.0)
    assert row.azimuth_deg == pytest.approx(60.0)
    assert row.azimuth_off_deg == pytest.approx(2.0)
    assert row.board_coverage is not None
    assert row.board_coverage > 0.5
    assert row.residual_distortion is not None
    assert row.residual_distortion < 0.02
    assert row.focal == pytest.approx((1303.5, 1306.1))


def test_the_lens_error_is_the_spread_of_repeated_lenses(good) -> None:
    # Places of the dots through lenses from other views of equal noise, the pose free to follow.
    assert good.fit is not None
    px, lens = good.dots.px, good.camera.intrinsics
    assert lens is not None
    off = []
    for seed in range(2, 14):
        other = calibrate_intrinsics(views(12, seed), BOARD, SIZE, drop_percentile=100).intrinsics
        ideal = (lens.to_undistorted(px) - lens.K[:2, 2]) / np.diag(lens.K)[:2]
        seen = (other.to_undistorted(px) - other.K[:2, 2]) / np.diag(other.K)[:2]
        x, y = ideal.T
        follow = np.concatenate(
            [
                np.stack([x * y, -(1 + x * x), y, x], axis=1),
                np.stack([1 + y * y, -x * y, -x, y], axis=1),
            ]
        )
        gap = (seen - ideal).T.ravel()
        gap = gap - follow @ np.linalg.lstsq(follow, gap, rcond=None)[0]
        off.append(2 * np.mean((1303 * gap) ** 2))
    stated = camera_quality(good).lens_error
    assert stated == pytest.approx(np.sqrt(np.mean(off)), rel=0.4)


def test_views_in_the_middle_alone_are_sent_to_the_corners() -> None:
    words = advice(calibrated("203", 60.0, views(6, 1, spread=0.0)))
    assert "camera 203: board views cover 5 % of the image" in words
    assert "take views nearer the corners" in words
    assert "the lens rests on 6 board views" in words


def test_a_bad_view_and_a_blank_one_are_named(good) -> None:
    corners = views(12, 1)
    corners[6] = corners[6] + np.random.default_rng(1).normal(0, 1.5, corners[6].shape)
    words = advice(replace(calibrated("203", 60.0, corners), blank=("0013-board",)))
    assert "board view 0007-board was left out, its corners are off by 2." in words
    assert "no board was found in 0013-board" in words


def test_a_wrong_azimuth_and_lost_dots_are_told(good) -> None:
    words = advice(replace(good, left_out=40), azimuth_deg=55.5)
    assert "camera 203: it stands at azimuth 60.0°, 4.5° from what rig.toml says" in words
    assert "40 of " in words
    assert "dots of the target are 2.8 px off" in advice(replace(good, residuals=good.residuals + 2.0))


def test_pairs_have_their_angle_and_their_errors(good) -> None:
    second = calibrated("204", 90.0, views(12, 2))
    error, row = pair_quality(good, second)
    assert row.pair == ("203", "204")
    assert row.points == error.points > 80
    # At the near side of the cylinder the angle is wider than the 30° at its axis.
    assert 32 < row.angle_deg < 38
    assert row.rms < 1e-6
    assert row.epipolar_rms < 1e-6
    assert pair_advice(row) == ()
    shifted = replace(second, dots=replace(second.dots, px=second.dots.px + np.array([0, 3.0])))
    _, off = pair_quality(good, shifted)
    assert off.epipolar_rms == pytest.approx(1.5, rel=0.02)  # each camera takes half
    words = "\n".join(pair_advice(replace(off, points=12, rms=0.4, angle_deg=75.0)))
    for part in ("pair 203-204: only 12 dots", "come back 0.40 mm off", "75° apart"):
        assert part in words
    with pytest.raises(ComputationError, match="203 and 210 have no dot of the target in common"):
        pair_quality(good, calibrated("210", 270.0, views(12, 3)))
