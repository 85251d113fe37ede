"""The file of the results, see `ringdic.results.results`, written a step at a time."""

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

from ringdic.arrays import Floats
from ringdic.results import vtkhdf
from ringdic.results.fields import StepFields, available, compute_fields
from ringdic.results.json_values import plain
from ringdic.results.ranges import Extent, Ranges
from ringdic.results.results import SCHEMA, Matches, Results
from ringdic.results.series import InMemory, Series
from ringdic.strain.deformation import Deformation
from ringdic.strain.rigid_motion import RigidMotion
from ringdic.strain.window import strain_window

T = TypeVar("T")

#: Arrays kept for every step as they are; the other fields follow from them and from the positions.
_KEPT = (
    "displacement", "correlation", "sigma_xyz", "sigma_displacement", "chi2",
    "J", "lambda1", "lambda2", "E1", "E2", "E_tensor", "direction1_reference", "direction1_current", "isotropy",
    "linear1", "linear2",
    "sigma_calibration", "sigma_displacement_calibration", "sigma_lambda_calibration1", "sigma_lambda_calibration2",
    "face_correlation", "sigma_lambda1", "sigma_lambda2", "window_lambda1", "window_lambda2", "window_E1", "window_E2",
    "window_sigma_lambda1", "window_sigma_lambda2",
)  # fmt: skip
#: Arrays that are the same at every step.
_CONSTANT = ("area", "pair")
_OF_MATCHES = ("px", "c_ls", "sigma", "status")


def write_results(path: Path, results: Results, progress: Callable[[float], None] = lambda _: None) -> None:
    """Compute all fields and write the file; ``path`` must not exist. ``progress`` is told the share done."""
    write_series(path, InMemory(results), progress, results.calibration, results.summary)


def write_series(
    path: Path,
    series: Series,
    progress: Callable[[float], None],
    calibration: dict[str, Any],
    summary: dict[str, Any],
) -> None:
    """The same of results that are not all in memory. calibration, summary : JSON values."""
    with ResultsWriter(path, series.reference, series.names) as file:

        def made(step: int) -> StepRecord:
            only = series.at(step)
            last = len(only.steps) - 1
            return file.made(only, only.motion(last), only.deformation(last))

        for step, one in enumerate(in_turn(made, range(len(series.names)))):
            file.write(step, one)
            progress((step + 1) / len(series.names))
        file.finish(calibration, summary)


def in_turn(made: Callable[[int], T], steps: Sequence[int]) -> Iterator[T]:
    """What is made of each step, in order; as many at once as there are cores, which bounds the memory."""
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for step in steps:
            waiting.append(pool.submit(made, step))
            if len(waiting) > (os.cpu_count() or 1):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@dataclass(frozen=True)
class StepRecord:
    """What the file keeps of one step.

    positions : (N, 3) mm, finite. point, face : arrays of the points and of the triangles. extent : of the fields.
    motion : back onto the reference. matches : of the step alone.
    """

    positions: Floats
    point: dict[str, NDArray[Any]]
    face: dict[str, NDArray[Any]]
    extent: Extent
    motion: RigidMotion
    matches: tuple[dict[str, NDArray[Any]], ...]


class ResultsWriter:
    """A file of results while its steps are written.

    path : must not exist. reference : the results of the reference alone, with all that will be known of every step.
    names : (F,) captures.
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
        for name in _CONSTANT:
            vtkhdf.write_constant(self._group, "CellData", name, first.face[name].astype(np.float32))
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

    def made(self, results: Results, motion: RigidMotion, found: Deformation) -> StepRecord:
        """What is written of the last step of some results; of several steps at once, from several threads.

        motion, found : its rigid motion back onto the reference and its deformation.
        """
        last = len(results.steps) - 1
        fields = self._fields(results, motion, found)
        measured = np.isfinite(results.vertices[last]).all(axis=1)
        positions = np.where(measured[:, None], results.vertices[last], results.vertices_ref)
        flags = {"measured": measured.astype(np.uint8), "status": results.status[last].astype(np.int8)}
        matches = tuple({name: getattr(each, name)[last] for name in _OF_MATCHES} for each in results.matches)
        extent = self._ranges.extent(fields)
        return StepRecord(positions, {**_kept(fields.point), **flags}, _kept(fields.face), extent, motion, matches)

    def write(self, step: int, one: StepRecord) -> None:
        """Write one step; they come in order."""
        vtkhdf.write_step(self._group, step, one.positions, one.point, one.face)
        for k, matches in enumerate(one.matches):
            for name, values in matches.items():
                self._own[f"matches/{k}/{name}"][step] = values
        self._ranges.take(one.extent)
        self._motions.append(one.motion)

    def finish(self, calibration: dict[str, Any], summary: dict[str, Any]) -> None:
        """Write what is not of a single step. calibration, summary : JSON values."""
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
        own["calibration"] = json.dumps(plain(calibration), allow_nan=False)
        own["summary"] = json.dumps(plain(summary), allow_nan=False)
        cameras = own.create_group("cameras")
        for camera in reference.cameras:
            group = cameras.create_group(camera.id)
            group["P"], group["size"] = camera.P, np.array(camera.size)
            if camera.intrinsics is not None:
                group["K"], group["distortion"] = camera.intrinsics.K, camera.intrinsics.distortion

    def _fields(self, results: Results, motion: RigidMotion, found: Deformation) -> StepFields:
        last = len(results.steps) - 1
        return compute_fields(
            results.vertices_ref, results.vertices[last], results.faces, motion, results.certainty(last), results.pair,
            self._window, self._scatter, found, both_tensors=False,
        )  # fmt: skip

    def _begin(self, group: h5py.Group, matches: Matches) -> None:
        group.attrs["cameras"] = json.dumps(matches.cameras)
        group.attrs["seconds"] = json.dumps(matches.seconds)
        group["xy"], group["vertex"] = matches.xy, matches.vertex
        for name in _OF_MATCHES:
            values = getattr(matches, name)
            group.create_dataset(name, shape=(len(self._names), *values.shape[1:]), dtype=values.dtype)


def _kept(arrays: dict[str, Floats]) -> dict[str, NDArray[np.float32]]:
    return {name: values.astype(np.float32) for name, values in arrays.items() if name in _KEPT}
