"""First approximation of the surface: its radius over a lattice, from depth sweeps of the camera pairs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Points
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.multiview.lattice import TURN, Pieces, SurfaceLattice, robust_pieces

_SMOOTHING = 12.0  # mm, reach of the pieces through the samples of the sweeps
_MARGIN = 3  # rows beyond the samples


def px_per_mm(cameras: Sequence[Camera], radius: float) -> float:
    """Median image scale, px/mm, where each camera faces a cylinder of a radius, mm, about the z axis."""
    scales = []
    for camera in cameras:
        towards = camera.centre[:2] / np.linalg.norm(camera.centre[:2])
        position = np.array([*(radius * towards), camera.centre[2]])
        ends = np.stack([position, position + np.array([0.0, 0.0, 1.0])])
        scales.append(float(np.linalg.norm(np.diff(camera.project(ends), axis=0))))
    return float(np.median(scales))


def lay_lattice(samples: Points, spacing: float) -> SurfaceLattice:
    """Lay a lattice over samples of the surface, with equal spacing along the arc of their median radius and along z.

    samples : (n, 3) float64, mm, world frame. spacing : mm, between nodes.
    """
    radius = float(np.median(np.hypot(samples[:, 0], samples[:, 1])))
    columns = max(8, round(TURN * radius / spacing))
    low, high = (float(value) for value in (samples[:, 2].min(), samples[:, 2].max()))
    first = np.floor(low / spacing) - _MARGIN
    count = int(np.ceil(high / spacing) + _MARGIN - first) + 1
    return SurfaceLattice(radius, columns, (first + np.arange(count)) * spacing)


def rough_surface(lattice: SurfaceLattice, samples: Points) -> Pieces:
    """Fit smooth pieces through samples of the surface that are scattered over the lattice and partly wrong.

    samples : (n, 3) float64, mm, world frame. Raises ComputationError where the samples do not form a surface.
    """
    theta = np.arctan2(samples[:, 1], samples[:, 0]) % TURN
    column, row, inside = lattice.nearest(theta, samples[:, 2])
    radius = _medians(lattice.shape, column[inside], row[inside], np.hypot(samples[:, 0], samples[:, 1])[inside])
    # Samples are sparse: one node in many has one, so the share of known nodes is judged against their density.
    known = np.isfinite(radius)
    pieces, _ = robust_pieces(lattice, radius, _SMOOTHING, 2, least=0.3 * _density(known), floor=1.0)
    if not np.isfinite(pieces.radius).any():
        raise ComputationError("the camera pairs found too few places of the surface to join; check focus and speckle")
    return pieces


def _density(known: Mask) -> float:
    """Median share of known nodes in the blocks of 8 x 8 nodes that hold any. known : (columns, rows)."""
    blocks = [
        known[i : i + 8, j : j + 8].mean() for i in range(0, known.shape[0], 8) for j in range(0, known.shape[1], 8)
    ]
    occupied = [share for share in blocks if share > 0]
    return float(np.median(occupied)) if occupied else 0.0


def _medians(shape: tuple[int, int], column: Indices, row: Indices, values: Floats) -> Floats:
    """Median of the values that fall on each node of a lattice, (columns, rows), NaN where none does.

    column, row : (n,) int, the node of each value. values : (n,).
    """
    out = np.full(shape, np.nan)
    node = column * shape[1] + row
    order = np.lexsort((values, node))
    node, values = node[order], values[order]
    first = np.flatnonzero(np.diff(node, prepend=-1))
    count = np.diff(np.append(first, len(node)))
    out.flat[node[first]] = 0.5 * (values[first + (count - 1) // 2] + values[first + count // 2])
    return out
