"""A sheet of print in millimetres, and its file: vector PDF at true scale with rulers to check the printer by."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.figure import Figure

from ringdic.arrays import Floats

#: Free border round the pattern, mm: it holds the rulers, the cutting marks and the caption.
MARGIN = 16.0
_MM_PER_INCH = 25.4
_POINTS_PER_MM = 72 / _MM_PER_INCH
#: Width of hairlines, mm, and lengths of the ruler's marks at 1, 5 and 10 mm, mm.
_HAIRLINE = 0.1
_MARKS = (1.5, 2.2, 3.0)


@dataclass(frozen=True)
class Label:
    """A text on a sheet: centre of its lower edge at x, y, mm; height of its capitals, mm."""

    x: float
    y: float
    height: float
    text: str


def _no_shapes(columns: int) -> Floats:
    return np.zeros((0, columns))


@dataclass(frozen=True)
class Sheet:
    """What is printed in black on a white sheet; lengths in mm, the origin at the lower left corner of the pattern.

    name : what the sheet is, in words; stands in its caption.
    width, height : of the pattern, which is the part that is used, mm.
    rectangles : (n, 4) left, bottom, width, height, mm.
    discs : (n, 3) x and y of the centre, diameter, mm.
    labels : texts within the pattern.
    advice : what to do with the sheet; stands below its name.
    """

    name: str
    width: float
    height: float
    rectangles: Floats = field(default_factory=lambda: _no_shapes(4))
    discs: Floats = field(default_factory=lambda: _no_shapes(3))
    labels: tuple[Label, ...] = ()
    advice: str = ""

    @property
    def page(self) -> tuple[float, float]:
        """Width and height of the page in whole mm: those of the pattern and a border all round."""
        return float(math.ceil(self.width + 2 * MARGIN)), float(math.ceil(self.height + 2 * MARGIN))


def write_sheet(sheet: Sheet, path: Path) -> None:
    """Write a sheet as a PDF of one page at true scale.

    The page is the pattern and a border of 16 mm, which holds a ruler along two sides, cutting marks at the corners of
    the pattern, and a caption. Printed at "actual size", 100 mm of the rulers are 100 mm on paper.
    """
    width, height = sheet.page
    figure = Figure(figsize=(width / _MM_PER_INCH, height / _MM_PER_INCH))
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), frameon=False)
    axes.set(xlim=(-MARGIN, width - MARGIN), ylim=(-MARGIN, height - MARGIN), xticks=[], yticks=[])
    left, bottom, across, up = sheet.rectangles.T
    corners = np.stack([left, bottom, left + across, bottom, left + across, bottom + up, left, bottom + up], axis=-1)
    axes.add_collection(PolyCollection(list(corners.reshape(-1, 4, 2)), facecolors="black", linewidths=0))
    x, y, diameter = sheet.discs.T
    axes.add_collection(
        EllipseCollection(
            diameter,
            diameter,
            np.zeros(len(x)),
            units="xy",
            offsets=np.column_stack([x, y]),
            offset_transform=axes.transData,
            facecolors="black",
            linewidths=0,
        )
    )
    lines = np.concatenate([_cutting_marks(sheet), _ruler(sheet.width), _ruler(sheet.height)[:, :, ::-1]])
    axes.add_collection(LineCollection(list(lines), colors="black", linewidths=_HAIRLINE * _POINTS_PER_MM))
    for label in (*sheet.labels, *_caption(sheet)):
        size = label.height * _POINTS_PER_MM / 0.73  # capitals are 0.73 of the type size high
        axes.text(label.x, label.y, label.text, size=size, ha="center", va="baseline")
    figure.savefig(path, format="pdf", metadata={"Title": sheet.name, "Creator": "RingDIC", "CreationDate": None})


def _ruler(length: float) -> Floats:
    """Ruler along the lower border, as lines (n, 2, 2) mm; as long as whole centimetres fit into `length` mm."""
    ticks = np.arange(10.0 * (length // 10.0) + 0.5)
    marks = np.select([ticks % 10 == 0, ticks % 5 == 0], [_MARKS[2], _MARKS[1]], _MARKS[0])
    foot = np.full_like(ticks, -8.0)
    return np.stack([np.column_stack([ticks, foot]), np.column_stack([ticks, foot + marks])], axis=1)


def _cutting_marks(sheet: Sheet) -> Floats:
    """Lines (8, 2, 2) mm beside the corners of the pattern that show where to cut."""
    near, far = 1.0, 4.0
    marks = []
    for x, outward_x in ((0.0, -1.0), (sheet.width, 1.0)):
        for y, outward_y in ((0.0, -1.0), (sheet.height, 1.0)):
            marks.append([[x + outward_x * near, y], [x + outward_x * far, y]])
            marks.append([[x, y + outward_y * near], [x, y + outward_y * far]])
    return np.array(marks)


def _caption(sheet: Sheet) -> tuple[Label, ...]:
    """Name and advice above the pattern, and what the rulers are for below it."""
    middle = sheet.width / 2
    centimetres = int(sheet.width // 10), int(sheet.height // 10)
    check = f"Print at actual size. The rulers must measure {centimetres[0]} cm and {centimetres[1]} cm."
    letters = max(len(sheet.name), len(sheet.advice), len(check))
    size = min(2.2, sheet.page[0] / (0.75 * letters))
    return (
        Label(middle, sheet.height + MARGIN - 5.0, size, sheet.name),
        Label(middle, sheet.height + MARGIN - 9.5, size, sheet.advice),
        Label(middle, 3.0 - MARGIN, size, check),
    )
