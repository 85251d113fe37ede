"""Variance of the noise of a camera's grey levels: from a scene at rest, from flat areas, from matches in time."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.uncertainty.matches import INTERPOLATED_NOISE
from ringdic.uncertainty.texture import GreyImage

_QUANTISED = 1.0 / 12.0  # grey levels², the variance of rounding to whole ones
# Second differences in x and in y: zero for a plane and for any ridge or edge along either axis.
_CROSSED = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]).astype(np.float32) / np.float32(
    6.0
)  # keeps the variance of white noise
_MANY = 2**18  # pixels, of which every second one each way tells enough
_FLAT = 0.2  # share of the dark and of the bright pixels that count as flat
_TRULY_FLAT = 3.0  # slopes there, in units of those that the noise alone would make
_CLIP = 3.0
_CLIPPED = 0.9866  # standard deviation of a normal distribution within ± 3 σ
# Between two exposures of a moving surface the residual consists of noise and of edges sampled at other pixels; at
# least this share of it is noise.
_LEAST_SHARE = 0.55


def flat_noise(image: GreyImage) -> float:
    """Variance of the noise of one image, grey levels², from its flattest dark and its flattest bright areas.

    image : (h, w) grey levels, at least 16 x 16 px; ValueError for a smaller one.
    In a pattern so fine that it has no flat areas the result is an upper bound, since the pattern counts as noise. In
    an image that was compressed it is a lower bound, since compression removes the noise of flat areas.
    """
    grey = np.asarray(image, dtype=np.float32)
    if grey.ndim != 2 or min(grey.shape) < 16:
        raise ValueError(f"an image of {grey.shape} px shows no noise; at least 16 x 16 are needed")
    smooth = cv2.blur(grey, (3, 3))
    fx, fy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    some = (slice(4, -4, 1 if grey.size < _MANY else 2),) * 2
    slope = cv2.blur(fx * fx + fy * fy, (5, 5))[some].ravel()
    wave = cv2.filter2D(grey, cv2.CV_32F, _CROSSED)[some].ravel()
    level = cv2.blur(grey, (5, 5))[some].ravel()
    dark = level < 0.5 * np.percentile(level, [10, 90]).sum()
    estimates = []
    for half in (dark, ~dark):
        if half.sum() < 50:
            continue
        flat = half & (slope <= np.quantile(slope[half], _FLAT))
        variance = _clipped_variance(wave[flat])
        if variance <= 0:  # saturated throughout, so the noise is cut off
            continue
        estimates.append((float(slope[flat].mean()) / (_white_slope() * variance), variance))
    trusted = [variance for unevenness, variance in estimates if unevenness < _TRULY_FLAT]
    return max(
        float(np.mean(trusted)) if trusted else min((variance for _, variance in estimates), default=0.0), _QUANTISED
    )


def rest_noise(images: Sequence[GreyImage]) -> float:
    """Variance of the noise, grey levels², from the differences of images of a scene at rest.

    images : K ≥ 2 images (h, w), grey levels; ValueError for fewer.
    """
    if len(images) < 2:
        raise ValueError("noise shows between two images or more of a scene at rest")
    stack = np.stack([np.asarray(image, dtype=np.float32) for image in images])
    return max(float(stack.var(axis=0, ddof=1).mean()), _QUANTISED)


def camera_noise(flat: float, c_ls: Floats, contrast: Floats) -> float:
    """Variance of the noise of one camera, grey levels², from its reference image and from its matches in time.

    The residual of the step where it is smallest bounds the noise from both sides, since motion and light only add to
    it.

    flat : grey levels², the variance by `flat_noise` of the reference image.
    c_ls : (F, n) C_LS of the matches in time, NaN where lost.
    contrast : (n,) grey levels, standard deviation of the grey levels of each reference subset.
    """
    with np.errstate(invalid="ignore"):
        residual = np.atleast_2d(c_ls) * contrast**2
    steps = [float(np.median(row[np.isfinite(row)])) for row in residual if np.isfinite(row).sum() >= 3]
    quiet = [step for step in steps if step > 0]
    if not quiet:
        return flat
    largest = min(quiet) / (1.0 + INTERPOLATED_NOISE)
    # Compression leaves less noise in flat areas than at edges; the true variance lies between the two estimates.
    return float(np.clip(flat, _LEAST_SHARE * largest, largest) ** (2 / 3) * largest ** (1 / 3))


def _white_slope() -> float:
    """Mean square of the smoothed slopes of white noise of unit variance."""
    blur, step = np.ones(3) / 3.0, np.array([-1.0, 0.0, 1.0]) * 0.5
    ramp, bell = np.convolve(blur, step), np.convolve(blur, np.array([1.0, 2.0, 1.0]) / 4.0)
    return float(2.0 * (ramp @ ramp) * (bell @ bell))


def _clipped_variance(values: NDArray[np.float32]) -> float:
    """Variance of normally distributed values (n,) with outliers, by clipping at three standard deviations."""
    inside = np.asarray(values, dtype=np.float64)
    for _ in range(10):
        limit = _CLIP * max(float(np.sqrt(np.mean(inside**2))) / _CLIPPED, 1e-6)
        clipped = inside[np.abs(inside) <= limit]
        if len(clipped) == len(inside):
            break
        inside = clipped
    return float(np.mean(inside**2)) / _CLIPPED**2
