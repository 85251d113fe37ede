"""Start values for every point of a grid from matches of a few of them, a subset apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ringdic.arrays import Floats, Mask
from ringdic.correlation import Correlation, CorrelationSettings, Current, Reference, correlate_points
from ringdic.correlation.lattice_field import ALL, between_corners

_FEWEST = 8  # matches of which an affine fit says where the others lie


def lattice_spacing(settings: CorrelationSettings, radii: float = 2.0) -> int:
    """A multiple of the grid's step near so many subset radii, px."""
    return settings.step * max(1, round(radii * settings.radius / settings.step))


def on_lattice(xy: Floats, spacing: int) -> Mask:
    """Points (n,) whose coordinates are multiples of ``spacing`` px."""
    return np.asarray((np.mod(xy, spacing) == 0).all(axis=1))


def match_from_lattice(
    reference: Reference,
    current: Current,
    xy: Floats,
    settings: CorrelationSettings,
    start: Floats,
    spacing: int,
) -> Correlation:
    """Matches of points xy (n, 2) px from start values (n, 6) of some of those ``spacing`` px apart, NaN elsewhere."""
    chosen = np.flatnonzero(on_lattice(xy, spacing))
    known = np.isfinite(start[chosen]).all(axis=1)
    if known.sum() < _FEWEST:
        return correlate_points(reference, current, xy, settings, start=start)
    at = xy[chosen[known]]
    part = current.about_all(at, at + start[chosen[known], :2], xy, settings.radius)
    coarse = correlate_points(
        reference, part, xy[chosen], replace(settings, step=spacing), start=start[chosen], follow=True
    )
    dense = between(coarse, xy, spacing, settings.order)
    if not np.isfinite(dense).all(axis=1).any():
        return correlate_points(reference, current, xy, settings, start=start)
    found = correlate_points(reference, part, xy, settings, start=dense)
    for name in ("prepare", "start", "refine"):
        found.seconds[name] += coarse.seconds[name]
    return found


def between(coarse: Correlation, xy: Floats, spacing: int, order: int) -> Floats:
    """Start values (n, 6), of second order (n, 12), of points xy (n, 2) px among matches on a lattice; NaN far from it.

    coarse : matches of m points whose coordinates are multiples of ``spacing`` px.
    """
    n = len(coarse.xy)
    parts = [coarse.uv, coarse.gradient.reshape(n, 4), *([coarse.curvature.reshape(n, 6)] if order == 2 else [])]
    start, weight = between_corners(coarse.xy[coarse.good], np.concatenate(parts, axis=1)[coarse.good], spacing, xy)
    start[weight <= ALL] = np.nan  # other points are reached from their neighbours
    return start
