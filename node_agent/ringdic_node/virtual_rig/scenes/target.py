"""The calibration cylinder: 30 columns of 20 printed squares, column numbers, one mark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic_node.virtual_rig.arrays import Floats
from ringdic_node.virtual_rig.body import CYLINDER
from ringdic_node.virtual_rig.texture import RADIUS

COLUMNS, ROWS = 30, 20
_LARGEST = 0.5  # mm of print error: a dot stays in its own cell of the print


@dataclass(frozen=True)
class TargetScene:
    """The calibration target, displaced by ``offset`` mm from the place at which it defines the world frame.

    print_error : standard deviation of the printed dots' places along the arc and along the axis, mm, drawn from
    ``seed`` and never beyond 0.5 mm.
    """

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    print_error: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.print_error <= 0.2:
            raise ValueError(f"a print error must lie between 0 and 0.2 mm, not {self.print_error}")

    def body(self) -> Floats:
        """Parameters (6,) of the surface, as `ringdic_node.virtual_rig.body` defines them; mm."""
        return np.array([CYLINDER, RADIUS, *self.offset, 0.0])

    def prints(self) -> Floats:
        """Print errors: deviation of each dot from its nominal place along arc and axis, (20, 30, 2) mm, row by row."""
        drawn = np.random.default_rng([self.seed, 3012]).standard_normal((ROWS, COLUMNS, 2))
        return np.clip(self.print_error * drawn, -_LARGEST, _LARGEST)

    def dots(self) -> Floats:
        """Centres of the printed dots in space, (20 rows, 30 columns, 3) mm, world frame."""
        prints = self.prints()
        theta = (np.arange(COLUMNS) * 12.0 + prints[..., 0]) / RADIUS
        z = 10.0 + 12.0 * np.arange(ROWS)[:, None] + prints[..., 1]
        return np.stack([RADIUS * np.cos(theta), RADIUS * np.sin(theta), z], axis=-1) + np.array(self.offset)
