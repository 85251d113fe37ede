"""Colours of field values: a sequential scale for magnitudes, a diverging one for values about a centre.

The scales are those of the web page, built in the perceptual colour space OKLCH (Ottosson 2020), in which equal steps
look equal.
"""

from __future__ import annotations

import numpy as np

from ringdic.arrays import Floats

UNMEASURED = (0.5, 0.5, 0.5)
_FROM_OKLAB = np.array([[0.3963377774, 0.2158037573], [-0.1055613458, -0.0638541728], [-0.0894841775, -1.291485548]])
_LINEAR_FROM_CUBES = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.707614701],
    ]
)


def colours(values: Floats, low: float, high: float, diverging: bool = False) -> Floats:
    """sRGB colours of field values on a scale between two limits.

    values : (...) in any unit; values beyond the limits get the end colours. low, high : the limits.
    diverging : from blue over near-white to red, instead of from dark violet over blue and green to light yellow.
    Returns (..., 3) sRGB from 0 to 1; grey where a value is not finite.
    """
    values = np.asarray(values, dtype=float)
    share = np.clip((values - low) / max(high - low, 1e-300), 0.0, 1.0)
    t = np.where(np.isfinite(share), share, 0.0)
    if diverging:
        side = 2.0 * t - 1.0
        away = np.abs(side)
        lightness, chroma, hue = 0.96 - 0.54 * away, 0.19 * away**0.85, np.where(side < 0, 258.0, 27.0)
    else:
        lightness, chroma, hue = 0.26 + 0.67 * t, 0.09 + 0.24 * t * (1.0 - t) + 0.06 * t, 305.0 - 200.0 * t
    rgb = _encoded(_linear(lightness, chroma, np.radians(hue)))
    return np.asarray(np.where(np.isfinite(values)[..., None], rgb, UNMEASURED))


def _linear(lightness: Floats, chroma: Floats, hue: Floats) -> Floats:
    """Linear sRGB (..., 3) of OKLCH colours (...), hue in rad; clipped to 0 … 1."""
    plane = np.stack([chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    cubes = (lightness[..., None] + plane @ _FROM_OKLAB.T) ** 3
    return np.clip(cubes @ _LINEAR_FROM_CUBES.T, 0.0, 1.0)


def _encoded(linear: Floats) -> Floats:
    """sRGB values of linear ones, by the transfer curve of IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
