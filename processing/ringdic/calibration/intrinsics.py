"""Intrinsic calibration of a camera from views of a plane checkerboard (Zhang 2000), with the covariance of its lens.

The parameters are ``fx fy s cx cy k1 k2 p1 p2 k3`` and six of the pose of each view. The reprojection error of all
corners is minimised by the Levenberg-Marquardt method; the poses are eliminated from the normal equations (Schur
complement).
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ringdic.arrays import Floats, Mask, Pixels, Points
from ringdic.calibration.coverage import coverage, residual_distortion
from ringdic.calibration.lens_model import (
    LensModel,
    LensModelChoice,
    candidate_models,
    choose_model,
    independent_observations,
)
from ringdic.calibration.parameters import lens_of, pose_jacobians
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Intrinsics
from ringdic.session.json_values import from_json_value, json_value

log = logging.getLogger(__name__)

#: A third radial term with a larger standard error is fixed at zero: the views do not separate it from the second.
K3_SIGMA_LIMIT = 0.2
#: With fewer views than this, none is left out for an error above the percentile.
VIEWS_FOR_DROPPING = 10
#: Which of the parameters every lens has.
_ALWAYS = np.array([True, True, False, True, True, True, True, False, False, False])
#: Least standard deviation of a corner that is supposed, px.
_CORNER_FLOOR = 1e-6
#: Squared Mahalanobis distance from a flat board with square squares that shows another for certain; and how often that
#: is followed.
_BENT, _MOST_BENDS = 50.0, 4
#: Fewest views that determine a camera with free skew, focal lengths and principal point.
VIEWS_NEEDED = 3


@dataclass(frozen=True)
class IntrinsicsFit:
    """Intrinsics of a camera from views of a board, with their uncertainty and measures of fit.

    intrinsics : the lens.
    sigma : (10,) standard errors of fx fy s cx cy, px, and k1 k2 p1 p2 k3, no unit; 0 for a parameter that was fixed.
    view_errors : (n,) px, RMS residual of the corners of each view, also of the views that were left out.
    inliers : (n,) bool, the views that the lens was fitted to.
    rms : RMS residual over these views, px.
    covariance : (10, 10) of these parameters, in that order; 0 for those that were fixed.
    model : the free terms of the lens, in words. reason : why these were chosen.
    coverage : part of the image that the board covers in these views together, 0 to 1.
    residual_distortion : px, RMS over cells of the image of the mean residual in a cell, less what noise explains; it
        shows a lens or a board that differs from the model.
    redundancy_factor : 1 or more, coordinates of corners per independent one: what the bend of a board displaces, it
        displaces together, so that the true covariance is larger than ``covariance`` by about this factor.
    bend, bend_sigma : mm, height of the board's surface over its corners, highest minus lowest, and its standard error.
        Where the views show a bend for certain, the lens is fitted to the bent board; 0 for a flat one.
    stretch : part by which its squares are longer along the board than across, 0 where the views do not show that.
    distance : mm, of the middle of the board from the camera, median of the views.
    """

    intrinsics: Intrinsics
    sigma: Floats
    view_errors: Floats
    inliers: Mask
    rms: float
    covariance: Floats
    model: str = ""
    reason: str = ""
    coverage: float = float("nan")
    residual_distortion: float = float("nan")
    redundancy_factor: float = 1.0
    bend: float = 0.0
    bend_sigma: float = 0.0
    stretch: float = 0.0
    distance: float = float("nan")

    def to_dict(self) -> dict[str, Any]:
        """The fit as JSON values."""
        values: dict[str, Any] = json_value(self)
        kept = values.pop("inliers")
        return {**values, "kept": kept}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> IntrinsicsFit:
        """The fit from the JSON values of :meth:`to_dict`."""
        return from_json_value(cls, {**values, "inliers": values["kept"]})


def read_intrinsics(path: Path) -> Intrinsics:
    """Read the intrinsics of a camera from a JSON file.

    The file holds ``K`` (3 x 3, px), ``distortion`` (k1 k2 p1 p2 k3) and ``size`` (width, height). Raises InputError,
    naming the file, where it does not exist or is not such a file.
    """
    path = Path(path)
    try:
        return from_json_value(Intrinsics, json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; the rig names it as a camera's intrinsics") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: not usable as intrinsics ({error}); it needs K (3 x 3), distortion (k1 k2 p1 p2 k3) "
            "and size (width, height) as JSON"
        ) from error


def calibrate_intrinsics(
    views: list[Pixels],
    board_xy: Floats,
    size: tuple[int, int],
    *,
    radial: int | None = None,
    tangential: bool = True,
    skew: bool = True,
    fewest_terms: bool = False,
    drop_percentile: float = 80.0,
) -> IntrinsicsFit:
    """Intrinsics of a camera from the corners of a plane board in several views.

    Parameters
    ----------
    views : corners of each view, (n, 2) px, all n corners in the order of ``board_xy``.
    board_xy : (n, 2) mm, corners on the board.
    size : (width, height) of the image, px.
    radial : number of radial terms, 2 or 3; None takes 3 if the standard error of k3 is below ``K3_SIGMA_LIMIT``.
    tangential, skew : whether these terms are free.
    fewest_terms : True takes, of all models with some of these terms, that of the least information criterion.
    drop_percentile : with at least ``VIEWS_FOR_DROPPING`` views, those with an error above this percentile are left
        out and the others are fitted again; 100 keeps all.

    Raises
    ------
    ComputationError : fewer than ``VIEWS_NEEDED`` views, or the corners are not those of a board.
    """
    if len(views) < VIEWS_NEEDED:
        raise ComputationError(
            f"the checkerboard was found in {len(views)} images; intrinsics need at least {VIEWS_NEEDED}"
        )
    px = np.stack([np.asarray(view, dtype=float).reshape(-1, 2) for view in views])
    board = np.column_stack([np.asarray(board_xy, dtype=float), np.zeros(len(board_xy))])
    models = candidate_models(radial, tangential, skew, fewest_terms)
    fit = _fit_to_board(px, board, size, models, drop_percentile, fewest_terms)
    board, inliers, choice = fit.board, fit.inliers, fit.choice
    state, _ = _refine(fit.state, px, board, np.zeros(10, dtype=bool))  # poses of all views, with the intrinsics fixed
    errors = _view_errors(state, px, board)
    residuals = (px - _project(state, board))[inliers]
    rms = float(np.sqrt(np.mean(errors[inliers] ** 2)))
    model = str(choice.model)
    log.info("intrinsics from %d of %d views, %s (%s), RMS %.3f px", inliers.sum(), len(px), model, choice.reason, rms)
    return IntrinsicsFit(
        lens_of(state[0], size),
        np.sqrt(np.diag(fit.covariance)),
        errors,
        inliers,
        rms,
        fit.covariance,
        model,
        choice.reason,
        coverage(px[inliers], size),
        residual_distortion(px[inliers], residuals, size),
        max(1.0, residuals.size / independent_observations(residuals, board[:, :2])),
        float(np.ptp(board[:, 2])),
        fit.bend_sigma,
        float(np.ptp(board[:, 1]) / np.ptp(np.asarray(board_xy)[:, 1]) - 1),
        float(np.median(np.linalg.norm(state[1][inliers] @ board.mean(axis=0) + state[2][inliers], axis=1))),
    )


_State = tuple[Floats, Floats, Floats]  # inner (10,), rotations (views, 3, 3), translations (views, 3) mm


@dataclass(frozen=True)
class _BoardFit:
    """A lens fitted to a board that may be bent, and whose squares may be longer than wide.

    board : (n, 3) mm, its corners. state : with the poses of all v views. covariance : (10, 10) of the lens. inliers :
    (v,) bool. bend_sigma : mm, standard error of the board's edge over its middle.
    """

    board: Points
    state: _State
    covariance: Floats
    inliers: Mask
    choice: LensModelChoice
    bend_sigma: float


def _fit_to_board(
    px: Pixels, board: Points, size: tuple[int, int], models: list[LensModel], drop_percentile: float, fewest: bool
) -> _BoardFit:
    """Choose a lens model and fit it to the views without gross errors; again with the board's shape, if it has one.

    px : (v, n, 2). board : (n, 3) mm, flat.
    """
    state, followed = _start(px, board, size), np.zeros(2, dtype=bool)
    for _ in range(_MOST_BENDS):
        state, _ = _refine(state, px, board, models[0].free)
        inliers = _inlier_views(_view_errors(state, px, board), drop_percentile)
        choice, state, covariance = _fit_of_chosen_model(models, state, px, board, inliers, fewest)
        seen = _of_views(state, inliers), px[inliers], board, choice.model.free
        shape = _board_shape(*seen)
        certain = np.array(shape.chi2) > _BENT
        if not certain.any():
            break
        followed |= certain
        board = board + _board_shape(*seen, bend=certain[0], stretch=certain[1]).shift
    if followed.any():
        covariance = _board_shape(*seen, bend=followed[0], stretch=followed[1]).lens_covariance
    return _BoardFit(board, state, covariance, inliers, choice, shape.bend_sigma)


def _of_views(state: _State, which: Mask) -> _State:
    """The state with the poses of some views only. which : (v,) bool."""
    return state[0], state[1][which], state[2][which]


@dataclass(frozen=True)
class _Shape:
    """Errors of a board's shape beside that which its corners have already: its bend, and the stretch of its squares.

    shift : (n, 3) mm, of the corners. bend_sigma : mm, standard error of the height of the board's edge over its
    middle. chi2 : of bend and stretch, squared Mahalanobis distances from none, about 3 and 1 without.
    lens_covariance : (10, 10), with the shape free.
    """

    shift: Points
    bend_sigma: float
    chi2: tuple[float, float]
    lens_covariance: Floats


def _board_shape(
    state: _State, px: Pixels, board: Points, free: Mask, *, bend: bool = True, stretch: bool = True
) -> _Shape:
    """Errors of shape that lower the residuals of all v views most, lens and poses free to follow, to first order.

    px : (v, n, 2). board : (n, 3) mm. free : (10,) parameters of the lens. bend, stretch : the errors to estimate.
    Standard errors are for as many residuals as are independent without these.
    """
    centred = board[:, :2] - board[:, :2].mean(axis=0)
    x, y = (centred / np.abs(centred).max()).T
    modes = np.zeros((len(board), 3, 4))
    modes[:, 2, :3], modes[:, 1, 3] = np.column_stack([x * x, x * y, y * y]), y
    modes = modes[..., np.array([bend, bend, bend, stretch])]
    projected, by_inner, by_pose, by_point = pose_jacobians(lens_of(state[0]), *_in_cameras(state, board))
    by_shape = np.einsum("vnki,nij->vnkj", by_point @ state[1][:, None], modes)
    J, r = np.concatenate([by_inner[..., free], by_shape], axis=-1), px - projected
    A, B, C, a, c = _normal_equations(r, J, by_pose)
    change, pose = _solve(A, B, C, a, c, 0.0)
    left = r - J @ change - np.einsum("vnij,vj->vni", by_pose, pose)
    degrees = max(r.size - len(change) - 6 * len(px), 1)
    variance = max(float(np.sum(left**2)) / degrees, _CORNER_FLOOR**2)
    covariance = variance * _inner_inverse(A, B, C)
    k = int(free.sum())
    q, own = change[k:], covariance[k:, k:] * max(1.0, left.size / independent_observations(left, board[:, :2]))
    lens = np.zeros((10, 10))
    lens[np.ix_(free, free)] = covariance[:k, :k]
    b = 3 * bend
    heights = modes[:, 2, :b]
    sigma = float(np.sqrt(np.max(np.einsum("ni,ij,nj->n", heights, own[:b, :b], heights))))
    of_bend, of_stretch = (
        float(q[part] @ np.linalg.pinv(own[part, part]) @ q[part]) for part in (slice(0, b), slice(b, None))
    )
    return _Shape(modes @ q, sigma, (of_bend, of_stretch), lens)


def _inner_inverse(A: Floats, B: Floats, C: Floats) -> Floats:
    """Inverse (p, p) of the normal equations of the inner parameters after elimination of the poses."""
    S = A - np.einsum("vij,vjk,vlk->il", B, np.linalg.inv(C), B)
    scale = np.sqrt(np.diag(A))
    return np.asarray(np.linalg.pinv(S / np.outer(scale, scale)) / np.outer(scale, scale))


def _fit_of_chosen_model(
    models: list[LensModel], state: _State, px: Pixels, board: Points, inliers: Mask, fewest_terms: bool
) -> tuple[LensModelChoice, _State, Floats]:
    """Choose a lens model and fit it to the inlier views.

    state : of the largest model, fitted to all v views. px : (v, n, 2). board : (n, 3) mm. inliers : (v,).

    Returns the choice, the state with the poses of the inlier views refined, and the covariance of the inner parameters
    (10, 10).
    """
    inner, rotations, translations = state
    fits: dict[LensModel, tuple[_State, Floats]] = {}

    def fit(model: LensModel) -> tuple[float, float]:
        start = (np.where(model.free | _ALWAYS, inner, 0.0), rotations[inliers], translations[inliers])
        fits[model] = _refine(start, px[inliers], board, model.free)
        refined, covariance = fits[model]
        return _cost(refined, px[inliers], board) / px[inliers].size, float(np.sqrt(covariance[9, 9]))

    N = independent_observations((px - _project(state, board))[inliers], board[:, :2])
    choice = choose_model(models, fit, N, K3_SIGMA_LIMIT, fewest_terms)
    if choice.model not in fits:
        fit(choice.model)
    (inner, *poses), covariance = fits[choice.model]
    rotations, translations = rotations.copy(), translations.copy()
    rotations[inliers], translations[inliers] = poses
    return choice, (inner, rotations, translations), covariance


def _start(px: Pixels, board: Points, size: tuple[int, int]) -> _State:
    """Start of the fit: focal length from the homographies with the principal point in the middle, and the poses.

    px : (v, n, 2) corners in v views. board : (n, 3) mm.
    """
    points = [board.astype(np.float32)] * len(px)
    K = cv2.initCameraMatrix2D(points, [view.astype(np.float32) for view in px], size)
    if not np.all(np.isfinite(K)) or not 0.2 * max(size) < K[0, 0] < 20 * max(size):
        focal = 1.0 * max(size)  # views parallel to the image do not determine the focal length
        K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    rotations, translations = [], []
    for view in px:
        solved, rotation, translation = cv2.solvePnP(board, view, K, None)
        if not solved:
            raise ComputationError("the pose of a checkerboard view could not be found; its corners are not a board")
        rotations.append(cv2.Rodrigues(rotation)[0])
        translations.append(translation.ravel())
    inner = np.array([K[0, 0], K[1, 1], 0, K[0, 2], K[1, 2], 0, 0, 0, 0, 0], dtype=float)
    return inner, np.array(rotations), np.array(translations)


def _project(state: _State, board: Points) -> Pixels:
    """Projections of the board's corners (n, 3) mm in all views, (v, n, 2) px."""
    _, in_camera = _in_cameras(state, board)
    lens = lens_of(state[0])
    distorted = lens.distort_normalised(in_camera[..., :2] / in_camera[..., 2:])
    return distorted @ lens.K[:2, :2].T + lens.K[:2, 2]


def _in_cameras(state: _State, board: Points) -> tuple[Points, Points]:
    """Corners ``R X`` and ``R X + t`` of the board in the camera frames of all views, (v, n, 3) mm each."""
    _, rotations, translations = state
    rotated = np.einsum("vij,nj->vni", rotations, board)
    return rotated, rotated + translations[:, None]


def _cost(state: _State, px: Pixels, board: Points) -> float:
    """Sum of squared residuals, px²; infinite where the state is not a camera."""
    if min(state[0][:2]) <= 0:
        return float("inf")
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        cost = float(np.sum((px - _project(state, board)) ** 2))
    return cost if np.isfinite(cost) else float("inf")


def _view_errors(state: _State, px: Pixels, board: Points) -> Floats:
    """RMS residual of the corners of each view, (v,) px."""
    difference = px - _project(state, board)
    return np.sqrt(np.mean(np.sum(difference**2, axis=-1), axis=-1))


def _inlier_views(errors: Floats, drop_percentile: float) -> Mask:
    """Views (v,) without gross errors and, where there are many, with an error (v,) px up to the percentile.

    All views, where fewer than ``VIEWS_NEEDED`` would be left.
    """
    inliers = errors <= np.maximum(5.0 * np.median(errors), 1e-6)
    if len(errors) >= VIEWS_FOR_DROPPING:
        inliers &= errors <= np.percentile(errors, drop_percentile)
    return inliers if inliers.sum() >= VIEWS_NEEDED else np.ones(len(errors), dtype=bool)


def _jacobians(state: _State, board: Points) -> tuple[Pixels, Floats, Floats]:
    """Projections of the corners (v, n, 2) px, derivatives by inner parameters (v, n, 2, 10) and pose (v, n, 2, 6).

    The pose is changed as ``R ← exp([ω]×) R``, ``t ← t + τ``, parameters (ω, τ).
    """
    px, by_inner, by_pose, _ = pose_jacobians(lens_of(state[0]), *_in_cameras(state, board))
    return px, by_inner, by_pose


def _refine(state: _State, px: Pixels, board: Points, free: Mask) -> tuple[_State, Floats]:
    """Fit the free inner parameters (10,) and all poses by the Levenberg-Marquardt method, to convergence.

    Returns the state and the covariance of the inner parameters (10, 10), 0 where fixed.
    """
    damping = 1e-3
    projected, by_inner, by_pose = _jacobians(state, board)
    cost = float(np.sum((px - projected) ** 2))
    for _ in range(100):
        A, B, C, a, c = _normal_equations(px - projected, by_inner[..., free], by_pose)
        while True:
            step_inner, step_pose = _solve(A, B, C, a, c, damping)
            trial = _plus(state, free, step_inner, step_pose)
            trial_cost = _cost(trial, px, board)
            if trial_cost <= cost or damping > 1e12:
                break
            damping *= 10
        if not trial_cost <= cost:
            break  # no step lowers the cost any more, by round-off
        converged = cost - trial_cost <= 1e-12 * cost
        state, cost, damping = trial, trial_cost, max(damping / 10, 1e-12)
        projected, by_inner, by_pose = _jacobians(state, board)
        if converged:
            break
    covariance = np.zeros((10, 10))
    if not free.any():
        return state, covariance
    A, B, C, _, _ = _normal_equations(px - projected, by_inner[..., free], by_pose)
    degrees = max(px.size - int(free.sum()) - 6 * len(px), 1)
    # Without a least error of corners, exact data would give an infinite weight.
    covariance[np.ix_(free, free)] = _inner_inverse(A, B, C) * max(cost / degrees, _CORNER_FLOOR**2)
    return state, covariance


def _normal_equations(r: Floats, by_inner: Floats, by_pose: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Blocks of JᵀJ and Jᵀr: inner (p, p), inner by pose (v, p, 6), pose (v, 6, 6), right sides (p,) and (v, 6).

    r : (v, n, 2) px residuals. by_inner, by_pose : (v, n, 2, p) and (v, n, 2, 6).
    """
    v, rows = len(r), r[0].size
    Ji, Jp, r = by_inner.reshape(v, rows, by_inner.shape[-1]), by_pose.reshape(v, rows, 6), r.reshape(v, rows)
    JiT, JpT = np.swapaxes(Ji, 1, 2), np.swapaxes(Jp, 1, 2)
    return (JiT @ Ji).sum(0), JiT @ Jp, JpT @ Jp, (JiT @ r[..., None]).sum(0)[:, 0], (JpT @ r[..., None])[..., 0]


def _solve(A: Floats, B: Floats, C: Floats, a: Floats, c: Floats, damping: float) -> tuple[Floats, Floats]:
    """Solution of the damped normal equations: steps of the inner parameters (p,) and of the poses (v, 6)."""
    A = A + damping * np.diag(np.diag(A))
    C = C + damping * C * np.eye(6)
    BC = np.swapaxes(np.linalg.solve(C, np.swapaxes(B, 1, 2)), 1, 2)  # B C⁻¹
    S = A - np.einsum("vij,vkj->ik", BC, B)
    right = a - np.einsum("vij,vj->i", BC, c)
    scale = np.sqrt(np.diag(A))
    inner = np.zeros(0)
    if len(a):
        inner = np.linalg.lstsq(S / np.outer(scale, scale), right / scale, rcond=None)[0] / scale
    pose = np.linalg.solve(C, (c - np.einsum("vij,i->vj", B, inner))[..., None])[..., 0]
    return inner, pose


def _plus(state: _State, free: Mask, step_inner: Floats, step_pose: Floats) -> _State:
    """The state after a step of the free inner parameters (p,) and of the poses (v, 6)."""
    inner, rotations, translations = state
    inner = inner.copy()
    inner[free] += step_inner
    turns = np.array([cv2.Rodrigues(omega)[0] for omega in step_pose[:, :3]])
    return inner, turns @ rotations, translations + step_pose[:, 3:]
