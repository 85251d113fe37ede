"""Reference and current images with their gradients and B-spline coefficients, computed once for all pairs."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Mask, Pixels
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.spline import PAD, REACH, Box, coefficients, gradients
from ringdic.errors import InputError

Levels = NDArray[np.floating]
T = TypeVar("T")

_FIT_POINTS = 500  # points at most, of an affine fit to the motion of a region


@dataclass(frozen=True)
class _PreparedImage:
    """An image in a box, with B-spline coefficients computed on first use.

    image : (height, width) grey levels of the whole image, in its own type.
    box : x0, y0, x1, y1 px, ends exclusive.
    degree : of the B-spline, 3 or 5. precision : float32, or float64 for tolerances that need it.
    """

    image: NDArray = field(repr=False)
    box: Box
    degree: int
    precision: type

    @property
    def origin(self) -> Pixels:
        """Position (x, y) of the box's first pixel in the image. (2,) float64, px."""
        return np.array(self.box[:2], dtype=np.float64)

    @cached_property
    def coef(self) -> Levels:
        """B-spline coefficients of the box, padded. (h + 2 PAD, w + 2 PAD).

        They are those of the whole image, since the filter also takes the pixels around the box.
        """
        return coefficients(self.image, self.degree, self.box, self.precision)


@dataclass(frozen=True)
class Reference(_PreparedImage):
    """A reference image in a box around the region of interest, with gradients computed on first use.

    mask : (h, w) bool, the region of interest in the box.
    grey_range : largest grey level, 255 or, of 16 bits, that of the image.
    """

    mask: Mask = field(repr=False)
    grey_range: float
    _cache: dict[Hashable, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def grey(self) -> Levels:
        """Grey levels of the box. (h, w)."""
        return self.get_or_compute("grey", lambda: _crop(self.image, self.box, self.precision))

    @property
    def gradient(self) -> tuple[Levels, Levels]:
        """Derivatives of the grey levels of the box, ∂/∂x and ∂/∂y, grey levels per px. Two (h, w)."""
        return self.get_or_compute("gradient", lambda: gradients(self.image, self.degree, self.box, self.precision))

    @cached_property
    def transpose(self) -> Reference:
        """The reference with x and y exchanged, about its box."""
        along_x, along_y = self.gradient
        cache: dict[Hashable, Any] = {
            "grey": _transpose(self.grey),
            "gradient": (_transpose(along_y), _transpose(along_x)),
        }
        box, mask = _transpose_box(self.box), _transpose(self.mask)
        return replace(self, image=_transpose_about(self.image, self.box), box=box, mask=mask, _cache=cache)

    def get_or_compute(self, key: Hashable, compute: Callable[[], T]) -> T:
        """The value stored under a key, computed by ``compute`` and stored on first use.

        Quantities of the reference alone are thus computed once for all images that are matched to it.
        """
        if key not in self._cache:
            self._cache[key] = compute()
        value: T = self._cache[key]
        return value


@dataclass(frozen=True)
class Current(_PreparedImage):
    """A current image in a box where matches can lie."""

    @cached_property
    def transpose(self) -> Current:
        """The current image with x and y exchanged, about its box."""
        return replace(self, image=_transpose_about(self.image, self.box), box=_transpose_box(self.box))

    def crop_around(self, positions: Pixels, margin: float) -> Current:
        """The current image with its box reduced to given positions and a margin around them.

        positions : (k, 2) float64, px. margin : px. A box that would hardly be smaller is left as it is.
        """
        x0, y0, x1, y1 = self.box
        (left, right), (top, bottom) = (
            (int(np.floor(at.min() - margin)), int(np.ceil(at.max() + margin)) + 1) for at in positions.T.copy()
        )
        box = (
            max(x0, min(left, x1 - 8)), max(y0, min(top, y1 - 8)),
            min(x1, max(right, x0 + 8)), min(y1, max(bottom, y0 + 8)),
        )  # fmt: skip
        if (box[2] - box[0]) * (box[3] - box[1]) > 0.7 * (x1 - x0) * (y1 - y0):
            return self
        return replace(self, box=box)

    def crop_by_affine_fit(self, at: Pixels, to: Pixels, xy: Pixels, radius: int) -> Current:
        """The current image with its box reduced to where an affine fit of some matches predicts all points.

        at, to : (k, 2) float64, px, reference and current positions of the matched points.
        xy : (n, 2) float64, px, reference positions of all points. radius : px, of the subset; the margin is three of
            it and 32 px.
        """
        some = slice(None, None, max(1, len(at) // _FIT_POINTS))
        fit = np.linalg.lstsq(np.insert(at[some], 0, 1.0, axis=1), to[some], rcond=None)[0]
        return self.crop_around(np.concatenate([to, fit[0] + xy @ fit[1:]]), 3.0 * radius + 32.0)


def prepare_reference(
    image: NDArray, mask: Mask | None = None, settings: CorrelationSettings | None = None
) -> Reference:
    """Prepare a reference image for correlation, in the box around its region of interest.

    image : (h, w) grey levels, 8 or 16 bits or float. mask : (h, w) bool, region of interest; None for the whole image.
    Raises InputError for an empty mask or one of another size.
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
    return Reference(image, box, settings.degree, settings.precision, region, _grey_range(image))


def prepare_current(image: NDArray, roi: Box | None = None, settings: CorrelationSettings | None = None) -> Current:
    """Prepare a current image for correlation, whole or in a box where matches can lie.

    image : (h, w) grey levels, 8 or 16 bits or float.
    roi : box x0, y0, x1, y1 px, ends exclusive; None for the whole image. A subset that leaves the box is lost as if it
        left the image.
    Raises InputError for a box that is empty or outside the image.
    """
    settings = settings or CorrelationSettings()
    _check_image(image, "current")
    box = _clip(roi or (0, 0, image.shape[1], image.shape[0]), image.shape)
    if box[2] - box[0] < 8 or box[3] - box[1] < 8:
        raise InputError(f"the box {roi} of the current image is empty or lies outside it")
    return Current(image, box, settings.degree, settings.precision)


def as_8_bit(image: NDArray) -> NDArray[np.uint8]:
    """An image in 8 bits for the search of start values, its 0.1 to 99.9 percentiles stretched to the whole range.

    image : (h, w) grey levels of any type. Returns (h, w) uint8 grey levels, the image itself if it has 8 bits.
    """
    if image.dtype == np.uint8:
        return image
    low, high = np.percentile(image[::4, ::4], [0.1, 99.9])
    return np.clip((image - low) * (255.0 / max(high - low, 1e-9)), 0, 255).astype(np.uint8)


def _grey_range(image: NDArray) -> float:
    """Largest grey level that an image of this type can have; images of 10 and 12 bits also come in 16."""
    if image.dtype == np.uint16:
        return max(float(image.max()), 255.0)
    return 255.0


def _clip(box: Box, shape: tuple[int, ...]) -> Box:
    """The part of a box that lies inside an image of this shape."""
    return max(int(box[0]), 0), max(int(box[1]), 0), min(int(box[2]), shape[1]), min(int(box[3]), shape[0])


def _transpose(image: NDArray) -> NDArray:
    """Transposed copy of an image or mask."""
    whole = image.view(np.uint8) if image.dtype == np.bool_ else image
    return np.asarray(cv2.transpose(whole)).view(image.dtype)  # by blocks: five times faster than a copy of image.T


def _transpose_about(image: NDArray, box: Box) -> NDArray:
    """Transposed copy of an image, filled only in a box and where filters of the box reach."""
    margin = PAD + REACH
    x0, y0, x1, y1 = _clip((box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin), image.shape)
    out = np.empty(image.shape[::-1], image.dtype)
    out[x0:x1, y0:y1] = _transpose(image[y0:y1, x0:x1])
    return out


def _transpose_box(box: Box) -> Box:
    """A box with x and y exchanged."""
    return box[1], box[0], box[3], box[2]


def _crop(image: NDArray, box: Box, precision: type) -> Levels:
    """Contiguous copy of a box of an image in the given precision."""
    return np.ascontiguousarray(image[box[1] : box[3], box[0] : box[2]], dtype=precision)


def _check_image(image: NDArray, name: str) -> None:
    """Raise InputError unless an image is grey and at least 8 px wide and high."""
    if image.ndim != 2 or min(image.shape) < 8:
        raise InputError(f"the {name} image must be grey and at least 8 px wide and high, not of shape {image.shape}")
