"""Start values for every point of a grid from matches of a few of them, a subset apart.

A value between four matched corners is the mean of what their displacements say and of what their gradients say, each
weighed by nearness: the two err by the same amount to either side, so a quadratic field is met exactly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from processing.correlation import Correlation, CorrelationSettings, Current, Reference, correlate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MARGIN = 3.0  # subset radii, and 32 px, about the expected places in which the current image is filtered
_LEAST_WEIGHT = 0.99  # all corners that have a say are there; other points are reached from their neighbours
_FEWEST = 8  # matches of which an affine fit says where the others lie


def lattice_spacing(settings: CorrelationSettings, radii: float = 2.0) -> int:
    """A multiple of the grid's step near so many subset radii, px."""
    return settings.step * max(1, round(radii * settings.radius / settings.step))


def on_lattice(xy: Array, spacing: int) -> Mask:
    """Points (n,) whose coordinates are multiples of ``spacing`` px."""
    return np.asarray((np.mod(xy, spacing) == 0).all(axis=1))


def match_from_lattice(
    reference: Reference,
    current: Current,
    xy: Array,
    settings: CorrelationSettings,
    start: Array,
    spacing: int,
    before: Array | None = None,
) -> Correlation:
    """Matches of points xy (n, 2) px from start values (n, 6) of some of those ``spacing`` px apart, NaN elsewhere.

    before : (n, 6), the points' matches in another image of the same camera: what has changed since varies far less
    from point to point than the matches do.
    """
    chosen = np.flatnonzero(on_lattice(xy, spacing))
    known = np.isfinite(start[chosen]).all(axis=1)
    if known.sum() < _FEWEST:
        return correlate(reference, current, xy, settings, start=start)
    part = _about(current, xy, chosen[known], start, settings)
    coarse = correlate(reference, part, xy[chosen], replace(settings, step=spacing), start=start[chosen])
    dense = between(coarse, xy, spacing, settings.order, None if before is None else (before[chosen], before))
    if not np.isfinite(dense).all(axis=1).any():
        return correlate(reference, current, xy, settings, start=start)
    found = correlate(reference, part, xy, settings, start=dense)
    for name in ("prepare", "start", "refine"):
        found.seconds[name] += coarse.seconds[name]
    return found


def between(
    coarse: Correlation, xy: Array, spacing: int, order: int, before: tuple[Array, Array] | None = None
) -> Array:
    """Start values (n, 6), of second order (n, 12), of points xy (n, 2) px among matches on a lattice; NaN far from it.

    coarse : matches of m points whose coordinates are multiples of ``spacing`` px. before : matches (m, 6) and (n, 6)
    in another image, of the lattice and of the points: only what differs from them is taken from neighbours.
    """
    n = len(coarse.xy)
    parts = [coarse.uv, coarse.gradient.reshape(n, 4), *([coarse.curvature.reshape(n, 6)] if order == 2 else [])]
    warps = np.concatenate(parts, axis=1)
    if before is not None:
        warps[:, :6] -= before[0]
    warps = warps[coarse.good]
    if not len(warps):
        return np.full((len(xy), sum(part.shape[1] for part in parts)), np.nan)
    cells = np.rint(coarse.xy[coarse.good] / spacing).astype(np.int64)
    low = np.minimum(cells.min(axis=0), np.floor(xy.min(axis=0) / spacing).astype(np.int64))
    high = np.maximum(cells.max(axis=0), np.floor(xy.max(axis=0) / spacing).astype(np.int64) + 1)
    table = np.full((*(high - low + 1), warps.shape[1]), np.nan)
    table[tuple((cells - low).T)] = warps
    if before is not None:
        table = _continued(table, spacing)
    corner = np.floor(xy / spacing).astype(np.int64)
    share = xy / spacing - corner
    total, weight = np.zeros((len(xy), warps.shape[1])), np.zeros(len(xy))
    for i in (0, 1):
        for j in (0, 1):
            near = (share[:, 0] if i else 1.0 - share[:, 0]) * (share[:, 1] if j else 1.0 - share[:, 1])
            at = corner + np.array([i, j])
            values = table[tuple((at - low).T)]
            offset = xy - at * spacing
            told = values.copy()
            told[:, :2] += 0.5 * (values[:, 2:6].reshape(-1, 2, 2) @ offset[:, :, None])[..., 0]
            near = np.where(np.isfinite(told).all(axis=1), near, 0.0)
            total += near[:, None] * np.nan_to_num(told)
            weight += near
    with np.errstate(invalid="ignore", divide="ignore"):
        told_all = np.where(weight[:, None] > _LEAST_WEIGHT, total / weight[:, None], np.nan)
    if before is not None:
        told_all[:, :6] += before[1]
    return told_all


def _continued(table: Array, spacing: int) -> Array:
    """The table (columns, rows, k) of what has changed at a lattice, continued by a cell where it is NaN: the mean of
    what the cells around expect there by their gradients."""
    padded = np.pad(table, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    columns, rows, _ = table.shape
    total, count = np.zeros(table.shape), np.zeros(table.shape[:2])
    for i, j in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        told = padded[1 + i : 1 + i + columns, 1 + j : 1 + j + rows].copy()
        slope = told[..., 2:6].reshape(columns, rows, 2, 2)
        told[..., :2] -= spacing * (slope[..., 0] * i + slope[..., 1] * j)
        known = np.isfinite(told[..., 0])
        total[known] += told[known]
        count += known
    unknown = np.isnan(table[..., 0]) & (count > 0)
    table[unknown] = total[unknown] / count[unknown][:, None]
    return table


def _about(
    current: Current, xy: Array, known: NDArray[np.int64], start: Array, settings: CorrelationSettings
) -> Current:
    """The current image filtered once, about where an affine fit of the start values puts all points."""
    A = np.concatenate([np.ones((len(known), 1)), xy[known]], axis=1)
    to = xy[known] + start[known, :2]
    fit = np.linalg.lstsq(A, to, rcond=None)[0]
    return current.around(np.concatenate([to, fit[0] + xy @ fit[1:]]), _MARGIN * settings.radius + 32.0)
