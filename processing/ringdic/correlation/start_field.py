"""Start values of all points of a grid, interpolated from the matches of a coarse lattice of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ringdic.arrays import Floats, Mask, Pixels
from ringdic.correlation import CorrelationSettings, Current, PointMatches, Reference, correlate_points
from ringdic.correlation.lattice_field import COMPLETE, interpolate_lattice

_FEWEST = 8  # start values from which an affine fit extrapolates where all points lie


def lattice_spacing(settings: CorrelationSettings, radii: float = 2.0) -> int:
    """Spacing of a coarse lattice, in px: the multiple of the grid step nearest to a number of subset radii."""
    return settings.step * max(1, round(radii * settings.radius / settings.step))


def on_lattice(xy: Pixels, spacing: int) -> Mask:
    """Whether the coordinates of points are multiples of a lattice's spacing.

    xy : (n, 2) float64, px. spacing : px. Returns (n,) bool.
    """
    return np.asarray((np.mod(xy, spacing) == 0).all(axis=1))


def match_from_lattice(
    reference: Reference,
    current: Current,
    xy: Pixels,
    settings: CorrelationSettings,
    start: Floats,
    spacing: int,
) -> PointMatches:
    """Match all points of a grid, with start values interpolated from the matches of a coarse lattice.

    Parameters
    ----------
    reference, current : the images.
    xy : (n, 2) float64, px, points of the reference image.
    start : (n, 6) float64, u v ux uy vx vy (u, v in px), start values of lattice points; NaN where unknown.
    spacing : px, of the lattice, a multiple of the grid step.

    The lattice points are matched from the given start values and interpolated to start values of the others. With
    fewer than eight start values, or no match on the lattice, all points are matched as ``correlate_points`` does.
    """
    lattice = np.flatnonzero(on_lattice(xy, spacing))
    known = np.isfinite(start[lattice]).all(axis=1)
    if known.sum() < _FEWEST:
        return correlate_points(reference, current, xy, settings, start=start)
    at = xy[lattice[known]]
    part = current.crop_by_affine_fit(at, at + start[lattice[known], :2], xy, settings.radius)
    coarse = correlate_points(
        reference, part, xy[lattice], replace(settings, step=spacing), start=start[lattice], prefer_neighbour=True
    )
    dense = interpolate_start_values(coarse, xy, spacing, settings.order)
    if not np.isfinite(dense).all(axis=1).any():
        return correlate_points(reference, current, xy, settings, start=start)
    matches = correlate_points(reference, part, xy, settings, start=dense)
    for name in ("prepare", "start", "refine"):
        matches.seconds[name] += coarse.seconds[name]
    return matches


def interpolate_start_values(coarse: PointMatches, xy: Pixels, spacing: int, order: int) -> Floats:
    """Start values of points between matches on a lattice.

    Parameters
    ----------
    coarse : matches of m points whose coordinates are multiples of ``spacing`` px.
    xy : (n, 2) float64, px, points to find start values for.
    order : of the shape functions; 2 adds the second derivatives.

    Returns
    -------
    start : (n, 6) or, for order 2, (n, 12), px and derivatives; NaN unless all lattice points about a point are
        matched.
    """
    n = len(coarse.xy)
    parts = [coarse.uv, coarse.gradient.reshape(n, 4), *([coarse.curvature.reshape(n, 6)] if order == 2 else [])]
    start, weight = interpolate_lattice(coarse.xy[coarse.good], np.concatenate(parts, axis=1)[coarse.good], spacing, xy)
    start[weight <= COMPLETE] = np.nan  # these points are reached by propagation from their neighbours
    return start
