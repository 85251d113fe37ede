"""Lattices of image positions, and the region of interest of a camera pair from where a depth sweep matches them.

A position belongs to the specimen where its match is unambiguous and its depth agrees with that of its neighbours.
Parts that a camera sees too obliquely, by the angle between surface normal and line of sight, are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Mask, Pixels, Points, Vectors
from ringdic.geometry.camera import Camera


@dataclass(frozen=True)
class ImageLattice:
    """Positions on a regular lattice over an image.

    xy : (rows, columns, 2) float64, px. spacing : px.
    """

    xy: Pixels
    spacing: int


def image_lattice(size: tuple[int, int], spacing: int, margin: int) -> ImageLattice:
    """Lattice of all multiples of ``spacing`` that keep a margin from the edge of an image.

    size : (width, height) px. spacing, margin : px.
    """
    first = -(-margin // spacing) * spacing
    x = np.arange(first, size[0] - margin, spacing, dtype=float)
    y = np.arange(first, size[1] - margin, spacing, dtype=float)
    return ImageLattice(np.stack(np.meshgrid(x, y), axis=-1), spacing)


def coherent_depths(radius: Floats, candidates: Mask, tolerance: float, min_positions: int = 0) -> Mask:
    """Lattice positions whose depth agrees with that of the matched positions around them.

    Parameters
    ----------
    radius : (rows, columns) float64, mm, distance of the surface from the z axis at each position, as a measure of
        depth.
    candidates : (rows, columns) bool, positions with an unambiguous match.
    tolerance : mm, largest difference from the median radius of the candidates among the 8 neighbours, of which there
        must be at least three.
    min_positions : smallest size of a connected group that remains; 0 leaves only the largest group.

    Returns
    -------
    coherent : (rows, columns) bool.
    """
    padded = np.pad(np.where(candidates, radius, np.nan), 1, constant_values=np.nan)
    rows, columns = radius.shape
    around = np.stack(
        [
            padded[1 + j : 1 + j + rows, 1 + i : 1 + i + columns]
            for j in (-1, 0, 1)
            for i in (-1, 0, 1)
            if (i, j) != (0, 0)
        ]
    )
    count = np.isfinite(around).sum(axis=0)
    ordered = np.sort(around, axis=0)  # NaN last
    middle = np.take_along_axis(ordered, (np.maximum(count, 1)[None] - 1) // 2, axis=0)[0]
    coherent = candidates & (count >= 3) & (np.abs(radius - middle) < tolerance)
    labels_count, labels, stats, _ = cv2.connectedComponentsWithStats(coherent.astype(np.uint8), connectivity=8)
    if labels_count < 2:
        return np.zeros_like(coherent)
    area = stats[1:, cv2.CC_STAT_AREA]
    large = area >= min_positions if min_positions else np.arange(len(area)) == np.argmax(area)
    return np.asarray(np.append(False, large)[labels])


def contrast(image: NDArray[np.generic], xy: Pixels, half_width: int) -> Floats:
    """Root mean square of the grey level's gradient in a square around positions of an image, by Sobel differences.

    image : (height, width) grey levels. xy : (..., 2) float64, px. half_width : px, of the square, of which the part
        inside the image counts.
    Returns (...), in grey levels per px.
    """
    at = np.ascontiguousarray(xy.reshape(-1, 2), dtype=np.float64)
    out = np.empty(len(at))
    _contrast(np.ascontiguousarray(image), at, half_width, out)
    return out.reshape(xy.shape[:-1])


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _contrast(image, xy, half_width, out):  # type: ignore[no-untyped-def]
    """Fill out (n,) with the contrast of ``contrast`` around positions xy (n, 2)."""
    (height, width), one = image.shape, np.uint64(1)
    kind: Any = np.float32
    for k in range(len(xy)):
        column, row = int(xy[k, 0]), int(xy[k, 1])
        left, right = max(column - half_width, 1), min(column + half_width + 1, width - 1)
        total, count = 0.0, 0
        for i in range(max(row - half_width, 1), min(row + half_width + 1, height - 1)):
            of_row = kind(0.0)
            for j in range(np.uint64(left), np.uint64(right)):
                before, after = j - one, j + one
                a, b, c = kind(image[i - 1, before]), kind(image[i - 1, j]), kind(image[i - 1, after])
                d, e = kind(image[i, before]), kind(image[i, after])
                f, g, h = kind(image[i + 1, before]), kind(image[i + 1, j]), kind(image[i + 1, after])
                along_x, along_y = c - a + e - d + e - d + h - f, f - a + g - b + g - b + h - c
                of_row += along_x * along_x + along_y * along_y
            total += of_row
            count += max(right - left, 0)
        out[k] = math.sqrt(total / count) / 8.0 if count else 0.0


def lattice_normals(xyz: Points) -> Vectors:
    """Outward unit normals of a surface that is given by a lattice of points.

    xyz : (rows, columns, 3) float64, mm, in the world frame. Returns (rows, columns, 3), no unit, NaN where unknown.
    Differences are central where both neighbours exist; outward is away from the z axis.
    """
    along_x = _difference(xyz, axis=1)
    along_y = _difference(xyz, axis=0)
    normals = np.cross(along_x, along_y)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        inwards = normals[..., 0] * xyz[..., 0] + normals[..., 1] * xyz[..., 1] < 0
    normals[inwards] *= -1
    return normals


def within_incidence(xyz: Points, cameras: tuple[Camera, Camera], limit_deg: float) -> Mask:
    """Lattice positions whose surface both cameras see at an angle of incidence below a limit.

    xyz : (rows, columns, 3) float64, mm, in the world frame. limit_deg : degrees, between normal and line of sight.
    Returns (rows, columns) bool.
    """
    normals = lattice_normals(xyz)
    limit = np.cos(np.radians(limit_deg))
    with np.errstate(invalid="ignore"):
        return np.logical_and.reduce([camera.incidence_cosine(xyz, normals) > limit for camera in cameras])


def lattice_region(points: ImageLattice, good: Mask, size: tuple[int, int]) -> Mask:
    """Region of an image that the good positions of a lattice cover, gaps between them closed.

    good : (rows, columns) bool. size : (width, height) px. Returns (height, width) bool.
    """
    width, height = size
    region = np.zeros((height, width), bool)
    at = points.xy[good].astype(int)
    if not len(at):
        return region
    half, reach = points.spacing // 2 + 1, 2 * points.spacing
    left, top = np.maximum(at.min(axis=0) - half - reach - 1, 0)
    box = region[top : at[:, 1].max() + half + reach + 2, left : at[:, 0].max() + half + reach + 2]
    mask = np.zeros(box.shape, np.uint8)
    for x, y in at - (left, top):
        mask[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1] = 1
    closing = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * reach + 1, 2 * reach + 1))
    box[:] = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, closing)
    return region


def _difference(xyz: Points, axis: int) -> Vectors:
    """Differences (rows, columns, 3) of points along a lattice axis, central or, beside a missing point, one-sided."""
    forward = np.full_like(xyz, np.nan)
    backward = np.full_like(xyz, np.nan)
    lower = [slice(None)] * 3
    upper = [slice(None)] * 3
    lower[axis], upper[axis] = slice(None, -1), slice(1, None)
    step = xyz[tuple(upper)] - xyz[tuple(lower)]
    forward[tuple(lower)] = step
    backward[tuple(upper)] = step
    both = (forward + backward) / 2
    one = np.where(np.isfinite(forward), forward, backward)
    return np.where(np.isfinite(both), both, one)
