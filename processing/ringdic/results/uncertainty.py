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
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Indices
from ringdic.calibration.bundle import BundleFit
from ringdic.calibration.parameters import PER_CAMERA
from ringdic.geometry.camera import Camera
from ringdic.results.results import Matches, Results
from ringdic.results.series import InMemory, join_steps
from ringdic.settings import settings_of_run
from ringdic.strain.deformation import Deformation
from ringdic.uncertainty.calibration import (
    CameraCovariance,
    Shares,
    shares,
    sigma_of,
    stretch_sigma_by_cameras,
)
from ringdic.uncertainty.position import covariance, position_gain
from ringdic.uncertainty.strain import corners_alike, stretch_sigma

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


def add_uncertainty(results: Results, known: CameraCovariance | None) -> Results:
    """The same results with every standard deviation that can be stated of them.

    known : of the cameras; None where nothing is: then nothing is stated of what the calibration adds.
    """
    series = InMemory(results)
    stated = StepUncertainty(series.reference, known, series.noise)
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        parts = pool.map(lambda k: stated.of(series.at(k), k), range(len(results.steps)))
        return join_steps(list(parts))


class StepUncertainty:
    """What can be stated of the uncertainty of a run's results, a step at a time.

    reference : the results of the reference alone. known : of the cameras, None where nothing is. noise : of `Series`.
    """

    def __init__(self, reference: Results, known: CameraCovariance | None, noise: Sequence[Floats]) -> None:
        pairwise = any(len(matches.cameras) == 2 for matches in reference.matches)
        scattered = pairwise and reference.sigma_displacement is None
        self._scatter = _Scatter(reference, noise) if scattered else None
        self._calibration = None if known is None else _ByCalibration(reference, known, followed=not pairwise)

    def of(self, results: Results, step: int, found: Deformation | None = None) -> Results:
        """The same results of a step, see `Series`, completed. found : its deformation, where it is known."""
        last = len(results.steps) - 1
        found = results.deformation(last) if found is None else found
        added: dict[str, Any] = {}
        if self._scatter is not None:
            added |= self._scatter.of(results, step, found)
        if self._calibration is not None:
            added |= self._calibration.of(results, found)
        return replace(results, **added)


class _ByCalibration:
    """What the uncertain cameras add. followed : cameras followed the points from the projection of the reference."""

    def __init__(self, reference: Results, known: CameraCovariance, followed: bool) -> None:
        self._known, self._followed = known, followed
        places = reference.vertices_ref
        self._at_first: Shares = shares(reference.cameras, places, _gain(reference, 0), known)
        self._position = sigma_of(self._at_first)

    def of(self, results: Results, found: Deformation) -> dict[str, Floats]:
        """The standard deviations at the reference and at the step of some results, by their names."""
        N, M = len(results.vertices_ref), len(results.faces)
        rows = [(self._position, np.zeros((N, 3)), np.zeros((M, 2)))]
        if len(results.steps) > 1:
            anchor = (results.vertices_ref, self._at_first) if self._followed else None
            now = shares(results.cameras, results.vertices[1], _gain(results, 1), self._known, anchor)
            stretches = stretch_sigma_by_cameras(found, results.vertices_ref, results.faces, self._at_first, now)
            rows.append((sigma_of(now), sigma_of(now - self._at_first), stretches))
        names = ("sigma_calibration", "sigma_displacement_calibration", "sigma_lambda_calibration")
        return {name: np.stack(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}


def _gain(results: Results, step: int) -> Floats:
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

    gain : (4, N, 3, 2) mm a px. sigma : (4, N, 2) px.
    """

    gain: Floats
    sigma: Floats


class _Scatter:
    """Standard deviations of displacements and stretches of camera pairs over repeated noise.

    noise : of each pair (F, 2) px, see `Series`. What a camera's own images leave over in the quietest step is noise;
    motion and light add to the others.
    """

    def __init__(self, reference: Results, noise: Sequence[Floats]) -> None:
        self._shares = [_share_of_noise(level) for level in noise]
        correlation = settings_of_run(reference.settings).correlation
        cameras = {camera.id: camera for camera in reference.cameras}
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            self._pairs = list(pool.map(partial(_Pair.of, reference, cameras), range(len(reference.matches))))
        px = np.full((2, len(reference.vertices_ref), 2), np.nan)
        for pair in self._pairs:
            px[:, pair.vertex[pair.held]] = pair.px
        alike = corners_alike(px, reference.faces, correlation.radius_px, correlation.order)
        self._alike = np.concatenate([alike, alike])

    def of(self, results: Results, step: int, found: Deformation) -> dict[str, Floats]:
        """The standard deviations at the reference and at the step of some results, by their names."""
        N = len(results.vertices_ref)
        displacement, stretches = [np.zeros((N, 3))], [np.zeros((len(results.faces), 2))]
        if len(results.steps) > 1:
            parts = _Sources(np.zeros((4, N, 3, 2)), np.full((4, N, 2), np.nan))
            for pair, matches, shares_of in zip(self._pairs, results.matches, self._shares, strict=True):
                _fill(parts, results.vertices[1], pair, matches, shares_of[step])
            one = np.sqrt(np.einsum("nii->ni", covariance(parts.gain, parts.sigma)))
            two = stretch_sigma(found, results.vertices_ref, results.faces, parts.gain, self._alike, parts.sigma)
            one[~np.isfinite(results.vertices[1]).all(axis=1)] = np.nan
            two[~np.isfinite(found.J)] = np.nan
            displacement.append(one)
            stretches.append(two)
        return {"sigma_displacement": np.stack(displacement), "sigma_lambda": np.stack(stretches)}


@dataclass(frozen=True)
class _Pair:
    """What the steps of a pair have in common.

    cameras : of n points. vertex : (n,), -1 where one has none. held : (k,) rows of those that have one, and px
    (2, k, 2) their places in the reference images, apart from other pairs'. gain : (2, k, 3, 2) mm a px at the
    reference.
    """

    cameras: tuple[Camera, ...]
    vertex: Indices
    held: Indices
    px: Floats
    gain: Floats

    @classmethod
    def of(cls, results: Results, cameras: Mapping[str, Camera], k: int) -> _Pair:
        """Of the k-th matches of the results of the reference."""
        matches = results.matches[k]
        own = tuple(cameras[id_] for id_ in matches.cameras)
        held = np.flatnonzero(matches.vertex >= 0)
        gain = position_gain(own, results.vertices_ref[matches.vertex[held]], np.ones((2, len(held), 2)))
        px = matches.px[0][:, held] + np.array([[2 * k * _APART, 0.0], [(2 * k + 1) * _APART, 0.0]])[:, None]
        return cls(own, matches.vertex, held, px, gain)


def _share_of_noise(level: Floats) -> Floats:
    """Of what each step's matches state, (F, 2) px, the share that is noise, (F, 2); NaN where nothing is stated."""
    later = level.copy()
    later[0] = np.nan  # the grid itself, or the match between the cameras
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.fmin.reduce(later, axis=0) / later)


def _fill(parts: _Sources, xyz: Floats, pair: _Pair, matches: Matches, share: Floats) -> None:
    """Add the points of one pair. xyz : (N, 3) mm at the step. share : (2,) of what is stated, that is noise."""
    noise = matches.sigma[1][:, pair.held] / np.sqrt(_BOTH) * share[:, None, None]
    usable = (matches.status[1, pair.held] == 0) & np.isfinite(noise).all(axis=(0, 2))
    noise, who = noise[:, usable], pair.vertex[pair.held[usable]]
    now = position_gain(pair.cameras, xyz[who], np.ones((2, len(who), 2)))
    parts.gain[:, who] = np.concatenate([now[:1], pair.gain[1:, usable], now])
    parts.sigma[:, who] = np.concatenate([noise, noise])
