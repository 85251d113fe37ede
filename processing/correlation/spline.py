"""B-spline coefficients and gradients of an image by finite filters.

A spline through the samples f is Σ c_k β(x − k) with c = b⁻¹ * f, b the sampled B-spline (Unser, Aldroubi & Eden
1993). The inverse filter decays as its largest pole to the power of the distance (quintic 0.431, cubic 0.268), so a
finite filter reaches any accuracy; mirrored borders are exact for it. What goes in decides the precision: a float32
image is filtered in single precision, with as many taps as that resolves.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Levels = NDArray[np.floating]

_SAMPLES = {3: np.array([1.0, 4.0, 1.0]) / 6.0, 5: np.array([1.0, 26.0, 66.0, 26.0, 1.0]) / 120.0}
# β'(k) at the integers k = -2 ... 2 (cubic: -1 ... 1).
_SLOPES = {3: np.array([0.5, 0.0, -0.5]), 5: np.array([1.0, 10.0, 0.0, -10.0, -1.0]) / 24.0}
# Taps on either side: pole ** reach < 3e-7 in single precision, 1e-10 in double.
_REACH = {("f", 3): 12, ("f", 5): 18, ("d", 3): 18, ("d", 5): 28}
REACH = max(_REACH.values()) + 2  # of any filter here
PAD = 32  # coefficients outside the image: a position inside has its taps, a vector its lanes


def prefilter_taps(degree: int, precision: str = "d") -> Array:
    """The inverse of the sampled B-spline, centred. (2 reach + 1,). precision : a float's character code, f or d."""
    reach = _REACH[precision, degree]
    samples = _SAMPLES[degree]
    period = 8 * reach
    kernel = np.zeros(period)
    half = len(samples) // 2
    kernel[np.arange(-half, half + 1) % period] = samples
    inverse = np.fft.ifft(1.0 / np.fft.fft(kernel)).real
    return np.asarray(inverse[np.arange(-reach, reach + 1) % period])


def gradient_taps(degree: int, precision: str = "d") -> Array:
    """Derivative at the samples of the interpolating spline, as a correlation kernel. (odd,)."""
    return np.convolve(prefilter_taps(degree, precision), _SLOPES[degree])[::-1].copy()


def coefficients(image: Levels, degree: int) -> Levels:
    """Spline coefficients of an image (h, w), with PAD more on every side. (h + 2 PAD, w + 2 PAD)."""
    taps = prefilter_taps(degree, image.dtype.char)
    inner = cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_REFLECT_101)
    padded = cv2.copyMakeBorder(inner, PAD, PAD, PAD, PAD, cv2.BORDER_REFLECT_101)
    return np.ascontiguousarray(padded, dtype=image.dtype)


def gradients(image: Levels, degree: int) -> tuple[Levels, Levels]:
    """∂/∂x and ∂/∂y of the spline at the samples of an image (h, w). Two (h, w), grey levels a pixel."""
    slope, one = gradient_taps(degree, image.dtype.char), np.ones(1)
    border = cv2.BORDER_REFLECT_101
    return (
        np.asarray(cv2.sepFilter2D(image, -1, slope, one, borderType=border), dtype=image.dtype),
        np.asarray(cv2.sepFilter2D(image, -1, one, slope, borderType=border), dtype=image.dtype),
    )
