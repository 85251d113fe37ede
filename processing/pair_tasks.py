"""The matching of all camera pairs as tasks: one for each pair's reference images, one for each pair and step.

The steps of a pair are independent of one another: each is matched from the reference. So one more capture, or the
newest step alone, makes no other step anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.camera import Camera
from processing.correlation import CorrelationSettings, Reference, prepare_reference
from processing.images import read_mask
from processing.matching import Grid, PairMatches, StepMatches, Stereo, collect, match_reference, match_step
from processing.session import Capture, Session
from processing.step_images import Digests, step_image
from processing.sweep import Search
from processing.tasks import Arrays, Task, code_stamp, digest, kept, read_output, work_folder

Array = NDArray[np.float64]
_MATCH_COST = 0.6  # of a step's second correlation, in correlations of the reference


@dataclass(frozen=True)
class PairJob:
    """The tasks of one pair: the reference's, then a step's each."""

    cameras: tuple[Camera, Camera]
    reference: Task
    steps: tuple[Task, ...]

    @property
    def name(self) -> str:
        """The pair's name."""
        return f"{self.cameras[0].id}-{self.cameras[1].id}"

    def matches(self) -> PairMatches:
        """The pair's matches at all steps. Raises the ComputationError that the reference ended with."""
        of_reference = read_output(self.reference.output)
        grid = _grid(of_reference)
        found = [_step_matches(of_reference), *(_step_matches(read_output(task.output)) for task in self.steps)]
        return collect((self.cameras[0].id, self.cameras[1].id), grid, found)


def pair_jobs(
    session: Session,
    cameras: Mapping[str, Camera],
    pairs: Sequence[tuple[str, str]],
    steps: Sequence[Capture],
    search: Search,
    correlation: CorrelationSettings,
) -> list[PairJob]:
    """The tasks of all pairs over these steps, the reference first."""
    plan = _Plan(session, work_folder(session.path), Digests(session))
    return [plan.job(Stereo((cameras[first], cameras[second]), search, correlation), steps) for first, second in pairs]


def in_order(jobs: Sequence[PairJob]) -> list[Task]:
    """All tasks, step by step and round the ring: what two of them read is read while it is still in memory."""
    steps = range(len(jobs[0].steps) if jobs else 0)
    return [*(job.reference for job in jobs), *(job.steps[step] for step in steps for job in jobs)]


@dataclass(frozen=True)
class _Plan:
    """What the tasks of a session's pairs are made of."""

    session: Session
    folder: Path
    digests: Digests

    def job(self, stereo: Stereo, steps: Sequence[Capture]) -> PairJob:
        first, second = stereo.ids
        mask = self.session.mask(first)
        reference = Task(
            digest(
                code_stamp(), "pair reference", stereo.cameras, stereo.search, stereo.settings,
                [self.digests.image(steps[0], id_) for id_ in stereo.ids], self.digests.mask(first),
            ),
            f"pair {first}-{second}",
            reference_task,
            (stereo, tuple(steps[0].images[id_] for id_ in stereo.ids), mask),
            self.folder,
            cost=1.0 + _MATCH_COST,
        )  # fmt: skip
        return PairJob(stereo.cameras, reference, tuple(self._step(stereo, reference, steps, k) for k in _later(steps)))

    def _step(self, stereo: Stereo, reference: Task, steps: Sequence[Capture], k: int) -> Task:
        first, second = stereo.ids
        seen = tuple(steps[k].images.get(id_) for id_ in stereo.ids)
        return Task(
            digest("pair step", reference.key, [self.digests.image(steps[k], id_) for id_ in stereo.ids]),
            f"pair {first}-{second}, {steps[k].id}",
            step_task,
            (stereo, steps[0].images[first], seen),
            self.folder,
            (reference.key,),
            cost=1.0 + _MATCH_COST,
        )


def reference_task(stereo: Stereo, images: tuple[Path, Path], mask: Path | None, *, inputs: tuple[Path, ...]) -> Arrays:
    """Region, points and matches of a pair's reference images."""
    del inputs
    first, second = stereo.cameras
    drawn = None if mask is None else read_mask(mask, (first.size[1], first.size[0]))
    grid, found = match_reference(stereo, step_image(images[0], first), step_image(images[1], second), drawn)
    region = {"region": np.packbits(grid.region), "shape": np.array(grid.region.shape)}
    own: dict[str, NDArray[Any]] = {
        "xy": grid.xy,
        "faces": grid.faces,
        "gradient": found.gradient,
        "points": np.array(len(grid.xy)),
    }
    return {**region, **own, **_arrays(found)}


def step_task(
    stereo: Stereo, reference: Path, images: tuple[Path | None, Path | None], *, inputs: tuple[Path, ...]
) -> Arrays:
    """Matches of a pair's images of one step. reference : the first camera's reference image."""
    (kept_grid,) = inputs
    grid, at_reference, prepared = _prepared(kept_grid, reference, stereo)
    seen = [None if path is None else step_image(path, each) for path, each in zip(images, stereo.cameras, strict=True)]
    found = match_step(stereo, prepared, grid.xy, seen[0], seen[1], at_reference)
    made = int(at_reference.good.sum()) * sum(image is not None for image in seen)
    return {**_arrays(found), "points": np.array(made)}


def _prepared(grid_file: Path, image: Path, stereo: Stereo) -> tuple[Grid, StepMatches, Reference]:
    """A pair's points, their matches at the reference and its prepared image, kept in memory for all its steps."""

    def make() -> tuple[Grid, StepMatches, Reference]:
        of_reference = read_output(grid_file)
        grid = _grid(of_reference)
        reference = prepare_reference(step_image(image, stereo.cameras[0]), grid.region, stereo.settings)
        assert reference.slopes  # computed when first asked for
        return grid, _step_matches(of_reference), reference

    def size(value: tuple[Grid, StepMatches, Reference]) -> int:
        grid, found, reference = value
        matched = sum(array.nbytes for array in (found.px, found.sigma, found.c_ls, found.status, found.gradient))
        filtered = reference.grey.nbytes + sum(slope.nbytes for slope in reference.slopes) + reference.mask.nbytes
        return int(
            filtered + matched + grid.region.nbytes + grid.xy.nbytes + grid.faces.nbytes + reference.image.nbytes
        )

    return kept.get(("reference", str(grid_file)), make, size)


def _arrays(found: StepMatches) -> dict[str, NDArray[Any]]:
    seconds = {f"seconds_{name}": np.array(value) for name, value in found.seconds.items()}
    return {"px": found.px, "sigma": found.sigma, "c_ls": found.c_ls, "status": found.status, **seconds}


def _step_matches(arrays: Arrays) -> StepMatches:
    start = len("seconds_")
    seconds = {name[start:]: float(value) for name, value in arrays.items() if name.startswith("seconds_")}
    gradient = arrays.get("gradient", np.empty((0, 2, 2), np.float32))
    return StepMatches(arrays["px"], arrays["sigma"], arrays["c_ls"], arrays["status"], seconds, gradient)


def _grid(arrays: Arrays) -> Grid:
    height, width = (int(side) for side in arrays["shape"])
    region = np.unpackbits(arrays["region"], count=height * width).reshape(height, width).astype(bool)
    return Grid(region, arrays["xy"], arrays["faces"])


def _later(steps: Sequence[Capture]) -> Iterator[int]:
    return iter(range(1, len(steps)))
