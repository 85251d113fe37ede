"""The matching of all camera pairs as tasks: one for each pair's reference images, one for each camera and later step.

The steps of a camera are independent of one another: each is matched from the reference. So one more capture, or the
newest step alone, makes no other step anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ringdic.arrays import Floats
from ringdic.correlation import CorrelationSettings, Reference, prepare_reference, reference_bytes
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.pairs.matching import Grid, StepMatches, Stereo, at_step, match_reference
from ringdic.pairs.tracking import (
    CameraGrid,
    CameraMatches,
    CameraPixels,
    Own,
    Shared,
    camera_grid,
    match_camera,
    places,
)
from ringdic.session.folder import Capture, Session
from ringdic.session.images import read_mask
from ringdic.sweep.sweep import DepthSearch
from ringdic.tasks import Arrays, Task, code_stamp, digest, process_memory, read_output, work_folder
from ringdic.tasks.step_images import Digests, step_image

_REFERENCE_COST = 2.0  # of a pair, in steps of a camera
_SECONDS = "seconds_"  # before the names of stages in an output
_FOLLOWED = ("xy", "uv", "gradient", "sigma", "c_ls", "status")


@dataclass(frozen=True)
class CameraJob:
    """The tasks of one camera: one for each later step, None where it has no image."""

    steps: tuple[Task | None, ...]

    def places(self, step: int, xy: Floats) -> CameraPixels | None:
        """Where places xy (n, 2) px of the reference image lie at a step from 1 on; None without an image."""
        task = self.steps[step - 1]
        if task is None:
            return None
        # Cached, since two pairs use it.
        found = process_memory.get(("followed", str(task.output)), lambda: _followed(task.output), _bytes)
        return places(found, xy)


@dataclass(frozen=True)
class PairJob:
    """The task of one pair's reference images, and those of its cameras."""

    cameras: tuple[Camera, Camera]
    reference: Task
    followed: tuple[CameraJob, CameraJob]

    @property
    def name(self) -> str:
        """The pair's name."""
        return f"{self.cameras[0].id}-{self.cameras[1].id}"

    def at_reference(self) -> tuple[Grid, StepMatches]:
        """The pair's points and their matches at the reference. Raises the ComputationError that this ended with."""
        arrays = read_output(self.reference.output)
        return _grid(arrays), _step_matches(arrays)

    def step(self, k: int, at_reference: StepMatches) -> StepMatches:
        """The matches at a later step k."""
        first, second = self.followed
        return at_step(at_reference, (first.places(k, at_reference.px[0]), second.places(k, at_reference.second)))


def pair_jobs(
    session: Session,
    cameras: Mapping[str, Camera],
    pairs: Sequence[tuple[str, str]],
    steps: Sequence[Capture],
    search: DepthSearch,
    correlation: CorrelationSettings,
) -> list[PairJob]:
    """The tasks of all pairs over these steps, the reference first."""
    digests, folder = Digests(session), work_folder(session.path)
    references: dict[tuple[str, str], Task] = {}
    for first, second in pairs:
        stereo, mask = Stereo((cameras[first], cameras[second]), search, correlation), session.mask(first)
        images = [digests.image(steps[0], id_) for id_ in stereo.ids]
        key = digest(
            code_stamp(), "pair reference", stereo.cameras, search, correlation, images, digests.mask(first)
        )  # fmt: skip
        given = (stereo, tuple(steps[0].images[id_] for id_ in stereo.ids), mask)
        name = f"pair {first}-{second}"
        references[first, second] = Task(key, name, reference_task, given, folder, cost=_REFERENCE_COST)

    def followed(id_: str) -> CameraJob:
        own = [pair for pair in references if id_ in pair]
        is_first, needs = tuple(pair[0] == id_ for pair in own), tuple(references[pair].key for pair in own)

        def task(step: Capture) -> Task | None:
            if id_ not in step.images:
                return None
            key = digest("camera step", is_first, needs, [digests.image(each, id_) for each in (steps[0], step)])
            given = (cameras[id_], correlation, is_first, steps[0].images[id_], step.images[id_])
            return Task(key, f"camera {id_}, {step.id}", camera_task, given, folder, needs)

        return CameraJob(tuple(task(step) for step in steps[1:]))

    jobs = {id_: followed(id_) for id_ in dict.fromkeys(id_ for pair in pairs for id_ in pair)}
    return [
        PairJob((cameras[first], cameras[second]), reference, (jobs[first], jobs[second]))
        for (first, second), reference in references.items()
    ]


def ordered_tasks(jobs: Sequence[PairJob]) -> list[Task]:
    """All tasks, camera by camera: what the steps of one need is read while it is still in memory."""
    followed = {id(each): each for job in jobs for each in job.followed}
    later = [task for each in followed.values() for task in each.steps if task is not None]
    return [*(job.reference for job in jobs), *later]


def reference_task(stereo: Stereo, images: tuple[Path, Path], mask: Path | None, *, inputs: tuple[Path, ...]) -> Arrays:
    """A pair's region, points and matches at the reference. mask : drawn for the first camera."""
    first, second = stereo.cameras
    drawn = None if mask is None else read_mask(mask, (first.size[1], first.size[0]))
    grid, found = match_reference(stereo, step_image(images[0], first), step_image(images[1], second), drawn)
    seconds = {f"{_SECONDS}{name}": np.array(value) for name, value in found.seconds.items()}
    return {
        "region": np.packbits(grid.region), "shape": np.array(grid.region.shape), "xy": grid.xy, "faces": grid.faces,
        "px": found.px, "sigma": found.sigma, "c_ls": found.c_ls, "status": found.status,
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
    """A camera's points in its image of one step. is_first : whether it is the first camera of each pair in inputs."""
    grid, prepared = _prepared(camera, settings, is_first, reference, inputs)
    found = match_camera(prepared, step_image(image, camera), grid, settings)
    arrays = {name: getattr(found, name) for name in _FOLLOWED}
    return {**arrays, "step": np.array(found.step), "points": np.array(len(grid.xy))}


def _prepared(
    camera: Camera, settings: CorrelationSettings, is_first: tuple[bool, ...], image: Path, pairs: tuple[Path, ...]
) -> tuple[CameraGrid, Reference]:
    """A camera's points and its prepared reference image, kept in memory for all its steps."""

    def make() -> tuple[CameraGrid, Reference]:
        own: list[Own] = []
        shared: list[Shared] = []
        for path, first in zip(pairs, is_first, strict=True):
            try:
                arrays = read_output(path)
            except ComputationError:  # told where the pair is left out
                continue
            grid, found = _grid(arrays), _step_matches(arrays)
            if first:
                own.append((grid.region, grid.xy[found.good]))
            else:
                shared.append((found.second, grid.faces))
        followed = camera_grid(camera.size, settings.step, own, shared)
        if not len(followed.xy):
            raise ComputationError(f"camera {camera.id}: none of its pairs gave a surface")
        reference = prepare_reference(step_image(image, camera), followed.region, settings)
        assert reference.gradient  # computed when first asked for
        return followed, reference

    def size(value: tuple[CameraGrid, Reference]) -> int:
        grid, reference = value
        return reference_bytes(reference, len(grid.xy), settings) + grid.region.nbytes + grid.xy.nbytes

    return process_memory.get(("reference", camera.id, *map(str, pairs)), make, size)


def _followed(output: Path) -> CameraMatches:
    arrays = read_output(output)
    return CameraMatches(step=int(arrays["step"]), **{name: arrays[name] for name in _FOLLOWED})


def _bytes(found: CameraMatches) -> int:
    return sum(int(getattr(found, name).nbytes) for name in _FOLLOWED)


def _grid(arrays: Arrays) -> Grid:
    height, width = (int(side) for side in arrays["shape"])
    region = np.unpackbits(arrays["region"], count=height * width).reshape(height, width).astype(bool)
    return Grid(region, arrays["xy"], arrays["faces"])


def _step_matches(arrays: Arrays) -> StepMatches:
    told = [name for name in arrays if name.startswith(_SECONDS)]
    seconds = {name.removeprefix(_SECONDS): float(arrays[name]) for name in told}
    return StepMatches(arrays["px"], arrays["sigma"], arrays["c_ls"], arrays["status"], seconds)
