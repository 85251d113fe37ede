"""B-spline coefficients and gradients of an image by finite filters.

A spline through the samples f is Σ c_k β(x − k) with c = b⁻¹ * f, b the sampled B-spline (Unser, Aldroubi & Eden
1993). The inverse filter decays as its largest pole to the power of the distance (quintic 0.431, cubic 0.268), so a
finite filter reaches any accuracy; mirrored borders are exact for it. What goes in decides the precision: a float32
image is filtered in single precision, with as many taps as that resolves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.correlation.filters import separable

Levels = NDArray[np.floating]
Box = tuple[int, int, int, int]

_SAMPLES = {3: np.array([1.0, 4.0, 1.0]) / 6.0, 5: np.array([1.0, 26.0, 66.0, 26.0, 1.0]) / 120.0}
# β'(k) at the integers k = -2 ... 2 (cubic: -1 ... 1).
_SLOPES = {3: np.array([0.5, 0.0, -0.5]), 5: np.array([1.0, 10.0, 0.0, -10.0, -1.0]) / 24.0}
# Taps on either side: pole ** reach < 3e-7 in single precision, 1e-10 in double.
_REACH = {("f", 3): 12, ("f", 5): 18, ("d", 3): 18, ("d", 5): 28}
REACH = max(_REACH.values()) + 2  # of any filter here
PAD = 32  # coefficients outside the image: a position inside has its taps, a vector its lanes


def prefilter_taps(degree: int, precision: str = "d") -> Floats:
    """The inverse of the sampled B-spline, centred. (2 reach + 1,). precision : a float's character code, f or d."""
    reach = _REACH[precision, degree]
    samples = _SAMPLES[degree]
    period = 8 * reach
    kernel = np.zeros(period)
    half = len(samples) // 2
    kernel[np.arange(-half, half + 1) % period] = samples
    inverse = np.fft.ifft(1.0 / np.fft.fft(kernel)).real
    return np.asarray(inverse[np.arange(-reach, reach + 1) % period])


def gradient_taps(degree: int, precision: str = "d") -> Floats:
    """Derivative at the samples of the interpolating spline, as a correlation kernel. (odd,)."""
    return np.convolve(prefilter_taps(degree, precision), _SLOPES[degree])[::-1].copy()


def coefficients(image: NDArray, degree: int, box: Box | None = None, precision: type | None = None) -> Levels:
    """Spline coefficients of a box (x0, y0, x1, y1; the whole if None) of an image (h, w), with PAD more on every side.

    precision : float32 or float64; the image's own if None. (y1 - y0 + 2 PAD, x1 - x0 + 2 PAD).
    """
    x0, y0, x1, y1 = box or (0, 0, image.shape[1], image.shape[0])
    kind = np.dtype(precision or image.dtype)
    taps = prefilter_taps(degree, kind.char).astype(kind)
    out = np.empty((y1 - y0 + 2 * PAD, x1 - x0 + 2 * PAD), kind)
    separable(image, taps, taps, x0 - PAD, y0 - PAD, out)
    return out


def gradients(
    image: NDArray, degree: int, box: Box | None = None, precision: type | None = None
) -> tuple[Levels, Levels]:
    """∂/∂x and ∂/∂y of the spline at the samples of a box (the whole if None) of an image. Two (y1 - y0, x1 - x0),
    grey levels a pixel. precision : as for :func:`coefficients`."""
    x0, y0, x1, y1 = box or (0, 0, image.shape[1], image.shape[0])
    kind = np.dtype(precision or image.dtype)
    slope, one = gradient_taps(degree, kind.char).astype(kind), np.ones(1, kind)
    along_x, along_y = np.empty((y1 - y0, x1 - x0), kind), np.empty((y1 - y0, x1 - x0), kind)
    separable(image, slope, one, x0, y0, along_x)
    separable(image, one, slope, x0, y0, along_y)
    return along_x, along_y
