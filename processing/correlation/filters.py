"""A row of taps along the rows of an image and along its columns, compiled: separable filters of a box of an image.

An image goes on beyond its border as in a mirror, the pixel of the border once. All sums run over the taps in their
order, so a pixel's value depends neither on the box nor on the number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from processing.correlation.interpolation import FAST
from processing.correlation.lanes import LANES, load, number, pointer, ramp, store

_U = np.uint64
_L = np.uint64(LANES)
BLOCK = 4 * LANES  # columns that are summed at once
_ROWS = 32  # rows that one thread takes at a time


@nb.njit(cache=True, nogil=True)
def mirrored(at, count):  # type: ignore[no-untyped-def]
    """The pixel of a row of ``count`` that a place inside or beyond it shows."""
    while at < 0 or at >= count:
        at = -at if at < 0 else 2 * (count - 1) - at
    return at


@nb.njit(nogil=True, cache=True, fastmath=FAST)
def _block(source, first, stride, taps, count, out, to):  # type: ignore[no-untyped-def]
    """BLOCK sums of ``count`` taps, the first over source[first ...], the next ``stride`` further, to out[to ...]."""
    a = b = c = d = ramp(source) * np.float32(0)
    for k in range(_U(count)):
        at, tap = first + k * stride, number(taps, k)
        a += tap * load(source, at)
        b += tap * load(source, at + _L)
        c += tap * load(source, at + _L + _L)
        d += tap * load(source, at + _L + _L + _L)
    store(out, to, a)
    store(out, to + _L, b)
    store(out, to + _L + _L, c)
    store(out, to + _L + _L + _L, d)


@nb.njit(nogil=True, cache=True, parallel=True)
def along_rows(image, taps, left, top, out):  # type: ignore[no-untyped-def]
    """out (h, w), w a multiple of BLOCK: taps (odd,) centred on the pixels from column ``left`` and row ``top`` on.

    The rows lie in the image, the columns need not.
    """
    rows, width = out.shape
    reach, columns = len(taps) // 2, image.shape[1]
    for chunk in nb.prange((rows + _ROWS - 1) // _ROWS):
        line = np.empty(width + 2 * reach, out.dtype)
        for i in range(chunk * _ROWS, min((chunk + 1) * _ROWS, rows)):
            begin = left - reach
            here = image[top + i]
            low, high = min(max(-begin, 0), len(line)), min(max(columns - begin, 0), len(line))
            for k in range(low):
                line[k] = here[mirrored(begin + k, columns)]
            inner, shown = line[low:high], here[begin + low : begin + high]
            for m in range(_U(len(inner))):
                inner[m] = shown[m]
            for k in range(max(high, low), len(line)):
                line[k] = here[mirrored(begin + k, columns)]
            for j in range(0, width, BLOCK):
                _block(pointer(line), _U(j), _U(1), pointer(taps), len(taps), pointer(out[i]), _U(j))


@nb.njit(nogil=True, cache=True, parallel=True)
def along_columns(source, taps, first, out):  # type: ignore[no-untyped-def]
    """out (h, w): taps (odd,) over rows of the source (any, at least w rounded up to BLOCK), row i's from i + first on.

    A row that the source has not is not asked for.
    """
    rows, width = out.shape
    stride = _U(source.shape[1])
    for chunk in nb.prange((rows + _ROWS - 1) // _ROWS):
        spare = np.empty(BLOCK, out.dtype)
        for j in range(0, width, BLOCK):
            for i in range(chunk * _ROWS, min((chunk + 1) * _ROWS, rows)):
                if j + BLOCK <= width:
                    _block(pointer(source[first + i]), _U(j), stride, pointer(taps), len(taps), pointer(out[i]), _U(j))
                else:
                    _block(pointer(source[first + i]), _U(j), stride, pointer(taps), len(taps), pointer(spare), _U(0))
                    for k in range(j, width):
                        out[i, k] = spare[k - j]
