"""The same scene photographed again and again: what is measured spreads as it says of itself.

A patch of the virtual rig's limb at full scale, three cameras, two steps of its load; rendered once, its noise drawn
anew for every repeat. Everything is measured from the images alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from node_agent.virtual_rig.lens import VirtualCamera
from node_agent.virtual_rig.render import radiance
from node_agent.virtual_rig.rig import paper_rig
from node_agent.virtual_rig.scenes import Limb, Specimen
from node_agent.virtual_rig.sensor import expose
from processing.camera import Camera, Intrinsics
from processing.correlation import CorrelationSettings
from processing.deformation import deformation
from processing.multiview.certainty import Certainty, certainty
from processing.multiview.motion import Motion, measure_motion
from processing.multiview.shape import ReferenceShape, reference_shape
from processing.multiview.tracking import Tracking
from processing.sweep import Search
from processing.uncertainty.repeated import Spread, shared_places, spread

REPEATS = 6
HALF = 65  # px of the patch about its middle
MARGIN = 50  # px about it
CORRELATION = CorrelationSettings(radius=20, step=10)


@dataclass(frozen=True)
class Run:
    shape: ReferenceShape
    motion: Motion
    sure: Certainty


def real(camera: VirtualCamera) -> Camera:
    lens = Intrinsics(camera.K, camera.distortion, (camera.width, camera.height))
    P = lens.K_undistorted @ np.column_stack([camera.R, camera.t])
    return Camera(camera.id, P / P[2, 3], lens.size, lens)


def cropped(camera: VirtualCamera, xyz: np.ndarray) -> VirtualCamera:
    """The part of a camera's image that shows some points."""
    px = camera.project(xyz)
    low, high = np.floor(px.min(axis=0)) - MARGIN, np.ceil(px.max(axis=0)) + MARGIN
    K = camera.K.copy()
    K[:2, 2] -= low
    width, height = (high - low + 1).astype(int)
    return replace(camera, K=K, width=int(width), height=int(height))


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    limb, rig = Limb(), paper_rig(12, 1.0)
    reach = HALF / 9.3  # mm: so many px a mm there
    theta, z = np.meshgrid(np.linspace(-reach, reach, 5) / 55.0, 120.0 + np.linspace(-reach, reach, 5))
    patch = np.concatenate([limb.position(theta, z, step).reshape(-1, 3) for step in (0, 1)])
    views = [cropped(rig.cameras[k], patch) for k in (11, 0, 1)]
    light = {(v.id, step): radiance(v, Specimen(limb, step)) for v in views for step in (0, 1)}
    return [measure([real(v) for v in views], exposed(light, repeat)) for repeat in range(REPEATS)]


def exposed(light: dict, repeat: int) -> Callable[[str, int], np.ndarray]:
    seeds = {key: 1000 * repeat + k for k, key in enumerate(light)}
    grey = {key: expose(image, seeds[key]) for key, image in light.items()}
    return lambda id_, step: grey[id_, step]


def measure(cameras: list[Camera], image: Callable[[str, int], np.ndarray]) -> Run:
    search = Search(radius=55.0, reach=6.0, incidence=65.0)
    shape = reference_shape(cameras, lambda id_: image(id_, 0), {}, [(0, 1), (1, 2)], search, CORRELATION)
    motion = measure_motion(cameras, shape, image, 2, {}, CORRELATION, Tracking(), 0.05)
    return Run(shape, motion, certainty(cameras, shape, motion, CORRELATION.radius, 1))


@pytest.fixture(scope="module")
def places(runs: list[Run]) -> list[np.ndarray]:
    """The points that all runs named by the same pixel of the same camera and saw in the same cameras."""
    labels = []
    for run in runs:
        shape = run.shape
        pixel = np.rint(shape.px[shape.reference, np.arange(len(shape.xyz))])
        views = (np.isfinite(shape.px[..., 0]) * 2 ** np.arange(len(shape.px))[:, None]).sum(axis=0)
        labels.append(np.column_stack([shape.node, shape.reference, pixel, views]).astype(np.int64))
    return shared_places(labels)


def judge(name: str, found: Spread, figures: Callable[[str, str, str], None]) -> None:
    ratios = " ".join(f"{ratio:.2f}" for ratio in found.ratio)
    figures(f"spread / stated over {found.repeats} repeats: {name}", ratios, "0.8 … 1.25")
    assert found.places > 50
    assert (found.ratio > 0.8).all()
    assert (found.ratio < 1.25).all()


def taken(runs: list[Run], places: list[np.ndarray], what: Callable[[Run], np.ndarray]) -> np.ndarray:
    """One array of every run at the common places. (R, n, ...)."""
    return np.array([what(run)[at] for run, at in zip(runs, places, strict=True)])


def test_reference_positions_spread_as_stated(runs, places, figures) -> None:
    values = taken(runs, places, lambda run: run.shape.xyz)
    judge("X, between cameras", spread(values, taken(runs, places, lambda run: run.sure.position[0])), figures)


def test_positions_of_a_step_spread_as_stated(runs, places, figures) -> None:
    values = taken(runs, places, lambda run: run.motion.xyz[1])
    judge("X, at a later step", spread(values, taken(runs, places, lambda run: run.sure.position[1])), figures)


def test_displacements_spread_as_stated(runs, places, figures) -> None:
    values = taken(runs, places, lambda run: run.motion.xyz[1] - run.shape.xyz)
    judge("displacement", spread(values, taken(runs, places, lambda run: run.sure.displacement[1])), figures)


def test_stretches_spread_as_stated(runs, places, figures) -> None:
    faces = []
    for run, at in zip(runs, places, strict=True):
        common = np.full(len(run.shape.xyz), -1)
        common[at] = np.arange(len(at))
        faces.append(np.sort(common[run.shape.faces], axis=1))
    known = [np.where((corners >= 0).all(axis=1, keepdims=True), corners, -1) for corners in faces]
    same = shared_places(known)
    values, stated = [], []
    for run, corners, at in zip(runs, known, same, strict=True):
        at = at[corners[at, 0] >= 0]
        found = deformation(run.shape.xyz, run.motion.xyz[1], run.shape.faces)
        values.append(np.column_stack([found.lambda1, found.lambda2])[at])
        stated.append(run.sure.stretches[1, at])
    judge("λ1, λ2", spread(values, stated), figures)


def test_chi_square_of_good_points_is_about_one(runs, places, figures) -> None:
    for name, chi2, degrees in (
        ("between cameras", lambda run: run.shape.chi2, lambda run: run.shape.degrees),
        ("in time", lambda run: run.motion.chi2[1], lambda run: run.motion.degrees[1]),
    ):
        each = float(np.nansum(taken(runs, places, chi2)) / np.sum(taken(runs, places, degrees)))
        figures(f"χ² a degree of freedom, {name}", f"{each:.2f}", "0.4 … 1.6")
        assert 0.4 < each < 1.6
