"""Reference images of all cameras, as the charts are matched in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from ringdic.arrays import Image
from ringdic.correlation import CorrelationSettings, Current, prepare_current
from ringdic.geometry.camera import Camera


@dataclass
class ChartImages:
    """Reference images of all cameras, each prepared once as a current image.

    cameras : the C calibrated cameras. image : function that returns the image of camera number k, (height, width)
    grey levels. settings : of the correlation.
    """

    cameras: Sequence[Camera]
    image: Callable[[int], Image]
    settings: CorrelationSettings
    _current: dict[int, Current] = field(default_factory=dict)

    def current(self, k: int) -> Current:
        """Image of camera k as a current image."""
        if k not in self._current:
            self._current[k] = prepare_current(self.image(k), settings=self.settings)
        return self._current[k]
