"""Image centroids of printed dots, modelled as patches of a cylinder and not as points, with their derivatives.

The centroid of a dot's image is not the projection of its centre: perspective, the curvature of the cylinder and the
lens enlarge some parts of the dot more than others. With the image ``p(s, z)`` of a point of the sheet (s along the
arc, z along the axis), centroid = ∫∫ p |∂p/∂(s, z)| ds dz / ∫∫ |∂p/∂(s, z)| ds dz over the printed square or disk, here
by a quadrature rule of sixteen nodes. Derivatives are taken by complex steps (Squire & Trapp 1998), exact to round-off.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Pixels, Points
from ringdic.session.rig import Target

Values = NDArray[Any]  # float64, or complex128 in a complex step

_STEP = 1e-40  # imaginary step of a derivative; it cannot cancel digits, however small


@dataclass(frozen=True)
class PrintedSheet:
    """Geometry of the printed sheet on the cylinder.

    radius : of the printed surface, mm. pitch : distance of the columns along the arc, mm. tilt : rotation of the sheet
    within the surface, rad; positive raises the columns with the higher numbers.
    """

    radius: float
    pitch: float
    tilt: float = 0.0

    @classmethod
    def nominal(cls, target: Target) -> PrintedSheet:
        """The nominal sheet of a target as rig.toml describes it, without tilt."""
        return cls(target.radius_mm, target.column_spacing_mm)

    def seam(self, target: Target) -> float:
        """Arc length across the seam, from the last column to the first, mm."""
        return 2 * np.pi * self.radius - (target.columns - 1) * self.pitch


def sheet_points(target: Target, sheet: PrintedSheet, rows: Indices, columns: Indices) -> Floats:
    """Positions of dots' centres on the sheet, without print errors: arc s and height z.

    rows, columns : (n,), from 1. Returns (n, 2) mm.
    """
    arc, height = _nominal(target, rows, columns)
    s = arc * (sheet.pitch / target.column_spacing_mm) - sheet.tilt * (height - _middle(target)[1])
    return np.column_stack([s, height + sheet.tilt * (arc - _middle(target)[0])])


def sheet_jacobians(target: Target, rows: Indices, columns: Indices) -> Floats:
    """Derivatives of :func:`sheet_points` with respect to pitch (mm) and tilt (rad).

    rows, columns : (n,), from 1. Returns (n, 2, 2), last axis the parameter.
    """
    arc, height = _nominal(target, rows, columns)
    D = np.zeros((len(arc), 2, 2))
    D[:, 0, 0] = arc / target.column_spacing_mm
    D[:, 0, 1] = -(height - _middle(target)[1])
    D[:, 1, 1] = arc - _middle(target)[0]
    return D


def _nominal(target: Target, rows: Indices, columns: Indices) -> tuple[Floats, Floats]:
    """Nominal arcs (n,) and heights (n,) of dots, mm."""
    arc = (np.asarray(columns, dtype=np.float64) - 1) * target.column_spacing_mm
    return arc, target.first_row_z_mm + (np.asarray(rows, dtype=np.float64) - 1) * target.row_spacing_mm


def _middle(target: Target) -> tuple[float, float]:
    """Arc and height of the middle of the sheet, about which it is tilted, mm."""
    return (
        0.5 * (target.columns - 1) * target.column_spacing_mm,
        target.first_row_z_mm + 0.5 * (target.rows - 1) * target.row_spacing_mm,
    )


def cylinder_points(radius: float, angle: Floats, height: Floats) -> Points:
    """Points on a cylinder round the z axis.

    radius : mm. angle : (...) rad, from +x. height : (...) z in mm. Returns (..., 3) mm, world frame.
    """
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)


def quadrature(shape: str, size: float, order: int = 4) -> tuple[Floats, Floats]:
    """Quadrature rule for means over a printed dot: nodes about its centre (n, 2) mm, and weights (n,) of sum 1.

    shape, size : "square" with the edge ``size`` mm, Gauss-Legendre nodes; or "circle" with the diameter ``size`` mm,
    radii by Gauss's rule in r². order : even; n is its square, and polynomials up to the degree 2 order − 1 are exact.
    """
    x: Floats
    w: Floats
    if shape == "square":
        x, w = (np.asarray(each, dtype=np.float64) for each in np.polynomial.legendre.leggauss(order))
        return 0.5 * size * np.column_stack([np.tile(x, order), np.repeat(x, order)]), np.outer(w, w).ravel() / 4
    x, w = np.polynomial.legendre.leggauss(order // 2)
    radius = np.repeat(0.5 * size * np.sqrt((x + 1) / 2), 2 * order)
    angle = np.tile(np.arange(2 * order) * np.pi / order, order // 2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]), np.repeat(w, 2 * order) / (4 * order)


@dataclass(frozen=True)
class DotViews:
    """n observations of dots, each with the parameters of the camera that sees it and the position of the dot.

    inner : (n, 10), fx fy s cx cy k1 k2 p1 p2 k3, px or without unit.
    rotation, translation : (n, 3, 3) and (n, 3) mm, world to camera.
    sz : (n, 2) mm, arc and height of the dot's centre on the sheet.
    radius : of the cylinder, mm.
    """

    inner: Floats
    rotation: Floats
    translation: Floats
    sz: Floats
    radius: float


def project_patches(views: DotViews, shape: str, size: float) -> Pixels:
    """Centroids of the images of printed dots, (n, 2) px; shape, size : of a dot, mm, as for `quadrature`."""
    distorted = _centroids(views, quadrature(shape, size))
    return _to_px(views.inner, distorted)


def project_centres(views: DotViews) -> Pixels:
    """Projections of the centres of printed dots, (n, 2) px."""
    return _to_px(views.inner, _centroids(views, (np.zeros((1, 2)), np.ones(1))))


def patch_jacobians(views: DotViews, shape: str, size: float) -> tuple[Pixels, Floats, Floats, Floats, Floats]:
    """Centroids of the images of printed dots and their derivatives.

    shape, size : of a dot, mm, as for `quadrature`.

    Returns centroids (n, 2) px and their derivatives with respect to the inner parameters (n, 2, 10), the pose
    (n, 2, 6), the position sz (n, 2, 2) and the radius (n, 2, 1), in px per unit of the parameter. The parameters of
    the pose are ω (rad) and τ (mm) with ``R ← exp([ω]×) R``, ``t ← t + τ``.
    """
    distorted = _centroids(views, quadrature(shape, size))
    rule = quadrature(shape, size, 2)  # exact to the third degree: the derivatives' error is 2e-6 of themselves
    n = len(distorted)
    inner = np.zeros((n, 2, 10))
    inner[:, 0, 0], inner[:, 1, 1], inner[:, 0, 2] = distorted[:, 0], distorted[:, 1], distorted[:, 1]
    inner[:, 0, 3] = inner[:, 1, 4] = 1.0
    rest = np.zeros((n, 2, 14))
    for k in range(14):
        step = np.zeros(14, dtype=complex)
        step[k] = 1j * _STEP
        rest[:, :, k] = _centroids(views, rule, step).imag / _STEP
    to_px = np.zeros((n, 2, 2))
    to_px[:, 0, 0], to_px[:, 0, 1], to_px[:, 1, 1] = views.inner[:, 0], views.inner[:, 2], views.inner[:, 1]
    rest = to_px @ rest
    inner[:, :, 5:] = rest[:, :, :5]
    return _to_px(views.inner, distorted), inner, rest[:, :, 5:11], rest[:, :, 11:13], rest[:, :, 13:]


def _to_px(inner: Floats, distorted: Floats) -> Pixels:
    """Image pixels (n, 2) of distorted normalised points (n, 2), by inner parameters (n, 10)."""
    fx, fy, s, cx, cy = inner.T[:5]
    return np.column_stack([fx * distorted[:, 0] + s * distorted[:, 1] + cx, fy * distorted[:, 1] + cy])


def _centroids(views: DotViews, rule: tuple[Floats, Floats], step: Values | None = None) -> Values:
    """Centroids of the images of dots in distorted normalised coordinates, (n, 2).

    rule : nodes and weights. step : (14,) complex changes of k1 k2 p1 p2 k3, ω (3), τ (3), s, z and radius.
    """
    offsets, weights = rule
    d: Values = np.zeros(14) if step is None else step
    k1, k2, p1, p2, k3 = (views.inner[:, 5 + i, None] + d[i] for i in range(5))
    radius = views.radius + d[13]
    angle = (views.sz[:, 0, None] + d[11] + offsets[:, 0]) / radius
    height = views.sz[:, 1, None] + d[12] + offsets[:, 1]
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array(
        [[1, -d[7], d[6]], [d[7], 1, -d[5]], [-d[6], d[5], 1]]
    )  # exp([ω]×) to first order: enough for a derivative
    R = turn @ views.rotation
    X, Y, Z = (
        radius * (R[:, i, 0, None] * cos + R[:, i, 1, None] * sin)
        + R[:, i, 2, None] * height
        + views.translation[:, i, None]
        + d[8 + i]
        for i in range(3)
    )
    Xs, Ys, Zs = (R[:, i, 1, None] * cos - R[:, i, 0, None] * sin for i in range(3))
    Xz, Yz, Zz = (R[:, i, 2, None] for i in range(3))
    x, y = X / Z, Y / Z
    # det ∂(x, y)/∂(s, z); the lens's determinant follows, and fx fy cancels as it is the same for the whole dot.
    area = ((Xs - x * Zs) * (Yz - y * Zz) - (Xz - x * Zz) * (Ys - y * Zs)) / (Z * Z)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    xy = x * y * slope + 2 * (p1 * x + p2 * y)
    weight = weights * area * (xx * yy - xy * xy)
    x_d = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y_d = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    total = weight.sum(axis=1)
    return np.stack([(weight * x_d).sum(axis=1) / total, (weight * y_d).sum(axis=1) / total], axis=-1)
