"""Local least squares: a quadratic of a measured field over the neighbours of every point, on any set of points.

About point i the field is ``f(x_j) = a + b dx + c dy + p dx²/2 + q dx dy + r dy²/2`` with (dx, dy) = x_j - x_i; each
neighbour weighs as its uncertainty says. The coefficients are the field, its gradient and its second derivatives at
the point, far less noisy than those of one subset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.correlation.warps import cholesky, solve

Array = NDArray[np.float64]

_LEAST = 10  # neighbours, itself included, that six coefficients are taken from
_LEAST_SHARE = 0.3  # of the median sigma: no point weighs more than this lets it
_RIDGE = 1e-10  # of the trace: points on one line give a large sigma, not an error


@dataclass(frozen=True)
class QuadraticFit:
    """Local quadratics of a field of k components at n points; NaN where too few neighbours are known.

    value : (n, k). gradient : (n, k, 2) by x, y. curvature : (n, k, 3), second derivatives by xx, xy, yy.
    value_sigma (n,), curvature_sigma (n, 3) : their standard uncertainties, the neighbours' noise independent.
    leave_out : (n, k), measured value minus the quadratic of the other points; NaN where not measured.
    """

    value: Array
    gradient: Array
    curvature: Array
    value_sigma: Array
    curvature_sigma: Array
    leave_out: Array


class Neighbourhoods:
    """The neighbours within ``window`` of each of the points xy (n, 2), the point itself included."""

    def __init__(self, xy: Array, window: float) -> None:
        if not window > 0:
            raise ValueError(f"the window must be positive, not {window}")
        self.xy = np.ascontiguousarray(xy, dtype=np.float64)
        n = len(self.xy)
        pairs = cKDTree(self.xy).query_pairs(window, output_type="ndarray") if n > 1 else np.zeros((0, 2), np.int64)
        own = np.arange(n)
        rows = np.concatenate([pairs[:, 0], pairs[:, 1], own]).astype(np.int32)
        members = np.concatenate([pairs[:, 1], pairs[:, 0], own]).astype(np.int32)
        order = np.argsort(rows, kind="stable")
        self.window = float(window)
        self._members = members[order]
        self._first = np.searchsorted(rows[order], np.arange(n + 1))

    def fit(self, values: Array, sigma: Array | None = None) -> QuadraticFit:
        """Quadratics of a field.

        values : (n, k), a row with NaN is not measured. sigma : (n,) standard uncertainty, 1 if not given.
        """
        n, k = values.shape
        known: NDArray[np.bool_] = np.asarray(np.isfinite(values).all(axis=1))
        weight = _weights(known, sigma)
        measured = np.where(known[:, None], values, 0.0)
        c, scatter = np.full((n, 6, k), np.nan), np.full((n, 6), np.nan)
        _fit(self.xy, self._first, self._members, self.window, known, weight, measured, c, scatter)
        with np.errstate(invalid="ignore", divide="ignore"):
            own = weight * scatter[:, 0] ** 2
            leave_out = np.where(known[:, None], (values - c[:, 0]) / (1.0 - own)[:, None], np.nan)
        c = np.moveaxis(c, 1, 2)
        w = self.window
        return QuadraticFit(
            c[..., 0], c[..., 1:3] / w, c[..., 3:] / w**2, scatter[:, 0], scatter[:, 3:] / w**2, leave_out
        )

    def median(self, values: Array) -> Array:
        """Median (n,) of the known values (n,) about each point, its own included; NaN where there is none."""
        out = np.full(len(values), np.nan)
        _median(self._first, self._members, np.ascontiguousarray(values, dtype=np.float64), out)
        return out


def _weights(known: NDArray[np.bool_], sigma: Array | None) -> Array:
    if sigma is None:
        return known.astype(np.float64)
    with np.errstate(invalid="ignore"):
        ready = known & np.isfinite(sigma) & (sigma > 0)
    if not ready.any():
        return known.astype(np.float64)
    median = float(np.median(sigma[ready]))
    limited = np.where(ready, np.maximum(np.nan_to_num(sigma, nan=median), _LEAST_SHARE * median), median)
    return np.where(known, 1.0 / limited**2, 0.0)


@nb.njit(cache=True, nogil=True, parallel=True)
def _fit(xy, first, members, window, known, weight, values, c, scatter):  # type: ignore[no-untyped-def]
    """c (n, 6, k), in units of the window, and scatter (n, 6), √ of the diagonal of the inverse normal matrix."""
    n, k = values.shape
    for i in nb.prange(n):
        M, b, phi, e = np.zeros((6, 6)), np.zeros((k, 6)), np.empty(6), np.empty(6)
        count = 0
        for at in range(first[i], first[i + 1]):
            j = members[at]
            if not known[j]:
                continue
            count += 1
            x, y, w = (xy[j, 0] - xy[i, 0]) / window, (xy[j, 1] - xy[i, 1]) / window, weight[j]
            phi[0], phi[1], phi[2], phi[3], phi[4], phi[5] = 1.0, x, y, 0.5 * x * x, x * y, 0.5 * y * y
            for p in range(6):
                wp = w * phi[p]
                for q in range(p + 1):
                    M[p, q] += wp * phi[q]
                for m in range(k):
                    b[m, p] += wp * values[j, m]
        if count < _LEAST:
            continue
        trace = M[0, 0] + M[1, 1] + M[2, 2] + M[3, 3] + M[4, 4] + M[5, 5]
        for p in range(6):
            M[p, p] += _RIDGE * trace
        if not cholesky(M, 6):
            continue
        for m in range(k):
            solve(M, b[m], 6)
            for p in range(6):
                c[i, p, m] = b[m, p]
        for p in range(6):
            e[:] = 0.0
            e[p] = 1.0
            solve(M, e, 6)
            scatter[i, p] = math.sqrt(e[p])


@nb.njit(cache=True, nogil=True, parallel=True)
def _median(first, members, values, out):  # type: ignore[no-untyped-def]
    for i in nb.prange(len(values)):
        about = values[members[first[i] : first[i + 1]]]
        about = about[np.isfinite(about)]
        if len(about):
            out[i] = np.median(about)
