"""The joint least-squares adjustment of cameras and target: state, normal equations, steps, weights.

Minimised is ``Σ ρ(r / σ) + Σ (x − m)ᵀ Λ (x − m) + Σ (d / σ_d)² + Σ (g − g₀)² / σ_g²``: dots' centroids with Huber's ρ,
the lenses as the boards know them, print errors d of the dots, geometry g of the sheet. σ follows from the median of
the residuals, σ_d from the print errors found, each divided by its redundancy (Förstner 1979).
Parameters: sixteen of each camera (``fx fy s cx cy k1 k2 p1 p2 k3``, ω, τ), radius, pitch, tilt, two of each dot; the
dots are eliminated from the normal equations (Schur complement).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy

from ringdic.arrays import Floats, Indices, Mask
from ringdic.calibration.parameters import PER_CAMERA
from ringdic.calibration.patch import (
    PrintedSheet,
    Views,
    by_sheet,
    patch_jacobians,
    project_centres,
    project_patches,
    sheet_points,
)
from ringdic.errors import ComputationError
from ringdic.session.rig import Target

#: Residuals beyond this many σ count by their length, not by its square (Huber 1964).
HUBER = 2.5
#: The adjustment trusts no centroid and no print to better than this, px and mm.
_PX_FLOOR, _PRINT_FLOOR = 1e-5, 5e-4


@dataclass(frozen=True)
class State:
    """inner (C, 10), rotation (C, 3, 3), translation (C, 3), the sheet, print errors of the dots (m, 2) mm."""

    inner: Floats
    rotation: Floats
    translation: Floats
    sheet: PrintedSheet
    offsets: Floats

    def moved(self, step: Floats, dots: Floats) -> State:
        """The state after a step of cameras and sheet (16 C + 3,), and of the dots (m, 2) unless they are held."""
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
    """What is observed and what is known beforehand.

    px : (n, 2) centroids. camera, dot : (n,) whose and of which dot. rows, columns : (m,) of the dots.
    lens : (C, 10) lenses expected, with their information matrices lens_information (C, 10, 10), 1/unit².
    sheet_sigma : (3,) standard deviations of radius, pitch and tilt about the nominal, 0 where held.
    free : (16 C + 3,) which parameters of cameras and sheet are adjusted. The dots are where their print errors have
        a scale.
    """

    target: Target
    px: Floats
    camera: Indices
    dot: Indices
    rows: Indices
    columns: Indices
    lens: Floats
    lens_information: Floats
    sheet_sigma: Floats
    free: Mask

    def views(self, state: State) -> Views:
        """The patch of every observation in its camera."""
        sz = sheet_points(self.target, state.sheet, self.rows, self.columns) + state.offsets
        c = self.camera
        return Views(state.inner[c], state.rotation[c], state.translation[c], sz[self.dot], state.sheet.radius)

    def project(self, state: State) -> Floats:
        """Centroids expected. (n, 2) px."""
        return project_patches(self.views(state), self.target.dot_shape, self.target.dot_size_mm)

    def project_centres(self, state: State) -> Floats:
        """Images of the dots' centres. (n, 2) px."""
        return project_centres(self.views(state))

    def lens_gap(self, state: State) -> Floats:
        """Squared distance of each lens from what is known of it, in units of its covariance. (C,)."""
        gap = state.inner - self.lens
        return np.einsum("ci,cij,cj->c", gap, self.lens_information, gap)

    def without(self, left_out: Mask) -> Problem:
        """The same with some observations (n,) taken away."""
        return replace(self, px=self.px[~left_out], camera=self.camera[~left_out], dot=self.dot[~left_out])


@dataclass(frozen=True)
class Scales:
    """Standard deviations of a centroid, px a component, and of the print errors, mm, 0 where the dots are held; and
    by what the standard errors that the boards gave the lenses must be multiplied, 1 or more.
    """

    px: float
    print: float
    lens: float = 1.0


@dataclass(frozen=True)
class Solution:
    """The adjusted state, the scales and how certain it is.

    covariance : (16 C + 3, 16 C + 3) of cameras and sheet, zero for what was held.
    dots_covariance : (m, 2, 2) of the print errors, mm².
    chi2 : (C,) squared residuals of each camera's centroids in units of their variance, a degree of freedom.
    """

    state: State
    scales: Scales
    covariance: Floats
    dots_covariance: Floats
    chi2: Floats
    iterations: int


def adjust(problem: Problem, start: State, print_sigma: float, *, limit: int = 60) -> Solution:
    """The adjustment to convergence, scales and all, by Levenberg-Marquardt with reweighting.

    print_sigma : mm, expected size of the print errors; the size found takes its place. 0 holds the dots.

    Raises ComputationError where the observations do not determine the free parameters.
    """
    state, damping, iterations = start, 1e-6, 0
    scales = Scales(max(_robust_sigma(problem.px - problem.project(start)), _PX_FLOOR), print_sigma)
    near = settled = False
    while True:
        normal = _normal(problem, state, scales)
        if near:
            now = _estimate(problem, state, normal)
            settled = (
                abs(now.px / scales.px - 1) < 0.005
                and abs(now.print - scales.print) <= 0.02 * scales.print
                and abs(now.lens / scales.lens - 1) < 0.02
            )
            scales, normal = now, _reweighted(problem, state, normal, now)
        trial, damping, gained, cost = _step(problem, state, normal, damping)
        iterations += 1
        # A hundredth of a squared standard deviation is nothing to any parameter, but an exact world ends exactly.
        at_rest = gained <= 1e-4 * cost or gained <= 1e-12
        done = trial is None or (at_rest and gained <= 1e-2)
        state = state if trial is None else trial
        if (done and settled) or iterations == limit:
            break
        if not near:
            px = _robust_sigma(problem.px - problem.project(state))
            scales = Scales(max(px, _PX_FLOOR), print_sigma)
        near = near or done or gained <= 0.02 * cost
    covariance, crossed, dots_covariance = _inverse(normal)
    redundancy = 1 - _leverage(problem, normal, covariance, crossed, dots_covariance)
    whole = np.zeros((len(problem.free),) * 2)
    whole[np.ix_(problem.free, problem.free)] = covariance
    return Solution(state, scales, whole, dots_covariance, _chi2(problem, normal, redundancy), iterations)


@dataclass(frozen=True)
class _Normal:
    """Normal equations at a state and at scales: A of the k free parameters of cameras and sheet (k, k), D of each dot
    (m, 2, 2), B between them (k, m, 2), right sides a (k,) and d (m, 2); the information known beforehand, prior
    (k, k), is in A. by_rest (2 n, k) and by_dot (n, 2, 2) are the Jacobians and residuals (n, 2), all in px;
    weights (n, 2) in px⁻².
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
    residuals: Floats
    weights: Floats


def _normal(problem: Problem, state: State, scales: Scales) -> _Normal:
    target = problem.target
    px, inner, pose, by_dot, radius = patch_jacobians(problem.views(state), target.dot_shape, target.dot_size_mm)
    by_sheet_now = by_dot @ by_sheet(target, problem.rows, problem.columns)[problem.dot]
    values = np.concatenate([inner, pose, radius, by_sheet_now], axis=-1)
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


def _reweighted(problem: Problem, state: State, normal: _Normal, scales: Scales) -> _Normal:
    """The same at other scales."""
    return _assembled(problem, state, scales, normal.by_rest, normal.by_dot, normal.residuals)


def _assembled(
    problem: Problem, state: State, scales: Scales, by_rest: scipy.sparse.csr_array, by_dot: Floats, residuals: Floats
) -> _Normal:
    m = len(problem.rows) if scales.print else 0
    w = np.minimum(1.0, HUBER * scales.px / np.maximum(np.abs(residuals), 1e-300)) / scales.px**2  # (n, 2)
    prior, a = _beforehand(problem, state, scales)
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


def _beforehand(problem: Problem, state: State, scales: Scales) -> tuple[Floats, Floats]:
    """Information on the free parameters known beforehand (k, k), and its pull on the state (k,)."""
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
    nominal, sheet = PrintedSheet.nominal(problem.target), state.sheet
    return np.array([sheet.radius - nominal.radius, sheet.pitch - nominal.pitch, sheet.tilt])


def _step(problem: Problem, state: State, normal: _Normal, damping: float) -> tuple[State | None, float, float, float]:
    """The state after one step, or None where none lowers the cost; the damping, the gain and the cost before."""
    cost = _cost(problem, state, normal.scales)
    while damping < 1e8:
        rest, dots = _solve(normal, damping)
        step = np.zeros(len(problem.free))
        step[problem.free] = rest
        trial = state.moved(step, dots)
        trial_cost = _cost(problem, trial, normal.scales)
        if trial_cost <= cost:
            return trial, damping / 10, cost - trial_cost, cost
        damping = max(damping, 1e-7) * 10
    return None, 1e-6, 0.0, cost


def _cost(problem: Problem, state: State, scales: Scales) -> float:
    with np.errstate(all="ignore"):
        t = np.abs(problem.px - problem.project(state)) / scales.px
        cost = float(np.sum(np.where(t <= HUBER, t * t, HUBER * (2 * t - HUBER))))
    cost += float(problem.lens_gap(state).sum()) / scales.lens**2
    known = problem.sheet_sigma > 0
    cost += float(np.sum((_sheet_gap(problem, state)[known] / problem.sheet_sigma[known]) ** 2))
    if scales.print:
        cost += float(np.sum(state.offsets**2)) / scales.print**2
    return cost if np.isfinite(cost) and np.all(state.inner[:, :2] > 0) else float("inf")


def _estimate(problem: Problem, state: State, normal: _Normal) -> Scales:
    """All scales from what is left over, each divided by its redundancy."""
    old = normal.scales
    covariance, crossed, dots = _inverse(normal)
    redundancy = 1 - _leverage(problem, normal, covariance, crossed, dots)
    telling = redundancy > 0.05  # the rest is what fits anything
    px = max(_robust_sigma(normal.residuals[telling] / np.sqrt(redundancy[telling])), _PX_FLOOR)
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
    found = float(np.sqrt(np.sum(state.offsets**2) / max(count - own, 1e-6 * count)))
    return Scales(px, max(found, _PRINT_FLOOR), lens)


def _chi2(problem: Problem, normal: _Normal, redundancy: Floats) -> Floats:
    count = len(problem.lens)
    squares = np.sum(normal.weights * normal.residuals**2, axis=1)
    degrees = np.bincount(problem.camera, weights=redundancy.sum(axis=1), minlength=count)
    return np.bincount(problem.camera, weights=squares, minlength=count) / np.maximum(degrees, 1.0)


def _leverage(problem: Problem, normal: _Normal, covariance: Floats, crossed: Floats, dots: Floats) -> Floats:
    """Share of each residual (n, 2) that the parameters take up: diagonal of J N⁻¹ Jᵀ W."""
    J, by_dot = normal.by_rest, normal.by_dot
    taken = np.sum((J @ covariance) * J.toarray(), axis=1).reshape(-1, 2)
    if len(dots):
        both = (J @ crossed.reshape(len(covariance), -1)).reshape(len(by_dot), 2, -1, 2)
        both = both[np.arange(len(by_dot)), :, problem.dot]
        taken += 2 * np.einsum("nri,nri->nr", both, by_dot)
        taken += np.einsum("nri,nij,nrj->nr", by_dot, dots[problem.dot], by_dot)
    return np.asarray(taken * normal.weights, dtype=np.float64)


def _robust_sigma(residuals: Floats) -> float:
    """Standard deviation a component, from the median of its size."""
    return 1.4826 * float(np.median(np.abs(residuals)))


def _reduced(normal: _Normal, damping: float) -> tuple[tuple[Floats, bool], Floats, Floats, Floats]:
    """Factor and scale of the equations without the dots, D⁻¹ (m, 2, 2) and B D⁻¹ (k, m, 2)."""
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
    """One damped step: of the free parameters of cameras and sheet (k,) and of the dots (m, 2)."""
    factor, scale, inverse_D, BD = _reduced(normal, damping)
    right = normal.a - np.einsum("kmi,mi->k", BD, normal.d)
    rest = scale * scipy.linalg.cho_solve(factor, scale * right)
    dots = np.einsum("mij,mj->mi", inverse_D, normal.d) - np.einsum("kmi,k->mi", BD, rest)
    return rest, dots


def _inverse(normal: _Normal) -> tuple[Floats, Floats, Floats]:
    """Covariance of the free parameters of cameras and sheet (k, k), with the dots (k, m, 2), of each dot (m, 2, 2)."""
    factor, scale, inverse_D, BD = _reduced(normal, 0.0)
    covariance = scipy.linalg.cho_solve(factor, np.eye(len(scale))) * np.outer(scale, scale)
    crossed = -np.tensordot(covariance, BD, axes=1)
    return covariance, crossed, inverse_D - np.einsum("kmi,kmj->mij", BD, crossed)
