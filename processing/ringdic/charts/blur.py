"""Blur and contrast of one image's pattern beside another's, from the ratio of their spectra.

A blur of covariance S px² leaves the share ``exp(-ω·S·ω)`` of the pattern's power at the frequency ω radians a px, so S
follows from the ratio of the two spectra by least squares, along every direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats

#: Side of the squares of an image whose spectra are compared, px.
SQUARE_PX = 64
_LOWEST = 2.5  # periods a square: below, the spectrum is that of the shading too
_HIGHEST = 0.3  # periods a px: above, interpolation and JPEG change it
_OVER_NOISE = 4.0  # power of the first pattern at a frequency that counts, in units of its noise's
_NOISE_FROM = 0.42  # periods a px: from there on the spectrum is taken for that of the noise
_FEWEST_FREQUENCIES = 24


@dataclass(frozen=True)
class BlurChange:
    """Blur and contrast of a pattern beside another; NaN where unknown.

    along : px, standard deviation of the blur along the direction in which it is greatest, negative where the pattern
    is sharper in all. angle : degrees, that direction, from x (right) towards y (down). across : px, the same at right
    angles. contrast : of the pattern without the blur, in units of the other's.
    """

    along: float = math.nan
    angle: float = math.nan
    across: float = math.nan
    contrast: float = math.nan

    @property
    def mean(self) -> float:
        """Standard deviation of the blur in the mean of all directions, px; negative where the pattern is sharper."""
        square = 0.5 * (self.along * abs(self.along) + self.across * abs(self.across))
        return math.copysign(math.sqrt(abs(square)), square)


def blur_change(first: NDArray[np.float32], second: NDArray[np.float32]) -> BlurChange:
    """Blur and contrast of the pattern in some squares of an image beside that in squares of another.

    first, second : (k, 64, 64) and (m, 64, 64) grey levels. The frequencies at which the first pattern stands out from
    its noise count; all figures are NaN where they are too few.
    """
    if not (len(first) and len(second)):
        return BlurChange()
    (power, noise), (other, other_noise) = _spectrum(first), _spectrum(second)
    y, x = np.meshgrid(*[2.0 * np.pi * np.fft.fftfreq(SQUARE_PX)] * 2, indexing="ij")
    radius = np.hypot(x, y) / (2.0 * np.pi)
    counts = (radius * SQUARE_PX >= _LOWEST) & (radius <= _HIGHEST) & (power > (1.0 + _OVER_NOISE) * noise)
    if counts.sum() < _FEWEST_FREQUENCIES:
        return BlurChange()
    with np.errstate(divide="ignore"):
        pattern = np.maximum(other[counts] - other_noise, 0.5 * other_noise + 1e-9)
        ratio = np.log(pattern / (power[counts] - noise))
    wx, wy = x[counts], y[counts]
    terms = np.column_stack([np.ones(len(wx)), -(wx**2), -2.0 * wx * wy, -(wy**2)])
    level, xx, xy, yy = np.linalg.lstsq(terms, ratio, rcond=None)[0]
    values, vectors = np.linalg.eigh([[xx, xy], [xy, yy]])
    across, along = np.sign(values) * np.sqrt(np.abs(values))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])) % 180.0
    return BlurChange(float(along), float(angle), float(across), float(np.exp(0.5 * level)))


def _spectrum(squares: NDArray[np.float32]) -> tuple[Floats, float]:
    """Mean power of squares (k, s, s) by frequency, and that of the noise, from the highest frequencies."""
    window = np.hanning(SQUARE_PX).astype(np.float32)
    level = squares - squares.mean(axis=(1, 2), keepdims=True)
    power = np.mean(np.abs(np.fft.fft2(level * window * window[:, None])) ** 2, axis=0)
    frequency = np.abs(np.fft.fftfreq(SQUARE_PX))
    corner = (frequency >= _NOISE_FROM) & (frequency[:, None] >= _NOISE_FROM)
    return np.asarray(power), float(np.median(power[corner]))
