"""Tasks of the measurement by all cameras together: the reference shape, then the tracks of each camera.

A camera tracks its points through blocks of steps. A block starts from the state in which the previous one ended, so
the blocks of a camera run one after the other, and the cameras side by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ringdic.correlation import CorrelationSettings
from ringdic.geometry.camera import Camera
from ringdic.multiview.shape import ReferenceShape, ShapeSettings, reference_shape
from ringdic.multiview.surface import pair_indices, reference_pixels, shape_settings, tracking_settings
from ringdic.multiview.tracking import CameraTrack, Tracking, TrackState, at_reference, track_block
from ringdic.session.folder import Capture, Session
from ringdic.session.images import read_mask
from ringdic.settings import Settings
from ringdic.sweep.sweep import DepthSearch
from ringdic.tasks import Arrays, Task, code_stamp, digest, read_output, work_folder
from ringdic.tasks.step_images import Digests, Image, step_image

T = TypeVar("T")

_BLOCK = 4  # steps of a task: few enough to lose little when one is interrupted, enough that starting it costs little
_SHAPE_COST = 8.0  # of the shape, for each camera, in units of one camera's step
_STATE, _TRACK = "state_", "track_"


@dataclass(frozen=True)
class MultiviewJob:
    """Tasks of a measurement by all cameras: the reference shape, and for each camera the blocks of steps in order."""

    cameras: tuple[Camera, ...]
    shape: Task
    blocks: tuple[tuple[Task, ...], ...]

    @property
    def tasks(self) -> list[Task]:
        """All tasks: the shape, then block after block of all cameras."""
        return [self.shape, *(task for turn in zip(*self.blocks, strict=True) for task in turn)]

    def outputs(self) -> tuple[ReferenceShape, dict[int, CameraTrack]]:
        """Reference shape, and the track through all steps of each camera that sees some of it, by index of the camera.

        Raises ComputationError where the shape could not be measured.
        """
        shape = ReferenceShape.from_arrays(read_output(self.shape.output))
        tracks = {}
        for k, (camera, blocks) in enumerate(zip(self.cameras, self.blocks, strict=True)):
            vertex, x0 = reference_pixels(camera, shape, k)
            if len(vertex):
                later = [_part(CameraTrack, read_output(task.output), _TRACK) for task in blocks]
                tracks[k] = CameraTrack.joined([at_reference(x0, camera.size[::-1]), *later])
        return shape, tracks


def multiview_job(
    session: Session,
    cameras: Sequence[Camera],
    pairs: Sequence[tuple[str, str]],
    steps: Sequence[Capture],
    search: DepthSearch,
    settings: Settings,
) -> MultiviewJob:
    """Create the tasks of a session's measurement by all cameras together.

    cameras : all with a reference image. pairs : ids of neighbouring cameras. steps : captures, the reference first.
    search : region in which the surface may lie.
    """
    digests, folder = Digests(session), work_folder(session.path)
    correlation = CorrelationSettings(**settings.correlation.keywords)
    indices, shape_options = pair_indices(cameras, pairs), shape_settings(settings)
    masks = {camera.id: mask for camera in cameras if (mask := session.mask(camera.id)) is not None}
    references = [[digests.image(steps[0], camera.id), digests.mask(camera.id)] for camera in cameras]
    shape = Task(
        digest(code_stamp(), "shape", list(cameras), indices, search, correlation, shape_options, references),
        "shape of the reference",
        shape_task,
        (tuple(cameras), tuple(indices), search, correlation, shape_options, dict(steps[0].images), masks),
        folder,
        cost=_SHAPE_COST * len(cameras),
    )
    options = tracking_settings(settings)
    blocks = []
    for k, camera in enumerate(cameras):
        images = [step.images.get(camera.id) for step in steps]
        row: list[Task] = []
        for first in range(1, len(steps), _BLOCK):
            part = range(first, min(first + _BLOCK, len(steps)))
            needs = (shape.key, *([row[-1].key] if row else []))
            images_of_block = [digests.image(steps[step], camera.id) for step in part]
            row.append(
                Task(
                    digest("track", needs, k, correlation, options, images_of_block),
                    f"camera {camera.id}, {steps[part[0]].id} to {steps[part[-1]].id}",
                    track_task,
                    (camera, k, correlation, options, tuple(images[: part[-1] + 1]), part, masks.get(camera.id)),
                    folder,
                    needs,
                    cost=float(len(part)),
                )
            )
        blocks.append(tuple(row))
    return MultiviewJob(tuple(cameras), shape, tuple(blocks))


def shape_task(
    cameras: tuple[Camera, ...],
    pairs: tuple[tuple[int, int], ...],
    search: DepthSearch,
    correlation: CorrelationSettings,
    shape_options: ShapeSettings,
    images: Mapping[str, Path],
    masks: Mapping[str, Path],
    *,
    inputs: tuple[Path, ...],
) -> Arrays:
    """Measure the reference shape.

    cameras : all with a reference image. pairs : indices of neighbouring cameras. images, masks : files by camera id.
    inputs : none. Returns the arrays of the shape, and "points", the number of matches computed.
    """
    del inputs
    by_id = {camera.id: camera for camera in cameras}
    mask_images = {id_: read_mask(path, by_id[id_].size[::-1]) for id_, path in masks.items()}

    def image(id_: str) -> Image | None:
        return step_image(images[id_], by_id[id_]) if id_ in images else None

    shape = reference_shape(cameras, image, mask_images, pairs, search, correlation, shape_options)
    return {**shape.arrays(), "points": np.array(shape.match_count)}


def track_task(
    camera: Camera,
    k: int,
    correlation: CorrelationSettings,
    options: Tracking,
    images: tuple[Path | None, ...],
    steps: range,
    mask: Path | None,
    *,
    inputs: tuple[Path, ...],
) -> Arrays:
    """Track the points of one camera through a block of steps.

    camera, k : the camera and its index. images : files of all steps up to the block's last one, the reference
    first, None where there is none. steps : of the block. mask : file of the region drawn by the user. inputs :
    outputs of the shape and of the previous block. Returns the arrays of the track and of the state in which the
    block ends.
    """
    shape_file, *previous = inputs
    _, x0 = reference_pixels(camera, ReferenceShape.from_arrays(read_output(shape_file)), k)
    state = _part(TrackState, read_output(previous[0]), _STATE) if previous else None

    def image(step: int) -> Image | None:
        path = images[step]
        return None if path is None else step_image(path, camera)

    reference = image(0)
    assert reference is not None  # cameras without a reference image are not used
    mask_image = None if mask is None else read_mask(mask, camera.size[::-1])
    track, state = track_block(reference, image, steps, x0, mask_image, correlation, options, state)
    arrays = {f"{_TRACK}{name}": values for name, values in track.arrays().items()}
    arrays |= {f"{_STATE}{name}": np.asarray(values) for name, values in state.arrays().items()}
    return {**arrays, "points": np.array(len(x0) * len(steps))}


def _part(kind: type[T], arrays: Mapping[str, NDArray[Any]], prefix: str) -> T:
    """Rebuild a dataclass from its arrays, stored under names with a prefix."""
    return kind(**{name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)})
