"""Tasks of the measurement by all cameras: depth maps, charts, the surface, then each camera's image of each step.

The steps of a camera are independent of one another, as each is matched from the reference. So one more capture, or
the newest step alone, leaves the outputs of all other steps valid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ringdic.arrays import Image, Mask
from ringdic.charts.chart import Chart, chart_with_uncertainty
from ringdic.charts.depth_map import DepthImages, DepthMap, measure_depths
from ringdic.charts.images import ChartImages
from ringdic.charts.matching import match_chart
from ringdic.charts.patches import Patches
from ringdic.charts.plane_sweep import DepthRange
from ringdic.charts.series import camera_view
from ringdic.charts.surface import ReferenceSurface, reference_surface
from ringdic.charts.tracked_points import TrackedPoints, tracked_points
from ringdic.charts.tracking import CameraMatches, match_in_two_passes, surface_grid
from ringdic.charts.views import plan_chart
from ringdic.correlation import CorrelationSettings, Reference, prepare_reference, reference_bytes
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.session.folder import Capture, Session
from ringdic.session.images import read_mask
from ringdic.settings import Settings
from ringdic.tasks import Arrays, Task, code_stamp, digest, process_memory, read_output, work_folder
from ringdic.tasks.step_images import Digests, step_image

_WIDEST = 72.0  # degrees between the views of two cameras that are matched with one another
_MOST = 2  # cameras, those with the most similar views, that a depth map is measured with
_CHART_COST = 2.0  # of a depth map and of a chart, in units of one camera's step
_MATCHES = ("xy", "uv", "gradient", "sigma", "c_ls", "status")


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
    """Tasks of a measurement by all cameras: depth maps, charts, the surface, and for each camera its later steps."""

    views: RigViews
    maps: tuple[Task, ...]
    charts: tuple[Task, ...]
    surface: Task
    steps: tuple[tuple[Task | None, ...], ...]

    @property
    def tasks(self) -> list[Task]:
        """All tasks in order, camera by camera, so that a reference image is prepared once for all its steps."""
        later = [task for row in self.steps for task in row if task is not None]
        return [*self.maps, *self.charts, self.surface, *later]

    def matches(self, camera: int, step: int) -> CameraMatches | None:
        """Matches of a camera at a step from 1 on; None where it has no image or no part in the surface."""
        task = self.steps[camera][step - 1]
        if task is None:
            return None
        try:
            arrays = read_output(task.output)
        except ComputationError:
            return None
        return CameraMatches(step=int(arrays["step"]), **{name: arrays[name] for name in _MATCHES})


def charts_job(session: Session, cameras: Sequence[Camera], steps: Sequence[Capture], settings: Settings) -> ChartsJob:
    """Create the tasks of a session's measurement by all cameras that have a reference image.

    cameras : all with a reference image. steps : captures, the reference first.
    """
    views = RigViews.of(cameras)
    digests, folder = Digests(session), work_folder(session.path)
    correlation = CorrelationSettings(**settings.correlation.keywords)
    masks = tuple(session.mask(camera.id) for camera in cameras)
    images = tuple(steps[0].images[camera.id] for camera in cameras)
    marks = [(digests.image(steps[0], camera.id), digests.mask(camera.id)) for camera in cameras]
    reference = _ReferenceFiles(views, images, masks, correlation)
    stamp = code_stamp()
    maps, charts = [], []
    for k, camera in enumerate(cameras):
        used = [marks[c] for c in (k, *views.partners[k])]
        key = digest(stamp, "depth map", k, list(cameras), correlation, used)
        maps.append(Task(key, f"depth of camera {camera.id}", depth_task, (reference, k), folder, cost=_CHART_COST))
    needs = tuple(task.key for task in maps)
    incidence = settings.surface.incidence_deg
    for k, camera in enumerate(cameras):
        key = digest(stamp, "chart", k, needs, incidence)
        name = f"chart of camera {camera.id}"
        charts.append(Task(key, name, chart_task, (reference, k, incidence), folder, needs, _CHART_COST))
    needs = tuple(task.key for task in charts)
    sigma_max = settings.surface.sigma_max_px
    surface = Task(
        digest(stamp, "surface", needs, sigma_max), "surface", surface_task,
        (views.cameras, correlation.step, sigma_max), folder, needs,
    )  # fmt: skip
    rows = []
    for k, camera in enumerate(cameras):
        row: list[Task | None] = []
        for step in steps[1:]:
            if camera.id not in step.images:
                row.append(None)
                continue
            mark = digests.image(step, camera.id)
            arguments = (views.cameras, k, correlation, images[k], step.images[camera.id])
            key = digest("tracked camera", surface.key, k, mark)
            row.append(Task(key, f"camera {camera.id}, {step.id}", tracking_task, arguments, folder, (surface.key,)))
        rows.append(tuple(row))
    return ChartsJob(views, tuple(maps), tuple(charts), surface, tuple(rows))


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
    images = DepthImages.of(files.views.cameras, files.image, files.correlation)
    depth_map = measure_depths(images, k, partners[:_MOST], files.views.space, files.mask(k))
    patches = depth_map.patches
    return {
        "px": patches.px, "inverse_depth": patches.inverse_depth, "gradient": patches.gradient,
        "sigma": depth_map.sigma, "zncc": depth_map.zncc, "textured": depth_map.textured,
        "spacing": np.array(depth_map.spacing), "grey_noise": np.array(depth_map.grey_noise),
        "points": np.array(len(patches.px)),
    }  # fmt: skip


def _depth_map(camera: str, arrays: Mapping[str, np.ndarray]) -> DepthMap:
    """The depth map of a camera from the arrays of a task's output."""
    n = len(arrays["px"])
    patches = Patches(arrays["px"], arrays["inverse_depth"], arrays["gradient"], np.zeros((n, 3)))
    sigma, zncc, textured = (arrays[name] for name in ("sigma", "zncc", "textured"))
    return DepthMap(camera, int(arrays["spacing"]), patches, sigma, zncc, textured, float(arrays["grey_noise"]))


def chart_task(files: _ReferenceFiles, k: int, incidence: float, *, inputs: tuple[Path, ...]) -> Arrays:
    """Match the chart of camera k in all cameras that see it. inputs : outputs of the depth maps of all cameras."""
    cameras = files.views.cameras
    maps = [_depth_map(camera.id, read_output(path)) for camera, path in zip(cameras, inputs, strict=True)]
    plan = plan_chart(k, cameras, maps, incidence, files.views.partners[k])
    images = ChartImages(cameras, files.image, files.correlation)
    matches = match_chart(images, k, maps[k], plan, files.mask(k), incidence)
    noise = np.array([maps[c].grey_noise for c in matches.cameras])
    chart = chart_with_uncertainty(images, matches, noise)
    return {**chart.arrays(), "points": np.array(int(np.isfinite(chart.px[..., 0]).sum()))}


def surface_task(cameras: tuple[Camera, ...], step: int, sigma_max: float, *, inputs: tuple[Path, ...]) -> Arrays:
    """Triangulate and merge the charts. inputs : outputs of the charts of all cameras."""
    charts = [Chart.from_arrays(read_output(path)) for path in inputs]
    return reference_surface(cameras, charts, step, sigma_max).arrays()


def tracking_task(
    cameras: tuple[Camera, ...], k: int, settings: CorrelationSettings, reference: Path, image: Path,
    *, inputs: tuple[Path, ...],
) -> Arrays:  # fmt: skip
    """Match the grid of camera k in its image of one step. inputs : output of the surface."""
    prepared, points = _reference_and_points(cameras, k, settings, reference, inputs[0])
    matches = match_in_two_passes(prepared, step_image(image, cameras[k]), points, settings)
    arrays = {name: getattr(matches, name) for name in _MATCHES}
    return {**arrays, "step": np.array(matches.step), "points": np.array(len(points.positions))}


def _reference_and_points(
    cameras: tuple[Camera, ...], k: int, settings: CorrelationSettings, image: Path, surface: Path
) -> tuple[Reference, TrackedPoints]:
    """Prepared reference image of camera k and the points of its grid, cached in memory for all its steps."""
    camera = cameras[k]

    def make() -> tuple[Reference, TrackedPoints]:
        measured = ReferenceSurface.from_arrays(read_output(surface))
        view = camera_view(camera, k, measured)
        if not len(view.vertex):
            raise ComputationError(f"camera {camera.id}: it shares no measured point of the surface with another")
        px = np.full((len(measured.xyz), 2), np.nan)
        px[view.vertex] = view.px
        grid = surface_grid(camera.size, settings.step, [(px, measured.faces.astype(np.int32))])
        prepared = prepare_reference(step_image(image, camera), grid.region, settings)
        assert prepared.gradient  # computed here once, when first used
        return prepared, tracked_points(prepared, grid.xy, settings)

    def size(value: tuple[Reference, TrackedPoints]) -> int:
        prepared, points = value
        return reference_bytes(prepared, len(points.positions), settings)

    return process_memory.get(("tracked reference", camera.id, str(surface)), make, size)
