"""Size of the speckles from the autocorrelation of the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats

Image = NDArray[np.generic]

_SIDE = 64  # px, of a patch
_PATCHES = 64


def speckle_size(image: Image, px: Floats, noise: float = 0.0) -> float | None:
    """Speckle size in px: full width at half maximum of the autocorrelation, over all directions; None if unknown.

    image : (h, w) grey levels. px : (n, 2) places about which patches of 64 px are taken. noise : variance, grey
    levels²: it adds a peak of no width, which is removed. A disk's peak is 0.81 of its diameter wide.
    """
    half = _SIDE // 2
    height, width = image.shape[:2]
    inside = ((px >= half) & (px < (width - half, height - half))).all(axis=1)
    places = px[inside]
    if not len(places):
        return None
    chosen = places[np.linspace(0, len(places) - 1, min(_PATCHES, len(places))).astype(int)].astype(int)
    total = np.zeros((_SIDE, _SIDE))
    for x, y in chosen:
        patch = np.asarray(image[y - half : y + half, x - half : x + half], dtype=float)
        total += _autocovariance(patch)
    total /= len(chosen)
    return _width(_profile(total), noise)


def _autocovariance(patch: Floats) -> Floats:
    """Mean product of the grey levels' deviations a lag apart, lag zero at the corner; unbiased by the edges."""
    size = 2 * _SIDE
    ones = np.abs(np.fft.rfft2(np.ones_like(patch), (size, size))) ** 2
    spectrum = np.abs(np.fft.rfft2(patch - patch.mean(), (size, size))) ** 2
    pairs = np.fft.irfft2(ones, (size, size))
    products = np.fft.irfft2(spectrum, (size, size))
    both = np.roll(products / np.maximum(pairs, 0.5), (_SIDE // 2, _SIDE // 2), axis=(0, 1))
    return np.asarray(both[:_SIDE, :_SIDE])


def _profile(covariance: Floats) -> Floats:
    """Mean over all directions at lags of 0, 1, 2 … px."""
    y, x = np.indices(covariance.shape) - _SIDE // 2
    ring = np.hypot(x, y)
    lags = np.arange(_SIDE // 2)
    nearest = np.rint(ring).astype(int).ravel()
    radius = np.bincount(nearest, ring.ravel()) / np.bincount(nearest)
    mean = np.bincount(nearest, covariance.ravel()) / np.bincount(nearest)
    return np.asarray(np.interp(lags, radius, mean))


def _width(profile: Floats, noise: float) -> float | None:
    peak = profile[0] - noise
    if not peak > 0:
        return None
    below = np.flatnonzero(profile[1:] < 0.5 * peak)
    if not len(below):
        return None
    k = int(below[0]) + 1
    before = peak if k == 1 else profile[k - 1]
    return float(2.0 * (k - 1 + (before - 0.5 * peak) / (before - profile[k])))
