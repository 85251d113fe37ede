"""The numbers printed above the columns, compared between cameras: they tell which columns are the same ones.

No font is known and nothing is read. What is printed above each column is brought to the sheet, what all columns have
in common is taken off, and the rest is the same picture wherever it is seen.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.calibration import dlt
from ringdic.calibration.target import DotObservations
from ringdic.geometry.camera import Camera
from ringdic.session.rig import Target

#: What is printed above each column, by the column's number.
Labels = dict[int, Floats]

#: The strip above the middle of the top row, as parts of the distance of rows and of half the distance of columns.
_LOW, _HIGH, _HALF_WIDTH = 0.25, 1.0, 0.8
#: Samples a millimetre, and the blur that forgives a place that is not quite right, in samples.
_SAMPLES, _BLUR = 4.0, 1.0
#: Grey levels spread less than this part of the paper's are no print.
_PRINT = 0.04
#: Correlation of the same numbers, and how much better than any other numbering it must be.
_ALIKE, _MARGIN = 0.86, 0.1
#: Samples by which two pictures of one number may be shifted.
_SLACK = 3
#: Columns that both cameras must see well.
_FEWEST = 3


def read_labels(image: NDArray[np.generic], dots: DotObservations, target: Target, *, below: bool = False) -> Labels:
    """What is printed above each column that the camera sees well.

    image : grey, as the dots were found in it. below : under the lowest row in place of above the highest.
    """
    grey = np.asarray(image, dtype=np.float32)
    camera = Camera("", dlt.to_projection(dlt.solve_dlt(dots.xyz, dots.px)), (1, 1))
    bend = _Bend(dots, target, dots.px - camera.project(dots.xyz))
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
        angle = s / target.radius_mm
        xyz = np.stack([target.radius_mm * np.cos(angle), target.radius_mm * np.sin(angle), zz], axis=-1)
        normal = xyz * [1 / target.radius_mm, 1 / target.radius_mm, 0]
        if camera.incidence_cosine(xyz, normal).min() < 0.6:
            continue
        px = (camera.project(xyz) + bend(s, zz)).astype(np.float32)
        patch = cv2.remap(grey, px[..., 0], px[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        paper = float(np.percentile(patch, 90))
        if paper > 0:
            labels[int(column)] = np.asarray(scipy.ndimage.gaussian_filter(patch / paper, _BLUR), dtype=np.float64)
    return labels


def has_labels(labels: Labels) -> bool:
    """Whether something is printed there that differs from column to column."""
    if len(labels) < 3:
        return False
    patches = np.stack(list(labels.values()))
    return float(np.median((patches - patches.mean(axis=0)).std(axis=(1, 2)))) > _PRINT


def common_part(all_labels: Iterable[Labels]) -> Floats:
    """The mean over all columns of all cameras: shade and borders, which are no numbers."""
    return np.asarray(np.mean([patch for labels in all_labels for patch in labels.values()], axis=0))


def same_numbers(first: Labels, second: Labels, common: Floats, columns: int) -> int | None:
    """By how much the second camera's numbers of columns must be raised to agree with the first's, modulo columns.

    None where they have too little in common, or more than one answer is likely.
    """
    a = {column: (patch - common).astype(np.float32) for column, patch in first.items()}
    b = {
        column: (patch - common).astype(np.float32)[_SLACK:-_SLACK, _SLACK:-_SLACK] for column, patch in second.items()
    }
    scores = []
    for shift in range(columns):
        pairs = [(a[(c + shift - 1) % columns + 1], p) for c, p in b.items() if (c + shift - 1) % columns + 1 in a]
        if len(pairs) >= _FEWEST:
            scores.append((float(np.mean([_alike(whole, part) for whole, part in pairs])), shift))
    scores.sort(reverse=True)
    if not scores or scores[0][0] < _ALIKE or (len(scores) > 1 and scores[0][0] - scores[1][0] < _MARGIN):
        return None
    return scores[0][1]


def _alike(whole: NDArray[np.float32], inner: NDArray[np.float32]) -> float:
    """The best correlation over the places where the inner part fits into the whole."""
    return float(cv2.matchTemplate(whole, np.ascontiguousarray(inner), cv2.TM_CCOEFF_NORMED).max())


class _Bend:
    """A cubic surface through what the camera without a lens leaves over, in arc and height. px."""

    def __init__(self, dots: DotObservations, target: Target, rest: Floats) -> None:
        self._spacing = target.column_spacing_mm
        s: Floats = np.asarray((dots.columns - 1) * self._spacing, dtype=np.float64)
        z: Floats = dots.xyz[:, 2]
        # Columns beyond the seam continue on the other side.
        self._period = target.columns * self._spacing
        self._s0, self._z0 = self._middle(s), float(z.mean())
        self._coefficients = np.linalg.lstsq(self._terms(s, z), rest, rcond=None)[0]

    def _middle(self, s: Floats) -> float:
        angle = 2 * np.pi * s / self._period
        return float(np.arctan2(np.sin(angle).mean(), np.cos(angle).mean()) / (2 * np.pi) * self._period)

    def _terms(self, s: Floats, z: Floats) -> Floats:
        x = ((s - self._s0 + self._period / 2) % self._period - self._period / 2) / 50.0
        y = (z - self._z0) / 100.0
        powers: Floats = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)
        return powers

    def __call__(self, s: Floats, z: Floats) -> Floats:
        return np.asarray(self._terms(s, z) @ self._coefficients)
