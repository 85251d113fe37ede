"""B-spline coefficients and gradients of an image by finite filters.

A spline through the samples f is Σ c_k β(x − k) with c = b⁻¹ * f, b the sampled B-spline (Unser, Aldroubi & Eden 1993).
The inverse filter decays as its largest pole to the power of the distance (quintic 0.431, cubic 0.268), so a finite
filter reaches any accuracy; mirrored borders are exact for it. In single precision the filter has only as many taps as
that resolves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.correlation.filters import COLUMNS, separable_filter
from ringdic.correlation.parallel import in_ranges

Levels = NDArray[np.floating]
Box = tuple[int, int, int, int]

_SAMPLES = {3: np.array([1.0, 4.0, 1.0]) / 6.0, 5: np.array([1.0, 26.0, 66.0, 26.0, 1.0]) / 120.0}
# β'(k) at the integers k = -2 ... 2 (cubic: -1 ... 1).
_SLOPES = {3: np.array([0.5, 0.0, -0.5]), 5: np.array([1.0, 10.0, 0.0, -10.0, -1.0]) / 24.0}
# Taps on either side: pole ** reach < 3e-7 in single precision, 1e-10 in double.
_REACH = {("f", 3): 12, ("f", 5): 18, ("d", 3): 18, ("d", 5): 28}
REACH = max(_REACH.values()) + 2  # the longest of all filters, and the derivative's taps
PAD = 32  # coefficients outside the image: taps of positions near its edge, and lanes of vectors that reach over it


def prefilter_taps(degree: int, precision: str = "d") -> Floats:
    """Taps of the inverse filter that turns samples into B-spline coefficients, centred.

    degree : 3 or 5. precision : character code of the float type, f or d. Returns (2 reach + 1,) float64, no unit.
    """
    reach = _REACH[precision, degree]
    samples = _SAMPLES[degree]
    period = 8 * reach
    kernel = np.zeros(period)
    half = len(samples) // 2
    kernel[np.arange(-half, half + 1) % period] = samples
    inverse = np.fft.ifft(1.0 / np.fft.fft(kernel)).real
    return np.asarray(inverse[np.arange(-reach, reach + 1) % period])


def gradient_taps(degree: int, precision: str = "d") -> Floats:
    """Taps of a correlation kernel that gives the derivative of the interpolating spline at the samples.

    degree : 3 or 5. precision : character code of the float type, f or d. Returns (k,) float64, k odd, 1/px.
    """
    return np.convolve(prefilter_taps(degree, precision), _SLOPES[degree])[::-1].copy()


def coefficients(image: NDArray, degree: int, box: Box | None = None, precision: type | None = None) -> Levels:
    """B-spline coefficients of an image, or of a box of it, with PAD more on every side.

    image : (h, w) grey levels. degree : 3 or 5. box : x0, y0, x1, y1 in px, ends exclusive; None for the whole image.
    precision : float32 or float64; None for the image's own type.
    Returns (y1 - y0 + 2 PAD, x1 - x0 + 2 PAD), in grey levels.
    """
    x0, y0, x1, y1 = box or (0, 0, image.shape[1], image.shape[0])
    kind = np.dtype(precision or image.dtype)
    taps = prefilter_taps(degree, kind.char).astype(kind)
    out = np.empty((y1 - y0 + 2 * PAD, x1 - x0 + 2 * PAD), kind)
    in_ranges(separable_filter, -(-out.shape[1] // COLUMNS), image, taps, taps, x0 - PAD, y0 - PAD, out)
    return out


def gradients(
    image: NDArray, degree: int, box: Box | None = None, precision: type | None = None
) -> tuple[Levels, Levels]:
    """Derivatives ∂/∂x and ∂/∂y of the interpolating spline at the pixels of an image, or of a box of it.

    image : (h, w) grey levels. degree : 3 or 5. box : x0, y0, x1, y1 in px, ends exclusive; None for the whole image.
    precision : float32 or float64; None for the image's own type.
    Returns two arrays (y1 - y0, x1 - x0), in grey levels per px.
    """
    x0, y0, x1, y1 = box or (0, 0, image.shape[1], image.shape[0])
    kind = np.dtype(precision or image.dtype)
    slope, one = gradient_taps(degree, kind.char).astype(kind), np.ones(1, kind)
    along_x, along_y = np.empty((y1 - y0, x1 - x0), kind), np.empty((y1 - y0, x1 - x0), kind)
    in_ranges(separable_filter, -(-along_x.shape[1] // COLUMNS), image, slope, one, x0, y0, along_x)
    in_ranges(separable_filter, -(-along_y.shape[1] // COLUMNS), image, one, slope, x0, y0, along_y)
    return along_x, along_y
