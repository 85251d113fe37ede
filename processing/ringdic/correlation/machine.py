"""Roofline model of the correlation: arithmetic speed and bandwidth of one core, and cost of a point in the kernel.

Measured in time of the process on one core, so that other programs disturb little.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ringdic.correlation.kernels import template
from ringdic.correlation.lanes import LANES, load, pointer, store
from ringdic.correlation.settings import CorrelationSettings

# Operations on a vector of LANES pixels, counted in the kernels.
_ONCE = {1: 4 + 21, 2: 4 + 31}  # per point: pack f and its gradient, and sum the moments; by order
_INTERPOLATE = {3: 4 + 2 * 9 + 4 * 4 + 4, 5: 4 + 2 * 23 + 6 * 6 + 6}  # position, weights, rows of taps; by degree
_STEP = {1: 10, 2: 14}  # add to the sums of a step; by order
_LOCATE = 3  # position of the vector in the current image
_LINE = 16  # numbers of single precision in a cache line
_BYTES = 4 * 4 + 1  # per pixel: f, its gradient, a coefficient of the current image, the mask


@dataclass(frozen=True)
class Machine:
    """Arithmetic speed and memory bandwidth of one core.

    clock : GHz. operations : fused multiply-adds of LANES numbers per second. bandwidth : bytes read from memory per
        second.
    """

    clock: float
    operations: float
    bandwidth: float


@dataclass(frozen=True)
class KernelCost:
    """Operations and memory traffic of one point of a correlation.

    pixels : of the subset. vectors : of LANES pixels that hold them. operations : on vectors. bytes : read from memory.
    """

    pixels: int
    vectors: int
    operations: float
    bytes: float

    def bound(self, machine: Machine) -> float:
        """Largest number of points per second that one core can reach, bounded by its arithmetic or its memory."""
        return 1.0 / max(self.operations / machine.operations, self.bytes / machine.bandwidth)


def kernel_cost(settings: CorrelationSettings, iterations: float) -> KernelCost:
    """Cost of one point of a correlation with given settings and number of iterations."""
    corner, bits, _ = template(settings.radius, settings.subset == "circle")
    vectors = corner.shape[1]
    per_iteration = _INTERPOLATE[settings.degree] + _STEP[settings.order] + _LOCATE
    operations = vectors * (_ONCE[settings.order] + iterations * per_iteration)
    pixels = int(np.unpackbits(bits.view(np.uint8)).sum())
    return KernelCost(pixels, vectors, operations, float(_BYTES * min(settings.step, 2 * settings.radius + 1) ** 2))


def measure_machine() -> Machine:
    """Measure the clock, the vector arithmetic and the memory bandwidth of the core that this runs on."""
    line = _aligned(np.full(LANES + _LINE, 1e-8, np.float32))
    block = np.ones(2**24, np.float32)
    turns = 200_000
    return Machine(
        clock=6e-9 * turns / _least(lambda: _chain(turns)),
        operations=10 * turns / _least(lambda: _multiply(turns, line)),
        bandwidth=block.nbytes / _least(lambda: float(block.max()), 5),
    )


def _least(work: Callable[[], object], runs: int = 15) -> float:
    """Shortest time in seconds of several runs of some work."""
    work()
    best = np.inf
    for _ in range(runs):
        began = time.process_time()
        work()
        best = min(best, time.process_time() - began)
    return max(best, 1e-9)


def _aligned(numbers: NDArray[np.float32]) -> NDArray[np.float32]:
    """LANES of the numbers from the begin of a cache line on; there must be a line more of them."""
    skip = (-numbers.ctypes.data % (4 * _LINE)) // 4
    return numbers[skip : skip + LANES]


@nb.njit(cache=True, nogil=True)
def _chain(turns):  # type: ignore[no-untyped-def]
    """Chain of six dependent operations a turn, of one cycle each (xorshift, Marsaglia 2003)."""
    x = np.uint64(88172645463325252)
    for _ in range(turns):
        x ^= x << np.uint64(13)
        x ^= x >> np.uint64(7)
        x ^= x << np.uint64(17)
    return x


@nb.njit(cache=True, nogil=True, fastmath={"contract"})
def _multiply(turns, line):  # type: ignore[no-untyped-def]
    """Ten independent fused multiply-adds of vectors a turn."""
    at, first = pointer(line), np.uint64(0)
    x = load(at, first)
    a = b = c = d = e = f = g = h = i = k = x
    for _ in range(turns):
        a, b, c, d, e = a * x + x, b * x + x, c * x + x, d * x + x, e * x + x
        f, g, h, i, k = f * x + x, g * x + x, h * x + x, i * x + x, k * x + x
    store(at, first, a + b + c + d + e + f + g + h + i + k)
