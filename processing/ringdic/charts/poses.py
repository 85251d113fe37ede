"""Poses of the cameras at the reference, checked against the matches of all charts and refined where cameras moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.calibration.moved_cameras import CameraMotions, find_moved_cameras, still_cameras
from ringdic.calibration.parameters import LENS, CameraParameters, projection_jacobians
from ringdic.charts.chart import Chart
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import triangulate

_MOST = 3000  # points of each chart that are used
_SIGMA = 0.1  # px, largest standard deviation of a match that is used
_FEATURE_SIGMA = 0.5  # px, of a feature
_FEW = 500  # points that tell how far a pose's uncertainty moves the image
_EXPLAINED = 2.0  # standard deviations of the calibration, within which a shift of an image is no camera's motion
_FLOOR = 0.005  # px, of a match due to errors of the shape that warps are held at


def poses_of_charts(
    cameras: Sequence[Camera],
    charts: Sequence[Chart],
    features: Sequence[tuple[Indices, Pixels]],
    covariance: Floats | None,
) -> CameraMotions:
    """Find which cameras moved between the calibration and the reference, and how.

    cameras : the C cameras. charts : their matches at the reference. features : of cameras without matches, indices of
    two cameras and (2, n, 2) px in their images. covariance : (C, 6, 6) of the calibrated poses, rad and mm; None where
    it is unknown.
    """
    count = len(cameras)
    observed = [_observations(count, chart) for chart in charts if len(chart.cameras) > 1 and len(chart.xy)]
    observed += [_spread(count, between, px, np.full(px.shape, _FEATURE_SIGMA)) for between, px in features]
    if not observed:
        return still_cameras(cameras)
    px, sigma = (np.concatenate(parts, axis=1) for parts in zip(*observed, strict=True))
    try:
        motions = find_moved_cameras(cameras, px, sigma, covariance)
    except ComputationError:  # too few points to say
        return still_cameras(cameras)
    within = covariance is not None and motions.moved.any() and is_within_calibration(motions, px, covariance)
    return still_cameras(cameras) if within else motions


def is_within_calibration(motions: CameraMotions, px: Pixels, covariance: Floats) -> bool:
    """Whether the calibration's own uncertainty explains all motions: no camera need have moved.

    The cameras' points may fix a pose better than the calibration did, above all along a plane. px : (C, n, 2) px, of
    the points. covariance : (C, 6, 6) of the calibrated poses, rad and mm.
    """
    seen: Mask = np.asarray(np.isfinite(px).all(axis=2))
    shared = np.flatnonzero(seen.sum(axis=0) >= 2)
    some = shared[:: max(1, len(shared) // _FEW)]
    xyz = triangulate(motions.cameras, px[:, some])
    for c in np.flatnonzero(motions.moved):
        at = xyz[seen[c, some] & np.isfinite(xyz).all(axis=1)]
        slopes = projection_jacobians(CameraParameters.of(motions.cameras[c]), at)[1][:, :, LENS:]
        variance = np.einsum("nri,ij,nrj->n", slopes, covariance[c], slopes)
        if not len(at) or motions.effect[c] > _EXPLAINED * np.sqrt(variance.mean()):
            return False
    return True


def motions_as_arrays(motions: CameraMotions) -> dict[str, NDArray]:
    """The motions (C, 6), rad and mm, with their figures, as arrays by name, for the output of a task."""
    return {each.name: np.asarray(getattr(motions, each.name)) for each in fields(motions) if each.name != "cameras"}


def motions_from_arrays(cameras: Sequence[Camera], arrays: Mapping[str, NDArray]) -> CameraMotions:
    """The motions (C, 6), rad and mm, with their figures. cameras : as calibrated. arrays : as stored."""
    values: dict[str, Any] = {each.name: arrays[each.name] for each in fields(CameraMotions) if each.name != "cameras"}
    values |= {name: float(arrays[name]) for name in ("scale", "gain")}
    values |= {name: int(arrays[name]) for name in ("contradicting", "used")}
    return CameraMotions(cameras=tuple(cameras), **values)


def _observations(count: int, chart: Chart) -> tuple[Pixels, Pixels]:
    """Pixels and standard deviations (C, k, 2) px of some points of a chart in all of ``count`` cameras, else NaN."""
    every = slice(None, None, max(1, len(chart.xy) // _MOST))
    sigma = np.sqrt(chart.noise[:, every].astype(float) ** 2 + chart.systematic[:, every].astype(float) ** 2)
    sigma = np.hypot(sigma, _FLOOR)
    with np.errstate(invalid="ignore"):
        usable = (sigma < _SIGMA).all(axis=2, keepdims=True)
    return _spread(count, chart.cameras, np.where(usable, chart.px[:, every], np.nan), sigma)


def _spread(count: int, of: Indices, px: Pixels, sigma: Pixels) -> tuple[Pixels, Pixels]:
    """Pixels and standard deviations (m, k, 2) of the cameras with indices ``of`` (m,) as those (C, k, 2) of all."""
    out = np.full((2, count, *px.shape[1:]), np.nan)
    out[0, of], out[1, of] = px, sigma
    return out[0], out[1]
