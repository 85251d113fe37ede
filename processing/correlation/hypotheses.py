"""Many affine warps tried at each point, for start values that a calibration and a proxy surface suggest."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from processing.correlation.prepared import Current, Reference

Array = NDArray[np.float64]

_MANY = 16  # warps a point from which on they are first tried on fewer pixels
_THINNED = 2  # every so many of the pixels each way at first
_DOUBT = 0.3  # ZNCC that the first trial may be off: three standard deviations of 80 pixels that are not alike


def search_hypotheses(
    reference: Reference,
    current: Current,
    xy: Array,
    warps: Array,
    radius: int,
    *,
    stride: int = 2,
    separation: float = 4.0,
) -> tuple[Array, Array, Array]:
    """The best of K affine warps at each of n points, by ZNCC over every second pixel of a circular subset.

    xy : (n, 2) px on the reference; warps : (n, K, 6), u v ux uy vx vy at the point, NaN where not to be tried.
    Returns best (n, 6), its zncc (n,), and second_peak (n,), the best ZNCC of a warp whose displacement differs by
    more than ``separation`` px. NaN (zncc -1) where no warp stays inside the current image.
    """
    n, count = warps.shape[:2]
    if warps.shape != (n, count, 6) or xy.shape != (n, 2):
        raise ValueError(f"warps must be (n, K, 6) for xy (n, 2), not {warps.shape} for {xy.shape}")
    score = np.empty((n, count))
    _score(
        reference.image,
        reference.mask,
        reference.box[0],
        reference.box[1],
        current.image,
        np.ascontiguousarray(xy, dtype=np.float64),
        np.ascontiguousarray(warps, dtype=np.float64),
        radius,
        stride,
        score,
    )
    rows = np.arange(n)
    at = np.argmax(score, axis=1)
    zncc, best = score[rows, at], warps[rows, at].copy()
    best[zncc <= -1.0] = np.nan
    apart = np.hypot(*np.moveaxis(warps[:, :, :2] - best[:, None, :2], -1, 0)) > separation
    return best, zncc, np.where(apart, score, -1.0).max(axis=1)


_FAST = {"contract", "reassoc", "arcp", "nsz"}


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def _pixels(grey, mask, left_of_mask, top_of_mask, jx, iy, off_x, off_y, radius, stride, px):  # type: ignore[no-untyped-def]
    """Every so many pixels of the circular subset that the mask leaves: dx, dy and grey level less its mean, in px.

    Returns their number and the norm of the levels.
    """
    n, total = 0, 0.0
    for dy in range(-(radius // stride) * stride, radius + 1, stride):
        for dx in range(-(radius // stride) * stride, radius + 1, stride):
            i, j = iy + dy - top_of_mask, jx + dx - left_of_mask
            if dx * dx + dy * dy > radius * radius or i < 0 or j < 0 or i >= mask.shape[0] or j >= mask.shape[1]:
                continue
            if mask[i, j]:
                px[0, n], px[1, n], px[2, n] = dx + off_x, dy + off_y, grey[iy + dy, jx + dx]
                total += px[2, n]
                n += 1
    mean, square = total / max(n, 1), 0.0
    for m in range(n):
        px[2, m] -= mean
        square += px[2, m] * px[2, m]
    return n, math.sqrt(square)


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def _alike(image, x0, y0, warp, px, n, norm, radius, nearest):  # type: ignore[no-untyped-def]
    """ZNCC of n pixels with the image under a warp (6,), bilinear or of the nearest pixels; -1 where they leave it or
    the warp is NaN."""
    u, v, ux, uy, vx, vy = warp[0], warp[1], warp[2], warp[3], warp[4], warp[5]
    if n < 8 or not norm > 0.0 or not math.isfinite(u + v + ux + uy + vx + vy):
        return -1.0
    height, width = image.shape
    wide = (radius + 1.0) * (1.0 + abs(ux) + abs(uy))
    high = (radius + 1.0) * (1.0 + abs(vx) + abs(vy))
    within = x0 + u > wide and y0 + v > high and x0 + u + wide < width - 1 and y0 + v + high < height - 1
    s_g = s_gg = s_fg = 0.0
    for m in range(n):
        dx, dy = px[0, m], px[1, m]
        x = x0 + u + (1.0 + ux) * dx + uy * dy
        y = y0 + v + vx * dx + (1.0 + vy) * dy
        if not within and not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
            return -1.0
        if nearest:
            g = float(image[np.uint64(np.int64(y + 0.5)), np.uint64(np.int64(x + 0.5))])
        else:
            left, top = np.uint64(np.int64(x)), np.uint64(np.int64(y))
            fx, fy = x - left, y - top
            right, below = left + np.uint64(1), top + np.uint64(1)
            g = (1.0 - fy) * ((1.0 - fx) * image[top, left] + fx * image[top, right]) + fy * (
                (1.0 - fx) * image[below, left] + fx * image[below, right]
            )
        s_g += g
        s_gg += g * g
        s_fg += g * px[2, m]
    variance = s_gg - s_g * s_g / n
    return s_fg / (norm * math.sqrt(variance)) if variance > 1e-9 * n else -1.0


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=_FAST)
def _score(grey, mask, left_of_mask, top_of_mask, image, xy, warps, radius, stride, score):  # type: ignore[no-untyped-def]
    """ZNCC (n, K) of every warp; -1 where the subset leaves either image or the warp is NaN. Bilinear in the current.

    grey, image : the whole images, xy : (n, 2) px in them; mask : (h, w) of the box whose corner is given. Of many
    warps those that a quarter of the pixels, read without interpolation, shows to be far from the best keep that first
    score.
    """
    count = warps.shape[1]
    for k in nb.prange(xy.shape[0]):
        jx, iy = math.floor(xy[k, 0] + 0.5), math.floor(xy[k, 1] + 0.5)
        off_x, off_y = jx - xy[k, 0], iy - xy[k, 1]
        px = np.empty((3, (2 * (radius // stride) + 1) ** 2))
        limit = -2.0
        if count >= _MANY:
            n, norm = _pixels(
                grey, mask, left_of_mask, top_of_mask, jx, iy, off_x, off_y, radius, _THINNED * stride, px
            )
            for h in range(count):
                score[k, h] = _alike(image, xy[k, 0], xy[k, 1], warps[k, h], px, n, norm, radius, True)
            limit = max(np.max(score[k]) - _DOUBT, -0.99)
        n, norm = _pixels(grey, mask, left_of_mask, top_of_mask, jx, iy, off_x, off_y, radius, stride, px)
        for h in range(count):
            if count < _MANY or score[k, h] > limit:
                score[k, h] = _alike(image, xy[k, 0], xy[k, 1], warps[k, h], px, n, norm, radius, False)
