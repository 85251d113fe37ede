"""Bundle adjustment of cameras and target by robust least squares: state, normal equations, steps, variances.

The cost is ``Σ ρ(r / σ) + Σ (x − m)ᵀ Λ (x − m) + Σ (d / σ_d)² + Σ (g − g₀)² / σ_g²``: residuals r of the dots'
centroids with Huber's ρ; lenses x against their estimates m from the boards, with information Λ; print errors d of
the dots; and geometry g of the sheet against its nominal g₀. σ is estimated from the median of the residuals and σ_d
from the print errors, each divided by its redundancy (Förstner 1979).

The parameters are sixteen for each of C cameras (``fx fy s cx cy k1 k2 p1 p2 k3``, ω, τ), radius, pitch and tilt of the
sheet, and two for each of m dots. The dots are eliminated from the normal equations (Schur complement). Units are px,
mm, rad, or none; a covariance has the products of the units of its parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask, Pixels, Vectors
from ringdic.calibration.parameters import PER_CAMERA
from ringdic.calibration.patch import (
    DotViews,
    PrintedSheet,
    patch_jacobians,
    project_centres,
    project_patches,
    sheet_jacobians,
    sheet_points,
)
from ringdic.errors import ComputationError
from ringdic.geometry.outliers import SIGMA_OF_MAD
from ringdic.session.rig import Target

#: Residuals beyond this many σ enter the cost linearly instead of squared (Huber 1964).
HUBER = 2.5
#: Least standard deviations of a centroid, px, and of a print error, mm, that the adjustment supposes.
_PX_FLOOR, _PRINT_FLOOR = 1e-5, 5e-4
_MOST_STEPS = 60


@dataclass(frozen=True)
class State:
    """Values of all parameters of the adjustment.

    inner : (C, 10) fx fy s cx cy k1 k2 p1 p2 k3, px or without unit.
    rotation, translation : (C, 3, 3) and (C, 3) mm, world to camera.
    sheet : radius, pitch and tilt of the printed sheet.
    offsets : (m, 2) mm, print errors of the dots along arc and axis.
    """

    inner: Floats
    rotation: Floats
    translation: Vectors
    sheet: PrintedSheet
    offsets: Floats

    def plus(self, step: Floats, dots: Floats) -> State:
        """The state after adding a step of the adjustment.

        step : (16 C + 3,) of cameras and sheet; px, rad, mm. dots : (m, 2) mm of the print errors, empty if fixed.
        """
        cameras = step[:-3].reshape(-1, PER_CAMERA)
        radius, pitch, tilt = step[-3:]
        turns = np.array([cv2.Rodrigues(omega)[0] for omega in cameras[:, 10:13]])
        return State(
            self.inner + cameras[:, :10],
            turns @ self.rotation,
            self.translation + cameras[:, 13:],
            PrintedSheet(self.sheet.radius + radius, self.sheet.pitch + pitch, self.sheet.tilt + tilt),
            self.offsets + dots if len(dots) else self.offsets,
        )


@dataclass(frozen=True)
class Problem:
    """Observations and prior knowledge of a bundle adjustment.

    px : (n, 2) px, observed centroids.
    camera, dot : (n,) indices of the camera and the dot of each observation.
    rows, columns : (m,) of the dots on the target, from 1.
    lens, lens_information : (C, 10) prior values of the lenses and (C, 10, 10) their information matrices, in the
        inverse products of the parameters' units, 0 where nothing is known.
    sheet_sigma : (3,) prior standard deviations of radius (mm), pitch (mm) and tilt (rad); 0 fixes the nominal value.
    free : (16 C + 3,) bool, which parameters of cameras and sheet are adjusted. The dots are adjusted unless the
        standard deviation of the print errors is 0.
    """

    target: Target
    px: Pixels
    camera: Indices
    dot: Indices
    rows: Indices
    columns: Indices
    lens: Floats
    lens_information: Floats
    sheet_sigma: Floats
    free: Mask

    def views(self, state: State) -> DotViews:
        """For each observation the camera parameters and the dot position that a state gives it."""
        sz = sheet_points(self.target, state.sheet, self.rows, self.columns) + state.offsets
        c = self.camera
        return DotViews(state.inner[c], state.rotation[c], state.translation[c], sz[self.dot], state.sheet.radius)

    def project(self, state: State) -> Pixels:
        """Predicted image centroids of the observed dots for a state of the parameters, (n, 2) px."""
        return project_patches(self.views(state), self.target.dot_shape, self.target.dot_size_mm)

    def project_centres(self, state: State) -> Pixels:
        """Projections of the centres of the observed dots for a state of the parameters, (n, 2) px."""
        return project_centres(self.views(state))

    def lens_gap(self, state: State) -> Floats:
        """Squared Mahalanobis distance of each lens from its prior values, (C,) without unit."""
        gap = state.inner - self.lens
        return np.einsum("ci,cij,cj->c", gap, self.lens_information, gap)

    def without(self, left_out: Mask) -> Problem:
        """The problem with some of its observations removed. left_out : (n,) bool, those to remove."""
        return replace(self, px=self.px[~left_out], camera=self.camera[~left_out], dot=self.dot[~left_out])


@dataclass(frozen=True)
class Scales:
    """Weights of an adjustment: standard deviations of centroids and print errors, and a factor on those of lenses.

    px : standard deviation of a centroid, px per component. print : of the print errors, mm per component, 0 where the
    dots are fixed. lens : factor, 1 or more, by which the boards' standard errors of the lenses are enlarged so that
    they agree with the target.
    """

    px: float
    print: float
    lens: float = 1.0


@dataclass(frozen=True)
class Solution:
    """Result of an adjustment: the adjusted parameters, the scales of the weights and the covariance.

    covariance : (16 C + 3, 16 C + 3) of cameras and sheet, px, mm and rad; zero for fixed parameters.
    dots_covariance : (m, 2, 2) mm², of the print errors.
    chi2 : (C,) sum of squared residuals of each camera's centroids in units of their variance, per degree of freedom.
    held_out : (n, 2) px, centroids minus those that the adjustment without their dot predicts, for a dot without print
        error.
    iterations : number of steps.
    """

    state: State
    scales: Scales
    covariance: Floats
    dots_covariance: Floats
    chi2: Floats
    held_out: Pixels
    iterations: int


def adjust(problem: Problem, start: State, print_sigma: float) -> Solution:
    """Adjust all free parameters to convergence by the Levenberg-Marquardt method, and estimate the weights' scales.

    print_sigma : mm, prior standard deviation of the print errors, replaced by its estimate; 0 fixes the dots.

    Raises ComputationError where the observations do not determine the free parameters.
    """
    state, damping, iterations = start, 1e-6, 0
    scales = Scales(max(_robust_sigma(problem.px - problem.project(start)), _PX_FLOOR), print_sigma)
    near = settled = False
    while True:
        normal = _normal_equations(problem, state, scales)
        if near:
            now = _estimated_scales(problem, state, normal)
            settled = (
                abs(now.px / scales.px - 1) < 0.005
                and abs(now.print - scales.print) <= 0.02 * scales.print
                and abs(now.lens / scales.lens - 1) < 0.02
            )
            scales, normal = now, _assembled(problem, state, now, normal.by_rest, normal.by_dot, normal.residuals)
        trial, damping, gained, cost = _step(problem, state, normal, damping)
        iterations += 1
        # A gain of 1e-2 moves no parameter by more than a tenth of its standard error; exact data reach zero cost.
        at_rest = gained <= 1e-4 * cost or gained <= 1e-12
        done = trial is None or (at_rest and gained <= 1e-2)
        state = state if trial is None else trial
        if (done and settled) or iterations == _MOST_STEPS:
            break
        if not near:
            px = _robust_sigma(problem.px - problem.project(state))
            scales = Scales(max(px, _PX_FLOOR), print_sigma)
        near = near or done or gained <= 0.02 * cost
    covariance, crossed, dots_covariance = _inverse(normal)
    redundancy = 1 - _leverage(problem, normal, covariance, crossed, dots_covariance)
    whole = np.zeros((len(problem.free),) * 2)
    whole[np.ix_(problem.free, problem.free)] = covariance
    chi2 = _chi2(problem, normal, redundancy)
    held_out = _held_out(problem, state, normal, covariance)
    return Solution(state, scales, whole, dots_covariance, chi2, held_out, iterations)


@dataclass(frozen=True)
class _Normal:
    """Normal equations at a state, for given scales.

    A : (k, k) block of the k free parameters of cameras and sheet. D : (m, 2, 2) blocks of the dots. B : (k, m, 2)
    blocks between them. a, d : (k,) and (m, 2) right sides. prior : (k, k) prior information, which is contained in A.
    by_rest, by_dot : sparse (2 n, k) and (n, 2, 2) Jacobians of the centroids by the free parameters and by the dots.
    residuals : (n, 2) px. weights : (n, 2) px⁻².
    """

    scales: Scales
    A: Floats
    B: Floats
    D: Floats
    a: Floats
    d: Floats
    prior: Floats
    by_rest: scipy.sparse.csr_array
    by_dot: Floats
    residuals: Pixels
    weights: Floats


def _normal_equations(problem: Problem, state: State, scales: Scales) -> _Normal:
    """Normal equations of a problem, with Jacobians evaluated at the state."""
    target = problem.target
    px, inner, pose, by_dot, radius = patch_jacobians(problem.views(state), target.dot_shape, target.dot_size_mm)
    by_sheet = by_dot @ sheet_jacobians(target, problem.rows, problem.columns)[problem.dot]
    values = np.concatenate([inner, pose, radius, by_sheet], axis=-1)
    n, C = len(px), len(state.inner)
    at = np.concatenate(
        [
            PER_CAMERA * problem.camera[:, None] + np.arange(PER_CAMERA),
            np.broadcast_to(PER_CAMERA * C + np.arange(3), (n, 3)),
        ],
        axis=1,
    )
    starts = np.arange(2 * n + 1) * at.shape[1]
    J = scipy.sparse.csr_array(
        (values.reshape(-1), np.repeat(at, 2, axis=0).ravel(), starts), shape=(2 * n, len(problem.free))
    )
    return _assembled(problem, state, scales, J[:, problem.free], by_dot, problem.px - px)


def _assembled(
    problem: Problem, state: State, scales: Scales, by_rest: scipy.sparse.csr_array, by_dot: Floats, residuals: Pixels
) -> _Normal:
    """Normal equations from Jacobians (2 n, k) and (n, 2, 2) and residuals (n, 2) px."""
    m = len(problem.rows) if scales.print else 0
    w = huber_weights(residuals, scales.px)
    prior, a = _prior_information(problem, state, scales)
    weighted = by_rest * w.reshape(-1)[:, None]
    A = (by_rest.T @ weighted).toarray() + prior
    a = a + by_rest.T @ (w * residuals).ravel()
    B, D, d = np.zeros((len(a), m, 2)), np.zeros((m, 2, 2)), np.zeros((m, 2))
    if m:
        n = len(residuals)
        at = np.repeat(2 * problem.dot[:, None] + np.arange(2), 2, axis=0).ravel()
        J = scipy.sparse.csr_array((by_dot.reshape(-1), at, 2 * np.arange(2 * n + 1)), shape=(2 * n, 2 * m))
        B = (weighted.T @ J).toarray().reshape(-1, m, 2)
        np.add.at(D, problem.dot, np.swapaxes(by_dot, 1, 2) @ (w[..., None] * by_dot))
        D += np.eye(2) / scales.print**2
        d = (J.T @ (w * residuals).ravel()).reshape(m, 2) - state.offsets / scales.print**2
    return _Normal(scales, A, B, D, a, d, prior, by_rest, by_dot, residuals, w)


def huber_weights(residuals: Floats, sigma: Floats | float) -> Floats:
    """Weights of residuals in iteratively reweighted least squares with Huber's cost (1964).

    residuals : (n, 2) px. sigma : standard deviations, px, one number or (n, 2). Returns ``min(1, 2.5 σ/|r|) / σ²``,
    (n, 2) px⁻².
    """
    return np.asarray(np.minimum(1.0, HUBER * sigma / np.maximum(np.abs(residuals), 1e-300)) / sigma**2)


def _prior_information(problem: Problem, state: State, scales: Scales) -> tuple[Floats, Floats]:
    """Information matrix of the prior knowledge of the free parameters (k, k), and its right side (k,)."""
    C = len(state.inner)
    whole, pull = np.zeros((len(problem.free),) * 2), np.zeros(len(problem.free))
    for c, (information, gap) in enumerate(zip(problem.lens_information, state.inner - problem.lens, strict=True)):
        lens = slice(PER_CAMERA * c, PER_CAMERA * c + 10)
        whole[lens, lens] = information / scales.lens**2
        pull[lens] = -information @ gap / scales.lens**2
    known = np.flatnonzero(problem.sheet_sigma > 0)
    at = PER_CAMERA * C + known
    whole[at, at] = 1 / problem.sheet_sigma[known] ** 2
    pull[at] = -_sheet_gap(problem, state)[known] / problem.sheet_sigma[known] ** 2
    return whole[np.ix_(problem.free, problem.free)], pull[problem.free]


def _sheet_gap(problem: Problem, state: State) -> Floats:
    """Radius, pitch (mm) and tilt (rad) of the sheet minus their nominal values, (3,)."""
    nominal, sheet = PrintedSheet.nominal(problem.target), state.sheet
    return np.array([sheet.radius - nominal.radius, sheet.pitch - nominal.pitch, sheet.tilt])


def _step(problem: Problem, state: State, normal: _Normal, damping: float) -> tuple[State | None, float, float, float]:
    """One Levenberg-Marquardt step.

    Returns the new state, or None where no step lowers the cost; the new damping, the decrease of the cost, and the
    cost before.
    """
    cost = _cost(problem, state, normal.scales)
    while damping < 1e8:
        rest, dots = _solve(normal, damping)
        step = np.zeros(len(problem.free))
        step[problem.free] = rest
        trial = state.plus(step, dots)
        trial_cost = _cost(problem, trial, normal.scales)
        if trial_cost <= cost:
            return trial, damping / 10, cost - trial_cost, cost
        damping = max(damping, 1e-7) * 10
    return None, 1e-6, 0.0, cost


def _cost(problem: Problem, state: State, scales: Scales) -> float:
    """The cost of a state, without unit; infinite where it is not a camera."""
    with np.errstate(all="ignore"):
        t = np.abs(problem.px - problem.project(state)) / scales.px
        cost = float(np.sum(np.where(t <= HUBER, t * t, HUBER * (2 * t - HUBER))))
    cost += float(problem.lens_gap(state).sum()) / scales.lens**2
    known = problem.sheet_sigma > 0
    cost += float(np.sum((_sheet_gap(problem, state)[known] / problem.sheet_sigma[known]) ** 2))
    if scales.print:
        cost += float(np.sum(state.offsets**2)) / scales.print**2
    return cost if np.isfinite(cost) and np.all(state.inner[:, :2] > 0) else float("inf")


def _estimated_scales(problem: Problem, state: State, normal: _Normal) -> Scales:
    """Scales from the residuals of centroids, lenses and print errors, each divided by its redundancy."""
    old = normal.scales
    covariance, crossed, dots = _inverse(normal)
    redundancy = 1 - _leverage(problem, normal, covariance, crossed, dots)
    testable = redundancy > 0.05  # with less, the parameters fit any value of an observation
    px = max(_robust_sigma(normal.residuals[testable] / np.sqrt(redundancy[testable])), _PX_FLOOR)
    lens = 1.0
    known: Mask = np.any(problem.lens_information != 0, axis=2)
    if known.any():
        at = np.zeros(len(problem.free), dtype=bool)
        at[:-3].reshape(len(known), PER_CAMERA)[:, :10] = known
        at = at[problem.free]
        own_lens = float(np.sum(covariance[np.ix_(at, at)] * normal.prior[np.ix_(at, at)]))
        left = max(float(known.sum()) - own_lens, 0.01 * float(known.sum()))
        lens = max(float(np.sqrt(problem.lens_gap(state).sum() / left)), 1.0)
    if not old.print:
        return Scales(px, 0.0, lens)
    count = state.offsets.size
    own = float(np.einsum("mii->", dots)) / old.print**2
    print_sigma = float(np.sqrt(np.sum(state.offsets**2) / max(count - own, 1e-6 * count)))
    return Scales(px, max(print_sigma, _PRINT_FLOOR), lens)


def _chi2(problem: Problem, normal: _Normal, redundancy: Floats) -> Floats:
    """Weighted squared residuals of each camera per degree of freedom, (C,); redundancy : (n, 2)."""
    count = len(problem.lens)
    squares = np.sum(normal.weights * normal.residuals**2, axis=1)
    degrees = np.bincount(problem.camera, weights=redundancy.sum(axis=1), minlength=count)
    return np.bincount(problem.camera, weights=squares, minlength=count) / np.maximum(degrees, 1.0)


def _leverage(problem: Problem, normal: _Normal, covariance: Floats, crossed: Floats, dots: Floats) -> Floats:
    """Leverage of each observation (n, 2), the diagonal of J N⁻¹ Jᵀ W: the share of its error that the fit absorbs.

    covariance (k, k), crossed (k, m, 2), dots (m, 2, 2) : of ``_inverse``.
    """
    J, by_dot = normal.by_rest, normal.by_dot
    leverage = np.sum((J @ covariance) * J.toarray(), axis=1).reshape(-1, 2)
    if len(dots):
        both = (J @ crossed.reshape(len(covariance), -1)).reshape(len(by_dot), 2, -1, 2)
        both = both[np.arange(len(by_dot)), :, problem.dot]
        leverage += 2 * np.einsum("nri,nri->nr", both, by_dot)
        leverage += np.einsum("nri,nij,nrj->nr", by_dot, dots[problem.dot], by_dot)
    return np.asarray(leverage * normal.weights, dtype=np.float64)


def _held_out(problem: Problem, state: State, normal: _Normal, covariance: Floats) -> Pixels:
    """Residuals (n, 2) px that the views of each dot would have had, had the dot taken no part in the adjustment.

    With the print errors eliminated, the views of a dot have the covariance ``V = W⁻¹ + σ_d² D Dᵀ``, D their
    derivatives by its place, and the residuals ``(I − J N⁻¹ Jᵀ V⁻¹)⁻¹ r`` when they are left out. covariance : (k, k),
    N⁻¹ of cameras and sheet.
    """
    n, m = len(problem.px), len(problem.rows)
    order = np.argsort(problem.dot, kind="stable")
    count = np.bincount(problem.dot, minlength=m)
    place = np.arange(n) - np.repeat(np.cumsum(count) - count, count)
    views = np.full((m, int(count.max())), n)  # the observations of each dot; n, a row of zeros, where there are fewer
    views[problem.dot[order], place] = order

    def of_dots(values: Floats) -> Floats:
        """Values of observations (n, 2, j) as (m, 2 v, j) of the views of each dot."""
        padded = np.concatenate([values, np.zeros((1, *values.shape[1:]))])
        return np.asarray(padded[views].reshape(m, 2 * views.shape[1], values.shape[2]))

    r = normal.residuals + np.einsum("nij,nj->ni", normal.by_dot, state.offsets[problem.dot])
    J, D = of_dots(normal.by_rest.toarray().reshape(n, 2, -1)), of_dots(normal.by_dot)
    variance = 1 / of_dots(normal.weights[..., None])[..., 0].clip(1e-300)
    V = normal.scales.print**2 * D @ np.swapaxes(D, 1, 2) + variance[..., None] * np.eye(J.shape[1])
    H = np.swapaxes(np.linalg.solve(V, J @ covariance @ np.swapaxes(J, 1, 2)), 1, 2)
    left_out = np.linalg.solve(np.eye(J.shape[1]) - H, of_dots(r[..., None]))
    result = np.empty((n + 1, 2))
    result[views.ravel()] = left_out.reshape(-1, 2)
    return result[:n]


def _robust_sigma(residuals: Floats) -> float:
    """Standard deviation of a component of residuals (n, 2), from the median of their absolute values."""
    return SIGMA_OF_MAD * float(np.median(np.abs(residuals)))


def _reduced(normal: _Normal, damping: float) -> tuple[tuple[Floats, bool], Floats, Floats, Floats]:
    """Normal equations of cameras and sheet after elimination of the dots, ``S = A − B D⁻¹ Bᵀ``.

    Returns the Cholesky factor of the scaled S, its scale (k,), D⁻¹ (m, 2, 2) and B D⁻¹ (k, m, 2).
    """
    A = normal.A + damping * np.diag(np.diag(normal.A))
    inverse_D = np.asarray(np.linalg.inv(normal.D + damping * normal.D * np.eye(2)), dtype=np.float64)
    BD: Floats = np.einsum("kmi,mij->kmj", normal.B, inverse_D)
    S = A - BD.reshape(len(A), -1) @ normal.B.reshape(len(A), -1).T
    scale = 1 / np.sqrt(np.diag(A))
    try:
        factor = scipy.linalg.cho_factor(S * np.outer(scale, scale), lower=True)
    except scipy.linalg.LinAlgError as error:
        raise ComputationError(
            "the images of the target do not determine all that the bundle adjustment was told to adjust; "
            "hold the target's radius and pitch, or use calibration.method = 'dlt'"
        ) from error
    return factor, scale, inverse_D, BD


def _solve(normal: _Normal, damping: float) -> tuple[Floats, Floats]:
    """Solution of the damped normal equations: steps of cameras and sheet (k,) and of the dots (m, 2) mm."""
    factor, scale, inverse_D, BD = _reduced(normal, damping)
    right = normal.a - np.einsum("kmi,mi->k", BD, normal.d)
    rest = scale * scipy.linalg.cho_solve(factor, scale * right)
    dots = np.einsum("mij,mj->mi", inverse_D, normal.d) - np.einsum("kmi,k->mi", BD, rest)
    return rest, dots


def _inverse(normal: _Normal) -> tuple[Floats, Floats, Floats]:
    """Covariances of cameras and sheet (k, k), of these with the dots (k, m, 2), and of each dot (m, 2, 2) mm²."""
    factor, scale, inverse_D, BD = _reduced(normal, 0.0)
    covariance = scipy.linalg.cho_solve(factor, np.eye(len(scale))) * np.outer(scale, scale)
    crossed = -np.tensordot(covariance, BD, axes=1)
    return covariance, crossed, inverse_D - np.einsum("kmi,kmj->mij", BD, crossed)
