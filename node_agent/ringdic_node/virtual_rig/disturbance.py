"""What happens to the cameras of a real rig: knocked, turned, refocused, and exposed otherwise than the rest.

Every change of a camera is stated as it is noticed: in pixels of its image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ringdic_node.virtual_rig.arrays import Floats, Radiance
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.rotation import rotation

_RED, _BLUE = 0.5, 0.6  # of the green values, in white light
_BODY = np.array([0.0, 0.0, 125.0])  # mm, the middle of what stands in the rig


@dataclass(frozen=True)
class ShotCondition:
    """How an image is taken, where that differs from the calm rig.

    light : exposure times gain, 1 is calm. noise : standard deviation of the sensor's noise, 1 is calm. smear : motion
    of the image during the exposure, along x and y, px. mirrored : whether left and right are exchanged in the file;
    upside_down : whether it is turned by 180°. mosaic : whether the file holds the raw values under the colour filters,
    without balance of the colours, where the calm one holds the luminance.
    """

    light: float = 1.0
    noise: float = 1.0
    smear: tuple[float, float] = (0.0, 0.0)
    mirrored: bool = False
    upside_down: bool = False
    mosaic: bool = False


CALM = ShotCondition()


def turned_camera(camera: VirtualCamera, across: float, along: float) -> VirtualCamera:
    """A camera turned about its centre, so that the image of the body moves by ``across`` px in x and ``along`` in y.

    The shift holds in the middle of the body.
    """
    # A rotation vector (a, b, 0) moves the normalised point on the axis of the lens by about (b, -a).
    aim, vector = camera.project(_BODY[None])[0] + np.array([across, along]), np.zeros(2)
    for _ in range(4):
        moved = _with_pose(camera, rotation(np.array([*vector, 0.0])))
        missing = aim - moved.project(_BODY[None])[0]
        vector = vector + np.array([-missing[1] / camera.K[1, 1], missing[0] / camera.K[0, 0]])
    return _with_pose(camera, rotation(np.array([*vector, 0.0])))


def shifted_camera(camera: VirtualCamera, across: float, along: float) -> VirtualCamera:
    """A camera shifted sideways, so that the image of the body's middle moves by ``across`` px in x, ``along`` in y."""
    depth = float((camera.R @ _BODY + camera.t)[2])
    aside = np.array([across * depth / camera.K[0, 0], along * depth / camera.K[1, 1], 0.0])
    return replace(camera, t=camera.t + aside)


def rolled_camera(camera: VirtualCamera, px: float) -> VirtualCamera:
    """A camera rolled about its line of sight, so that points a third of the image's height away move by ``px``."""
    return _with_pose(camera, rotation(np.array([0.0, 0.0, px / (camera.height / 3.0)])))


def retracted_camera(camera: VirtualCamera, px: float) -> VirtualCamera:
    """A camera moved back along its line of sight: points a third of the image's height from its middle move by px."""
    depth = float((camera.R @ _BODY + camera.t)[2])
    return replace(camera, t=camera.t + np.array([0.0, 0.0, depth * px / (camera.height / 3.0)]))


def refocused_camera(camera: VirtualCamera, factor: float) -> VirtualCamera:
    """A camera whose lens was refocused: its focal length is ``factor`` times as long."""
    K = camera.K.copy()
    K[:2, :2] *= factor
    return replace(camera, K=K)


def mosaicked(image: Radiance) -> Radiance:
    """An image (height, width) under the colour filters of a sensor, in linear light without unit.

    Even rows have red and green pixels, odd ones green and blue. Under white light a silicon sensor with common filters
    gives half as much red, and six tenths as much blue, as green.
    """
    out = image.copy()
    out[0::2, 0::2] *= np.float32(_RED)
    out[1::2, 1::2] *= np.float32(_BLUE)
    return out


def smeared(image: Radiance, smear: tuple[float, float]) -> Radiance:
    """An image (height, width), in linear light without unit, that moved evenly during the exposure.

    smear : along x and y, px; the mean place is kept.
    """
    length = math.hypot(*smear)
    if length == 0.0:
        return image
    count = max(3, math.ceil(4.0 * length))
    total = np.zeros(image.shape, np.float32)
    for share in (np.arange(count) + 0.5) / count - 0.5:
        total += _shifted(image, share * smear[0], share * smear[1])
    return total / np.float32(count)


def _shifted(image: Radiance, x: float, y: float) -> Radiance:
    """An image (height, width) moved by x, y px, linear between the pixels and repeated at its rim."""
    for axis, shift in ((1, x), (0, y)):
        whole = math.floor(shift)
        part = np.float32(shift - whole)
        index = np.arange(image.shape[axis]) - whole
        last = image.shape[axis] - 1
        near, next_ = (np.take(image, np.clip(index - k, 0, last), axis=axis) for k in (0, 1))
        image = (np.float32(1.0) - part) * near + part * next_
    return image


def _with_pose(camera: VirtualCamera, turn: Floats) -> VirtualCamera:
    """The camera turned about its centre by a rotation (3, 3) in its own frame."""
    return replace(camera, R=turn @ camera.R, t=turn @ camera.t)
