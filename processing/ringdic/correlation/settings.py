"""What a correlation is told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.errors import InputError

SUBSETS = ("circle", "square")
INTERPOLATIONS = {"cubic": 3, "quintic": 5}


@dataclass(frozen=True)
class CorrelationSettings:
    """Settings of the correlation of one pair of images.

    radius, step : px; subset radius (half the side of a square, less half a pixel) and spacing of the points.
    order : 1 for affine shape functions, 2 for quadratic ones.
    subset : "circle" or "square"; always cut by the mask.
    interpolation : "quintic" or "cubic" B-spline of the current image.
    interpolation, tolerance : by what they cost in truth. Radius 20, speckle of 1.0, 1.5, 2.0 px (standard deviation of
        its blur): a cubic is biased by up to 4.1, 0.75, 0.22 thousandths of a pixel, a quintic by 0.99, 0.06, 0.01. A
        tolerance of 2e-3 leaves 0.2 thousandths where noise makes 3.5, and a mean of less than 0.01.
    tolerance : px; iteration stops when the next step, judged by how the last two shrank (after one: by how those of
        other points did), would move the subset's rim by less, in the root mean square sense, or steps below 1e-5 px
        shrink no more. Below 1e-6 px all is computed in double precision, at a fifth of the speed.
    max_iterations : after so many the point is lost, or sooner when its steps foretell that these will not do.
    zncc_min : below this a point is lost.
    texture_min : least root-mean-square gradient along the weakest direction, in 1/255 of the grey range a pixel;
        the rounding to whole grey levels alone makes 0.5.
    noise : standard deviation of the grey levels; None takes it from the residual of each subset.
    """

    radius: int = 20
    step: int = 10
    order: int = 1
    subset: str = "circle"
    interpolation: str = "quintic"
    tolerance: float = 2e-3
    max_iterations: int = 50
    zncc_min: float = 0.7
    texture_min: float = 1.0
    noise: float | None = None

    def __post_init__(self) -> None:
        _require(2 <= self.radius <= 500, f"the subset radius must be 2 to 500 px, not {self.radius}")
        _require(self.step >= 1, f"the step must be at least 1 px, not {self.step}")
        _require(self.order in (1, 2), f"the order of the subset must be 1 or 2, not {self.order}")
        _require(self.subset in SUBSETS, f"the subset must be one of {', '.join(SUBSETS)}, not '{self.subset}'")
        _require(
            self.interpolation in INTERPOLATIONS,
            f"the interpolation must be one of {', '.join(INTERPOLATIONS)}, not '{self.interpolation}'",
        )
        _require(self.tolerance > 0, f"the tolerance must be positive, not {self.tolerance}")
        _require(self.max_iterations >= 1, f"max_iterations must be at least 1, not {self.max_iterations}")
        _require(-1 <= self.zncc_min < 1, f"zncc_min must lie in [-1, 1), not {self.zncc_min}")
        _require(self.noise is None or self.noise > 0, f"the noise must be positive, not {self.noise}")

    @property
    def degree(self) -> int:
        """Degree of the B-spline."""
        return INTERPOLATIONS[self.interpolation]

    @property
    def precision(self) -> type:
        """Type of the grey levels and of the sums over a subset: float32 resolves 1e-6 px."""
        return np.float64 if self.tolerance < 1e-6 else np.float32


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise InputError(f"correlation: {sentence}")
