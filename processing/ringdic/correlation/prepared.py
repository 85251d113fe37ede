"""Images made ready for correlation, once for all the pairs they take part in."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Mask
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.spline import REACH, Box, coefficients, gradients
from ringdic.errors import InputError

Levels = NDArray[np.floating]
T = TypeVar("T")

_SOME = 500  # points tell how a region is stretched as a whole


@dataclass(frozen=True)
class Reference:
    """A reference image and the box (x0, y0, x1, y1) of it around its region of interest, filtered when needed.

    image : the whole image as it came; mask : (h, w) bool, the region in the box; grey_range : 255 or 65535.
    precision : float32, or float64 for a tolerance beyond it.
    """

    image: NDArray = field(repr=False)
    box: Box
    mask: Mask = field(repr=False)
    degree: int
    precision: type
    grey_range: float
    _kept: dict[Hashable, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the whole image, px."""
        return self.image.shape[0], self.image.shape[1]

    @property
    def origin(self) -> Floats:
        """(x, y) px of the box in the image."""
        return np.array(self.box[:2], dtype=np.float64)

    @property
    def grey(self) -> Levels:
        """Grey levels of the box. (h, w)."""
        return self.once("grey", lambda: _crop(self.image, self.box, self.precision))

    @property
    def slopes(self) -> tuple[Levels, Levels]:
        """∂/∂x and ∂/∂y of the box, two (h, w)."""
        return self.once("slopes", lambda: gradients(self.image, self.degree, self.box, self.precision))

    @cached_property
    def coef(self) -> Levels:
        """Padded coefficients of the box; only points between the pixels need them."""
        return coefficients(self.image, self.degree, self.box, self.precision)

    @cached_property
    def turned(self) -> Reference:
        """The image turned about its diagonal: x and y exchanged."""
        along_x, along_y = self.slopes
        found: dict[Hashable, Any] = {"grey": _turned(self.grey), "slopes": (_turned(along_y), _turned(along_x))}
        box, mask = _exchanged(self.box), _turned(self.mask)
        return replace(self, image=_turned(self.image), box=box, mask=mask, _kept=found)

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """What ``make`` finds in this image, made when first asked for: of one reference many images are matched."""
        if key not in self._kept:
            self._kept[key] = make()
        kept: T = self._kept[key]
        return kept


@dataclass(frozen=True)
class Current:
    """A current image as it came, and the box (x0, y0, x1, y1) of it where matches can lie, filtered when needed."""

    image: NDArray = field(repr=False)
    box: Box
    degree: int
    precision: type

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the whole image, px."""
        return self.image.shape[0], self.image.shape[1]

    @property
    def origin(self) -> Floats:
        """(x, y) px of the box in the image."""
        return np.array(self.box[:2], dtype=np.float64)

    @cached_property
    def coef(self) -> Levels:
        """Padded coefficients of the box, those of the whole image: the filter sees the pixels around."""
        return coefficients(self.image, self.degree, self.box, self.precision)

    @cached_property
    def turned(self) -> Current:
        """The image turned about its diagonal: x and y exchanged."""
        return replace(self, image=_turned(self.image), box=_exchanged(self.box))

    def around(self, positions: Floats, margin: float) -> Current:
        """The same with the box no larger than the positions (k, 2) px and a margin about them."""
        x0, y0, x1, y1 = self.box
        (left, right), (top, bottom) = (
            (int(np.floor(at.min() - margin)), int(np.ceil(at.max() + margin)) + 1) for at in positions.T
        )
        box = (
            max(x0, min(left, x1 - 8)), max(y0, min(top, y1 - 8)),
            min(x1, max(right, x0 + 8)), min(y1, max(bottom, y0 + 8)),
        )  # fmt: skip
        if (box[2] - box[0]) * (box[3] - box[1]) > 0.7 * (x1 - x0) * (y1 - y0):
            return self
        return Current(self.image, box, self.degree, self.precision)

    def about_all(self, at: Floats, to: Floats, xy: Floats, radius: int) -> Current:
        """The same with a box about where points xy (n, 2) px will lie, judged by some of which it is known.

        at, to : (k, 2) px. An affine fit of them moves and stretches all; the margin is three subset radii and 32 px.
        """
        some = slice(None, None, max(1, len(at) // _SOME))
        fit = np.linalg.lstsq(np.insert(at[some], 0, 1.0, axis=1), to[some], rcond=None)[0]
        return self.around(np.concatenate([to, fit[0] + xy @ fit[1:]]), 3.0 * radius + 32.0)


def prepare_reference(
    image: NDArray, mask: Mask | None = None, settings: CorrelationSettings | None = None
) -> Reference:
    """The reference image (h, w), 8 or 16 bits or float, and the box of its mask (h, w) bool.

    Without a mask all pixels take part. InputError for an empty mask or one of another size.
    """
    settings = settings or CorrelationSettings()
    _check_image(image, "reference")
    mask = np.ones(image.shape, bool) if mask is None else np.asarray(mask, bool)
    if mask.shape != image.shape:
        raise InputError(
            f"the mask is {mask.shape[1]} x {mask.shape[0]} px but the reference image is "
            f"{image.shape[1]} x {image.shape[0]} px"
        )
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(columns):
        raise InputError("the mask marks no pixel; paint the region of interest white")
    margin = 2 + REACH  # the mirrored border is not the image: keep the reach of the filter around the mask
    box = _clip((columns[0] - margin, rows[0] - margin, columns[-1] + 1 + margin, rows[-1] + 1 + margin), image.shape)
    region = np.ascontiguousarray(mask[box[1] : box[3], box[0] : box[2]])
    return Reference(image, box, region, settings.degree, settings.precision, _grey_range(image))


def prepare_current(image: NDArray, roi: Box | None = None, settings: CorrelationSettings | None = None) -> Current:
    """The current image (h, w), or a box (x0, y0, x1, y1; ends exclusive) of it where matches can lie.

    A subset that leaves the box is lost as if it left the image.
    """
    settings = settings or CorrelationSettings()
    _check_image(image, "current")
    box = _clip(roi or (0, 0, image.shape[1], image.shape[0]), image.shape)
    if box[2] - box[0] < 8 or box[3] - box[1] < 8:
        raise InputError(f"the box {roi} of the current image is empty or lies outside it")
    return Current(image, box, settings.degree, settings.precision)


def as_8_bit(image: NDArray) -> NDArray[np.uint8]:
    """The image stretched to 8 bits for the search of start values, between its 0.1 and 99.9 percentiles."""
    if image.dtype == np.uint8:
        return image
    low, high = np.percentile(image[::4, ::4], [0.1, 99.9])
    return np.clip((image - low) * (255.0 / max(high - low, 1e-9)), 0, 255).astype(np.uint8)


def _grey_range(image: NDArray) -> float:
    if image.dtype == np.uint16:
        return max(float(image.max()), 255.0)  # 10 and 12 bits also come in 16
    return 255.0


def _clip(box: Box, shape: tuple[int, ...]) -> Box:
    return max(int(box[0]), 0), max(int(box[1]), 0), min(int(box[2]), shape[1]), min(int(box[3]), shape[0])


def _turned(image: NDArray) -> NDArray:
    whole = image.view(np.uint8) if image.dtype == np.bool_ else image
    return np.asarray(cv2.transpose(whole)).view(image.dtype)  # by blocks: five times faster than a copy of image.T


def _exchanged(box: Box) -> Box:
    return box[1], box[0], box[3], box[2]


def _crop(image: NDArray, box: Box, precision: type) -> Levels:
    return np.ascontiguousarray(image[box[1] : box[3], box[0] : box[2]], dtype=precision)


def _check_image(image: NDArray, name: str) -> None:
    if image.ndim != 2 or min(image.shape) < 8:
        raise InputError(f"the {name} image must be grey and at least 8 px wide and high, not of shape {image.shape}")
