"""Writing of results.h5, one step at a time.

The layout of the file is drawn in `ringdic.results.layout`.
"""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Points
from ringdic.results import vtkhdf
from ringdic.results.fields import StepFields, available, compute_fields
from ringdic.results.layout import CONSTANT_ARRAYS, SCHEMA, STEP_ARRAYS
from ringdic.results.ranges import Extent, Ranges
from ringdic.results.results import MATCH_ARRAYS, Matches, Results
from ringdic.results.series import select_steps
from ringdic.session.json_values import json_value
from ringdic.strain.deformation import Deformation
from ringdic.strain.rigid_motion import RigidMotion
from ringdic.strain.window import strain_window

T = TypeVar("T")


def write_results(path: Path, results: Results) -> None:
    """Compute the fields of all steps and write the file.

    path : of the new file; FileExistsError where there is one.
    """

    def at(step: int) -> Results:
        return select_steps(results, [0, step] if step else [0])

    write_steps(path, results.steps, at, lambda _: None, results.calibration, results.summary)


def write_steps(
    path: Path,
    names: Sequence[str],
    at: Callable[[int], Results],
    progress: Callable[[float], None],
    calibration: dict[str, Any],
    summary: dict[str, Any],
) -> None:
    """Compute the fields of some steps and write the file, with no more than a few steps in memory at a time.

    path : of the new file; FileExistsError where there is one. names : (F,) capture ids of the steps. at : function
    that returns the results of the reference and of a later step; for step 0 those of the reference alone.
    progress : called with the share done, 0 to 1. calibration, summary : JSON values.
    """
    with ResultsWriter(path, at(0), names) as file:

        def step_record(step: int) -> StepRecord:
            results = at(step)
            last = len(results.steps) - 1
            return file.record(results, results.motion(last), results.deformation(last))

        for step, record in enumerate(map_in_order(step_record, range(len(names)))):
            file.write(step, record)
            progress((step + 1) / len(names))
        file.finish(calibration, summary)


def map_in_order(compute: Callable[[int], T], steps: Sequence[int]) -> Iterator[T]:
    """Yield the values of a function at some steps, in order, computed by several threads.

    At most a few more values than there are cores are in memory at a time.
    """
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for step in steps:
            waiting.append(pool.submit(compute, step))
            if len(waiting) > (os.cpu_count() or 1):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@dataclass(frozen=True)
class StepRecord:
    """Contents of the results file for one step.

    positions : (N, 3) mm, finite: a lost point has its reference position. point : arrays (N, ...) of the vertices by
    name. face : arrays (M, ...) of the triangles by name. extent : percentiles of the fields, from `Ranges.extent`.
    motion : takes the step back onto the reference. matches : of each matches the arrays of this step by name.
    """

    positions: Points
    point: dict[str, NDArray[Any]]
    face: dict[str, NDArray[Any]]
    extent: Extent
    motion: RigidMotion
    matches: tuple[dict[str, NDArray[Any]], ...]


class ResultsWriter:
    """Writer of a results file, one step after the other, the reference first.

    path : of the new file; FileExistsError where there is one. names : (F,) capture ids of the steps.
    reference : the results of the reference alone; they have the same optional arrays as every later step.
    """

    def __init__(self, path: Path, reference: Results, names: Sequence[str]) -> None:
        self._reference, self._names = reference, tuple(names)
        self._window = strain_window(reference.mesh, reference.window_mm) if reference.window_mm > 0 else None
        self._scatter = None if self._window is None else reference.scatter(self._window)
        first = self._fields(reference, reference.motion(0), reference.deformation(0))
        self._ranges = Ranges(available(first.names))
        self._motions: list[RigidMotion] = []
        self._file = h5py.File(path, "x")
        self._group = vtkhdf.create_group(self._file, reference.faces, len(reference.vertices_ref), len(self._names))
        for name in CONSTANT_ARRAYS:
            vtkhdf.write_constant(self._group, name, first.face[name].astype(np.float32))
        self._own = self._file.create_group("ringdic")
        for k, matches in enumerate(reference.matches):
            self._begin(self._own.create_group(f"matches/{k}"), matches)
        self._own.require_group("matches")

    def __enter__(self) -> ResultsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def record(self, results: Results, motion: RigidMotion, deformation: Deformation) -> StepRecord:
        """The contents of the file for the last step of some results. Several threads may call it at a time.

        motion : takes this step back onto the reference. deformation : of this step since the reference.
        """
        last = len(results.steps) - 1
        fields = self._fields(results, motion, deformation)
        measured = np.isfinite(results.vertices[last]).all(axis=1)
        positions = np.where(measured[:, None], results.vertices[last], results.vertices_ref)
        flags = {"measured": measured.astype(np.uint8), "status": results.status[last].astype(np.int8)}
        matches = tuple({name: getattr(each, name)[last] for name in MATCH_ARRAYS} for each in results.matches)
        extent = self._ranges.extent(fields)
        return StepRecord(positions, {**_stored(fields.point), **flags}, _stored(fields.face), extent, motion, matches)

    def write(self, step: int, record: StepRecord) -> None:
        """Write the next step; the steps are written in order."""
        vtkhdf.write_step(self._group, step, record.positions, record.point, record.face)
        for k, matches in enumerate(record.matches):
            for name, values in matches.items():
                self._own[f"matches/{k}/{name}"][step] = values
        self._ranges.take(record.extent)
        self._motions.append(record.motion)

    def finish(self, calibration: dict[str, Any], summary: dict[str, Any]) -> None:
        """Write the parts that belong to the whole run; the reader refuses a file without them.

        calibration, summary : JSON values.
        """
        own, reference = self._own, self._reference
        own.attrs["schema"] = SCHEMA
        own.attrs["rig"] = reference.rig
        own.attrs["steps"] = json.dumps(self._names)
        own.attrs["pairs"] = json.dumps(reference.pairs)
        own.attrs["cameras"] = json.dumps([camera.id for camera in reference.cameras])
        own.attrs["fields"] = json.dumps(self._ranges.table())
        own["reference"] = reference.vertices_ref
        for name in ("faces", "pair", "vertex_pair"):
            own[name] = np.asarray(getattr(reference, name), dtype=np.int64)
        own["rigid_motion/R"] = np.array([motion.R for motion in self._motions])
        own["rigid_motion/t"] = np.array([motion.t for motion in self._motions])
        own["settings"] = reference.settings
        own["calibration"] = json.dumps(json_value(calibration), allow_nan=False)
        own["summary"] = json.dumps(json_value(summary), allow_nan=False)
        for one in reference.unmeasured:
            group = own.create_group(f"unmeasured/{one.camera}")
            group.attrs["spacing"] = one.spacing
            group["px"], group["status"], group["area"] = one.px.astype(np.float32), one.status, one.area
        cameras = own.create_group("cameras")
        for camera in reference.cameras:
            group = cameras.create_group(camera.id)
            group["P"], group["size"] = camera.P, np.array(camera.size)
            if camera.intrinsics is not None:
                group["K"], group["distortion"] = camera.intrinsics.K, camera.intrinsics.distortion

    def _fields(self, results: Results, motion: RigidMotion, deformation: Deformation) -> StepFields:
        """The fields of the last step of some results."""
        last = len(results.steps) - 1
        return compute_fields(
            results.vertices_ref, results.vertices[last], results.faces, motion, results.quality(last), results.pair,
            self._window, self._scatter, deformation, both_tensors=False,
        )  # fmt: skip

    def _begin(self, group: h5py.Group, matches: Matches) -> None:
        """Create the arrays of some matches; those with one entry a step are filled step by step."""
        group.attrs["cameras"] = json.dumps(matches.cameras)
        group.attrs["seconds"] = json.dumps(matches.seconds)
        group["xy"], group["vertex"] = matches.xy, matches.vertex
        for name in MATCH_ARRAYS:
            values = getattr(matches, name)
            group.create_dataset(name, shape=(len(self._names), *values.shape[1:]), dtype=values.dtype)


def _stored(arrays: dict[str, Floats]) -> dict[str, NDArray[np.float32]]:
    """Arrays that are stored in the file, in single precision."""
    return {name: values.astype(np.float32) for name, values in arrays.items() if name in STEP_ARRAYS}
