"""Checkerboard corners against true corners of rendered boards and against MATLAB's on the real rig."""

from pathlib import Path

import cv2
import numpy as np
from ringdic.calibration.board import board_points, count_squares, find_corners
from ringdic.session.rig import Board

BOARD = Board("checkerboard", (15, 20), 10.0)


def grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


def nearest(corners: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Offsets of corners from the nearest true ones; the choice must be one-to-one."""
    distance = np.linalg.norm(corners[:, None] - wanted[None], axis=-1)
    choice = distance.argmin(axis=1)
    assert len(set(choice.tolist())) == len(wanted)
    return corners - wanted[choice]


def test_board_points_lie_on_the_board_in_the_order_of_the_corners(shared_data):
    points = board_points(BOARD)
    assert points.shape == (266, 2)
    assert np.array_equal(points.max(axis=0), [130.0, 180.0])
    corners = find_corners(grey(shared_data / "rendered_ring/limb/board/cam_05/001.jpg"), BOARD.inner_corners)
    H, _ = cv2.findHomography(points, corners)
    mapped = cv2.perspectiveTransform(points[:, None], H)[:, 0]
    side = np.linalg.norm(corners[1] - corners[0])
    # A wrong order would displace corners by whole squares; the lens displaces them by a part of one.
    assert np.linalg.norm(mapped - corners, axis=1).max() < 0.4 * side


def test_corners_of_rendered_boards_are_true_to_three_hundredths_of_a_pixel(shared_data):
    truth = np.load(shared_data / "rendered_ring/limb/board_truth.npz")
    for camera, view in (("cam_01", 0), ("cam_04", 2), ("cam_09", 4)):
        corners = find_corners(
            grey(shared_data / f"rendered_ring/limb/board/{camera}/{view:03d}.jpg"), BOARD.inner_corners
        )
        error = nearest(corners, truth[f"corners_{camera}"][view].astype(float))
        assert np.abs(error.mean(axis=0)).max() < 0.01
        assert np.sqrt(np.mean(error**2)) < 0.04
        assert np.abs(error).max() < 0.15


def test_corners_of_a_reduced_image_lie_where_the_reduction_puts_them(shared_data):
    truth = np.load(shared_data / "rendered_ring/limb/board_truth.npz")["corners_cam_04"][2].astype(float)
    image = grey(shared_data / "rendered_ring/limb/board/cam_04/002.jpg")
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    corners = find_corners(half, BOARD.inner_corners)
    error = nearest(corners, (truth + 0.5) / 2 - 0.5)
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.sqrt(np.mean(error**2)) < 0.08


def test_number_format_does_not_move_corners(shared_data):
    image = grey(shared_data / "rendered_ring/limb/board/cam_02/001.jpg")
    as_bytes = find_corners(image, BOARD.inner_corners)
    assert np.array_equal(as_bytes, find_corners(image.astype(np.uint16) * 257, BOARD.inner_corners))
    assert np.array_equal(as_bytes, find_corners(image.astype(float), BOARD.inner_corners))


def test_corners_on_handheld_boards_agree_with_matlab(shared_data):
    folder = shared_data / "multidic_rig"
    with np.load(folder / "reference.npz") as reference:
        names = reference["checkerboard_names_201"].tolist()
        wanted = reference["checkerboard_corners_201"]
    for name in ("201_18.jpg", "201_35.jpg"):
        corners = find_corners(grey(folder / "checkerboard" / "201" / name), BOARD.inner_corners)
        distance = np.linalg.norm(nearest(corners, wanted[names.index(name)]), axis=1)
        # The medians of two detectors on a real print differ by a tenth of a pixel.
        assert np.median(distance) < 0.15
        assert distance.max() < 0.7


def test_an_image_without_the_whole_board_has_no_corners(shared_data):
    image = grey(shared_data / "rendered_ring/limb/board/cam_02/001.jpg")
    assert find_corners(np.full((400, 300), 90, np.uint8), BOARD.inner_corners) is None
    assert find_corners(image, (12, 19)) is None
    x, _ = np.rint(find_corners(image, BOARD.inner_corners).mean(axis=0)).astype(int)
    assert find_corners(np.ascontiguousarray(image[:, x:]), BOARD.inner_corners) is None


def test_a_board_of_another_number_of_squares_is_counted(shared_data):
    image = grey(shared_data / "rendered_ring/limb/board/cam_05/001.jpg")
    for said in ((14, 20), (15, 19), (16, 21), (14, 19)):
        assert count_squares(image, Board("checkerboard", said, 10.0)) == (15, 20)
    assert count_squares(np.full((400, 300), 128, np.uint8), BOARD) is None
