"""The checkerboard before each camera: 15 x 20 squares of 10 mm on white, in another pose for every view."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numba as nb
import numpy as np

from ringdic_node.virtual_rig.arrays import Floats
from ringdic_node.virtual_rig.lens import VirtualCamera

SQUARES = (15, 20)
SQUARE = 10.0  # mm
MARGIN = 15.0  # mm of white around the squares
_ATTEMPTS = 300
_STEEPEST = np.cos(np.radians(50.0))  # of the board's normal to the line of sight
_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])  # 1/p and 1/p² of the plastic number p


@dataclass(frozen=True)
class BoardScene:
    """The checkerboard in view number ``index``; its pose also depends on the camera and the seed.

    bow : mm, by which the middle of the sheet lies behind its upper and lower edge, 0 for a flat board.
    """

    index: int
    seed: int = 0
    bow: float = 0.0

    def pose(self, camera: VirtualCamera) -> tuple[Floats, Floats]:
        """Pose of the board: R (3, 3) and t (3,) mm from the board's frame to the camera's.

        The board's frame has its origin at the first corner of the squares, x across and y along them.
        The middles of successive views spread evenly over the image (the additive recurrence of the plastic number:
        Roberts 2018). Random poses are tried until all squares, though not always the
        margin, lie in the image; tilts are 25° to 45°, and at most 50° against the line of sight.
        """
        name = zlib.crc32(camera.id.encode())
        rng = np.random.default_rng([self.seed, name, self.index])
        start = np.random.default_rng([self.seed, name]).uniform(size=2)
        spread = (start + self.index * _PLASTIC) % 1.0 - 0.5
        middle = np.array([SQUARES[0], SQUARES[1], 0]) * SQUARE / 2
        rim = self.rim()
        edge = 0.012 * camera.width
        for attempt in range(_ATTEMPTS):
            shrink = 1.0 - attempt / _ATTEMPTS  # a place far out moves inwards until the board fits
            tilt, towards = rng.uniform(25.0, 45.0), rng.uniform(0.0, 2.0 * np.pi)
            R = _rotation(tilt * np.cos(towards), tilt * np.sin(towards), rng.uniform(-25, 25))
            distance = rng.uniform(290, 400)
            place = shrink * spread * [camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]]
            t = distance * np.array([*place, 1.0]) - R @ middle
            sight = R[:, 2] @ (R @ middle + t) / np.linalg.norm(R @ middle + t)
            if abs(sight) < _STEEPEST:
                continue
            px = camera.project_local(rim @ R.T + t)
            if (px > edge).all() and (px < [camera.width - edge, camera.height - edge]).all():
                return R, t
        raise RuntimeError(f"no pose of the board fits the image of {camera.id}")

    @staticmethod
    def rim() -> Floats:
        """Points round the rim of the squares, a tenth of a square outside, (n, 3) mm."""
        w, h, out = SQUARES[0] * SQUARE, SQUARES[1] * SQUARE, 0.1 * SQUARE
        across, along = np.linspace(-out, w + out, 9), np.linspace(-out, h + out, 9)
        points = [(x, y, 0.0) for x in across for y in (-out, h + out)]
        return np.array(points + [(x, y, 0.0) for x in (-out, w + out) for y in along])

    def corners(self, camera: VirtualCamera) -> Floats:
        """Exact pixels of the 14 x 19 inner corners in a camera's image, (266, 2) px, row by row across the board."""
        y, x = np.mgrid[1 : SQUARES[1], 1 : SQUARES[0]] * SQUARE
        R, t = self.pose(camera)
        xyz = np.stack([x.ravel(), y.ravel(), bow_height(y.ravel(), self.bow)], axis=1)
        return camera.project_local(xyz @ R.T + t)


@nb.njit(nogil=True)
def bow_height(y, bow):  # type: ignore[no-untyped-def]
    """Distance z, mm, of a bowed sheet from the plane of its upper and lower edge. y : mm, along it. bow : mm."""
    off = y / (0.5 * SQUARE * SQUARES[1]) - 1.0
    return bow * (1.0 - off * off)


def _rotation(about_x: float, about_y: float, about_z: float) -> Floats:
    """Rotation by angles in degrees about x, then y, then z."""
    a, b, c = np.radians([about_x, about_y, about_z])
    X = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    Y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    Z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(Z @ Y @ X)
