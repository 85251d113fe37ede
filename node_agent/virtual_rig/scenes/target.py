"""The calibration cylinder: 30 columns of 20 printed squares, column numbers, one mark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from node_agent.virtual_rig.body import CYLINDER
from node_agent.virtual_rig.texture import RADIUS

Array = NDArray[np.float64]

COLUMNS, ROWS = 30, 20


@dataclass(frozen=True)
class Target:
    """The target, displaced by ``offset`` mm from where it defines the world."""

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def body(self) -> Array:
        """Parameters of the surface."""
        return np.array([CYLINDER, RADIUS, *self.offset, 0.0])

    def dots(self) -> Array:
        """Centres of the dots (20 rows, 30 columns, 3) mm."""
        theta = np.arange(COLUMNS) * 12.0 / RADIUS
        z = 10.0 + 12.0 * np.arange(ROWS)
        ring = np.stack([RADIUS * np.cos(theta), RADIUS * np.sin(theta)], axis=-1)
        xyz = np.concatenate(
            [np.broadcast_to(ring, (ROWS, COLUMNS, 2)), np.broadcast_to(z[:, None, None], (ROWS, COLUMNS, 1))], axis=-1
        )
        return xyz + np.array(self.offset)
