"""Intrinsics with skew: exact on exact data, with errors of the stated size, robust to bad views."""

import json

import cv2
import numpy as np
import pytest
from ringdic.calibration.intrinsics import (
    IntrinsicsFit,
    calibrate_intrinsics,
    read_intrinsics,
)
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Intrinsics
from ringdic.session.json_values import json_value

SIZE = (1232, 1640)
LENS = Intrinsics(
    np.array([[1303.5, -0.8, 624.0], [0, 1306.1, 811.0], [0, 0, 1]]),
    np.array([0.17, -0.2, 4e-4, -3e-4, -0.1]),
    SIZE,
)
BOARD = np.stack(np.meshgrid(np.arange(14) * 10.0, np.arange(19) * 10.0), axis=-1).reshape(-1, 2)


def values(lens: Intrinsics) -> np.ndarray:
    """fx fy s cx cy k1 k2 p1 p2 k3."""
    return np.array([lens.K[0, 0], lens.K[1, 1], lens.K[0, 1], lens.K[0, 2], lens.K[1, 2], *lens.distortion])


def see(
    count: int,
    noise: float,
    seed: int,
    part: float = 1.0,
    heights: np.ndarray | float = 0.0,
    stretch: float = 0.0,
    turn: float = 1.5,
) -> list[np.ndarray]:
    """Views of the board held about 350 mm away at all angles, through ``LENS``; ``part``: a smaller board.

    heights : of the board's corners over its plane, mm. stretch : of its squares along, as a part. turn : rad, largest
    rotation within its plane.
    """
    rng = np.random.default_rng(seed)
    flat = part * (BOARD - BOARD.mean(axis=0)) * [1, 1 + stretch]
    board = np.column_stack([flat, heights * np.ones(len(BOARD))])
    views = []
    for _ in range(count):
        R, _ = cv2.Rodrigues(rng.uniform(-1, 1, 3) * [0.6, 0.6, turn])
        camera = board @ R.T + rng.uniform(-1, 1, 3) * part * [30, 50, 60] + [0, 0, 350]
        distorted = LENS.distort_normalised(camera[:, :2] / camera[:, 2:])
        px = distorted @ LENS.K[:2, :2].T + LENS.K[:2, 2]
        views.append(px + rng.normal(0, noise, px.shape))
    return views


def test_a_perfect_world_gives_the_lens_back():
    fit = calibrate_intrinsics(see(6, 0.0, 1), BOARD, SIZE)
    assert np.allclose(values(fit.intrinsics), values(LENS), rtol=1e-6, atol=1e-6)
    assert fit.rms < 1e-8
    assert fit.inliers.all()


def bent(amount: float, across: float, along: float, twist: float) -> np.ndarray:
    """Heights of the corners of a bent board, of which the highest and the lowest differ by ``amount`` mm."""
    x, y = ((BOARD - BOARD.mean(axis=0)) / 90).T
    heights = across * x * x + along * y * y + twist * x * y
    return amount * heights / np.ptp(heights)


@pytest.mark.parametrize("amount", [0.1, 0.5])
@pytest.mark.parametrize("shape", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -1, 0.5)])
def test_a_bent_board_is_measured_and_leaves_the_lens_alone(shape, amount):
    fit = calibrate_intrinsics(see(8, 0.03, 1, heights=bent(amount, *shape)), BOARD, SIZE)
    assert fit.bend == pytest.approx(amount, abs=max(6 * fit.bend_sigma, 0.01 * amount))
    assert fit.bend_sigma < 0.01
    assert np.abs((values(fit.intrinsics) - values(LENS)) / fit.sigma).max() < 4.5
    # Taken for flat, such a board gives a focal length that is wrong by a part of a thousandth for 0.1 mm.
    assert fit.sigma[0] < 5e-4 * fit.intrinsics.K[0, 0]


@pytest.mark.parametrize("turn", [0.1, 1.5])  # always upright, and turned in all directions
@pytest.mark.parametrize("stretch", [0.002, -0.01])
def test_squares_that_are_not_square_are_measured_and_leave_the_lens_alone(stretch, turn):
    fit = calibrate_intrinsics(see(8, 0.03, 2, stretch=stretch, turn=turn), BOARD, SIZE)
    assert fit.stretch == pytest.approx(stretch, abs=2e-4)
    assert fit.bend == 0
    assert np.abs((values(fit.intrinsics) - values(LENS)) / fit.sigma).max() < 4.5


def test_a_flat_board_shows_neither_bend_nor_stretch():
    # Of forty sets of views they are certain in none: χ² of three numbers exceeds 50 in one of 10¹⁰.
    fits = [calibrate_intrinsics(see(3 + seed % 8, 0.05, seed), BOARD, SIZE) for seed in range(40)]
    assert not any(fit.bend or fit.stretch for fit in fits)
    assert np.median([fit.distance for fit in fits]) == pytest.approx(350, abs=10)


def test_a_board_that_flexes_differently_in_each_view_is_not_taken_for_sure():
    rng = np.random.default_rng(4)
    views = [see(1, 0.03, seed, heights=bent(0.3 * rng.normal(), *rng.normal(size=3)))[0] for seed in range(10)]
    fit = calibrate_intrinsics(views, BOARD, SIZE)
    # Its residuals are not independent, and the lens is less sure than they seem to say.
    assert fit.redundancy_factor > 5
    sigma = fit.sigma * np.sqrt(fit.redundancy_factor)
    assert np.abs((values(fit.intrinsics) - values(LENS)) / sigma).max() < 4.5


def test_standard_errors_tell_the_scatter_of_repeated_calibrations():
    noise = 0.05
    fits = [calibrate_intrinsics(see(8, noise, seed), BOARD, SIZE) for seed in range(20)]
    pulls = np.array([(values(fit.intrinsics) - values(LENS)) / fit.sigma for fit in fits])
    # 200 correlated pulls of unit normal distribution.
    assert 0.75 < np.sqrt(np.mean(pulls**2)) < 1.25
    assert np.abs(pulls).max() < 4.5
    # RMS distance: two components.
    assert np.mean([fit.rms for fit in fits]) == pytest.approx(noise * np.sqrt(2), rel=0.03)


def test_held_parameters_stay_and_have_no_uncertainty():
    fit = calibrate_intrinsics(see(5, 0.03, 3), BOARD, SIZE, radial=2, tangential=False, skew=False)
    held = [2, 7, 8, 9]
    assert np.array_equal(values(fit.intrinsics)[held], np.zeros(4))
    assert np.array_equal(fit.sigma[held], np.zeros(4))
    assert (np.delete(fit.sigma, held) > 0).all()


def test_a_third_radial_term_is_left_out_where_the_views_cannot_tell_it():
    fit = calibrate_intrinsics(see(5, 0.05, 2, part=0.4), 0.4 * BOARD, SIZE)
    assert fit.intrinsics.distortion[4] == 0.0
    assert fit.sigma[9] == 0.0


def test_bad_views_are_dropped_and_named_by_their_error():
    views = see(12, 0.03, 4)
    rng = np.random.default_rng(5)
    views[3] = views[3] + rng.normal(0, 2.0, views[3].shape)
    fit = calibrate_intrinsics(views, BOARD, SIZE, drop_percentile=100)
    assert np.flatnonzero(~fit.inliers).tolist() == [3]
    assert fit.view_errors[3] == pytest.approx(2 * np.sqrt(2), rel=0.1)
    assert np.delete(fit.view_errors, 3).max() < 0.06
    assert (np.abs(values(fit.intrinsics) - values(LENS)) < 5 * fit.sigma).all()


def test_views_above_the_percentile_are_dropped_only_where_enough_are_left():
    assert calibrate_intrinsics(see(15, 0.05, 6), BOARD, SIZE, drop_percentile=80).inliers.sum() == 12
    assert calibrate_intrinsics(see(5, 0.05, 6), BOARD, SIZE, drop_percentile=80).inliers.all()


def test_too_few_views_are_refused():
    with pytest.raises(ComputationError, match="2 images; intrinsics need at least 3"):
        calibrate_intrinsics(see(2, 0.0, 1), BOARD, SIZE)


@pytest.mark.parametrize("camera", ["201", "202"])
def test_matlabs_corners_give_matlabs_lens(shared_data, camera):
    reference = np.load(shared_data / "multidic_rig" / "reference.npz")
    views = [view for view in reference[f"checkerboard_corners_{camera}"] if np.isfinite(view).all()]
    fit = calibrate_intrinsics(views, reference["checkerboard_board_xy_mm"], (2464, 3280), radial=3)
    difference = values(fit.intrinsics) - values(
        Intrinsics(reference[f"K_{camera}"], reference[f"dist_{camera}"], (2464, 3280))
    )
    # Half of MATLAB's views, and errors that a print and a bending board add: several standard errors.
    limit = np.array([10, 10, 0.8, 8, 8, 0.02, 0.2, 2e-3, 5e-4, 0.6])
    assert (np.abs(difference) < limit).all()
    assert fit.rms < 0.5


def test_the_fit_and_the_file_survive_json(tmp_path):
    fit = calibrate_intrinsics(see(4, 0.05, 1), BOARD, SIZE)
    again = IntrinsicsFit.from_dict(json.loads(json.dumps(fit.to_dict())))
    assert again.to_dict() == fit.to_dict()
    assert "inliers" not in fit.to_dict()  # stored once, as "kept"
    path = tmp_path / "lens.json"
    path.write_text(json.dumps(json_value(LENS)))
    assert np.array_equal(values(read_intrinsics(path)), values(LENS))
    path.write_text('{"K": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}')
    with pytest.raises(InputError, match=r"lens\.json: not usable as intrinsics"):
        read_intrinsics(path)
    with pytest.raises(InputError, match=r"absent\.json: no such file"):
        read_intrinsics(tmp_path / "absent.json")
