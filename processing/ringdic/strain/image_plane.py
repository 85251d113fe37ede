"""Strain in the plane of an image, from displacements of points: the result of a correlation without calibration.

Lengths are pixels; x runs to the right and y down, as in the image. The displacement gradient at a point is the slope
of the plane that fits the displacements of the points around it best, in the least-squares sense: the virtual strain
gauge of the International Digital Image Correlation Society's Good Practices Guide. From the deformation gradient
``F = I + ∂u/∂x`` follows the Green-Lagrange strain ``E = ½ (FᵀF - I)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.errors import InputError

_POINTS = 4096  # fitted at a time: bounds the memory of their neighbourhoods
_FEWEST = 3  # points that fix a plane
_FLATTEST = 1e-3  # smallest spread of the points across their line, as a share of the window, that fixes a plane
_ENTRIES = {"Exx": (0, 0), "Eyy": (1, 1), "Exy": (0, 1)}


@dataclass(frozen=True)
class ImageStrain:
    """Green-Lagrange strain in the plane of an image at n points, NaN where it could not be computed.

    gradient : (n, 2, 2), ∂u_i/∂x_j, no unit. window : width of the neighbourhoods it was fitted over, px; 0 for the
    gradients that the correlation itself measures.
    """

    gradient: Floats
    window: float

    @property
    def E(self) -> Floats:
        """Green-Lagrange strain ``½ (FᵀF - I)`` with ``F = I + gradient``, (n, 2, 2), no unit."""
        F = np.eye(2) + self.gradient
        return 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(2))

    @property
    def principal(self) -> Floats:
        """Principal Green-Lagrange strains, the smaller first, (n, 2), no unit."""
        E = self.E
        middle, half = 0.5 * (E[:, 0, 0] + E[:, 1, 1]), 0.5 * (E[:, 0, 0] - E[:, 1, 1])
        radius = np.hypot(half, E[:, 0, 1])
        return np.stack([middle - radius, middle + radius], axis=1)

    def field(self, name: str) -> Floats:
        """One component at every point, (n,), no unit.

        name : "Exx", "Eyy", "Exy" (x to the right, y down), or "E1", "E2" for the principal strains, the smaller
        first. Raises InputError for another name.
        """
        if name in _ENTRIES:
            i, j = _ENTRIES[name]
            return self.E[:, i, j]
        if name in ("E1", "E2"):
            return self.principal[:, ("E1", "E2").index(name)]
        raise InputError(f"no strain '{name}'; there are {', '.join(_ENTRIES)}, E1, E2")


def plane_gradients(xy: Pixels, displacement: Pixels, good: Mask, window: float) -> Floats:
    """Displacement gradients by a least-squares plane through the points of a circular window around each point.

    xy : (n, 2) px, positions in the reference image. displacement : (n, 2) px. good : (n,) bool, the points to use.
    window : diameter of the circle, px.

    Returns ∂u_i/∂x_j, (n, 2, 2), no unit; NaN at points that are not good, and where fewer than three good points lie
    in the window or all of them lie on a line. Raises InputError for a window that is not positive.
    """
    if not 0 < window < np.inf:
        raise InputError(f"the strain window is a width in px above 0, not {window:g}")
    index = np.flatnonzero(good)
    tree = cKDTree(xy[index])
    gradient = np.full((len(xy), 2, 2), np.nan)
    for first in range(0, len(index), _POINTS):
        centres = index[first : first + _POINTS]
        pairs = cKDTree(xy[centres]).sparse_distance_matrix(tree, 0.5 * window, output_type="ndarray")
        gradient[centres] = _slopes(pairs["i"], xy[index[pairs["j"]]], displacement[index[pairs["j"]]], window)
    return gradient


def _slopes(centre: Indices, xy: Pixels, displacement: Pixels, window: float) -> Floats:
    """Slopes of the planes through the points of each window, (c, 2, 2): ``Σ u ⊗ r (Σ r ⊗ r)⁻¹``, r from their mean.

    centre : (k,) number of the window, 0 … c - 1, each at least once, in any order. xy, displacement : (k, 2) px, of
    the points. window : width, px. NaN where the points do not fix a plane.
    """
    count = np.bincount(centre)
    r, u = (values - (_sums(centre, values) / count[:, None])[centre] for values in (xy, displacement))
    spread = _sums(centre, (r[:, :, None] * r[:, None, :]).reshape(-1, 4)).reshape(-1, 2, 2)
    together = _sums(centre, (u[:, :, None] * r[:, None, :]).reshape(-1, 4)).reshape(-1, 2, 2)
    flat = np.linalg.eigvalsh(spread)[:, 0] < count * (_FLATTEST * window) ** 2
    spread[flat | (count < _FEWEST)] = np.nan
    return np.asarray(together @ np.linalg.inv(spread))


def _sums(centre: Indices, values: Floats) -> Floats:
    """Sums of the rows of values (k, m) by the number of their window (k,), (c, m)."""
    return np.stack([np.bincount(centre, column) for column in values.T], axis=1)
