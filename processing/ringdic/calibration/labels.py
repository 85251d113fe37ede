"""Correspondence of the target's columns between cameras, by correlating the numbers printed above them.

The numbers are not read. The image of what is printed above each column is rectified to the sheet, the mean over all
columns is subtracted, and the rest is correlated between cameras: two views of one number agree.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ringdic.arrays import Floats, Pixels
from ringdic.calibration import dlt
from ringdic.calibration.patch import cylinder_points
from ringdic.calibration.target import DotObservations, cylinder_normals
from ringdic.session.rig import Target

#: Rectified images of what is printed above each column, by the column's number.
Labels = dict[int, Floats]

#: Strip above the top row: lower and upper edge in row distances, half width in halves of the column distance.
_LOW, _HIGH, _HALF_WIDTH = 0.25, 1.0, 0.8
#: Samples per mm, and standard deviation of the blur that tolerates small displacements, in samples.
_SAMPLES, _BLUR = 4.0, 1.0
#: Standard deviation of the grey levels of a print, as a part of the paper's level.
_PRINT = 0.04
#: Least correlation of equal numbers, and least difference to the second-best numbering.
_ALIKE, _MARGIN = 0.86, 0.1
#: Largest displacement between two images of one number, in samples.
_SLACK = 3
#: Fewest columns that both cameras must see well.
_FEWEST = 3


def column_labels(image: NDArray[np.generic], dots: DotObservations, target: Target, *, below: bool = False) -> Labels:
    """Rectified images of the number printed above each column of the target that the camera sees well.

    image : (height, width) grey, the image in which the dots were detected. below : True takes what is printed below
    the lowest row instead of above the highest.

    Returns for each column an image (rows, columns) in parts of the paper's grey level, (0, 0) at the upper left.
    """
    grey = np.asarray(image, dtype=np.float32)
    camera = dlt.to_camera(dlt.solve_dlt(dots.xyz, dots.px))
    distortion = _Distortion(dots, target, dots.px - camera.project(dots.xyz))
    half = _HALF_WIDTH * target.column_spacing_mm / 2
    low, high = (each * target.row_spacing_mm for each in (_LOW, _HIGH))
    across = np.arange(-half, half, 1 / _SAMPLES)
    up = np.arange(high, low, -1 / _SAMPLES)
    if below:
        up = -up
    row = 1 if below else target.rows
    z = target.first_row_z_mm + (row - 1) * target.row_spacing_mm + up
    labels = {}
    for column in np.unique(dots.columns[dots.rows == row]):
        s, zz = np.meshgrid((column - 1) * target.column_spacing_mm + across, z)
        xyz = cylinder_points(target.radius_mm, s / target.radius_mm, zz)
        if camera.incidence_cosine(xyz, cylinder_normals(target, xyz)).min() < 0.6:
            continue
        px = (camera.project(xyz) + distortion(s, zz)).astype(np.float32)
        patch = cv2.remap(grey, px[..., 0], px[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        paper = float(np.percentile(patch, 90))
        if paper > 0:
            labels[int(column)] = np.asarray(scipy.ndimage.gaussian_filter(patch / paper, _BLUR), dtype=np.float64)
    return labels


def has_labels(labels: Labels) -> bool:
    """Whether the labels differ from column to column, as printed numbers do."""
    if len(labels) < 3:
        return False
    patches = np.stack(list(labels.values()))
    return float(np.median((patches - patches.mean(axis=0)).std(axis=(1, 2)))) > _PRINT


def mean_label(all_labels: Iterable[Labels]) -> Floats:
    """Mean of the labels over all columns of all cameras: shading and borders, which are not part of the numbers.

    Returns an image (rows, columns) in parts of the paper's grey level.
    """
    return np.asarray(np.mean([patch for labels in all_labels for patch in labels.values()], axis=0))


def mirrored_labels(labels: Labels, columns: int) -> Labels:
    """The labels as the mirrored image would show them: each turned over, counted from the other end of the columns."""
    return {(-column) % columns + 1: patch[:, ::-1] for column, patch in labels.items()}


def column_shift(first: Labels, second: Labels, mean: Floats, columns: int) -> int | None:
    """Shift that must be added to the second camera's column numbers to agree with those of the first camera.

    mean : (rows, columns) image, in parts of the paper's grey level, that is subtracted from all labels. columns :
    number of columns round the target, modulo which the shift is counted.

    Returns None where the cameras have too few columns in common, or more than one shift is likely.
    """
    a = {column: (patch - mean).astype(np.float32) for column, patch in first.items()}
    b = {column: (patch - mean).astype(np.float32)[_SLACK:-_SLACK, _SLACK:-_SLACK] for column, patch in second.items()}
    scores = []
    for shift in range(columns):
        pairs = [(a[(c + shift - 1) % columns + 1], p) for c, p in b.items() if (c + shift - 1) % columns + 1 in a]
        if len(pairs) >= _FEWEST:
            scores.append((float(np.mean([_correlation(whole, part) for whole, part in pairs])), shift))
    scores.sort(reverse=True)
    if not scores or scores[0][0] < _ALIKE or (len(scores) > 1 and scores[0][0] - scores[1][0] < _MARGIN):
        return None
    return scores[0][1]


def _correlation(whole: NDArray[np.float32], inner: NDArray[np.float32]) -> float:
    """Largest correlation of an image with a larger one, over all displacements within it."""
    return float(cv2.matchTemplate(whole, np.ascontiguousarray(inner), cv2.TM_CCOEFF_NORMED).max())


class _Distortion:
    """Residuals of a camera without lens, fitted by cubic polynomials of arc and height on the target.

    residuals : (n, 2) px, of the dots.
    """

    def __init__(self, dots: DotObservations, target: Target, residuals: Pixels) -> None:
        self._spacing = target.column_spacing_mm
        s: Floats = np.asarray((dots.columns - 1) * self._spacing, dtype=np.float64)
        z: Floats = dots.xyz[:, 2]
        # Arcs are counted from the middle of the dots, so that columns on both sides of the seam are neighbours.
        self._period = target.columns * self._spacing
        self._s0, self._z0 = self._middle(s), float(z.mean())
        self._coefficients = np.linalg.lstsq(self._terms(s, z), residuals, rcond=None)[0]

    def _middle(self, s: Floats) -> float:
        """Circular mean of arcs (n,), mm."""
        angle = 2 * np.pi * s / self._period
        return float(np.arctan2(np.sin(angle).mean(), np.cos(angle).mean()) / (2 * np.pi) * self._period)

    def _terms(self, s: Floats, z: Floats) -> Floats:
        """Monomials (..., 10) up to the third degree of scaled arcs and heights (...)."""
        x = ((s - self._s0 + self._period / 2) % self._period - self._period / 2) / 50.0
        y = (z - self._z0) / 100.0
        powers: Floats = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)
        return powers

    def __call__(self, s: Floats, z: Floats) -> Pixels:
        """Residuals (..., 2) px at arcs and heights (...) mm."""
        return np.asarray(self._terms(s, z) @ self._coefficients)
