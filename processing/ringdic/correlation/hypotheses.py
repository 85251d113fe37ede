"""Many affine warps tried at each point, for start values that a calibration and a proxy surface suggest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask
from ringdic.correlation.prepared import Current, Reference

_MANY = 16  # warps a point from which on they are first tried on fewer pixels
_THINNED = 2  # every so many of the pixels each way at first
_DOUBT = 0.3  # ZNCC that the first trial may be off: three standard deviations of 80 pixels that are not alike
_ANY_PIXEL = np.zeros((0, 0), bool)  # in place of a mask: all pixels count


@dataclass(frozen=True)
class Row:
    """K warps at each of n points, evenly between a few of them: a match moves evenly along a line of sight.

    knots : (n, J, 6) warps, u v ux uy vx vy; NaN where not to be tried. places : (K,), where the warps lie, 2.25 being
    a quarter of the way from knot 2 to knot 3.
    """

    knots: Floats
    places: Floats

    @property
    def warps(self) -> Floats:
        """All of them. (n, K, 6)."""
        below = np.minimum(self.places.astype(np.int64), max(self.knots.shape[1] - 2, 0))
        share = (self.places - below)[:, None]
        above = np.minimum(below + 1, self.knots.shape[1] - 1)
        between = self.knots[:, below] + share * (self.knots[:, above] - self.knots[:, below])
        return np.where(share == 0.0, self.knots[:, below], np.where(share == 1.0, self.knots[:, above], between))


@dataclass(frozen=True)
class BestWarps:
    """The best of the warps tried at each of n points.

    warps : (n, 6), NaN where none stays inside the current image. zncc : (n,), then -1. second_peak : (n,), the best
    ZNCC of a warp that leads elsewhere, or -1. which : (n,), the number of the best.
    """

    warps: Floats
    zncc: Floats
    second_peak: Floats
    which: Indices


def search_hypotheses(
    reference: Reference,
    current: Current,
    xy: Floats,
    warps: Floats,
    radius: int,
    *,
    stride: int = 2,
    separation: float = 4.0,
) -> tuple[Floats, Floats, Floats]:
    """The best of K affine warps at each of n points, by ZNCC over every second pixel of a circular subset.

    xy : (n, 2) px on the reference; warps : (n, K, 6), u v ux uy vx vy at the point, NaN where not to be tried.
    Returns best (n, 6), its zncc (n,), and second_peak (n,), the best ZNCC of a warp whose displacement differs by
    more than ``separation`` px. NaN (zncc -1) where no warp stays inside the current image.
    """
    if warps.ndim != 3 or warps.shape[::2] != (len(xy), 6) or xy.shape != (len(xy), 2):
        raise ValueError(f"warps must be (n, K, 6) for xy (n, 2), not {warps.shape} for {xy.shape}")
    row = Row(warps, np.arange(warps.shape[1], dtype=np.float64))
    found = _search(reference.image, reference.mask, reference.box, current, xy, row, radius, stride, separation, -1.0)
    return found.warps, found.zncc, found.second_peak


def search_row(
    image: NDArray, current: Current, xy: Floats, row: Row, radius: int, *, least: float = -1.0, separation: float = 4.0
) -> BestWarps:
    """The best warp of a row at each of n points xy (n, 2) px of an image, all pixels of which count.

    As :func:`search_hypotheses`. least : a ZNCC below which a match is of no use: points that the first trial shows to
    stay below it keep the ZNCC of that trial.
    """
    return _search(image, _ANY_PIXEL, (0, 0), current, xy, row, radius, 2, separation, least)


def _search(
    image: NDArray,
    mask: Mask,
    corner: tuple[int, ...],
    current: Current,
    xy: Floats,
    row: Row,
    radius: int,
    stride: int,
    separation: float,
    least: float,
) -> BestWarps:
    n = len(xy)
    found = BestWarps(np.full((n, 6), np.nan), np.full(n, -1.0), np.full(n, -1.0), np.zeros(n, np.int64))
    _best(
        image,
        mask,
        corner[0],
        corner[1],
        current.image,
        np.ascontiguousarray(xy, dtype=np.float64),
        np.ascontiguousarray(row.knots, dtype=np.float64),
        row.places,
        radius,
        stride,
        separation,
        least,
        found.warps,
        found.zncc,
        found.second_peak,
        found.which,
    )
    return found


_FAST = {"contract", "reassoc", "arcp", "nsz"}


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def _pixels(grey, mask, left_of_mask, top_of_mask, jx, iy, off_x, off_y, radius, stride, px):  # type: ignore[no-untyped-def]
    """Every so many pixels of the circular subset that the mask leaves: dx, dy and grey level less its mean, in px.

    Returns their number and the norm of the levels.
    """
    n, total, all_count = 0, 0.0, mask.size == 0
    height, width = grey.shape if all_count else mask.shape
    for dy in range(-(radius // stride) * stride, radius + 1, stride):
        for dx in range(-(radius // stride) * stride, radius + 1, stride):
            i, j = iy + dy - top_of_mask, jx + dx - left_of_mask
            if dx * dx + dy * dy > radius * radius or i < 0 or j < 0 or i >= height or j >= width:
                continue
            if all_count or mask[i, j]:
                px[0, n], px[1, n], px[2, n] = dx + off_x, dy + off_y, grey[iy + dy, jx + dx]
                total += px[2, n]
                n += 1
    mean, square = total / max(n, 1), 0.0
    for m in range(n):
        px[2, m] -= mean
        square += px[2, m] * px[2, m]
    return n, math.sqrt(square)


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def _placed(shape, x0, y0, warp, px, n, radius, nearest, at, share):  # type: ignore[no-untyped-def]
    """Where n pixels of a subset about (x0, y0) lie under a warp (6,); false where one leaves the image of that shape.

    Fills at (n,), the number of the pixel that is nearest, or to the upper left; then also share (2, n), how far from
    that one to the next. Counted from the subset's corner, single precision is enough.
    """
    kind, half = np.float32, 0.5 if nearest else 0.0
    wide = (radius + 1.0) * (1.0 + abs(warp[2]) + abs(warp[3]))
    high = (radius + 1.0) * (1.0 + abs(warp[4]) + abs(warp[5]))
    x, y = x0 + warp[0], y0 + warp[1]
    if not (wide + high < 1e4 and x > -wide and y > -high and x < shape[1] + wide and y < shape[0] + high):
        return False
    left, top = math.floor(x - wide), math.floor(y - high)
    first, columns = np.int32(top * shape[1] + left), np.int32(shape[1])
    xx, xy, x_off = kind(1.0 + warp[2]), kind(warp[3]), kind(x - left + half)
    yx, yy, y_off = kind(warp[4]), kind(1.0 + warp[5]), kind(y - top + half)
    if not (x > wide and y > high and x + wide < shape[1] - 1 and y + high < shape[0] - 1):
        for m in range(n):
            x_at = x + (1.0 + warp[2]) * px[0, m] + warp[3] * px[1, m]
            y_at = y + warp[4] * px[0, m] + (1.0 + warp[5]) * px[1, m]
            if not (x_at >= 0.0 and y_at >= 0.0 and x_at < shape[1] - 1 and y_at < shape[0] - 1):
                return False
    for m in range(np.uint64(n)):
        dx, dy = px[0, m], px[1, m]
        x_at, y_at = x_off + xx * dx + xy * dy, y_off + yx * dx + yy * dy
        column, row = np.int32(x_at), np.int32(y_at)
        at[m] = first + row * columns + column
        if not nearest:
            share[0, m], share[1, m] = x_at - kind(column), y_at - kind(row)
    return True


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def _read(image, columns, n, nearest, at, share, level):  # type: ignore[no-untyped-def]
    """Fills level (n,) with the grey levels of the flat image of so many columns at the places at and share."""
    kind, one = np.float32, np.uint64(1)
    if nearest:
        for m in range(np.uint64(n)):
            level[m] = kind(image[np.uint64(at[m])])
        return
    for m in range(np.uint64(n)):
        above = np.uint64(at[m])
        below = above + np.uint64(columns)
        g, h = kind(image[above]), kind(image[below])
        g += share[0, m] * (kind(image[above + one]) - g)
        h += share[0, m] * (kind(image[below + one]) - h)
        level[m] = g + share[1, m] * (h - g)


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def _alike(image, shape, x0, y0, warp, px, n, norm, radius, nearest, at, share, level):  # type: ignore[no-untyped-def]
    """ZNCC of n pixels px (3, n) with the flat image under a warp (6,), bilinear or of the nearest pixels.

    -1 where they leave the image or the warp is NaN. at, share, level : scratch.
    """
    if n < 8 or not norm > 0.0 or not _placed(shape, x0, y0, warp, px, n, radius, nearest, at, share):
        return -1.0
    _read(image, shape[1], n, nearest, at, share, level)
    s_g = s_gg = s_fg = 0.0
    for m in range(np.uint64(n)):
        g = float(level[m])
        s_g += g
        s_gg += g * g
        s_fg += g * px[2, m]
    variance = s_gg - s_g * s_g / n
    return s_fg / (norm * math.sqrt(variance)) if variance > 1e-9 * (n + s_gg) else -1.0


@nb.njit(cache=True, nogil=True)
def _between(knots, place, warp):  # type: ignore[no-untyped-def]
    """Fills the warp (6,) at a place among the knots (J, 6)."""
    at = int(place)
    share = place - at
    for c in range(6):
        warp[c] = knots[at, c]
        if share > 0.0:
            warp[c] += share * (knots[at + 1, c] - knots[at, c])


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=_FAST)
def _best(  # type: ignore[no-untyped-def]
    grey, mask, left_of_mask, top_of_mask, image, xy, knots, places, radius, stride, separation, least,
    best, zncc, second_peak, which,
):  # fmt: skip
    """The best warp of each point's row, bilinear in the current image; the last four arrays are filled.

    grey, image : the whole images, xy : (n, 2) px in them; mask : (h, w) of the box whose corner is given, or empty.
    Of many warps those that a quarter of the pixels, read without interpolation, shows to be far from the best, or from
    any use, keep that first score.
    """
    count, flat = len(places), image.ravel()
    for k in nb.prange(xy.shape[0]):
        x0, y0 = xy[k, 0], xy[k, 1]
        jx, iy = math.floor(x0 + 0.5), math.floor(y0 + 0.5)
        most = (2 * (radius // stride) + 1) ** 2
        px, share = np.empty((3, most), np.float32), np.empty((2, most), np.float32)
        pixel, level = np.empty(most, np.int32), np.empty(most, np.float32)
        score, warp, highest, limit = np.full(count, -1.0), np.empty(6), -1.0, -2.0
        if count >= _MANY:
            n, norm = _pixels(
                grey, mask, left_of_mask, top_of_mask, jx, iy, jx - x0, iy - y0, radius, _THINNED * stride, px
            )
            for h in range(count):
                _between(knots[k], places[h], warp)
                score[h] = _alike(flat, image.shape, x0, y0, warp, px, n, norm, radius, True, pixel, share, level)
                highest = max(highest, score[h])
            limit = max(highest - _DOUBT, -0.99)
        if highest > least - _DOUBT or count < _MANY:
            n, norm = _pixels(grey, mask, left_of_mask, top_of_mask, jx, iy, jx - x0, iy - y0, radius, stride, px)
            for h in range(count):
                if score[h] > limit:
                    _between(knots[k], places[h], warp)
                    score[h] = _alike(flat, image.shape, x0, y0, warp, px, n, norm, radius, False, pixel, share, level)
        at = 0
        for h in range(count):
            if score[h] > score[at]:
                at = h
        which[k], zncc[k] = at, score[at]
        if score[at] > -1.0:
            _between(knots[k], places[at], best[k])
            for h in range(count):
                if score[h] > second_peak[k]:
                    _between(knots[k], places[h], warp)
                    if math.hypot(warp[0] - best[k, 0], warp[1] - best[k, 1]) > separation:
                        second_peak[k] = score[h]
