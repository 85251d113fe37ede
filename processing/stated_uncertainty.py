"""What the results of a run say of their own uncertainty, completed from the matches that they rest on.

Two parts that never mix: the noise of the images, which another exposure would draw anew, and the calibration, which
all points and steps share. Of the global way the first is known before; of camera pairs it is found here.

Each camera of a pair is followed in its own images. With δ what noise makes of a subset in the reference image and ε of
the same in a later one, the displacement is off by ``A₁ (ε₁ - δ₁) + A₂ ε₂ - A₂⁰ δ₂``. The second camera's place rests
on the match between the cameras too: it was found with δ₂ in the reference image and is followed from there, so of δ₂
the reference position alone holds a part; and what else that match is off by moves along with the point.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from processing.calibration.bundle import BundleFit
from processing.calibration.parameters import PER_CAMERA
from processing.camera import Camera
from processing.results import Matches, Results
from processing.uncertainty.calibration import (
    CameraCovariance,
    Shares,
    shares,
    sigma_of,
    stretch_sigma_by_cameras,
)
from processing.uncertainty.position import covariance, position_gain
from processing.uncertainty.strain import stretch_sigma

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# The square of a stated deviation counts the noise of the reference and what the interpolation leaves of the other's.
_BOTH = 1.85
# Places in the reference images of different pairs are this far apart, px: their subsets have nothing in common.
_APART = 1e6


def camera_covariance(fit: BundleFit | None) -> CameraCovariance | None:
    """What a bundle adjustment knows of the cameras; None where each camera was calibrated alone."""
    if fit is None:
        return None
    size = PER_CAMERA * len(fit.cameras)
    return CameraCovariance(fit.cameras, fit.covariance[:size, :size])


def with_uncertainty(results: Results, known: CameraCovariance | None) -> Results:
    """The same results with every standard deviation that can be stated of them.

    known : of the cameras; None where nothing is: then nothing is stated of what the calibration adds.
    """
    pairwise = any(len(matches.cameras) == 2 for matches in results.matches)
    if pairwise and results.sigma_displacement is None:
        results = _with_scatter(results)
    return results if known is None else _with_calibration(results, known, followed=not pairwise)


def _with_calibration(results: Results, known: CameraCovariance, followed: bool) -> Results:
    """What the uncertain cameras add. followed : cameras followed the points from the projection of the reference."""
    F, N, M = len(results.steps), len(results.vertices_ref), len(results.faces)
    position, displacement = np.full((F, N, 3), np.nan), np.full((F, N, 3), np.nan)
    stretches = np.full((F, M, 2), np.nan)
    at_first: Shares = shares(results.cameras, results.vertices_ref, _gain(results, 0), known)
    position[0], displacement[0], stretches[0] = sigma_of(at_first), 0.0, 0.0
    for step in range(1, F):
        anchor = (results.vertices_ref, at_first) if followed else None
        now = shares(results.cameras, results.vertices[step], _gain(results, step), known, anchor)
        position[step], displacement[step] = sigma_of(now), sigma_of(now - at_first)
        found = results.deformation(step)
        stretches[step] = stretch_sigma_by_cameras(found, results.vertices_ref, results.faces, at_first, now)
    return replace(
        results,
        sigma_calibration=position,
        sigma_displacement_calibration=displacement,
        sigma_lambda_calibration=stretches,
    )


def _gain(results: Results, step: int) -> Array:
    """How the points of a step move with each pixel of each camera, (C, N, 3, 2) mm a px."""
    index = {camera.id: k for k, camera in enumerate(results.cameras)}
    sigma = np.full((len(results.cameras), len(results.vertices_ref), 2), np.nan)
    for matches in results.matches:
        used = (matches.vertex >= 0) & (matches.status[step] == 0)
        for view, id_ in enumerate(matches.cameras):
            # A pair's points are triangulated with all pixels alike.
            alike = 1.0 if len(matches.cameras) == 2 else matches.sigma[step, view, used]
            sigma[index[id_], matches.vertex[used]] = alike
    return position_gain(results.cameras, results.vertices[step], sigma)


@dataclass(frozen=True)
class _Sources:
    """Independent errors: of a pair's two reference images, and of the step's two images.

    gain : (4, N, 3, 2) mm a px. px : (4, N, 2) places in the reference images. sigma : (4, N, 2) px.
    """

    gain: Array
    px: Array
    sigma: Array


def _with_scatter(results: Results) -> Results:
    """Standard deviations of displacements and stretches of camera pairs over repeated noise."""
    F, N, M = len(results.steps), len(results.vertices_ref), len(results.faces)
    displacement, stretches = np.full((F, N, 3), np.nan), np.full((F, M, 2), np.nan)
    displacement[0], stretches[0] = 0.0, 0.0
    group = tomllib.loads(results.settings).get("correlation", {})
    radius, order = int(group.get("radius_px", 20)), int(group.get("order", 1))
    cameras = {camera.id: camera for camera in results.cameras}
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        pairs = list(pool.map(partial(_Pair.of, results, cameras), range(len(results.matches))))
        px = np.full((2, N, 2), np.nan)
        for pair in pairs:
            px[:, pair.matches.vertex[pair.held]] = pair.px
        found = pool.map(partial(_step_scatter, results, pairs, px, radius, order), range(1, F))
        for step, (one, two) in enumerate(found, start=1):
            displacement[step], stretches[step] = one, two
    return replace(results, sigma_displacement=displacement, sigma_lambda=stretches)


@dataclass(frozen=True)
class _Pair:
    """What the steps of a pair have in common.

    cameras, matches : n points. held : rows of those that have a vertex, and px (2, k, 2) their places in the reference
    images, apart from other pairs'. noise : (2, F, n, 2) px. gain : (2, k, 3, 2) mm a px at the reference.
    """

    cameras: tuple[Camera, ...]
    matches: Matches
    held: Ints
    px: Array
    noise: Array
    gain: Array

    @classmethod
    def of(cls, results: Results, cameras: Mapping[str, Camera], k: int) -> _Pair:
        """Of the k-th matches of some results."""
        matches = results.matches[k]
        own = tuple(cameras[id_] for id_ in matches.cameras)
        held = np.flatnonzero(matches.vertex >= 0)
        gain = position_gain(own, results.vertices_ref[matches.vertex[held]], np.ones((2, len(held), 2)))
        px = matches.px[0][:, held] + np.array([[2 * k * _APART, 0.0], [(2 * k + 1) * _APART, 0.0]])[:, None]
        noise = np.stack([_noise_in_time(matches, camera) for camera in (0, 1)])
        return cls(own, matches, held, px, noise, gain)


def _step_scatter(
    results: Results, pairs: Sequence[_Pair], px: Array, radius: int, order: int, step: int
) -> tuple[Array, Array]:
    """Standard deviations of a step's displacements (N, 3) mm and stretches (M, 2). px : (2, N, 2)."""
    N = len(results.vertices_ref)
    parts = _Sources(np.zeros((4, N, 3, 2)), np.concatenate([px, px]), np.full((4, N, 2), np.nan))
    for pair in pairs:
        _fill(parts, results, pair, step)
    found = results.deformation(step)
    displacement = np.sqrt(np.einsum("nii->ni", covariance(parts.gain, parts.sigma)))
    stretches = stretch_sigma(
        found, results.vertices_ref, results.faces, parts.gain, parts.px, parts.sigma, radius, order
    )
    displacement[~np.isfinite(results.vertices[step]).all(axis=1)] = np.nan
    stretches[~np.isfinite(found.J)] = np.nan
    return displacement, stretches


def _noise_in_time(matches: Matches, camera: int) -> Array:
    """Standard deviations (F, n, 2) px of one subset's place by the noise of one image, NaN where there is no match.

    What a camera's own images leave over in the quietest step is noise; motion and light add to the others.
    """
    stated = np.where((matches.status == 0)[..., None], matches.sigma[:, camera], np.nan) / np.sqrt(_BOTH)
    level = np.array([np.nanmedian(one) if np.isfinite(one).any() else np.nan for one in stated])
    level[0] = np.nan  # the grid itself, or the match between the cameras
    with np.errstate(invalid="ignore"):
        share = np.nanmin(level) / level if np.isfinite(level).any() else level
    return np.asarray(stated * share[:, None, None])


def _fill(parts: _Sources, results: Results, pair: _Pair, step: int) -> None:
    """Add the points of one pair."""
    matches, noise = pair.matches, pair.noise[:, step]
    usable = (matches.status[step, pair.held] == 0) & np.isfinite(noise[:, pair.held]).all(axis=(0, 2))
    used = pair.held[usable]
    who = matches.vertex[used]
    now = position_gain(pair.cameras, results.vertices[step, who], np.ones((2, len(used), 2)))
    parts.gain[:, who] = np.concatenate([now[:1], pair.gain[1:, usable], now])
    parts.sigma[:, who] = np.concatenate([noise[:, used], noise[:, used]])
