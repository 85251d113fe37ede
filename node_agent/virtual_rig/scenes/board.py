"""The checkerboard held before each camera: 15 x 20 squares of 10 mm on white, a pose of its own for every view."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from node_agent.virtual_rig.lens import VirtualCamera

Array = NDArray[np.float64]

SQUARES = (15, 20)
SQUARE = 10.0  # mm
MARGIN = 15.0  # mm of white around the squares


@dataclass(frozen=True)
class Board:
    """View number ``index`` of the board; the pose also depends on the camera and the seed."""

    index: int
    seed: int = 0

    def pose(self, camera: VirtualCamera) -> tuple[Array, Array]:
        """R (3, 3) and t (3,) mm from the board's frame to the camera's.

        The board's frame has its origin at the corner of the squares, x across, y along, both as the squares run.
        Poses are drawn until the whole sheet lies in the image; tilts reach about 40°.
        """
        rng = np.random.default_rng([self.seed, zlib.crc32(camera.id.encode()), self.index])
        middle = np.array([SQUARES[0], SQUARES[1], 0]) * SQUARE / 2
        for attempt in range(200):
            calm = 1.0 if attempt < 150 else 0.3
            R = _rotation(rng.uniform(-40, 40) * calm, rng.uniform(-40, 40) * calm, rng.uniform(-25, 25))
            distance = rng.uniform(290, 400)
            place = np.array([rng.uniform(-70, 70) * calm, rng.uniform(-110, 110) * calm, distance])
            t = place - R @ middle
            px = camera.project_local(self.sheet() @ R.T + t)
            edge = 0.01 * camera.width
            if (px > edge).all() and (px < [camera.width - edge, camera.height - edge]).all():
                return R, t
        raise RuntimeError(f"no pose of the board fits the image of {camera.id}")

    @staticmethod
    def sheet() -> Array:
        """Points round the sheet's rim (n, 3) mm."""
        w, h = SQUARES[0] * SQUARE + MARGIN, SQUARES[1] * SQUARE + MARGIN
        across, along = np.linspace(-MARGIN, w, 9), np.linspace(-MARGIN, h, 9)
        rim = [(x, y, 0.0) for x in across for y in (-MARGIN, h)] + [(x, y, 0.0) for x in (-MARGIN, w) for y in along]
        return np.array(rim)

    def corners(self, camera: VirtualCamera) -> Array:
        """True inner corners in the image, (266, 2) px, across first."""
        y, x = np.mgrid[1 : SQUARES[1], 1 : SQUARES[0]] * SQUARE
        R, t = self.pose(camera)
        xyz = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return camera.project_local(xyz @ R.T + t)


def _rotation(about_x: float, about_y: float, about_z: float) -> Array:
    """Rotation by angles in degrees about x, then y, then z."""
    a, b, c = np.radians([about_x, about_y, about_z])
    X = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    Y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    Z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(Z @ Y @ X)
