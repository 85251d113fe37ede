"""Compiled separable filters of a rectangular box of an image.

Beyond its border an image is mirrored at the centre of the border pixel. All sums run over the taps in their order, so
a pixel's value depends neither on the box nor on the number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from ringdic.correlation.interpolation import FAST
from ringdic.correlation.lanes import INNER, LANES, load, load_one, pointer, ramp, store

_U = np.uint64
_L = np.uint64(LANES)
_BLOCK = 4 * LANES  # columns whose sums are in registers at once
COLUMNS = 64  # columns that one thread takes at a time: 2000 rows of them are half a megabyte


@nb.njit(cache=True, nogil=True)
def mirror_index(at, count):  # type: ignore[no-untyped-def]
    """Index of the pixel shown at position ``at``, inside a row of ``count`` pixels or mirrored at its ends."""
    while at < 0 or at >= count:
        at = -at if at < 0 else 2 * (count - 1) - at
    return at


@nb.njit(nogil=True, cache=True, fastmath=FAST, **INNER)
def _block(source, first, stride, taps, count, out, to):  # type: ignore[no-untyped-def]
    """Sums over ``count`` taps for _BLOCK neighbouring positions.

    The first tap reads source[first ...], each further tap ``stride`` further on; the sums go to out[to ...].
    """
    a = b = c = d = ramp(source) * np.float32(0)
    for k in range(_U(count)):
        at, tap = first + k * stride, load_one(taps, k)
        a += tap * load(source, at)
        b += tap * load(source, at + _L)
        c += tap * load(source, at + _L + _L)
        d += tap * load(source, at + _L + _L + _L)
    store(out, to, a)
    store(out, to + _L, b)
    store(out, to + _L + _L, c)
    store(out, to + _L + _L + _L, d)


@nb.njit(nogil=True, cache=True, **INNER)
def _line(row, begin, line):  # type: ignore[no-untyped-def]
    """Fill line (m,) with a row of an image from column ``begin`` on, mirrored beyond its border."""
    if begin >= 0 and begin + len(line) <= len(row):
        shown = row[begin : begin + len(line)]
        for k in range(_U(len(line))):
            line[k] = shown[k]
    else:
        for k in range(len(line)):
            line[k] = row[mirror_index(begin + k, len(row))]


@nb.njit(nogil=True, cache=True)
def separable_filter(begin, end, image, along_x, along_y, left, top, out):  # type: ignore[no-untyped-def]
    """Filter some columns of a box of an image along x and along y.

    begin, end : of the columns, in blocks of COLUMNS, the end exclusive; image : (h, w); along_x, along_y : taps, odd
    in number, centred on the pixel; left, top : the box's first pixel; out : (rows, columns), filled. Columns are taken
    a few at a time, so that what is filtered along x is still in the cache when it is filtered along y.
    """
    rows, width = out.shape
    reach_x, reach_y = len(along_x) // 2, len(along_y) // 2
    for block in range(begin, end):
        first = block * COLUMNS
        line, spare = np.empty(COLUMNS + 2 * reach_x, out.dtype), np.empty(COLUMNS, out.dtype)
        part = np.empty((rows + 2 * reach_y, COLUMNS), out.dtype)
        for i in range(len(part)):
            _line(image[mirror_index(top - reach_y + i, image.shape[0])], left + first - reach_x, line)
            for j in range(0, COLUMNS, _BLOCK):
                _block(pointer(line), _U(j), _U(1), pointer(along_x), len(along_x), pointer(part[i]), _U(j))
        whole = first + COLUMNS <= width
        for i in range(rows):
            to = out[i, first:] if whole else spare
            for j in range(0, COLUMNS, _BLOCK):
                _block(pointer(part[i]), _U(j), _U(COLUMNS), pointer(along_y), len(along_y), pointer(to), _U(j))
            if not whole:
                out[i, first:] = spare[: width - first]
