"""Search for a pattern that repeats itself, whose matches can be wrong by its period with a small standard deviation.

Windows of the reference image are compared with the image around them. A random pattern is like itself nowhere else, a
repeating one is so at its period. A window is as large as several subsets, which are matched wrongly together, and so
large that a random pattern of the same fineness is not as much like itself by chance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Image, Mask, Pixels
from ringdic.correlation.prepared import as_8_bit
from ringdic.correlation.seeds import even_sample
from ringdic.findings import Finding

_WINDOWS = 36  # that are compared
_FEWEST = 3  # of them that must repeat
_SHARE = 0.1  # of them that must repeat
_REACH = 320  # px, longest period that is sought: twice the displacement over which start values are sought
_LIKENESS = 0.65  # ZNCC, without noise, from which on matches were found at wrong places; random patterns reach 0.56
_SUBSETS = 2.0  # radii of a subset, half the side of a window
_SMALLEST = 15  # px, half the side of the smallest window
_CHANCE = 12.0  # standard deviations of the ZNCC by chance that the likeness of a window exceeds
_SAME_PEAK = 0.5  # ZNCC above which places around a peak belong to it
_AS_HIGH = 0.95  # of the highest of the other peaks, from which on the nearest one counts
_ALONG = 0.5  # of it, the mean on the way there, above which the window is like itself along an edge
_LONGEST = 1.5  # times as long as wide, a peak at zero that is not of stripes
_FLOOR = 3.0  # grey levels, that are added to the local standard deviation: where it is less there is no pattern
_LEVELLED = 64  # px at least over which mean and contrast are evened out
_SPECKLES = 8.0  # half widths of the peak at zero, over which they are for the comparison
_LEAST = 0.5  # standard deviation of such an image where there is a pattern
_COVERED = 0.6  # of a window, that must lie in the region
_FINE = 2.0  # px, half width of the peak at zero from which on the image is reduced by a half
_SIZED = 3.0  # px, half width of that peak up to which the size of the speckles is taken from it
_MIDDLE = 640  # px, side of the square in the middle by which this is decided
_ROWS = 4  # every so many rows are enough for that half width

Levels = NDArray[np.float32]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Repetition:
    """Windows of an image and whether their pattern repeats itself.

    xy : (k, 2) px, middles of the windows. likeness : (k,) ZNCC of the second peak, without the noise. period : (k, 2)
    px, where this peak lies. repeats : (k,) bool. speckle : px, size of the speckles, as the full width at half maximum
    of the autocorrelation, the geometric mean of its least and largest.
    """

    xy: Pixels
    likeness: Floats
    period: Pixels
    repeats: Mask
    speckle: float

    @property
    def share(self) -> float:
        """Part of the windows that repeat; 0 where they are too few to tell."""
        count = int(self.repeats.sum())
        share = count / max(len(self.repeats), 1)
        return share if count >= _FEWEST and share >= _SHARE else 0.0

    def ambiguous(self, xy: Pixels) -> Mask:
        """Which points lie where the pattern repeats itself, (n,) bool. xy : (n, 2) px, of the image."""
        if not self.share or not len(xy):
            return np.zeros(len(xy), bool)
        return np.asarray(self.repeats[cKDTree(self.xy).query(xy)[1]])

    def findings(self, what: str, cameras: tuple[str, ...] = (), step: str | None = None) -> list[Finding]:
        """The finding of a repeating pattern, if it does repeat.

        what : the image, as a sentence begins. cameras, step : that it is of.
        """
        if not self.share:
            return []
        lengths = np.linalg.norm(self.period[self.repeats], axis=1)
        period = float(np.percentile(lengths, 50.0, method="lower"))  # a period that there is
        likeness = float(np.median(self.likeness[self.repeats]))
        sentence = (
            f"{what}: over {100 * self.share:.0f} % of the pattern it repeats itself at {period:.0f} px, with a second "
            f"correlation peak of {likeness:.2f} (limit {_LIKENESS}), so matches can be wrong by that much; apply a "
            "random pattern, or draw a mask that leaves the repeating one out"
        )
        return [Finding("repeating-pattern", sentence, cameras, step, round(likeness, 3), _LIKENESS, "ZNCC")]


def find_repetition(image: Image, xy: Pixels, radius: int, region: Mask | None = None) -> Repetition:
    """Look for a pattern that repeats itself within the reach of the search for start values.

    image : (height, width) grey levels. xy : (n, 2) px, points that are matched. radius : px, of the subset. region :
    (height, width) bool, what belongs to the pattern; None for the whole image.
    """
    if not len(xy):
        return Repetition(xy, np.zeros(0), xy, np.zeros(0, bool), math.nan)
    corner, part = _extent(image.shape, region)
    middle = xy[np.argmin(np.linalg.norm(xy - np.median(xy, axis=0), axis=1))] - corner  # one that is matched
    grey = as_8_bit(image[part])
    inside = np.ones(grey.shape, np.uint8) if region is None else region[part].view(np.uint8)
    factor, even, speckle = 1, max(4 * radius, _LEVELLED), 0.0
    while True:
        about = _square(grey.shape, _scaled(middle, factor))
        narrow, wide = _half_widths(_levelled(grey[about], inside[about], even // factor))
        last = narrow <= _FINE or min(grey.shape) <= 4 * _LEVELLED
        if not speckle and (narrow <= _SIZED or last):
            speckle = 2.0 * factor * math.sqrt(narrow * wide)
        if last:
            break
        grey, inside = _halved(grey), _halved(inside)
        factor *= 2
    level = _levelled(grey, inside, round(_SPECKLES * narrow))  # where an edge counts as little as the speckles
    # Area of the squared peak at zero, as of a normal distribution: the number of independent places of a window is its
    # area over this. A much longer peak is that of stripes.
    peak = math.pi / (2.0 * math.log(2.0)) * narrow * min(wide, _LONGEST * narrow)
    wanted = max(round(_SUBSETS * radius / factor), _SMALLEST, 0.5 * _CHANCE / _LIKENESS * math.sqrt(peak))
    half = min(math.ceil(wanted), min(grey.shape) // 4)
    limit = _LIKENESS * max(wanted / half, 1.0)  # in a small image windows are smaller than wanted, and chance larger
    usable = _usable(level, inside, half)
    windows = xy[even_sample(xy, _WINDOWS)]
    rows = np.zeros((0, 5))
    for some in (windows[::2], windows[1::2]):
        found = [rows]
        for point in some:
            one = _second_peak(level, usable, *_scaled(point - corner, factor), half, _REACH // factor)
            if one is not None:
                found.append(np.array([[*point, one[0], factor * one[1], factor * one[2]]]))
        rows = np.concatenate(found)
        if len(rows) >= _FEWEST and not (rows[:, 2] >= limit).any():  # no need to look at the others
            break
    return Repetition(rows[:, :2], rows[:, 2], rows[:, 3:], rows[:, 2] >= limit, speckle)


def _extent(shape: tuple[int, ...], region: Mask | None) -> tuple[Pixels, tuple[slice, slice]]:
    """First pixel (2,) of the smallest part of an image of a shape that holds a region, and this part as slices."""
    whole = slice(0, shape[0]), slice(0, shape[1])
    if region is None or not region.any():
        return np.zeros(2), whole
    rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    corner = np.array([columns[0], rows[0]], dtype=np.float64)
    return corner, (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))


def _scaled(point: Pixels, factor: int) -> tuple[int, int]:
    """The pixel (x, y) nearest to a point (2,) px of an image that was reduced by a factor."""
    x, y = np.rint((point + 0.5) / factor - 0.5).astype(int)
    return int(x), int(y)


def _square(shape: tuple[int, ...], middle: tuple[int, int]) -> tuple[slice, slice]:
    """The part of an image of a shape about a pixel (x, y) from which the speckles' size is told."""
    at = (min(max(x - _MIDDLE // 2, 0), max(side - _MIDDLE, 0)) for x, side in zip(middle[::-1], shape, strict=True))
    rows, columns = (slice(first, first + _MIDDLE) for first in at)
    return rows, columns


def _levelled(image: Bytes, region: Bytes, side: int) -> Levels:
    """An image of even mean and contrast over squares of some px, 0 outside the region, which is 1 inside."""
    grey, inside = image.astype(np.float32), region.astype(np.float32)
    size = (2 * (side // 2) + 1,) * 2

    def mean(values: Levels) -> Levels:
        return np.asarray(cv2.blur(values, size, borderType=cv2.BORDER_CONSTANT), np.float32)

    count = np.maximum(mean(inside), np.float32(1e-3), dtype=np.float32)
    level = np.asarray((grey - mean(grey * inside) / count) * inside, np.float32)
    level /= np.sqrt(np.maximum(mean(level * level), 0.0) / count) + np.float32(_FLOOR)
    return level


def _halved(image: Bytes) -> Bytes:
    """An image reduced by a half."""
    height, width = (side // 2 * 2 for side in image.shape)
    half = cv2.resize(image[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(half, np.uint8)


def _half_widths(level: Levels) -> tuple[float, float]:
    """Least and largest distance, px, at which the autocorrelation of an image is half of that at zero, noise left out.

    Of four directions.
    """
    widths = []
    most = min(level.shape) // 8
    for dx, dy in ((1, 0), (0, 1), (1, 1), (-1, 1)):
        values = [1.0]
        while len(values) < 3 or (values[-1] > 0.5 * _at_zero(values[1], values[2]) and len(values) < most):
            values.append(_autocorrelation(level, dx * len(values), dy * len(values)))
        half = 0.5 * _at_zero(values[1], values[2])
        at = next((k for k, value in enumerate(values) if value < half), len(values) - 1)
        over = values[at - 1] - half
        lag = at - 1 + min(over / max(values[at - 1] - values[at], 1e-9), 1.0) if at > 1 else 0.7
        widths.append(lag * math.hypot(dx, dy))
    return min(widths), max(widths)


def _autocorrelation(level: Levels, dx: int, dy: int) -> float:
    """Correlation of an image of mean 0 with itself at a distance of dx (of either sign) and dy ≥ 0 px."""
    width = level.shape[1] - abs(dx)
    left, right = max(-dx, 0), max(dx, 0)
    here = level[: level.shape[0] - dy : _ROWS, left : left + width]
    there = level[dy::_ROWS, right : right + width]
    square = float(np.vdot(here, here)) * float(np.vdot(there, there))
    return float(np.vdot(here, there)) / math.sqrt(square) if square > 0 else 0.0


def _at_zero(first: float, second: float) -> float:
    """Autocorrelation at zero without the noise, by the parabola through those at 1 and at 2 px."""
    return min(max((4.0 * first - second) / 3.0, 0.5), 1.0)


def _usable(level: Levels, inside: Bytes, half: int) -> Mask:
    """About which pixels of an image, (height, width) bool, a window lies in the region, most of it, and has a pattern.

    half : px, half the side of the windows. Of a window without any, the ZNCC would be a quotient of rounding errors.
    """
    side = (2 * half + 1,) * 2
    mean, square, covered = (cv2.blur(each, side) for each in (level, level * level, inside.astype(np.float32)))
    return np.asarray((covered >= _COVERED) & (square - mean * mean >= _LEAST**2))


def _second_peak(
    level: Levels, usable: Mask, x: int, y: int, half: int, reach: int
) -> tuple[float, float, float] | None:
    """The highest ZNCC of the window about a pixel with others within reach, and where: (ZNCC, dx, dy), lags in px.

    usable : about which pixels windows count. half : px, half the side of the window, which is moved inwards at the
    image's edge. Places of the peak at zero do not count, nor others along an edge, for which the result is 0. None
    where the window itself does not count.
    """
    height, width = level.shape
    x, y = (min(max(at, half), side - half - 1) for at, side in ((x, width), (y, height)))
    rows, columns = slice(y - half, y + half + 1), slice(x - half, x + half + 1)
    window = level[rows, columns]
    if not usable[y, x]:
        return None
    top, left = max(y - half - reach, 0), max(x - half - reach, 0)
    around = level[top : y + half + 1 + reach, left : x + half + 1 + reach]
    zncc: Levels = np.asarray(cv2.matchTemplate(around, window, cv2.TM_CCOEFF_NORMED), np.float32)
    places = usable[top + half : top + half + len(zncc), left + half : left + half + len(zncc[0])]
    zncc[~places | ~np.isfinite(zncc)] = 0.0
    row, column = y - half - top, x - half - left
    noiseless = _noiseless(zncc, row, column)
    high = (zncc > _SAME_PEAK * noiseless).astype(np.uint8)
    high[row, column] = 1
    cv2.floodFill(high, None, (column, row), 2)
    zncc[high == 2] = -1.0
    highest = float(zncc.max())
    peaks = zncc >= cv2.dilate(zncc, np.ones((3, 3), np.uint8))
    at, to = np.nonzero(peaks & (zncc >= _AS_HIGH * highest))
    down, along = at - row, to - column
    nearest = np.argmin(np.hypot(down, along))
    dx, dy = int(along[nearest]), int(down[nearest])
    if _between(zncc, row, column, dx, dy) > _ALONG * highest:
        return 0.0, 0.0, 0.0
    return min(highest / noiseless, 1.0), float(dx), float(dy)


def _between(zncc: Levels, row: int, column: int, dx: int, dy: int) -> float:
    """Mean of the middle half of the way from the peak at zero, at a row and a column, to that at a lag of dx, dy."""
    way = np.linspace(0.25, 0.75, 1 + max(abs(dx), abs(dy)) // 2)
    return float(zncc[np.rint(row + dy * way).astype(int), np.rint(column + dx * way).astype(int)].mean())


def _noiseless(zncc: Levels, row: int, column: int) -> float:
    """The peak of an autocorrelation without the noise, from the values about it."""
    first, second = (
        np.mean([zncc[row, max(column - k, 0)], zncc[max(row - k, 0), column]]) for k in (1, 2)
    )  # it is symmetric
    return _at_zero(float(first), float(second))
