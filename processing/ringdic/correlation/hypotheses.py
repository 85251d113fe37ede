"""Search among many given affine warps of a subset for the one with the highest ZNCC.

The warps come from outside, for instance from a calibration and a proxy surface that suggest where a match may lie. The
best of them is a start value for the refinement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.correlation.lanes import INNER, LANES, floor, load, pointer, store, store_integers
from ringdic.correlation.parallel import in_ranges
from ringdic.correlation.prepared import Current, Reference

_MANY = 16  # warps per point from which on a first trial on fewer pixels pays
_THINNED = 2  # stride of the first trial, in strides of the final one
_DOUBT = 0.3  # error of the first trial's ZNCC: three standard deviations for 80 pixels of unrelated texture
_LEAST = 16  # points that are worth a thread
_SEPARATION = 4.0  # px, by which another warp's displacement must differ to count for the second peak
_ANY_PIXEL = np.zeros((0, 0), bool)  # in place of a mask: all pixels count


@dataclass(frozen=True)
class WarpHypotheses:
    """K affine warps to be tried at each of n points, interpolated linearly between J knots.

    As the depth of a point changes, its match moves evenly along an epipolar line, so that a few warps computed
    exactly, the knots, give all others.

    knots : (n, J, 6) float64, warps u v ux uy vx vy (u, v in px, the gradients without a unit); NaN where not to be
        tried.
    knot_coordinates : (K,) float64, where the K warps lie among the knots, no unit; 2.25 is a quarter of the way from
        knot 2 to knot 3.
    """

    knots: Floats
    knot_coordinates: Floats

    @property
    def warps(self) -> Floats:
        """All K warps at each point, u v ux uy vx vy with u, v in px. (n, K, 6)."""
        below = np.minimum(self.knot_coordinates.astype(np.int64), max(self.knots.shape[1] - 2, 0))
        share = (self.knot_coordinates - below)[:, None]
        above = np.minimum(below + 1, self.knots.shape[1] - 1)
        between = self.knots[:, below] + share * (self.knots[:, above] - self.knots[:, below])
        return np.where(share == 0.0, self.knots[:, below], np.where(share == 1.0, self.knots[:, above], between))


@dataclass(frozen=True)
class BestWarps:
    """The warp with the highest ZNCC among those tried at each of n points.

    warps : (n, 6) float64, u v ux uy vx vy (u, v in px); NaN where no warp keeps the subset inside the current image.
    zncc : (n,) float64, its ZNCC; -1 where there is none.
    second_peak : (n,) float64, highest ZNCC of a warp whose displacement differs by more than 4 px; -1 for none.
    index : (n,) int64, which of the K warps it is.
    """

    warps: Floats
    zncc: Floats
    second_peak: Floats
    index: Indices


def search_warps(
    reference: Reference, current: Current, xy: Pixels, warps: Floats, radius: int, *, stride: int = 2
) -> tuple[Floats, Floats, Floats]:
    """Best of K given affine warps at each point, by ZNCC over some of the pixels of a circular subset.

    Parameters
    ----------
    reference, current : the images; pixels outside the reference's mask do not count.
    xy : (n, 2) float64, px, points of the reference image.
    warps : (n, K, 6) float64, u v ux uy vx vy at the points (u, v in px); NaN where not to be tried.
    radius : px, of the subset. stride : px, spacing of the pixels that are compared.

    Returns
    -------
    warps (n, 6), zncc (n,) and second_peak (n,) of `BestWarps`.

    Raises ValueError if the shapes do not agree.
    """
    if warps.ndim != 3 or warps.shape[::2] != (len(xy), 6) or xy.shape != (len(xy), 2):
        raise ValueError(f"warps must be (n, K, 6) for xy (n, 2), not {warps.shape} for {xy.shape}")
    hypotheses = WarpHypotheses(warps, np.arange(warps.shape[1], dtype=np.float64))
    best = search_hypotheses(
        reference.image, current, xy, hypotheses, radius, stride=stride, mask=reference.mask, corner=reference.box[:2]
    )
    return best.warps, best.zncc, best.second_peak


def search_hypotheses(
    image: NDArray,
    current: Current,
    xy: Pixels,
    hypotheses: WarpHypotheses,
    radius: int,
    *,
    stride: int = 2,
    zncc_min: float = -1.0,
    mask: Mask = _ANY_PIXEL,
    corner: tuple[int, int] = (0, 0),
) -> BestWarps:
    """Best of the interpolated warp hypotheses at each point, by ZNCC over the pixels of a circular subset.

    image : (height, width) grey levels of the reference. xy : (n, 2) float64, px, points of it.
    hypotheses : the warps of these points into the current image. radius : px, of the subset.
    stride : px, spacing of the pixels that are compared.
    zncc_min : points for which a first trial on fewer pixels shows that no warp reaches this ZNCC keep the ZNCC of that
        trial, which saves time.
    mask : (h, w) bool, the pixels of ``image`` that count in a box whose upper left corner is at ``corner`` (x, y) px;
        an empty mask lets all count.
    """
    n = len(xy)
    best = BestWarps(np.full((n, 6), np.nan), np.full(n, -1.0), np.full(n, -1.0), np.zeros(n, np.int64))
    in_ranges(
        _best_warps, n, image, mask, *corner, current.image, np.ascontiguousarray(xy, dtype=np.float64),
        np.ascontiguousarray(hypotheses.knots, dtype=np.float64), hypotheses.knot_coordinates,
        radius, stride, _SEPARATION, zncc_min, best.warps, best.zncc, best.second_peak, best.index, least=_LEAST,
    )  # fmt: skip
    return best


_FAST = {"contract", "reassoc", "arcp", "nsz"}


@nb.njit(cache=True, nogil=True, fastmath=_FAST, **INNER)
def _pixels(grey, mask, left_of_mask, top_of_mask, jx, iy, off_x, off_y, radius, stride, px):  # type: ignore[no-untyped-def]
    """Pixels of a circular subset that lie in the mask, every ``stride``-th each way.

    Fills px (3, most) with dx, dy from the point and the grey level less the mean of all. (jx, iy) is the pixel nearest
    to the point, off_x and off_y its distance from it. Returns the number of pixels and the norm of their levels.
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


@nb.njit(cache=True, nogil=True, fastmath=_FAST, **INNER)
def _positions(shape, x0, y0, warp, px, n, radius, nearest, at, share):  # type: ignore[no-untyped-def]
    """Positions of n pixels of a subset in the current image under a warp.

    shape : (h, w) of the current image; x0, y0 : the point; warp : (6,); px : (3, n), offsets of the pixels.
    Fills at (n,), flat index of the pixel to the upper left (``nearest``: of the nearest pixel), counted from that of
    the subset's corner, and, unless ``nearest``, share (2, n), the fraction of a pixel from there to the position. So
    single precision is enough. Arrays are long enough for whole vectors. Returns the corner's flat index, and whether
    all pixels lie inside the image.
    """
    kind, half = np.float32, 0.5 if nearest else 0.0
    wide = (radius + 1.0) * (1.0 + abs(warp[2]) + abs(warp[3]))
    high = (radius + 1.0) * (1.0 + abs(warp[4]) + abs(warp[5]))
    x, y = x0 + warp[0], y0 + warp[1]
    if not (
        (wide + high) * shape[1] < 2.0**23 and x > -wide and y > -high and x < shape[1] + wide and y < shape[0] + high
    ):
        return 0, False
    left, top = math.floor(x - wide), math.floor(y - high)
    columns = kind(shape[1])
    xx, xy, x_off = kind(1.0 + warp[2]), kind(warp[3]), kind(x - left + half)
    yx, yy, y_off = kind(warp[4]), kind(1.0 + warp[5]), kind(y - top + half)
    if not (x > wide and y > high and x + wide < shape[1] - 1 and y + high < shape[0] - 1):
        for m in range(n):
            x_at = x + (1.0 + warp[2]) * px[0, m] + warp[3] * px[1, m]
            y_at = y + warp[4] * px[0, m] + (1.0 + warp[5]) * px[1, m]
            if not (x_at >= 0.0 and y_at >= 0.0 and x_at < shape[1] - 1 and y_at < shape[0] - 1):
                return 0, False
    along, down, number, along_share, down_share = (
        pointer(px[0]), pointer(px[1]), pointer(at), pointer(share[0]), pointer(share[1]),
    )  # fmt: skip
    for v in range(np.uint64(0), np.uint64(n), np.uint64(LANES)):
        dx, dy = load(along, v), load(down, v)
        x_at, y_at = dx * xx + dy * xy + x_off, dx * yx + dy * yy + y_off
        column, row = floor(x_at), floor(y_at)
        store_integers(number, v, row * columns + column)
        if not nearest:
            store(along_share, v, x_at - column)
            store(down_share, v, y_at - row)
    return top * shape[1] + left, True


@nb.njit(cache=True, nogil=True, fastmath=_FAST, **INNER)
def _zncc(image, shape, x0, y0, warp, px, n, norm, radius, nearest, at, share):  # type: ignore[no-untyped-def]
    """ZNCC of a subset of n pixels px (3, n) with the flat current image under a warp (6,).

    Grey levels are those of the nearest pixels (``nearest``) or bilinear. norm : of the subset's levels about their
    mean. -1 where a pixel lies outside the image, the warp is NaN or the image is even. at, share : scratch.
    """
    if n < 8 or not norm > 0.0:
        return -1.0
    corner, inside = _positions(shape, x0, y0, warp, px, n, radius, nearest, at, share)
    if not inside:
        return -1.0
    kind, first = (
        np.float32,
        np.float32(image[np.uint64(corner + at[0])]),
    )  # about a level of them, single precision is enough
    s_g, s_gg, s_fg, one = kind(0), kind(0), kind(0), np.uint64(1)
    for m in range(np.uint64(n)):
        above = np.uint64(corner + at[m])
        g = kind(image[above])
        if not nearest:
            below = above + np.uint64(shape[1])
            h = kind(image[below])
            g += share[0, m] * (kind(image[above + one]) - g)
            h += share[0, m] * (kind(image[below + one]) - h)
            g += share[1, m] * (h - g)
        g -= first
        s_g += g
        s_gg += g * g
        s_fg += g * px[2, m]
    variance = float(s_gg) - float(s_g) * float(s_g) / n
    return s_fg / (norm * math.sqrt(variance)) if variance > 1e-9 * (n + s_gg) else -1.0


@nb.njit(cache=True, nogil=True, **INNER)
def _interpolate_knots(knots, place, warp):  # type: ignore[no-untyped-def]
    """Fill the warp (6,) that lies at a coordinate among the knots (J, 6)."""
    at = int(place)
    share = place - at
    for c in range(6):
        warp[c] = knots[at, c]
        if share > 0.0:
            warp[c] += share * (knots[at + 1, c] - knots[at, c])


@nb.njit(cache=True, nogil=True, fastmath=_FAST)
def _best_warps(  # type: ignore[no-untyped-def]
    first, last, grey, mask, left_of_mask, top_of_mask, image, xy, knots, knot_coordinates,
    radius, stride, separation, zncc_min, best, zncc, second_peak, index,
):  # fmt: skip
    """Find the best of each point's K warps; fills best (n, 6), zncc, second_peak and index (n,) from first to last.

    grey, image : the whole reference and current images; xy : (n, 2) px in the reference; mask : (h, w) bool of the box
    whose corner is given, or empty. From ``_MANY`` warps on, all of them are first compared on a quarter of the pixels
    with nearest-pixel grey levels. Warps that this shows to be far below the best, or below ``zncc_min``, keep that
    score; the others are compared bilinearly on all pixels.
    """
    count, flat = len(knot_coordinates), image.ravel()
    for k in range(first, last):
        x0, y0 = xy[k, 0], xy[k, 1]
        jx, iy = math.floor(x0 + 0.5), math.floor(y0 + 0.5)
        most = ((2 * (radius // stride) + 1) ** 2 + LANES - 1) // LANES * LANES
        px, share = np.empty((3, most), np.float32), np.empty((2, most), np.float32)
        pixel = np.empty(most, np.int32)
        score, warp, highest, limit = np.full(count, -1.0), np.empty(6), -1.0, -2.0
        if count >= _MANY:
            n, norm = _pixels(
                grey, mask, left_of_mask, top_of_mask, jx, iy, jx - x0, iy - y0, radius, _THINNED * stride, px
            )
            for h in range(count):
                _interpolate_knots(knots[k], knot_coordinates[h], warp)
                score[h] = _zncc(flat, image.shape, x0, y0, warp, px, n, norm, radius, True, pixel, share)
                highest = max(highest, score[h])
            limit = max(highest - _DOUBT, -0.99)
        if highest > zncc_min - _DOUBT or count < _MANY:
            n, norm = _pixels(grey, mask, left_of_mask, top_of_mask, jx, iy, jx - x0, iy - y0, radius, stride, px)
            for h in range(count):
                if score[h] > limit:
                    _interpolate_knots(knots[k], knot_coordinates[h], warp)
                    score[h] = _zncc(flat, image.shape, x0, y0, warp, px, n, norm, radius, False, pixel, share)
        at = 0
        for h in range(count):
            if score[h] > score[at]:
                at = h
        index[k], zncc[k] = at, score[at]
        if score[at] > -1.0:
            _interpolate_knots(knots[k], knot_coordinates[at], best[k])
            for h in range(count):
                if score[h] > second_peak[k]:
                    _interpolate_knots(knots[k], knot_coordinates[h], warp)
                    if math.hypot(warp[0] - best[k, 0], warp[1] - best[k, 1]) > separation:
                        second_peak[k] = score[h]
