"""How noisy a camera's grey levels are, as a variance: from a scene at rest, from flat places, from matches in time."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats

Image = NDArray[np.uint8] | NDArray[np.uint16] | Floats

_QUANTISED = 1.0 / 12.0  # grey levels², the variance of rounding to whole ones
# Differences of differences in x and y: blind to whatever is a plane, a ridge or an edge along either axis.
_CROSSED = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]).astype(np.float32) / np.float32(6.0)  # keeps a variance
_FLAT = 0.2  # share of the dark and of the bright pixels that count as flat
_TRULY_FLAT = 3.0  # slopes there, in units of those that the noise alone would make
_CLIP = 3.0
_CLIPPED = 0.9866  # standard deviation of a normal distribution within ± 3 σ
_SEEN = 0.85  # share of the current image's noise that its interpolation lets through, see matches.py
# Between two exposures of a moving surface the residual is noise and what the pixels' grid makes of the edges.
_LEAST_SHARE = 0.55


def flat_noise(image: Image) -> float:
    """Variance of the noise of one image (h, w), from its flattest dark and its flattest bright places.

    Grey levels². Where the pattern is so fine that nothing is flat it counts as noise: an upper bound. Where the image
    was compressed the flat places have lost theirs: a lower bound.
    """
    grey = np.asarray(image, dtype=np.float32)
    if grey.ndim != 2 or min(grey.shape) < 16:
        raise ValueError(f"an image of {grey.shape} px shows no noise; at least 16 x 16 are needed")
    smooth = cv2.blur(grey, (3, 3))
    fx, fy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    slope = cv2.blur(fx * fx + fy * fy, (5, 5))[4:-4, 4:-4].ravel()
    wave = cv2.filter2D(grey, cv2.CV_32F, _CROSSED)[4:-4, 4:-4].ravel()
    level = cv2.blur(grey, (5, 5))[4:-4, 4:-4].ravel()
    dark = level < 0.5 * np.percentile(level, [10, 90]).sum()
    found = []
    for half in (dark, ~dark):
        if half.sum() < 50:
            continue
        flat = half & (slope <= np.quantile(slope[half], _FLAT))
        variance = _clipped_variance(wave[flat])
        if variance <= 0:  # black or white throughout: no noise is left to see
            continue
        found.append((float(slope[flat].mean()) / (_white_slope() * variance), variance))
    trusted = [variance for unevenness, variance in found if unevenness < _TRULY_FLAT]
    return max(
        float(np.mean(trusted)) if trusted else min((variance for _, variance in found), default=0.0), _QUANTISED
    )


def rest_noise(images: Sequence[Image]) -> float:
    """Variance of the noise from K ≥ 2 images (h, w) of a scene at rest, grey levels²; any pattern is without harm."""
    if len(images) < 2:
        raise ValueError("noise shows between two images or more of a scene at rest")
    stack = np.stack([np.asarray(image, dtype=np.float32) for image in images])
    return max(float(stack.var(axis=0, ddof=1).mean()), _QUANTISED)


def camera_noise(flat: float, c_ls: Floats, contrast: Floats) -> float:
    """Variance of one camera's noise from its reference image and from how well its own images agree.

    flat : of the reference image by ``flat_noise``. c_ls : (F, n) of matches in time, NaN where lost; contrast : (n,)
    of the reference subsets. The quietest step bounds it from both sides: motion and light only add to the residual.
    """
    with np.errstate(invalid="ignore"):
        residual = np.atleast_2d(c_ls) * contrast**2
    steps = [float(np.median(row[np.isfinite(row)])) for row in residual if np.isfinite(row).sum() >= 3]
    quiet = [step for step in steps if step > 0]
    if not quiet:
        return flat
    shown = min(quiet) / (1.0 + _SEEN)
    # Flat places are the brightest ones, quieter than the edges where coding bends the noise; the truth lies between.
    return float(np.clip(flat, _LEAST_SHARE * shown, shown) ** (2 / 3) * shown ** (1 / 3))


def _white_slope() -> float:
    """What white noise of unit variance makes of the mean square of the smoothed slope."""
    blur, step = np.ones(3) / 3.0, np.array([-1.0, 0.0, 1.0]) * 0.5
    ramp, bell = np.convolve(blur, step), np.convolve(blur, np.array([1.0, 2.0, 1.0]) / 4.0)
    return float(2.0 * (ramp @ ramp) * (bell @ bell))


def _clipped_variance(values: NDArray[np.float32]) -> float:
    """Variance of what is normally distributed, whatever else lies beyond three standard deviations."""
    inside = np.asarray(values, dtype=np.float64)
    for _ in range(10):
        limit = _CLIP * max(float(np.sqrt(np.mean(inside**2))) / _CLIPPED, 1e-6)
        kept = inside[np.abs(inside) <= limit]
        if len(kept) == len(inside):
            break
        inside = kept
    return float(np.mean(inside**2)) / _CLIPPED**2
