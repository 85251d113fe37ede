"""The sheets that a rig needs: dots of the calibration cylinder, checkerboard, ChArUco board, speckles."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ringdic.arrays import Floats
from ringdic.errors import InputError
from ringdic.prints.sheet import Label, Sheet
from ringdic.session.rig import Board, Target

#: Lower edge and height of the number above a column, in distances of the rows.
_NUMBER_FOOT, _NUMBER_HEIGHT = 0.4, 0.36
#: Part of a square that the marker of a ChArUco board fills, and white border of a board in squares.
_MARKER_SHARE, _QUIET = 0.75, 0.5
#: Largest displacement of a speckle from its place in a hexagonal lattice, and spread of the diameters, both as parts
#: of the lattice's distance and of the diameter.
_JITTER, _SPREAD = 0.35, 0.25
_MOST_SPECKLES = 200_000


def dot_sheet(target: Target) -> Sheet:
    """The dots of the calibration cylinder, with the number of each column above its highest dot.

    The sheet is as wide as the cylinder's circumference. Its lower edge is z = 0 of the world frame. The columns stand
    in its middle, so that the seam lies opposite to them; their numbers increase to the right, which is
    counter-clockwise seen from above when the print faces outwards.
    """
    width = 2 * math.pi * target.radius_mm
    top = target.first_row_z_mm + (target.rows - 1) * target.row_spacing_mm
    height = top + max(target.first_row_z_mm, 1.25 * target.row_spacing_mm)
    columns = (width - (target.columns - 1) * target.column_spacing_mm) / 2 + (
        np.arange(target.columns) * target.column_spacing_mm
    )
    rows = target.first_row_z_mm + np.arange(target.rows) * target.row_spacing_mm
    x, y = (each.ravel() for each in np.meshgrid(columns, rows))
    if y.min() < target.dot_size_mm / 2:
        raise InputError(
            f"the lowest dots lie {target.first_row_z_mm} mm above the lower edge and are {target.dot_size_mm} mm "
            "large: choose first_row_z_mm so that they are not cut"
        )
    edge = np.full_like(x, target.dot_size_mm)
    squares = np.column_stack([x - edge / 2, y - edge / 2, edge, edge])
    spacing = target.row_spacing_mm
    labels = tuple(
        Label(float(each), top + _NUMBER_FOOT * spacing, _NUMBER_HEIGHT * spacing, str(number))
        for number, each in enumerate(columns, start=1)
    )
    square = target.dot_shape == "square"
    return Sheet(
        f"Calibration cylinder: {target.rows} rows of {target.columns} dots, diameter {2 * target.radius_mm:g} mm",
        width,
        height,
        rectangles=squares if square else np.zeros((0, 4)),
        discs=np.zeros((0, 3)) if square else np.column_stack([x, y, edge]),
        labels=labels,
        advice=f"Glue it round a cylinder; measured over the paper the diameter must be {2 * target.radius_mm:g} mm.",
    )


def board_sheet(board: Board) -> Sheet:
    """The checkerboard from which the lenses are calibrated, with a white border of half a square."""
    across, along = board.squares
    return Sheet(
        f"Checkerboard: {across} × {along} squares of {board.square_mm:g} mm",
        (across + 2 * _QUIET) * board.square_mm,
        (along + 2 * _QUIET) * board.square_mm,
        rectangles=_dark_squares(board),
        advice="Glue it on a stiff, flat plate, without bubbles: glass, or aluminium of 3 mm or more.",
    )


def charuco_sheet(board: Board, dictionary: str = "DICT_5X5_1000") -> Sheet:
    """A ChArUco board of the checkerboard's measures: a marker in each white square, so that a part of it is enough.

    dictionary : one of OpenCV's predefined ones, by name. The markers are three quarters of a square large and numbered
    as OpenCV's ``CharucoBoard`` numbers them.

    Raises
    ------
    InputError : the dictionary is unknown or has too few markers.
    """
    number = getattr(cv2.aruco, dictionary, None)
    if number is None:
        raise InputError(f"OpenCV has no marker dictionary '{dictionary}'; one that it has is DICT_5X5_1000")
    markers = cv2.aruco.getPredefinedDictionary(number)
    across, along = board.squares
    held, needed = len(markers.bytesList), across * along // 2
    if needed > held:
        raise InputError(f"the dictionary {dictionary} has {held} markers and the board needs {needed}")
    cells = markers.markerSize + 2
    cell = _MARKER_SHARE * board.square_mm / cells
    inset = (1 - _MARKER_SHARE) / 2 * board.square_mm
    bits = []
    places = [(row, column) for row in range(along) for column in range(across) if (row + column) % 2 == 1]
    for marker, (row, column) in enumerate(places):
        image = cv2.aruco.generateImageMarker(markers, marker, cells, borderBits=1)
        down, right = np.nonzero(image == 0)
        left = (_QUIET + column) * board.square_mm + inset + right * cell
        upper = (_QUIET + along - row) * board.square_mm - inset - down * cell
        bits.append(np.column_stack([left, upper - cell, np.full((len(left), 2), cell)]))
    return Sheet(
        f"ChArUco board: {across} × {along} squares of {board.square_mm:g} mm, markers of "
        f"{_MARKER_SHARE * board.square_mm:g} mm, {dictionary}",
        (across + 2 * _QUIET) * board.square_mm,
        (along + 2 * _QUIET) * board.square_mm,
        rectangles=np.concatenate([_dark_squares(board), *bits]),
        advice="Glue it on a stiff, flat plate, without bubbles: glass, or aluminium of 3 mm or more.",
    )


def _dark_squares(board: Board) -> Floats:
    """Dark squares (n, 4) mm of a checkerboard whose upper left square is dark."""
    across, along = board.squares
    row, column = np.nonzero(np.add.outer(np.arange(along), np.arange(across)) % 2 == 0)
    left = (_QUIET + column) * board.square_mm
    bottom = (_QUIET + along - 1 - row) * board.square_mm
    return np.column_stack([left, bottom, np.full((len(left), 2), board.square_mm)])


def speckle_sheet(diameter_mm: float, width_mm: float, height_mm: float, *, cover: float = 0.5, seed: int = 1) -> Sheet:
    """Speckles of nearly one size at random places, to be printed on paper, transfer film or tattoo film.

    diameter_mm : mean diameter; 3 to 5 px in the images match best. width_mm, height_mm : of the pattern.
    cover : share of the area that is dark. seed : another number gives another pattern.

    The speckles are discs in a jittered hexagonal lattice, so that none covers another by much and no gap is large.

    Raises
    ------
    InputError : more than 200,000 speckles, or none.
    """
    if not 0.2 <= cover <= 0.7:
        raise InputError(f"speckles cover a share of 0.2 to 0.7 of the sheet, not {cover:g}")
    if diameter_mm <= 0 or min(width_mm, height_mm) < 4 * diameter_mm:
        raise InputError(f"a sheet of {width_mm:g} × {height_mm:g} mm is too small for speckles of {diameter_mm:g} mm")
    mean_square = diameter_mm**2 * (1 + _SPREAD**2 / 3)
    distance = math.sqrt(math.pi / 4 * mean_square / cover / (math.sqrt(3) / 2))
    nx, ny = int(width_mm / distance), int(height_mm / (distance * math.sqrt(3) / 2))
    if nx * ny > _MOST_SPECKLES:
        raise InputError(
            f"{nx * ny} speckles of {diameter_mm:g} mm are too many for one sheet (at most {_MOST_SPECKLES}); "
            "choose a smaller sheet"
        )
    random = np.random.default_rng(seed)
    row, column = (each.ravel() for each in np.mgrid[:ny, :nx])
    places = np.column_stack([column + 0.5 * (row % 2), row * math.sqrt(3) / 2]) + random.uniform(
        -_JITTER, _JITTER, (nx * ny, 2)
    )
    diameters = diameter_mm * random.uniform(1 - _SPREAD, 1 + _SPREAD, nx * ny)
    centres = (places + 0.5) * distance
    inside = np.all((centres > diameters[:, None] / 2) & (centres < [width_mm, height_mm] - diameters[:, None] / 2), 1)
    return Sheet(
        f"Speckles of {diameter_mm:g} mm, {100 * cover:.0f} % dark",
        width_mm,
        height_mm,
        discs=np.column_stack([centres, diameters])[inside],
        advice="A speckle should be 3 to 5 px large in the images.",
    )
