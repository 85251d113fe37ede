"""Tasks of the measurement by all cameras: depth maps, charts, the surface, then each camera's image of each step.

The steps of a camera are independent of one another, as each is matched from the reference. So one more capture, or
the newest step alone, leaves the outputs of all other steps valid.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Indices, Mask, Points
from ringdic.calibration.moved_cameras import CameraMotions, still_cameras
from ringdic.charts.body_motion import SeenBody, SurfaceFrames
from ringdic.charts.chart import Chart, chart_with_uncertainty
from ringdic.charts.depth_map import DepthMap, depths_at_fitting_size
from ringdic.charts.evidence import why_unmatched
from ringdic.charts.exchanged import ConfusedImages
from ringdic.charts.image_findings import RunImages, coarse_speckle
from ringdic.charts.image_state import ImageState, image_state, pixel_digest
from ringdic.charts.images import ChartImages
from ringdic.charts.matching import drop_masked, match_chart
from ringdic.charts.patches import Patches
from ringdic.charts.plane_sweep import DepthRange
from ringdic.charts.poses import motions_as_arrays, motions_from_arrays, poses_of_charts
from ringdic.charts.reference_state import REFERENCE_STATE, ReferenceState
from ringdic.charts.surface import reference_surface
from ringdic.charts.tracked_points import TrackedPoints, tracked_points
from ringdic.charts.tracking import CameraMatches, match_in_two_passes, surface_grid
from ringdic.charts.unmeasured import arrays_of_places, unmeasured_places
from ringdic.charts.views import MappedSurface, plan_chart
from ringdic.compiled import source_digest
from ringdic.correlation import CorrelationSettings, Reference, prepare_reference, reference_bytes
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.session.folder import Capture, Session
from ringdic.session.images import read_mask
from ringdic.settings import Settings, SurfaceGroup
from ringdic.tasks import Arrays, Task, digest, process_memory, read_output, work_folder
from ringdic.tasks.step_images import Digests, step_image

_WIDEST = 72.0  # degrees between the views of two cameras that are matched with one another
_MOST = 2  # cameras, those with the most similar views, that a depth map is measured with
_CHART_COST = 2.0  # of a depth map and of a chart, in units of one camera's step
_LOOSER = 4.0  # tolerance of matches between cameras, in units of that between steps: a tenth of their noise remains
_MATCHES = ("xy", "uv", "gradient", "curvature", "sigma", "c_ls", "status")


@dataclass(frozen=True)
class RigViews:
    """Cameras of a rig by the similarity of their views.

    cameras : C calibrated cameras. space : where the surface may be. partners : for each camera the indices of those
    whose views are similar enough to be matched, the most similar first.
    """

    cameras: tuple[Camera, ...]
    space: DepthRange
    partners: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> RigViews:
        """The views of calibrated cameras, about the point nearest to all optical axes."""
        space = DepthRange.of(cameras)
        towards = np.stack([camera.centre - space.centre for camera in cameras])
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip(towards @ towards.T, -1, 1)))
        partners = []
        for k, row in enumerate(angle):
            order = [int(c) for c in np.argsort(row, kind="stable") if c != k and row[c] < _WIDEST]
            partners.append(tuple(order))
        return cls(tuple(cameras), space, tuple(partners))


@dataclass(frozen=True)
class ChartsJob:
    """Tasks of a measurement by all cameras: depth maps, charts, the surface, and for each camera its later steps.

    cameras : as calibrated. views : of the cameras as they stood at the reference.
    names : of the charts: of their camera, or of their pair of cameras.
    """

    cameras: tuple[Camera, ...]
    views: RigViews
    names: tuple[str, ...]
    maps: tuple[Task, ...]
    charts: tuple[Task, ...]
    poses: Task | None
    surface: Task
    steps: tuple[tuple[Task | None, ...], ...]

    @property
    def tasks(self) -> list[Task]:
        """All tasks in order, camera by camera, so that a reference image is prepared once for all its steps."""
        return [*self.at_reference, *self.later]

    @property
    def at_reference(self) -> list[Task]:
        """The tasks before the surface: depth maps, charts, and the check of the poses."""
        return [*self.maps, *self.charts, *([] if self.poses is None else [self.poses])]

    @property
    def later(self) -> list[Task]:
        """The tasks from the surface on, which need those before."""
        return [self.surface, *(task for row in self.steps for task in row if task is not None)]

    @property
    def motions(self) -> CameraMotions:
        """How the cameras moved between the calibration and the reference, once this is computed."""
        if self.poses is None:
            return still_cameras(self.cameras)
        return motions_from_arrays(self.cameras, read_output(self.poses.output))

    @property
    def confused(self) -> list[ConfusedImages]:
        """What is wrong with reference images that do not match, once the depth maps are computed."""
        found = [read_output(task.output, ("confused",))["confused"].tolist() for task in self.maps]
        return [ConfusedImages(kind, tuple(cameras)) for kind, *cameras in filter(None, found)]

    def matches(self, camera: int, step: int) -> CameraMatches | None:
        """Matches of a camera at a step from 1 on; None where it has no image or no part in the surface."""
        task = self.steps[camera][step - 1]
        if task is None:
            return None
        try:
            arrays = read_output(task.output, ("step", *_MATCHES))
        except ComputationError:
            return None
        return CameraMatches(step=int(arrays["step"]), **{name: arrays[name] for name in _MATCHES})

    def images(
        self, steps: Sequence[str], measured: Floats, radius: int, target_edge: Callable[[], float]
    ) -> RunImages:  # fmt: skip
        """Blur, light and digest of every camera's image of every step, beside its reference image.

        steps : ids of the F captures. measured : (F,) share of the surface's points that each measured. radius : px.
        target_edge : function that returns the width, px, of the sharpest edges in the images of the target.
        """
        references = tuple(ReferenceState.of_arrays(read_output(task.output, REFERENCE_STATE)) for task in self.maps)
        states, digests = {}, {}
        for c, row in enumerate(self.steps):
            for step, task in enumerate(row, start=1):
                if task is None:
                    continue
                try:
                    arrays = read_output(task.output, ("image_state", "digest"))
                except ComputationError:  # the camera has no part in the surface
                    states[c, step] = ImageState(0, 0, *[np.nan] * 7)
                    continue
                states[c, step] = ImageState.of_array(arrays["image_state"])
                digests[c, step] = str(arrays["digest"])
        cameras = tuple(camera.id for camera in self.views.cameras)
        return RunImages(cameras, tuple(steps), references, states, digests, measured, radius, target_edge)


def charts_job(
    session: Session, cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]], steps: Sequence[Capture],
    settings: Settings, covariance: Floats | None = None, assumed: Sequence[Camera] | None = None,
    placed: Sequence[Camera] | None = None,
) -> ChartsJob:  # fmt: skip
    """Create the tasks of a session's measurement by all cameras that have a reference image.

    By the best method every camera has a chart, of what it faces most squarely; by the paper's method every pair has
    one, of all that its two cameras share.

    cameras : the C with a reference image, as calibrated. pairs : ids of neighbouring cameras. steps : captures, the
    reference first. covariance : (C, 6, 6) of the cameras' poses, rad and mm, None where unknown. assumed : the cameras
    with which the reference is matched, placed : those with which the surface and all steps are measured, where cameras
    are known to have moved since the calibration; None for the calibrated ones.
    """
    views = RigViews.of(assumed or cameras)
    digests, folder = Digests(session), work_folder(session.path)
    correlation = CorrelationSettings(**settings.correlation.keywords)
    masks = tuple(session.mask(camera.id) for camera in cameras)
    images = tuple(steps[0].images[camera.id] for camera in cameras)
    marks = [(digests.image(steps[0], camera.id), digests.mask(camera.id)) for camera in cameras]
    reference = _ReferenceFiles(views, images, masks, correlation)
    stamp = digest(source_digest(), list(views.cameras))  # another version computes all outputs again
    maps, charts = [], []
    for k, camera in enumerate(cameras):
        used = [marks[c] for c in (k, *views.partners[k])]
        key = digest(stamp, "depth map", k, correlation, used)
        maps.append(Task(key, f"depth of camera {camera.id}", depth_task, (reference, k), folder, cost=_CHART_COST))
    needs = tuple(task.key for task in maps)
    plans = _planned_charts(views, pairs, settings)
    for plan in plans:
        key = digest(stamp, "chart", plan, needs)
        charts.append(Task(key, f"chart of {plan.name}", chart_task, (reference, plan), folder, needs, _CHART_COST))
    needs = (*needs, *(task.key for task in charts))
    poses = None
    if settings.method == "best" and settings.calibration.refine_poses:
        key = digest(stamp, "poses", needs, list(cameras), [] if covariance is None else covariance)
        poses = Task(key, "poses of the cameras", poses_task, (tuple(cameras), covariance), folder, needs)
    views = replace(views, cameras=tuple(placed or views.cameras))
    joining = (correlation.step, correlation.radius, settings.surface)
    key = digest(stamp, "surface", needs, joining, list(views.cameras))
    surface = Task(key, "surface", surface_task, (views, *joining), folder, needs)
    curved = settings.method == "best"
    rows = []
    for k, camera in enumerate(cameras):
        row: list[Task | None] = []
        for step in steps[1:]:
            if camera.id not in step.images:
                row.append(None)
                continue
            mark = digests.image(step, camera.id)
            arguments = (views.cameras, k, correlation, curved, images[k], step.images[camera.id])
            key = digest("tracked camera", surface.key, k, mark)
            row.append(Task(key, f"camera {camera.id}, {step.id}", tracking_task, arguments, folder, (surface.key,)))
        rows.append(tuple(row))
    names = tuple(plan.name for plan in plans)
    return ChartsJob(tuple(cameras), views, names, tuple(maps), tuple(charts), poses, surface, tuple(rows))


@dataclass(frozen=True)
class _PlannedChart:
    """A chart before it is matched.

    name : of its camera or pair. camera : its index. partners : indices of the cameras that it may be matched with.
    incidence : degrees, of the steepest view. curved : whether the curvature of the surface is held, and the chart is
    the part that its camera faces most squarely; otherwise it is flat and all that it shares with its partner.
    """

    name: str
    camera: int
    partners: tuple[int, ...]
    incidence: float
    curved: bool


def _planned_charts(views: RigViews, pairs: Sequence[tuple[str, str]], settings: Settings) -> list[_PlannedChart]:
    """The charts of a measurement: of every camera, or by the paper's method of every pair of cameras."""
    incidence = settings.surface.incidence_deg
    if settings.method == "best":
        return [
            _PlannedChart(camera.id, k, views.partners[k], incidence, True) for k, camera in enumerate(views.cameras)
        ]
    index = {camera.id: k for k, camera in enumerate(views.cameras)}
    return [_PlannedChart(f"{a}-{b}", index[a], (index[b],), incidence, False) for a, b in pairs]


@dataclass(frozen=True)
class _ReferenceFiles:
    """Files of the reference images and masks of all cameras, and the settings of their correlation."""

    views: RigViews
    images: tuple[Path, ...]
    masks: tuple[Path | None, ...]
    correlation: CorrelationSettings

    def image(self, k: int) -> Image:
        """The image of camera k, (height, width) grey levels."""
        return step_image(self.images[k], self.views.cameras[k])

    def mask(self, k: int) -> Mask | None:
        """The region drawn for camera k, (height, width) bool; None where none was drawn."""
        path, camera = self.masks[k], self.views.cameras[k]
        return None if path is None else read_mask(path, camera.size[::-1])


def depth_task(files: _ReferenceFiles, k: int, *, inputs: tuple[Path, ...]) -> Arrays:
    """Measure the depth map of camera k. Returns its arrays, and "points", their number."""
    del inputs
    partners = files.views.partners[k]
    mask, space = files.mask(k), files.views.space
    images, depth_map = depths_at_fitting_size(
        files.views.cameras, files.image, files.correlation, k, partners[:_MOST], space, mask
    )
    nearest = partners[0] if partners else None
    unmatched = why_unmatched(images, depth_map, k, nearest, space, mask)
    why, confused = unmatched.sentence, unmatched.confused
    state = ReferenceState.of(files.views.cameras[k].id, files.image(k), depth_map, files.correlation.radius)
    if why and confused is None and state.repetition:
        why = state.repetition[0].sentence
    patches = depth_map.patches
    return {
        "px": patches.px, "inverse_depth": patches.inverse_depth, "gradient": patches.gradient,
        "sigma": depth_map.sigma, "textured": depth_map.textured, "patterned": depth_map.patterned,
        "spacing": np.array(depth_map.spacing), "grey_noise": np.array(depth_map.grey_noise),
        "points": np.array(len(patches.px)), "why": np.array(why), **state.arrays(),
        "confused": np.array([] if confused is None else [confused.kind, *confused.cameras], dtype=str),
        "features": unmatched.features, "between": np.array([k, k if nearest is None else nearest]),
    }  # fmt: skip


def _depth_map(arrays: Mapping[str, np.ndarray]) -> DepthMap:
    """A depth map from the arrays of a task's output."""
    n = len(arrays["px"])
    patches = Patches(arrays["px"], arrays["inverse_depth"], arrays["gradient"], np.zeros((n, 3)))
    sigma, textured, patterned = (arrays[name] for name in ("sigma", "textured", "patterned"))
    return DepthMap(int(arrays["spacing"]), patches, sigma, textured, patterned, float(arrays["grey_noise"]))


def _mapped_surface(camera: Camera, path: Path) -> MappedSurface:
    """The surface of the depth map in a task's output file, cached in memory for all charts that need it."""

    def size(value: MappedSurface) -> int:
        return 16 * value.map.patches.px.nbytes + value.map.textured.nbytes

    return process_memory.get(
        ("depth map", str(path)), lambda: MappedSurface(camera, _depth_map(read_output(path))), size
    )


def chart_task(files: _ReferenceFiles, planned: _PlannedChart, *, inputs: tuple[Path, ...]) -> Arrays:
    """Match a chart in all cameras that see it. inputs : outputs of the depth maps of all cameras."""
    cameras, k, incidence = files.views.cameras, planned.camera, planned.incidence
    surfaces = {c: _mapped_surface(cameras[c], inputs[c]) for c in (k, *planned.partners)}
    plan = plan_chart(k, surfaces, incidence, planned.partners, whole=not planned.curved)
    settings = replace(files.correlation, tolerance=_LOOSER * files.correlation.tolerance)
    images = ChartImages(cameras, files.image, settings)
    matches = match_chart(images, k, surfaces[k].map, plan, files.mask(k), incidence, curved=planned.curved)
    drop_masked(matches, files.mask)
    noise = np.array([surfaces[c].map.grey_noise for c in matches.cameras])
    chart = chart_with_uncertainty(images, matches, noise)
    return {**chart.arrays(), "points": np.array(int(np.isfinite(chart.px[..., 0]).sum()))}


def poses_task(cameras: tuple[Camera, ...], covariance: Floats | None, *, inputs: tuple[Path, ...]) -> Arrays:
    """Find which cameras moved since the calibration, see `CameraMotions`: px, rad, mm.

    covariance : (C, 6, 6) of the cameras' poses, rad and mm. inputs : outputs of the depth maps, then of the charts.
    """
    depths, charts = ([read_output(path) for path in part] for part in np.split(np.array(inputs), [len(cameras)]))
    features = [(one["between"], one["features"]) for one in depths if one["features"].size]
    return motions_as_arrays(poses_of_charts(cameras, list(map(Chart.from_arrays, charts)), features, covariance))


def surface_task(
    views: RigViews, step: int, radius: int, settings: SurfaceGroup, *, inputs: tuple[Path, ...]
) -> Arrays:  # fmt: skip
    """Triangulate and merge the charts, and find what they left unmeasured.

    inputs : outputs of the depth maps of all cameras, then of the charts. Returns the arrays of the surface and of the
    unmeasured places, and "unmatched", a sentence for each camera that has hardly a depth, else an empty one.
    """
    cameras = views.cameras
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        depths = list(pool.map(read_output, inputs[: len(cameras)]))
        charts = [pool.submit(read_output, path) for path in inputs[len(cameras) :]]
    maps = [_depth_map(one) for one in depths]
    why = [str(one["why"]) for one in depths]
    try:
        measured = [Chart.from_arrays(chart.result()) for chart in charts]
        surface = reference_surface(cameras, measured, step, settings.sigma_max_px, settings.merge)
        if not len(surface.xyz):
            raise ComputationError("no point of the surface was measured by two cameras")
    except ComputationError as error:
        coarse = coarse_speckle([float(one["speckle"]) for one in depths], radius)
        raise ComputationError("; ".join(filter(None, [str(error), *coarse, *why]))) from error
    places = unmeasured_places(cameras, maps, surface, settings.incidence_deg, views.space.centre)
    return {**surface.arrays(), **arrays_of_places(places), "unmatched": np.array(why)}


def tracking_task(
    cameras: tuple[Camera, ...], k: int, settings: CorrelationSettings, curved: bool, reference: Path, image: Path,
    *, inputs: tuple[Path, ...],
) -> Arrays:  # fmt: skip
    """Match the grid of camera k in its image of one step, with or without the field's curvature held.

    inputs : output of the surface.
    """
    prepared, points = _reference_and_points(cameras, k, settings, reference, inputs[0])
    current = step_image(image, cameras[k], again=False)
    matches = match_in_two_passes(prepared, current, points, settings, curved=curved)
    arrays = {name: getattr(matches, name) for name in _MATCHES}
    warp = np.column_stack([matches.uv, matches.gradient.reshape(-1, 4)])
    state = image_state(prepared.image, current, matches.xy.astype(float), warp)
    return {
        **arrays, "step": np.array(matches.step), "points": np.array(len(points.positions)),
        "image_state": state.array(), "digest": np.array(pixel_digest(current)),
    }  # fmt: skip


def _reference_and_points(
    cameras: tuple[Camera, ...], k: int, settings: CorrelationSettings, image: Path, surface: Path
) -> tuple[Reference, TrackedPoints]:
    """Prepared reference image of camera k and the points of its grid, cached in memory for all its steps."""
    camera = cameras[k]

    def frames() -> SurfaceFrames:
        xyz, _, seen, own = _seen_surface(surface)
        return process_memory.get(
            ("surface frames", str(surface)),
            lambda: SurfaceFrames.of(cameras, xyz, seen, own, settings.radius),
            lambda value: _bytes((value.origin, value.axes, value.form)),
        )

    def make() -> tuple[Reference, TrackedPoints]:
        xyz, faces, seen, _ = _seen_surface(surface)
        index = np.flatnonzero(seen[k])
        if not len(index):
            raise ComputationError(f"camera {camera.id}: it shares no measured point of the surface with another")
        px = np.full((len(xyz), 2), np.nan)
        px[index] = camera.project(xyz[index])
        grid = surface_grid(camera.size, settings.step, [(px, faces)])
        prepared = prepare_reference(step_image(image, camera), grid.region, settings)
        assert prepared.gradient  # computed here once, when first used
        body = SeenBody(camera, index, xyz[index], px[index], frames)
        return prepared, tracked_points(prepared, grid.xy, settings, body)

    def size(value: tuple[Reference, TrackedPoints]) -> int:
        prepared, points = value
        return reference_bytes(prepared, len(points.positions), settings)

    return process_memory.get(("tracked reference", camera.id, str(surface)), make, size)


def _seen_surface(path: Path) -> tuple[Points, NDArray[np.int32], Mask, Indices]:
    """The surface in a task's output file, cached in memory for all cameras.

    Returns points (N, 3) mm, triangles (M, 3), which point each of C cameras sees, (C, N) bool, and the camera (N,)
    that each point is of.
    """

    def read() -> tuple[Points, NDArray[np.int32], Mask, Indices]:
        arrays = read_output(path)
        seen: Mask = np.asarray(np.isfinite(arrays["px"][..., 0]))
        return arrays["xyz"], arrays["faces"].astype(np.int32), seen, arrays["own"]

    return process_memory.get(("surface", str(path)), read, _bytes)


def _bytes(arrays: Sequence[NDArray[Any]]) -> int:
    """Size of arrays in memory."""
    return sum(each.nbytes for each in arrays)
