"""A lattice of angle and height about the z axis, and smooth pieces of surface fitted to the radius at its nodes.

The pieces are polynomials of the second or third degree in the arc a = R (θ - θ₀) and the height b = z - z₀ about each
node, fitted by weighted least squares to the nodes within reach. On a lattice the sums of the normal equations are
correlations of the known nodes with fixed kernels, so all nodes are fitted at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Points, Vectors

TURN = 2.0 * math.pi
#: Powers of a and b that the coefficients belong to, those up to the second degree first.
POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
_QUADRATIC = 6
_RIDGE = 1e-9


@dataclass(frozen=True)
class SurfaceLattice:
    """Lattice of angle and height about the z axis: columns at equal angles all round, rows at equal heights.

    radius : mm, of the cylinder on which arcs are measured. columns : their number. z : (rows,) float64, mm, rising.
    """

    radius: float
    columns: int
    z: Floats

    def __post_init__(self) -> None:
        if not (self.radius > 0 and self.columns >= 8 and len(self.z) >= 2):
            raise ValueError("a lattice needs a radius, at least 8 columns and 2 rows")

    @property
    def shape(self) -> tuple[int, int]:
        """Number of columns and of rows."""
        return self.columns, len(self.z)

    @property
    def theta(self) -> Floats:
        """Angles of the columns, (columns,) rad, from 0."""
        return np.asarray(np.arange(self.columns) * (TURN / self.columns))

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance of neighbouring columns along the arc and of neighbouring rows, mm."""
        return TURN * self.radius / self.columns, float(self.z[1] - self.z[0])

    @property
    def coordinates(self) -> tuple[Floats, Floats]:
        """Angle θ, rad, and height z, mm, of all nodes, (columns, rows) each."""
        theta, z = np.meshgrid(self.theta, self.z, indexing="ij")
        return theta, z

    def nearest(self, theta: Floats, z: Floats) -> tuple[Indices, Indices, Mask]:
        """Node nearest to points on the cylinder.

        theta : (n,) rad. z : (n,) mm. Returns column (n,) and row (n,) indices, the rows clipped to the lattice, and
        a mask (n,) of the points that the lattice reaches.
        """
        column = np.rint(np.nan_to_num(theta) / (TURN / self.columns)).astype(np.int64) % self.columns
        row = np.rint((np.nan_to_num(z, nan=-1e9) - self.z[0]) / self.spacing[1]).astype(np.int64)
        inside = (row >= 0) & (row < len(self.z)) & np.isfinite(theta)
        return column, np.clip(row, 0, len(self.z) - 1), inside

    def arc(self, theta: Floats, theta_0: Floats) -> Floats:
        """Arc R (θ - θ₀) the short way round, mm.

        theta, theta_0 : (n,) rad, or other shapes that broadcast.
        """
        return self.radius * ((theta - theta_0 + math.pi) % TURN - math.pi)


@dataclass(frozen=True)
class Pieces:
    """Smooth pieces of surface, one about each node of a lattice, as polynomials of the radius.

    lattice : its nodes. coefficients : (columns, rows, 10) float64, mm, of the powers ``POWERS``, the first one the
    radius; NaN where too little is known around. support : (columns, rows), share of the nodes within reach that are
    known, by weight.
    """

    lattice: SurfaceLattice
    coefficients: Floats
    support: Floats

    @property
    def radius(self) -> Floats:
        """Fitted radius of the nodes, (columns, rows) mm."""
        return self.coefficients[..., 0]

    @property
    def normals(self) -> Vectors:
        """Outward unit normals of the surface at the nodes, (columns, rows, 3), world frame."""
        theta, _ = self.lattice.coordinates
        radius, along, up = np.moveaxis(self.coefficients[..., :3], -1, 0)
        along = along * self.lattice.radius  # d radius / dθ
        cos, sin = np.cos(theta), np.sin(theta)
        normals = np.stack([radius * cos + along * sin, radius * sin - along * cos, -radius * up], axis=-1)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    @property
    def xyz(self) -> Points:
        """Fitted positions of the nodes, (columns, rows, 3) mm, world frame."""
        theta, z = self.lattice.coordinates
        return np.stack([self.radius * np.cos(theta), self.radius * np.sin(theta), z + 0 * self.radius], axis=-1)


def fit_pieces(
    lattice: SurfaceLattice, radius: Floats, reach: float, degree: int = 3, *, least: float = 0.2, density: float = 1.0
) -> Pieces:
    """Fit a smooth piece of surface about every node of a lattice that has enough known nodes within reach.

    Parameters
    ----------
    radius : (columns, rows) float64, mm, NaN where unknown.
    reach : mm, at which the weights have fallen from one at the node to zero.
    degree : 2 or 3. Where the known nodes lie to one side, as at a rim, the piece is always of degree 2.
    least : share of known nodes, by weight, below which a node is left without a piece.
    density : share of the nodes that were to be measured at all; ``least`` and the support refer to these.
    """
    known = np.isfinite(radius)
    level = float(np.mean(radius[known])) if known.any() else 0.0
    a, b, weight = _window(lattice, reach)
    values = np.where(known, radius - level, 0.0)
    sums: dict[tuple[int, int], Floats] = {}
    for power in {(p + r, q + s) for p, q in POWERS for r, s in POWERS}:
        sums[power] = _correlate(known.astype(float), weight * a ** power[0] * b ** power[1])
    right = np.stack([_correlate(values, weight * a**p * b**q) for p, q in POWERS], axis=-1)
    total = density * float(weight.sum())
    support = sums[0, 0] / total
    off_centre = np.hypot(sums[1, 0], sums[0, 1]) / np.maximum(sums[0, 0], 1e-9)
    coefficients = np.full((*lattice.shape, len(POWERS)), np.nan)
    enough = (support > least) & (off_centre < 0.75) & (sums[0, 0] > 1e-6)
    inner = enough & (support > 0.6) & (off_centre < 0.2) & (degree > 2)
    for chosen, count in ((enough & ~inner, _QUADRATIC), (inner, len(POWERS))):
        if not chosen.any():
            continue
        powers = POWERS[:count]
        normal = np.stack([np.stack([sums[p + r, q + s][chosen] for r, s in powers], -1) for p, q in powers], -1)
        normal += _RIDGE * normal[:, :1, :1] * np.eye(count)
        solution = np.linalg.solve(normal, right[chosen][:, :count, None])[..., 0]
        coefficients[chosen] = 0.0
        coefficients[chosen, :count] = solution
    scale = np.array([reach ** -(p + q) for p, q in POWERS])
    coefficients *= scale
    coefficients[..., 0] += level
    return Pieces(lattice, coefficients, support)


def robust_pieces(
    lattice: SurfaceLattice,
    radius: Floats,
    reach: float,
    degree: int = 3,
    *,
    least: float = 0.2,
    floor: float = 0.1,
    density: float = 1.0,
) -> tuple[Pieces, Mask]:
    """Fit smooth pieces of surface with rejection of outlying nodes.

    A node is an outlier if its distance is more than ``floor`` and more than 6 standard deviations of the usual
    residual. The most distant nodes are rejected first, so that they do not bias the fit near good ones.

    Parameters
    ----------
    radius : (columns, rows) float64, mm, NaN where unknown.
    reach, degree, least, density : as in :func:`fit_pieces`.
    floor : mm.

    Returns
    -------
    The pieces, and the mask (columns, rows) of the known nodes that they were fitted to.
    """
    known = np.isfinite(radius)
    agreeing = known

    def fit() -> Pieces:
        return fit_pieces(lattice, np.where(agreeing, radius, np.nan), reach, degree, least=least, density=density)

    pieces = fit()
    for factor in (20.0, 10.0, 6.0, 6.0):
        residual = np.abs(radius - pieces.radius)
        usual = 1.4826 * float(np.nanmedian(residual[agreeing])) if np.isfinite(residual[agreeing]).any() else 0.0
        with np.errstate(invalid="ignore"):
            now = known & (residual <= max(factor * usual, floor))
        if (now == agreeing).all():
            continue
        agreeing = now
        pieces = fit()
    return pieces, agreeing


def evaluate(coefficients: Floats, a: Floats, b: Floats) -> tuple[Floats, Floats, Floats]:
    """Evaluate the polynomials of pieces of surface.

    coefficients : (..., 10) mm. a, b : (...) mm, arc and height from the pieces' nodes. Returns the radius, mm, and its
    derivatives with respect to a and b, (...) each.
    """
    c = np.moveaxis(coefficients, -1, 0)
    value = (
        c[0]
        + a * (c[1] + a * (c[3] + a * c[6]) + b * (c[4] + a * c[7] + b * c[8]))
        + b * (c[2] + b * (c[5] + b * c[9]))
    )
    by_a = c[1] + a * (2 * c[3] + 3 * a * c[6]) + b * (c[4] + 2 * a * c[7] + b * c[8])
    by_b = c[2] + b * (2 * c[5] + 3 * b * c[9]) + a * (c[4] + a * c[7] + 2 * b * c[8])
    return value, by_a, by_b


def _window(lattice: SurfaceLattice, reach: float) -> tuple[Floats, Floats, Floats]:
    """Arc a, height b and weight of the nodes of a window about a node; a and b in units of the reach."""
    along, up = lattice.spacing
    half = (max(2, math.ceil(reach / along)), max(2, math.ceil(reach / up)))
    half = (min(half[0], lattice.columns // 2 - 1), half[1])
    a, b = np.meshgrid(
        np.arange(-half[0], half[0] + 1) * (along / reach),
        np.arange(-half[1], half[1] + 1) * (up / reach),
        indexing="ij",
    )
    return a, b, np.maximum(1.0 - (a * a + b * b), 0.0)


def _correlate(values: Floats, kernel: Floats) -> Floats:
    """Σ kernel · values about each node (columns, rows), periodic over the columns and zero beyond the rows."""
    over, up = kernel.shape[0] // 2, kernel.shape[1] // 2
    padded = np.pad(np.pad(values, ((over, over), (0, 0)), mode="wrap"), ((0, 0), (up, up)))
    filtered = cv2.filter2D(padded, cv2.CV_64F, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered[over : over + values.shape[0], up : up + values.shape[1]])
