"""Settings of the correlation of one pair of images, with names without units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from ringdic.errors import InputError
from ringdic.settings import CorrelationGroup, Location, Wording, faults, name_without_unit

_DEFAULTS = CorrelationGroup()
_DEGREES = {"cubic": 3, "quintic": 5}


@dataclass(frozen=True)
class CorrelationSettings:
    """Settings of the correlation of one pair of images.

    Names (without their units), defaults and bounds are those of `ringdic.settings.CorrelationGroup`, where each is
    explained; `texture_min` and `noise` are the correlation's own.

    radius, step : px; subset radius and spacing of the points.
    order : 1 for affine shape functions, 2 for quadratic ones.
    subset : "circle" or "square".
    interpolation : "quintic" or "cubic" B-spline of the current image.
    tolerance : px; the iteration stops when the subset's rim would move by less.
    max_iterations : after so many the point is lost.
    zncc_min : below this a point is lost.
    texture_min : least root-mean-square gradient along the weakest direction, in 1/255 of the grey range a pixel;
        the rounding to whole grey levels alone makes 0.5.
    noise : standard deviation of the grey levels; None takes it from the residual of each subset.

    Raises InputError where a value is out of bounds.
    """

    radius: int = _DEFAULTS.radius_px
    step: int = _DEFAULTS.step_px
    order: int = _DEFAULTS.order
    subset: str = _DEFAULTS.subset
    interpolation: str = _DEFAULTS.interpolation
    tolerance: float = _DEFAULTS.tolerance
    max_iterations: int = _DEFAULTS.max_iterations
    zncc_min: float = _DEFAULTS.zncc_min
    texture_min: float = 1.0
    noise: float | None = None

    def __post_init__(self) -> None:
        names = {name_without_unit(name): name for name in CorrelationGroup.model_fields}
        try:
            CorrelationGroup.model_validate({name: getattr(self, own) for own, name in names.items()})
        except ValidationError as error:
            raise InputError(f"correlation: {faults(error, CorrelationGroup, _WORDING)}") from error
        if self.noise is not None and not self.noise > 0:
            raise InputError(f"correlation: noise must be greater than 0, not {self.noise}")

    @property
    def degree(self) -> int:
        """Degree of the B-spline."""
        return _DEGREES[self.interpolation]

    @property
    def precision(self) -> type:
        """Type of the grey levels and of the sums over a subset: float32 resolves 1e-6 px."""
        return np.float64 if self.tolerance < 1e-6 else np.float32


def _own_name(_: type, at: Location) -> str:
    return name_without_unit(str(at[0]))


_WORDING = Wording(_own_name)
