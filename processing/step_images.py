"""The images of a session's steps as the tasks read them, kept in memory between tasks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.camera import Camera
from processing.errors import InputError
from processing.tasks import kept

Image = NDArray[np.uint8] | NDArray[np.uint16]


def step_image(path: Path, camera: Camera) -> Image:
    """The grey image of a file. InputError where it has not the size that the camera was calibrated at."""
    grey: Image = kept.image(path)
    width, height = camera.size
    if grey.shape != (height, width):
        raise InputError(
            f"{path}: {grey.shape[1]} x {grey.shape[0]} px, but camera {camera.id} was calibrated at "
            f"{width} x {height} px; capture board, target and specimen at one size"
        )
    return grey
