"""Sheets are true to scale on paper, and what is printed is found by the detectors that will see it."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest
from numpy.typing import NDArray
from ringdic.calibration.board import board_points, find_corners
from ringdic.calibration.dots import find_dots
from ringdic.calibration.target import dot_points, identify_dots
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera
from ringdic.prints.patterns import board_sheet, charuco_sheet, dot_sheet, speckle_sheet
from ringdic.prints.sheet import MARGIN, Sheet, write_sheet
from ringdic.session.rig import Board, Target

MM = 25.4 / 72  # a point of the PDF
TARGET = Target("dot-cylinder", 30.0, 8, 11.0, 12.0, 9, 12.5, 4.0)
BOARD = Board("checkerboard", (7, 10), 9.0)


def printed(sheet: Sheet, folder: Path, px_per_mm: float) -> NDArray[np.uint8]:
    """The page as a printer makes it: grey image whose pixel (0, 0) is the page's upper left corner."""
    write_sheet(sheet, folder / "sheet.pdf")
    document = pypdfium2.PdfDocument(folder / "sheet.pdf")
    assert len(document) == 1
    assert np.array(document[0].get_size()) * MM == pytest.approx(sheet.page, abs=0.001)
    # The renderer counts pixels upwards and then fits the page to them.
    image = document[0].render(scale=px_per_mm * MM * (1 - 1e-6), grayscale=True).to_numpy()
    document.close()
    return np.ascontiguousarray(image.reshape(image.shape[:2]))


def on_sheet(px: NDArray[np.float64], sheet: Sheet, px_per_mm: float) -> NDArray[np.float64]:
    """Positions in mm from the lower left corner of the pattern, from px of the rendered page."""
    x, y = (px + 0.5).T / px_per_mm
    return np.column_stack([x - MARGIN, sheet.page[1] - MARGIN - y])


def true_to(places: NDArray[np.float64], truth: NDArray[np.float64], px_per_mm: float) -> float:
    """Error of the lengths between places (n, 2) mm over the whole sheet, mm; every one lies within a pixel of truth.

    The renderer sets each edge on whole pixels: single places are good to a pixel, a fit through all of them is not
    touched by it.
    """
    assert np.abs(places - truth).max() < 1.0 / px_per_mm
    slopes = [np.polyfit(truth[:, axis], places[:, axis], 1)[0] for axis in (0, 1)]
    return float(np.abs((np.array(slopes) - 1) * np.ptp(truth, axis=0)).max())


def test_dots_are_printed_to_a_hundredth_of_a_millimetre(tmp_path: Path) -> None:
    sheet = dot_sheet(TARGET)
    page = printed(sheet, tmp_path, 40.0)
    dark = cv2.connectedComponentsWithStats((page < 128).astype(np.uint8))
    area = dark[2][:, cv2.CC_STAT_AREA] / 40.0**2
    squares = np.abs(area - 16.0) < 1.0
    found = on_sheet(dark[3][squares], sheet, 40.0)
    assert len(found) == TARGET.rows * TARGET.columns
    left = (2 * np.pi * 30.0 - 8 * 12.5) / 2
    x, y = np.meshgrid(left + 12.5 * np.arange(9), 12.0 + 11.0 * np.arange(8))
    truth = np.column_stack([x.ravel(), y.ravel()])
    order = np.linalg.norm(found[:, None] - truth[None], axis=-1).argmin(axis=1)
    assert set(order) == set(range(len(truth)))
    assert true_to(found, truth[order], 40.0) < 0.01


def camera_at(azimuth_deg: float, distance_mm: float, height_mm: float) -> Camera:
    """A camera that looks at the axis of the cylinder, its upper side upwards, 900 × 700 px."""
    angle = np.radians(azimuth_deg)
    outward, up = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, 1.0])
    R = np.stack([np.cross(-outward, up), -up, -outward])
    centre = distance_mm * outward + height_mm * up
    K = np.array([[2400.0, 0.0, 449.5], [0.0, 2400.0, 349.5], [0.0, 0.0, 1.0]])
    P = K @ np.column_stack([R, -R @ centre])
    return Camera("one", P / P[2, 3], (900, 700))


def seen_on_cylinder(page: NDArray[np.uint8], camera: Camera, px_per_mm: float) -> NDArray[np.uint8]:
    """Image of the sheet glued round the cylinder of TARGET, column 1 on +x, on a white background."""
    width, height = camera.size
    rays = camera.ray(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float))
    c, radius = camera.centre, TARGET.radius_mm
    a, b = rays[..., 0] ** 2 + rays[..., 1] ** 2, rays[..., 0] * c[0] + rays[..., 1] * c[1]
    root = b**2 - a * (c[0] ** 2 + c[1] ** 2 - radius**2)
    hit = c + ((-b - np.sqrt(np.maximum(root, 0.0))) / a)[..., None] * rays
    sheet = dot_sheet(TARGET)
    column_1 = (sheet.width - (TARGET.columns - 1) * TARGET.column_spacing_mm) / 2
    x = MARGIN + column_1 + np.arctan2(hit[..., 1], hit[..., 0]) * radius
    y = sheet.page[1] - MARGIN - hit[..., 2]
    on_print = (root > 0) & (hit[..., 2] > 0) & (hit[..., 2] < sheet.height)
    places = (np.stack([x, y]) * px_per_mm - 0.5).astype(np.float32)
    image = cv2.remap(cv2.GaussianBlur(page, (0, 0), 1.2), *places, cv2.INTER_LINEAR, borderValue=(255.0,))
    return np.where(on_print, np.maximum(image, 20), 255).astype(np.uint8)


def test_a_glued_sheet_is_identified_row_by_row_and_column_by_column(tmp_path: Path) -> None:
    page = printed(dot_sheet(TARGET), tmp_path, 12.0)
    camera = camera_at(azimuth_deg=75.0, distance_mm=420.0, height_mm=50.0)
    dots = identify_dots(find_dots(seen_on_cylinder(page, camera, 12.0), TARGET), TARGET, 73.0)
    assert len(dots) > 30
    assert np.abs(camera.project(dot_points(TARGET, dots.rows, dots.columns)) - dots.px).max() < 0.5


def test_the_board_is_found_and_true_to_scale(tmp_path: Path) -> None:
    sheet = board_sheet(BOARD)
    page = printed(sheet, tmp_path, 10.0)
    corners = find_corners(page, BOARD.inner_corners)
    assert corners is not None
    places = on_sheet(corners, sheet, 10.0)
    truth = board_points(BOARD) + 1.5 * BOARD.square_mm
    order = np.linalg.norm(places[:, None] - truth[None], axis=-1).argmin(axis=1)
    assert true_to(places, truth[order], 10.0) < 0.01


def test_markers_of_the_charuco_board_are_those_that_opencv_expects(tmp_path: Path) -> None:
    sheet = charuco_sheet(BOARD)
    page = printed(sheet, tmp_path, 10.0)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    board = cv2.aruco.CharucoBoard(BOARD.squares, BOARD.square_mm, 0.75 * BOARD.square_mm, dictionary)
    corners, ids, _, markers = cv2.aruco.CharucoDetector(board).detectBoard(page)
    across, along = BOARD.squares
    assert len(markers) == across * along // 2
    assert sorted(ids.ravel()) == list(range((across - 1) * (along - 1)))
    truth = board.getChessboardCorners()[ids.ravel(), :2]
    seen = on_sheet(corners.reshape(-1, 2).astype(float), sheet, 10.0)
    seen[:, 1] = sheet.height - seen[:, 1]
    assert true_to(seen - 0.5 * BOARD.square_mm, truth, 10.0) < 0.01


@pytest.mark.parametrize(("diameter", "cover", "seed"), [(1.0, 0.5, 1), (2.5, 0.35, 7)])
def test_speckles_cover_what_is_asked_for(tmp_path: Path, diameter: float, cover: float, seed: int) -> None:
    sheet = speckle_sheet(diameter, 90.0, 60.0, cover=cover, seed=seed)
    page = printed(sheet, tmp_path, 8.0)
    inner = page[21 * 8 : 71 * 8, 21 * 8 : 101 * 8]
    # discs of a jittered lattice overlap a little, so that less is dark than the sum of their areas
    assert cover - 0.08 < (inner < 128).mean() < cover + 0.02
    again = speckle_sheet(diameter, 90.0, 60.0, cover=cover, seed=seed + 1)
    assert len(again.discs) != len(sheet.discs) or np.abs(again.discs - sheet.discs).max() > 0.1


def test_rulers_measure_centimetres(tmp_path: Path) -> None:
    sheet = board_sheet(BOARD)
    page = printed(sheet, tmp_path, 20.0)
    row = page[round((sheet.page[1] - MARGIN + 5.5) * 20)]  # through the longest marks of the lower ruler alone
    dark = np.flatnonzero(row[round(MARGIN * 20) - 10 : round((sheet.page[0] - MARGIN) * 20) + 10] < 200) - 10
    marks = (dark[np.insert(np.diff(dark) > 1, 0, True)] + 0.5) / 20
    assert len(marks) == int(sheet.width // 10) + 1
    assert np.abs(np.diff(marks) - 10.0).max() < 0.06


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: charuco_sheet(BOARD, "DICT_4X4_50x"), "no marker dictionary"),
        (lambda: charuco_sheet(Board("checkerboard", (12, 20), 9.0), "DICT_4X4_50"), "has 50 markers"),
        (lambda: speckle_sheet(0.1, 500.0, 500.0), "too many"),
        (lambda: speckle_sheet(10.0, 20.0, 20.0), "too small"),
        (lambda: speckle_sheet(1.0, 50.0, 50.0, cover=0.9), "share of 0.2 to 0.7"),
        (lambda: dot_sheet(Target("dot-cylinder", 30.0, 8, 11.0, 1.0, 9, 12.5, 4.0)), "are not cut"),
    ],
)
def test_what_cannot_be_printed_is_refused(make: Callable[[], Sheet], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make()
