"""Choice of the terms of a lens, coverage of the image by the views, and systematic residuals."""

import cv2
import numpy as np
import pytest
from ringdic.calibration.coverage import coverage, residual_distortion
from ringdic.calibration.intrinsics import IntrinsicsFit, calibrate_intrinsics
from ringdic.calibration.lens_model import LensModel, independent_observations
from ringdic.geometry.camera import Intrinsics

SIZE = (1232, 1640)
BOARD = np.stack(np.meshgrid(np.arange(14) * 10.0, np.arange(19) * 10.0), axis=-1).reshape(-1, 2)
PLAIN = Intrinsics(np.array([[1303.5, 0, 624.0], [0, 1306.1, 811.0], [0, 0, 1]]), np.array([0.17, -0.2, 0, 0, 0]), SIZE)
RICH = Intrinsics(
    np.array([[1303.5, -0.8, 624.0], [0, 1306.1, 811.0], [0, 0, 1]]), np.array([0.17, -0.2, 4e-4, -3e-4, -0.3]), SIZE
)


def see(lens: Intrinsics, count: int, noise: float, seed: int, waves: float = 0.0) -> list[np.ndarray]:
    """Views of the board held about 350 mm away at all angles; waves : height of those of its surface, mm."""
    rng = np.random.default_rng(seed)
    flat = BOARD - BOARD.mean(axis=0)
    board = np.column_stack([flat, waves * np.sum(np.cos(2 * np.pi * flat / flat.max(axis=0)), axis=1)])
    views = []
    for _ in range(count):
        R, _ = cv2.Rodrigues(rng.uniform(-1, 1, 3) * [0.6, 0.6, 1.5])
        camera = board @ R.T + rng.uniform(-1, 1, 3) * [30, 50, 60] + [0, 0, 350]
        px = lens.distort_normalised(camera[:, :2] / camera[:, 2:]) @ lens.K[:2, :2].T + lens.K[:2, 2]
        views.append(px + noise * rng.normal(size=px.shape))
    return views


def fitted(lens: Intrinsics, seed: int, **options) -> IntrinsicsFit:
    return calibrate_intrinsics(see(lens, 9, 0.05, seed), BOARD, SIZE, **options)


def test_the_most_terms_that_are_determined_are_taken_unless_told_otherwise() -> None:
    fit = fitted(PLAIN, 1)
    assert fit.model == str(LensModel(3))
    assert fit.reason.startswith("the most terms")
    assert fitted(PLAIN, 1, radial=2).model == str(LensModel(2))
    assert fitted(PLAIN, 1, radial=2).reason == "as set"


def test_the_criterion_takes_the_terms_that_the_lens_has() -> None:
    rich = fitted(RICH, 2, fewest_terms=True)
    assert rich.model == str(LensModel(3))
    assert "information criterion" in rich.reason
    # Each of three needless terms lowers the misfit by chance beyond Akaike's price in 16 % of cases.
    plain = [fitted(PLAIN, seed, fewest_terms=True) for seed in range(6)]
    needless = sum(("3 radial" in fit.model) + ("tangential" in fit.model) + ("skew" in fit.model) for fit in plain)
    assert needless <= 8
    assert any(fit.model == "2 radial terms" for fit in plain)
    assert "tangential" not in fitted(RICH, 2, fewest_terms=True, tangential=False).model


def test_white_residuals_count_in_full_and_bent_ones_do_not() -> None:
    rng = np.random.default_rng(1)
    white = rng.normal(size=(10, len(BOARD), 2))
    assert independent_observations(white, BOARD) == pytest.approx(white.size, rel=0.1)
    waves = np.sin(BOARD[:, :1] / 30) + np.cos(BOARD[:, 1:] / 40)
    smooth = rng.normal(size=(10, 1, 2)) * waves
    assert independent_observations(smooth, BOARD) < 0.02 * white.size


def test_coverage_is_the_share_of_the_image_inside_the_outlines() -> None:
    quarter = np.array([[0, 0], [615.5, 0], [615.5, 819.5], [0, 819.5]])
    assert coverage(quarter[None], SIZE) == pytest.approx(0.25, abs=0.02)
    other_half = quarter + np.array([616, 0])
    assert coverage(np.stack([quarter, quarter]), SIZE) == coverage(quarter[None], SIZE)
    assert coverage(np.stack([quarter, other_half]), SIZE) == pytest.approx(0.5, abs=0.02)


def test_what_is_left_over_in_common_is_found_under_the_noise() -> None:
    rng = np.random.default_rng(3)
    px = rng.uniform(0, 1, (6000, 2)) * SIZE
    noise = rng.normal(0, 0.2, px.shape)
    assert residual_distortion(px, noise, SIZE) < 0.01
    field = 0.1 * np.sign(px - np.array(SIZE) / 2)  # 0.1 px in each direction, away from the middle
    assert residual_distortion(px, noise + field, SIZE) == pytest.approx(0.1 * np.sqrt(2), rel=0.15)
    assert np.isnan(residual_distortion(px[:5], noise[:5], SIZE))


def test_a_wavy_board_shows_in_the_residual_distortion() -> None:
    # A plain bend is followed (`test_intrinsics_fit`); waves are not.
    flat = calibrate_intrinsics(see(RICH, 9, 0.03, 5), BOARD, SIZE)
    wavy = calibrate_intrinsics(see(RICH, 9, 0.03, 5, waves=2.0), BOARD, SIZE)
    assert flat.residual_distortion < 0.02
    assert wavy.residual_distortion > 5 * flat.residual_distortion + 0.05


def test_other_models_are_refused() -> None:
    with pytest.raises(ValueError, match="2 or 3 radial terms"):
        LensModel(4)
