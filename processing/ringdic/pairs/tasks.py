"""Tasks of matching all camera pairs: one for each pair's reference images, one for each camera and later step.

The steps of a camera are independent of one another, as each is matched from the reference. So one more capture, or
the newest step alone, leaves the outputs of all other steps valid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ringdic.arrays import Pixels
from ringdic.charts.tracking import CameraGrid, CameraMatches, CameraPixels, interpolate_matches
from ringdic.correlation import CorrelationSettings, Reference, prepare_reference, reference_bytes
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.pairs.matching import PairGrid, StepMatches, Stereo, match_reference, step_matches
from ringdic.pairs.tracking import FirstCameraView, SecondCameraView, camera_grid, match_camera
from ringdic.session.folder import Capture, Session
from ringdic.session.images import read_mask
from ringdic.sweep.sweep import DepthSearch
from ringdic.tasks import Arrays, Task, code_stamp, digest, process_memory, read_output, work_folder
from ringdic.tasks.step_images import Digests, step_image

_REFERENCE_COST = 2.0  # of a pair's reference, in units of one camera's step
_SECONDS = "seconds_"  # before the names of stages in an output
_MATCHES = ("xy", "uv", "gradient", "sigma", "c_ls", "status")


@dataclass(frozen=True)
class CameraJob:
    """Tasks of one camera: one for each later step, None where it has no image."""

    steps: tuple[Task | None, ...]

    def pixels(self, step: int, xy: Pixels) -> CameraPixels | None:
        """Pixels of some points of the reference image at a step from 1 on; None where the camera has no image.

        xy : (n, 2) float64, px, in the reference image.
        """
        task = self.steps[step - 1]
        if task is None:
            return None
        # In memory for both pairs of the camera.
        key = ("camera matches", str(task.output))
        matches = process_memory.get(key, lambda: _camera_matches(task.output), _bytes)
        return interpolate_matches(matches, xy)


@dataclass(frozen=True)
class PairJob:
    """Task of one pair's reference images, and the tasks of its two cameras."""

    cameras: tuple[Camera, Camera]
    reference: Task
    camera_jobs: tuple[CameraJob, CameraJob]

    @property
    def name(self) -> str:
        """Name of the pair."""
        return f"{self.cameras[0].id}-{self.cameras[1].id}"

    def at_reference(self) -> tuple[PairGrid, StepMatches]:
        """Grid of the pair and its matches at the reference. Raises the ComputationError with which the task ended."""
        arrays = read_output(self.reference.output)
        return _grid(arrays), _step_matches(arrays)

    def step(self, k: int, at_reference: StepMatches) -> StepMatches:
        """Matches of the pair at a later step k."""
        first, second = self.camera_jobs
        return step_matches(
            at_reference, (first.pixels(k, at_reference.px[0]), second.pixels(k, at_reference.second_px))
        )


def pair_jobs(
    session: Session,
    cameras: Mapping[str, Camera],
    pairs: Sequence[tuple[str, str]],
    steps: Sequence[Capture],
    search: DepthSearch,
    correlation: CorrelationSettings,
) -> list[PairJob]:
    """Create the tasks of all pairs for a session's steps.

    cameras : by id. pairs : ids of the cameras. steps : captures, the reference first. search : region in
    which the surface may lie.
    """
    digests, folder = Digests(session), work_folder(session.path)
    references: dict[tuple[str, str], Task] = {}
    for first, second in pairs:
        stereo, mask = Stereo((cameras[first], cameras[second]), search, correlation), session.mask(first)
        images = [digests.image(steps[0], id_) for id_ in stereo.ids]
        key = digest(
            code_stamp(), "pair reference", stereo.cameras, search, correlation, images, digests.mask(first)
        )  # fmt: skip
        arguments = (stereo, tuple(steps[0].images[id_] for id_ in stereo.ids), mask)
        name = f"pair {first}-{second}"
        references[first, second] = Task(key, name, reference_task, arguments, folder, cost=_REFERENCE_COST)

    def camera_job(id_: str) -> CameraJob:
        own_pairs = [pair for pair in references if id_ in pair]
        is_first, needs = tuple(pair[0] == id_ for pair in own_pairs), tuple(references[pair].key for pair in own_pairs)

        def task(step: Capture) -> Task | None:
            if id_ not in step.images:
                return None
            key = digest("camera step", is_first, needs, [digests.image(each, id_) for each in (steps[0], step)])
            arguments = (cameras[id_], correlation, is_first, steps[0].images[id_], step.images[id_])
            return Task(key, f"camera {id_}, {step.id}", camera_task, arguments, folder, needs)

        return CameraJob(tuple(task(step) for step in steps[1:]))

    jobs = {id_: camera_job(id_) for id_ in dict.fromkeys(id_ for pair in pairs for id_ in pair)}
    return [
        PairJob((cameras[first], cameras[second]), reference, (jobs[first], jobs[second]))
        for (first, second), reference in references.items()
    ]


def ordered_tasks(jobs: Sequence[PairJob]) -> list[Task]:
    """All tasks in order, camera by camera, so that a camera's reference image is prepared once for all its steps."""
    camera_jobs = {id(each): each for job in jobs for each in job.camera_jobs}
    later = [task for each in camera_jobs.values() for task in each.steps if task is not None]
    return [*(job.reference for job in jobs), *later]


def reference_task(stereo: Stereo, images: tuple[Path, Path], mask: Path | None, *, inputs: tuple[Path, ...]) -> Arrays:
    """Determine a pair's region and grid and match them at the reference.

    images : files of the two cameras. mask : file of the region drawn for the first camera. Returns the arrays of
    grid and matches, and "points", the number of points.
    """
    first, second = stereo.cameras
    mask_image = None if mask is None else read_mask(mask, (first.size[1], first.size[0]))
    grid, matches = match_reference(stereo, step_image(images[0], first), step_image(images[1], second), mask_image)
    seconds = {f"{_SECONDS}{name}": np.array(value) for name, value in matches.seconds.items()}
    return {
        "region": np.packbits(grid.region), "shape": np.array(grid.region.shape), "xy": grid.xy, "faces": grid.faces,
        "px": matches.px, "sigma": matches.sigma, "c_ls": matches.c_ls, "status": matches.status,
        "points": np.array(len(grid.xy)), **seconds,
    }  # fmt: skip


def camera_task(
    camera: Camera,
    settings: CorrelationSettings,
    is_first: tuple[bool, ...],
    reference: Path,
    image: Path,
    *,
    inputs: tuple[Path, ...],
) -> Arrays:
    """Match a camera's grid in its image of one step.

    is_first : for each pair whose output is in ``inputs``, whether the camera is its first. reference, image : files.
    Returns the arrays of the matches, and "points", the number of points.
    """
    grid, prepared = _grid_and_reference(camera, settings, is_first, reference, inputs)
    matches = match_camera(prepared, step_image(image, camera), grid, settings)
    arrays = {name: getattr(matches, name) for name in _MATCHES}
    return {**arrays, "step": np.array(matches.step), "points": np.array(len(grid.xy))}


def _grid_and_reference(
    camera: Camera, settings: CorrelationSettings, is_first: tuple[bool, ...], image: Path, pairs: tuple[Path, ...]
) -> tuple[CameraGrid, Reference]:
    """Grid of a camera and its prepared reference image, cached in memory for all its steps."""

    def make() -> tuple[CameraGrid, Reference]:
        first_views: list[FirstCameraView] = []
        second_views: list[SecondCameraView] = []
        for path, first in zip(pairs, is_first, strict=True):
            try:
                arrays = read_output(path)
            except ComputationError:  # reported where the pair is left out
                continue
            grid, matches = _grid(arrays), _step_matches(arrays)
            if first:
                first_views.append((grid.region, grid.xy[matches.good]))
            else:
                second_views.append((matches.second_px, grid.faces))
        grid_of_camera = camera_grid(camera.size, settings.step, first_views, second_views)
        if not len(grid_of_camera.xy):
            raise ComputationError(f"camera {camera.id}: none of its pairs gave a surface")
        reference = prepare_reference(step_image(image, camera), grid_of_camera.region, settings)
        assert reference.gradient  # computed here once, when first used
        return grid_of_camera, reference

    def size(value: tuple[CameraGrid, Reference]) -> int:
        grid, reference = value
        return reference_bytes(reference, len(grid.xy), settings) + grid.region.nbytes + grid.xy.nbytes

    return process_memory.get(("reference", camera.id, *map(str, pairs)), make, size)


def _camera_matches(output: Path) -> CameraMatches:
    """Matches of a camera from a task's output file."""
    arrays = read_output(output)
    return CameraMatches(step=int(arrays["step"]), **{name: arrays[name] for name in _MATCHES})


def _bytes(matches: CameraMatches) -> int:
    """Size of matches in memory."""
    return sum(int(getattr(matches, name).nbytes) for name in _MATCHES)


def _grid(arrays: Arrays) -> PairGrid:
    """Grid of a pair from the arrays of a task's output."""
    height, width = (int(side) for side in arrays["shape"])
    region = np.unpackbits(arrays["region"], count=height * width).reshape(height, width).astype(bool)
    return PairGrid(region, arrays["xy"], arrays["faces"])


def _step_matches(arrays: Arrays) -> StepMatches:
    """Matches of a pair at the reference from the arrays of a task's output."""
    names = [name for name in arrays if name.startswith(_SECONDS)]
    seconds = {name.removeprefix(_SECONDS): float(arrays[name]) for name in names}
    return StepMatches(arrays["px"], arrays["sigma"], arrays["c_ls"], arrays["status"], seconds)
