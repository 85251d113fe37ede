"""The simulated sensor, from light to grey levels: point spread, vignetting, noise, sRGB coding, 8 bits."""

from __future__ import annotations

import math

import numpy as np

from ringdic_node.virtual_rig.arrays import Image, Radiance

FULL_WELL = 4500.0  # electrons at radiance 1
READ_NOISE = 3.0  # electrons
POINT_SPREAD = 0.6  # px, standard deviation of the Gaussian point spread
_VIGNETTING = 0.18  # loss in the corners


def expose(radiance: Radiance, seed: int, exposure: float = 1.0, noisiness: float = 1.0) -> Image:
    """Grey levels (height, width) that the sensor gives for the light on it: vignetting, noise, sRGB coding, 8 bits.

    radiance : (height, width), linear, 1 saturates. seed : of the noise; equal seeds give equal images. exposure :
    factor of the light. noisiness : factor of the noise.
    """
    light = _vignetted(radiance) * np.float32(exposure)
    noise = np.float32(noisiness) * np.random.default_rng([seed, 4500]).standard_normal(light.shape, dtype=np.float32)
    electrons = np.minimum(light, 1.0) * np.float32(FULL_WELL)
    electrons += noise * np.sqrt(np.maximum(electrons, 0.0) + np.float32(READ_NOISE**2))
    return np.rint(255.0 * srgb_coded(np.clip(electrons / np.float32(FULL_WELL), 0.0, 1.0))).astype(np.uint8)


def srgb_coded(linear: Radiance) -> Radiance:
    """sRGB code of linear light (IEC 61966-2-1). linear : (..., ), 0 to 1. Returns that shape, 0 to 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def blurred(image: Radiance, deviation: float = POINT_SPREAD) -> Radiance:
    """Convolve an image with the lens's point spread, a Gaussian; (height, width), linear light without unit.

    Two passes of a sampled Gaussian; the image is mirrored at its rim. deviation : of the Gaussian, px.
    """
    reach = math.ceil(5.0 * deviation)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    taps = (taps / taps.sum()).astype(np.float32)
    for axis in (0, 1):
        padded = np.pad(image, [(reach, reach) if i == axis else (0, 0) for i in (0, 1)], mode="reflect")
        size = image.shape[axis]
        image = sum(  # type: ignore[assignment]
            tap * (padded[k : k + size] if axis == 0 else padded[:, k : k + size]) for k, tap in enumerate(taps)
        )
    return image


def _vignetted(image: Radiance) -> Radiance:
    height, width = image.shape
    y = (np.arange(height, dtype=np.float32) / (height - 1) - 0.5)[:, None]
    x = (np.arange(width, dtype=np.float32) / (width - 1) - 0.5)[None, :]
    return image * (1.0 - np.float32(_VIGNETTING) * 2.0 * (x * x + y * y))
