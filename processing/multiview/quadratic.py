"""Local least squares: a quadratic of a measured field over the neighbours of every point, on any set of points.

About point i the field is ``f(x_j) = a + b dx + c dy + p dx²/2 + q dx dy + r dy²/2`` with (dx, dy) = x_j - x_i; each
neighbour weighs as its uncertainty says. The coefficients are the field, its gradient and its second derivatives at
the point, far less noisy than those of one subset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

# Powers of dx, dy and factors of the six terms 1, dx, dy, dx²/2, dx dy, dy²/2.
_TERMS = ((0, 0, 1.0), (1, 0, 1.0), (0, 1, 1.0), (2, 0, 0.5), (1, 1, 1.0), (0, 2, 0.5))
_LEAST = 10  # neighbours, itself included, that six coefficients are taken from
_LEAST_SHARE = 0.3  # of the median sigma: no point weighs more than this lets it


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
        xy = np.asarray(xy, dtype=np.float64)
        n = len(xy)
        pairs = cKDTree(xy).query_pairs(window, output_type="ndarray") if n > 1 else np.zeros((0, 2), np.int64)
        rows = np.concatenate([pairs[:, 0], pairs[:, 1], np.arange(n)])
        columns = np.concatenate([pairs[:, 1], pairs[:, 0], np.arange(n)])
        order = np.argsort(rows, kind="stable")
        self.window = float(window)
        self.size = n
        self._columns = columns[order].astype(np.int32)
        self._rows = np.searchsorted(rows[order], np.arange(n + 1)).astype(np.int32)
        # In units of the window the powers are of one size.
        d = (xy[self._columns] - xy[rows[order]]) / self.window
        self._dx, self._dy = np.ascontiguousarray(d[:, 0]), np.ascontiguousarray(d[:, 1])

    def fit(self, values: Array, sigma: Array | None = None) -> QuadraticFit:
        """Quadratics of a field.

        values : (n, k), a row with NaN is not measured. sigma : (n,) standard uncertainty, 1 if not given.
        """
        known: NDArray[np.bool_] = np.asarray(np.isfinite(values).all(axis=1))
        weight = self._weights(known, sigma)
        right = np.concatenate([weight[:, None], np.where(known[:, None], values, 0.0) * weight[:, None]], axis=1)
        M, b = self._normal_equations(right)
        count = csr_array((np.ones(len(self._columns)), self._columns, self._rows), shape=(self.size,) * 2) @ known
        trace = np.einsum("nii->n", M)
        usable = (count >= _LEAST) & (trace > 0)
        inverse = np.full_like(M, np.nan)
        ridge = 1e-10 * trace[usable, None, None] * np.eye(6)  # points on one line give a large sigma, not an error
        inverse[usable] = np.linalg.inv(M[usable] + ridge)
        c = np.einsum("nab,nbk->nka", inverse, b)  # (n, k, 6)
        own = weight * inverse[:, 0, 0]
        with np.errstate(invalid="ignore", divide="ignore"):
            leave_out = np.where(known[:, None], (values - c[..., 0]) / (1.0 - own)[:, None], np.nan)
        w = self.window
        scatter = np.sqrt(np.einsum("naa->na", inverse))
        return QuadraticFit(
            c[..., 0], c[..., 1:3] / w, c[..., 3:] / w**2, scatter[:, 0], scatter[:, 3:] / w**2, leave_out
        )

    def _weights(self, known: NDArray[np.bool_], sigma: Array | None) -> Array:
        if sigma is None:
            return known.astype(np.float64)
        with np.errstate(invalid="ignore"):
            ready = known & np.isfinite(sigma) & (sigma > 0)
        if not ready.any():
            return known.astype(np.float64)
        median = float(np.median(sigma[ready]))
        limited = np.where(ready, np.maximum(np.nan_to_num(sigma, nan=median), _LEAST_SHARE * median), median)
        return np.where(known, 1.0 / limited**2, 0.0)

    def _normal_equations(self, right: Array) -> tuple[Array, Array]:
        """M (n, 6, 6) and b (n, 6, k) from the weight and the weighted values, right (n, 1 + k)."""
        n, k = self.size, right.shape[1] - 1
        moments: dict[tuple[int, int], Array] = {}
        M, b = np.empty((n, 6, 6)), np.empty((n, 6, k))
        for power in [(i, j) for i in range(5) for j in range(5 - i)]:
            data = self._dx ** power[0] * self._dy ** power[1]
            summed = csr_array((data, self._columns, self._rows), shape=(n, n))
            moments[power] = summed @ (right if sum(power) <= 2 else right[:, :1])
        for row, (i, j, f) in enumerate(_TERMS):
            b[:, row] = f * moments[i, j][:, 1:]
            for column, (p, q, g) in enumerate(_TERMS):
                M[:, row, column] = f * g * moments[i + p, j + q][:, 0]
        return M, b
