"""The same scene photographed again and again: what is measured spreads as it says of itself.

A patch of the virtual rig's limb at full scale, three cameras, two steps of its load, the second photographed twice;
rendered once, its noise drawn anew for every repeat. Everything is measured from the images alone, by all cameras
together and by a pair.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import gettempdir

import numpy as np
import pytest
from ringdic.charts.chart import Chart, chart_with_uncertainty
from ringdic.charts.depth_map import DepthImages, measure_depths
from ringdic.charts.images import ChartImages
from ringdic.charts.matching import match_chart
from ringdic.charts.plane_sweep import DepthRange
from ringdic.charts.series import SurfaceSeries, camera_view
from ringdic.charts.surface import ReferenceSurface, reference_surface
from ringdic.charts.tracked_points import tracked_points
from ringdic.charts.tracking import CameraMatches, match_in_two_passes, surface_grid
from ringdic.charts.views import MappedSurface, plan_chart
from ringdic.correlation import CorrelationSettings, prepare_reference
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.results.fields import OPTIONAL_ARRAYS
from ringdic.results.results import Results
from ringdic.results.series import StepCache
from ringdic.settings import Settings
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.render import radiance
from ringdic_node.virtual_rig.rig import paper_rig
from ringdic_node.virtual_rig.scenes import Limb, Specimen
from ringdic_node.virtual_rig.sensor import expose

REPEATS = 6
STEPS = 3
HALF = 65  # px of the patch about its middle
MARGIN = 50  # px about it
CORRELATION = CorrelationSettings(radius=20, step=10)


@dataclass(frozen=True)
class Spread:
    """Spread of one quantity over repeated noise, and what was stated.

    observed, stated : (k,) of each component, root mean squares over the places. ratio : (k,) of the two.
    whole : the ratio over all components. places, repeats : how many of each.
    """

    observed: np.ndarray
    stated: np.ndarray
    places: int
    repeats: int

    @property
    def ratio(self) -> np.ndarray:
        """Observed over stated, of each component. (k,)."""
        return self.observed / self.stated

    @property
    def whole(self) -> float:
        """Observed over stated of all components together."""
        return float(np.sqrt(np.sum(self.observed**2) / np.sum(self.stated**2)))


def spread(values: np.ndarray, sigma: np.ndarray) -> Spread:
    """Compare R ≥ 2 repeats of n places.

    values, sigma : (R, n, k), what was measured and its stated standard deviation. A place that any repeat lost is
    left out. ValueError where none is left.
    """
    values, sigma = np.asarray(values, dtype=float), np.asarray(sigma, dtype=float)
    if values.shape != sigma.shape or values.ndim != 3 or len(values) < 2:
        raise ValueError(
            f"values {values.shape} and deviations {sigma.shape} must both be (repeats, places, components)"
        )
    kept = (np.isfinite(values) & np.isfinite(sigma)).all(axis=(0, 2))
    if not kept.any():
        raise ValueError("no place was measured in every repeat")
    observed = np.sqrt(np.mean(values[:, kept].var(axis=0, ddof=1), axis=0))
    return Spread(observed, np.sqrt(np.mean(sigma[:, kept] ** 2, axis=(0, 1))), int(kept.sum()), len(values))


def shared_places(labels: list[np.ndarray]) -> list[np.ndarray]:
    """Where each of several runs has the places that all of them have.

    labels : for each run (n, m), whole numbers that name a place, such as its camera and its pixel there.
    Returns for each run the indices (k,) of the common places, in one order.
    """
    named = [{tuple(row): k for k, row in enumerate(run.tolist())} for run in labels]
    common = sorted(set(named[0]).intersection(*named[1:]))
    return [np.array([names[place] for place in common], dtype=np.int64) for names in named]


@dataclass(frozen=True)
class Run:
    """What one repeat measured: the surface at the reference and the results of all steps, σ due to noise alone."""

    surface: ReferenceSurface
    results: Results


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
def exposures() -> tuple[list[Camera], DepthRange, list[dict[tuple[int, int], np.ndarray]]]:
    """Cameras, where the surface may be, and for each repeat the images by camera's index and step."""
    limb, rig = Limb(), paper_rig(12, 1.0)
    reach = HALF / 9.3  # mm: so many px a mm there
    theta, z = np.meshgrid(np.linspace(-reach, reach, 5) / 55.0, 120.0 + np.linspace(-reach, reach, 5))
    patch = np.concatenate([limb.position(theta, z, step).reshape(-1, 3) for step in (0, 1)])
    views = [cropped(rig.cameras[k], patch) for k in (11, 0, 1)]
    light = {(k, step): radiance(v, Specimen(limb, step)) for k, v in enumerate(views) for step in (0, 1)}
    light |= {(k, 2): light[k, 1] for k in range(len(views))}
    repeats = [
        {key: expose(image, 1000 * repeat + k) for k, (key, image) in enumerate(light.items())}
        for repeat in range(REPEATS)
    ]
    return [real(v) for v in views], DepthRange.of([real(v) for v in rig.cameras]), repeats


@pytest.fixture(scope="module")
def runs(exposures) -> list[Run]:
    """Of all three cameras, each with a chart of its own."""
    cameras, space, repeats = exposures
    return [measure(cameras, space, grey, {0: (1, 2), 1: (0, 2), 2: (1, 0)}, "best") for grey in repeats]


@pytest.fixture(scope="module")
def pair_runs(exposures) -> list[Run]:
    """Of the first two cameras as the paper's pair: one chart of flat subsets with one partner."""
    cameras, space, repeats = exposures
    return [measure(cameras[:2], space, grey, {0: (1,)}, "paper") for grey in repeats]


def measure(
    cameras: list[Camera], space: DepthRange, grey: dict, partners: dict[int, tuple[int, ...]], method: str
) -> Run:
    curved = method == "best"
    reduced = DepthImages.of(cameras, lambda k: grey[k, 0], CORRELATION)
    others = [tuple(c for c in range(len(cameras)) if c != k) for k in range(len(cameras))]
    maps = [measure_depths(reduced, k, others[k], space, None) for k in range(len(cameras))]
    images = ChartImages(cameras, lambda k: grey[k, 0], CORRELATION)
    charts = []
    surfaces = {k: MappedSurface(cameras[k], depth_map) for k, depth_map in enumerate(maps)}
    for k, seen_by in partners.items():
        plan = plan_chart(k, surfaces, 65.0, seen_by, whole=not curved)
        matches = match_chart(images, k, maps[k], plan, None, curved=curved)
        charts.append(chart_with_uncertainty(images, matches, np.array([maps[c].grey_noise for c in matches.cameras])))
    surface = reference_surface(cameras, charts, CORRELATION.step, 0.05)
    surface = replace(surface, scatter=noise_of_matches(surface, charts))
    later = [tracked(camera, k, surface, grey, curved=curved) for k, camera in enumerate(cameras)]
    ids = [camera.id for camera in cameras]
    series = SurfaceSeries(
        "patch", cameras, list(pairwise(ids)), [ids[k] for k in partners], [str(step) for step in range(STEPS)],
        surface, lambda camera, step: later[camera][step - 1], Settings(method=method), StepCache(Path(gettempdir())),
    )  # fmt: skip
    return Run(surface, joined([series.at(k) for k in range(STEPS)]))


def joined(parts: list[Results]) -> Results:
    """Results of all steps from those of the single ones, without matches in the images."""
    names = ("vertices", "correlation", "sigma_xyz", "status", *OPTIONAL_ARRAYS)
    arrays = {n: np.stack([getattr(p, n)[-1] for p in parts]) for n in names if getattr(parts[0], n) is not None}
    return replace(parts[0], steps=tuple(part.steps[-1] for part in parts), matches=(), **arrays)


def noise_of_matches(surface: ReferenceSurface, charts: list[Chart]) -> np.ndarray:
    """Standard deviations (C, N, 2) px of the surface's matches due to noise alone: other causes do not vary here."""
    out = np.full(surface.px.shape, np.nan)
    for chart in charts:
        row = {tuple(xy): k for k, xy in enumerate(np.rint(chart.xy).astype(int).tolist())}
        vertex = np.flatnonzero(surface.own == chart.cameras[0])
        pixel = np.rint(surface.px[chart.cameras[0], vertex]).astype(int).tolist()
        out[np.ix_(chart.cameras, vertex)] = chart.noise[:, [row[tuple(xy)] for xy in pixel]]
    return np.where(np.isfinite(surface.px), out, np.nan)


def tracked(camera: Camera, k: int, surface: ReferenceSurface, grey: dict, *, curved: bool) -> list[CameraMatches]:
    view = camera_view(camera, k, surface)
    px = np.full((len(surface.xyz), 2), np.nan)
    px[view.vertex] = view.px
    grid = surface_grid(camera.size, CORRELATION.step, [(px, surface.faces.astype(np.int32))])
    reference = prepare_reference(grey[k, 0], grid.region, CORRELATION)
    points = tracked_points(reference, grid.xy, CORRELATION)
    return [
        match_in_two_passes(reference, grey[k, step], points, CORRELATION, curved=curved) for step in range(1, STEPS)
    ]


def named_points(runs: list[Run]) -> list[np.ndarray]:
    """The points that all runs named by the same pixel of the same camera and saw in the same cameras."""
    labels = []
    for run in runs:
        surface = run.surface
        pixel = np.rint(surface.px[surface.own, np.arange(len(surface.xyz))])
        views = (np.isfinite(surface.px[..., 0]) * 2 ** np.arange(len(surface.px))[:, None]).sum(axis=0)
        labels.append(np.column_stack([surface.own, pixel, views]).astype(np.int64))
    return shared_places(labels)


@pytest.fixture(scope="module")
def places(runs: list[Run]) -> list[np.ndarray]:
    return named_points(runs)


def judge(name: str, found: Spread, figures: Callable[[str, str, str], None]) -> None:
    ratios = " ".join(f"{ratio:.2f}" for ratio in found.ratio)
    figures(f"spread / stated over {found.repeats} repeats: {name}", ratios, "0.8 … 1.25")
    assert found.places > 50
    assert (found.ratio > 0.8).all()
    assert (found.ratio < 1.25).all()


def taken(runs: list[Run], places: list[np.ndarray], what: Callable[[Run], np.ndarray]) -> np.ndarray:
    """One array of every run at the common places. (R, n, ...)."""
    return np.array([what(run)[at] for run, at in zip(runs, places, strict=True)])


def common_faces(meshes: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Where each run has the triangles that all have. meshes : faces (M, 3) and places (n,) of the common points."""
    known = []
    for faces, at in meshes:
        common = np.full(faces.max() + 1 + len(at), -1)
        common[at] = np.arange(len(at))
        corners = np.sort(common[faces], axis=1)
        known.append(np.where((corners >= 0).all(axis=1, keepdims=True), corners, -1))
    same = shared_places(known)
    return [at[corners[at, 0] >= 0] for corners, at in zip(known, same, strict=True)]


def test_the_judge_finds_a_true_statement_true_and_a_false_one_false() -> None:
    rng = np.random.default_rng(0)
    sigma = np.broadcast_to(rng.uniform(0.5, 2.0, (400, 2)), (20, 400, 2))
    values = 7.0 + sigma * rng.normal(size=sigma.shape)
    found = spread(values, sigma * np.array([1.0, 2.0]))
    # 7600 degrees of freedom: a standard deviation is known to 0.8 %, a little less well with unlike places.
    np.testing.assert_allclose(found.ratio, [1.0, 0.5], rtol=0.04)
    values[3, 7] = np.nan
    assert spread(values, sigma).places == 399  # a place lost once is left out


def stretches(runs: list[Run], places: list[np.ndarray], *, previous: bool) -> tuple[np.ndarray, np.ndarray]:
    """λ1 and λ2 at step 2 (R, n, 2), and their stated standard deviations, of the triangles that all runs have."""
    meshes = [(run.results.faces, at) for run, at in zip(runs, places, strict=True)]
    values, stated = [], []
    for run, same in zip(runs, common_faces(meshes), strict=True):
        face = run.results.fields(2, previous=previous).face
        values.append(np.column_stack([face["lambda1"], face["lambda2"]])[same])
        stated.append(np.column_stack([face["sigma_lambda1"], face["sigma_lambda2"]])[same])
    return np.array(values), np.array(stated)


def displacements(
    runs: list[Run], places: list[np.ndarray], step: int, *, previous: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (R, n, 3) mm at a step, and their stated standard deviations, of the points that all runs have."""
    values = [run.results.vertices[step] - run.results.reference_positions(step, previous) for run in runs]
    stated = [run.results.fields(step, previous=previous).point["sigma_displacement"] for run in runs]
    return tuple(np.array([one[at] for one, at in zip(each, places, strict=True)]) for each in (values, stated))  # type: ignore[return-value]


def test_reference_positions_spread_as_stated(runs, places, figures) -> None:
    values = taken(runs, places, lambda run: run.surface.xyz)
    judge("X, between cameras", spread(values, taken(runs, places, lambda run: run.results.sigma_xyz[0])), figures)


def test_positions_of_a_step_spread_as_stated(runs, places, figures) -> None:
    values = taken(runs, places, lambda run: run.results.vertices[1])
    judge("X, at a later step", spread(values, taken(runs, places, lambda run: run.results.sigma_xyz[1])), figures)


STEPS_APART = [(1, False), (2, False), (2, True)]


@pytest.mark.parametrize(("step", "previous"), STEPS_APART)
def test_displacements_spread_as_stated(runs, places, figures, step: int, previous: bool) -> None:
    found = spread(*displacements(runs, places, step, previous=previous))
    judge(f"displacement {step - 1 if previous else 0} → {step}", found, figures)


def test_stretches_spread_as_stated(runs, places, figures) -> None:
    judge("λ1, λ2", spread(*stretches(runs, places, previous=False)), figures)


@pytest.fixture(scope="module")
def pixels(pair_runs: list[Run]) -> list[np.ndarray]:
    return named_points(pair_runs)


@pytest.mark.parametrize(("step", "previous"), STEPS_APART)
def test_displacements_of_a_pair_spread_as_stated(pair_runs, pixels, figures, step: int, previous: bool) -> None:
    found = spread(*displacements(pair_runs, pixels, step, previous=previous))
    judge(f"pair, displacement {step - 1 if previous else 0} → {step}", found, figures)


@pytest.mark.parametrize("previous", [False, True])
def test_stretches_of_a_pair_spread_as_stated(pair_runs, pixels, figures, previous: bool) -> None:
    # From step 1 to 2 nothing moves: the order of λ1 and λ2 sorts the noise, which takes some 15 % of its spread, and
    # both have one stated deviation. Their sum feels no order.
    values, stated = stretches(pair_runs, pixels, previous=previous)
    if previous:
        values, stated = values.sum(axis=2, keepdims=True), np.linalg.norm(stated, axis=2, keepdims=True)
    judge("pair, λ1 + λ2 1 → 2" if previous else "pair, λ1, λ2 0 → 2", spread(values, stated), figures)


def test_chi_square_of_good_points_is_about_one(runs, places, figures) -> None:
    reference = taken(runs, places, lambda run: run.surface.chi2), taken(runs, places, lambda run: run.surface.degrees)
    each = float(np.nansum(reference[0]) / np.sum(reference[1]))
    in_time = float(np.nanmean(taken(runs, places, lambda run: run.results.chi2[1])))
    # In time the views are weighted by their noise alone; interpolation between the points of the cameras' grids and of
    # the grey levels, the same in every repeat, adds about as much.
    for name, value, most in (("between cameras", each, 1.6), ("in time", in_time, 2.5)):
        figures(f"χ² a degree of freedom, {name}", f"{value:.2f}", f"0.4 … {most}")
        assert 0.4 < value < most
