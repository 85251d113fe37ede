"""A camera's inner orientation from views of a plane checkerboard (Zhang 2000), with skew and with its uncertainty.

The parameters are ``fx fy s cx cy k1 k2 p1 p2 k3``; each view adds a pose of six. Levenberg-Marquardt on the
reprojection error of all corners; the poses are eliminated from the normal equations (Schur complement).
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ringdic.arrays import Floats, Mask
from ringdic.calibration.coverage import coverage, residual_distortion
from ringdic.calibration.lens_model import LensModel, LensModelChoice, choose, independent, possible
from ringdic.calibration.parameters import lens_jacobians
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Intrinsics

log = logging.getLogger(__name__)

PARAMETERS = ("fx", "fy", "s", "cx", "cy", "k1", "k2", "p1", "p2", "k3")

#: A third radial term less certain than this is left at zero: the views cannot tell it from the second.
K3_SIGMA_LIMIT = 0.2
#: With fewer views than this no view is dropped for being above the percentile.
VIEWS_FOR_DROPPING = 10
#: Parameters that every lens has.
_ALWAYS = np.array([True, True, False, True, True, True, True, False, False, False])
#: No corner is better than this, px.
_CORNER_FLOOR = 1e-6
#: Views without which a camera with free skew, focal lengths and centre is not determined.
VIEWS_NEEDED = 3


@dataclass(frozen=True)
class IntrinsicsFit:
    """The intrinsics of a camera and how well they are known.

    sigma : (10,), standard errors in the order of ``PARAMETERS``; 0 for a parameter that was held.
    view_errors : (n,), RMS distance of each given view's corners after the fit, px; also of the views left out.
    kept : (n,), which views the fit rests on.
    rms : RMS distance over the kept views, px.
    covariance : (10, 10) of the same parameters; rows and columns of held ones are 0.
    model : the terms that are free, in words. reason : why these.
    coverage : part of the image that the kept views of the board cover together.
    residual_distortion : px, RMS over the cells of the image of what corners seen there are off in common, which
        noise does not explain: a lens or a board that is not as the model says.
    """

    intrinsics: Intrinsics
    sigma: Floats
    view_errors: Floats
    kept: Mask
    rms: float
    covariance: Floats
    model: str = ""
    reason: str = ""
    coverage: float = float("nan")
    residual_distortion: float = float("nan")

    def to_dict(self) -> dict[str, Any]:
        """The fit as JSON values."""
        return {
            "intrinsics": intrinsics_to_dict(self.intrinsics),
            "sigma": self.sigma.tolist(),
            "view_errors": self.view_errors.tolist(),
            "kept": self.kept.tolist(),
            "rms": self.rms,
            "covariance": self.covariance.tolist(),
            "model": self.model,
            "reason": self.reason,
            "coverage": self.coverage,
            "residual_distortion": self.residual_distortion,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> IntrinsicsFit:
        """The fit of :meth:`to_dict`."""
        return cls(
            intrinsics_from_dict(values["intrinsics"]),
            np.array(values["sigma"], dtype=float),
            np.array(values["view_errors"], dtype=float),
            np.array(values["kept"], dtype=bool),
            float(values["rms"]),
            np.array(values["covariance"], dtype=float),
            str(values["model"]),
            str(values["reason"]),
            float(values["coverage"]),
            float(values["residual_distortion"]),
        )


def intrinsics_to_dict(intrinsics: Intrinsics) -> dict[str, Any]:
    """Intrinsics as JSON values."""
    return {
        "K": intrinsics.K.tolist(),
        "distortion": intrinsics.distortion.tolist(),
        "size": list(intrinsics.size),
    }


def intrinsics_from_dict(values: dict[str, Any]) -> Intrinsics:
    """Intrinsics of :func:`intrinsics_to_dict`."""
    width, height = values["size"]
    return Intrinsics(np.array(values["K"]), np.array(values["distortion"]), (int(width), int(height)))


def read_intrinsics(path: Path) -> Intrinsics:
    """Intrinsics of a JSON file: ``K`` (3 × 3, px), ``distortion`` (k1 k2 p1 p2 k3), ``size`` (width, height)."""
    path = Path(path)
    try:
        return intrinsics_from_dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; the rig names it as a camera's intrinsics") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: not usable as intrinsics ({error}); it needs K (3 x 3), distortion (k1 k2 p1 p2 k3) "
            "and size (width, height) as JSON"
        ) from error


def calibrate_intrinsics(
    views: list[Floats],
    board_xy: Floats,
    size: tuple[int, int],
    *,
    radial: int | None = None,
    tangential: bool = True,
    skew: bool = True,
    fewest_terms: bool = False,
    drop_percentile: float = 80.0,
) -> IntrinsicsFit:
    """Intrinsics from the corners of a board in several views.

    views : corners of each view, (n, 2) px, all n corners in the order of ``board_xy``.
    board_xy : (n, 2) mm.
    size : (width, height), px.
    radial : number of radial terms, 2 or 3; None takes 3 where the standard error of k3 is below ``K3_SIGMA_LIMIT``.
    tangential, skew : whether these are free.
    fewest_terms : of the models without some of these terms that of the smallest information criterion is taken.
    drop_percentile : views whose error lies above this percentile are left out and the rest is fitted again, where
        there are at least ``VIEWS_FOR_DROPPING``; 100 keeps all.

    Raises ComputationError where there are too few views.
    """
    if len(views) < VIEWS_NEEDED:
        raise ComputationError(
            f"the checkerboard was found in {len(views)} images; intrinsics need at least {VIEWS_NEEDED}"
        )
    px = np.stack([np.asarray(view, dtype=float).reshape(-1, 2) for view in views])
    board = np.column_stack([np.asarray(board_xy, dtype=float), np.zeros(len(board_xy))])
    models = possible(radial, tangential, skew, fewest_terms)
    largest = models[0]
    whole, _ = _refine(_start(px, board, size), px, board, largest.free)
    kept = _views_to_keep(_view_errors(whole, px, board), drop_percentile)
    inner, rotations, translations = whole
    best = px[kept]
    fits: dict[LensModel, tuple[State, Floats]] = {}

    def fit(model: LensModel) -> tuple[float, float]:
        start = (np.where(model.free | _ALWAYS, inner, 0.0), rotations[kept], translations[kept])
        fits[model] = _refine(start, best, board, model.free)
        state, covariance = fits[model]
        return _cost(state, best, board) / best.size, float(np.sqrt(covariance[9, 9]))

    worth = independent((px - _project(whole, board)[0])[kept], board[:, :2])
    choice = choose(models, fit, worth, K3_SIGMA_LIMIT, fewest_terms)
    if choice.model not in fits:
        fit(choice.model)
    (inner, rotations_kept, translations_kept), covariance = fits[choice.model]
    rotations, translations = rotations.copy(), translations.copy()
    rotations[kept], translations[kept] = rotations_kept, translations_kept
    state = (inner, *_poses_refined(inner, rotations, translations, px, board))
    errors = _view_errors(state, px, board)
    residuals = (px - _project(state, board)[0])[kept]
    rms = float(np.sqrt(np.mean(errors[kept] ** 2)))
    log.info("intrinsics from %d of %d views, %s (%s), RMS %.3f px", kept.sum(), len(views), *_words(choice), rms)
    return IntrinsicsFit(
        _intrinsics(inner, size),
        np.sqrt(np.diag(covariance)),
        errors,
        kept,
        rms,
        covariance,
        *_words(choice),
        coverage(best, size),
        residual_distortion(best, residuals, size),
    )


def _words(choice: LensModelChoice) -> tuple[str, str]:
    return str(choice.model), choice.reason


State = tuple[Floats, Floats, Floats]  # inner (10,), rotations (views, 3, 3), translations (views, 3)


def _intrinsics(inner: Floats, size: tuple[int, int]) -> Intrinsics:
    fx, fy, s, cx, cy, k1, k2, p1, p2, k3 = inner
    return Intrinsics(np.array([[fx, s, cx], [0, fy, cy], [0, 0, 1]]), np.array([k1, k2, p1, p2, k3]), size)


def _start(px: Floats, board: Floats, size: tuple[int, int]) -> State:
    """Focal length from the homographies with the centre in the middle, then the pose of each view."""
    points = [board.astype(np.float32)] * len(px)
    K = cv2.initCameraMatrix2D(points, [view.astype(np.float32) for view in px], size)
    if not np.all(np.isfinite(K)) or not 0.2 * max(size) < K[0, 0] < 20 * max(size):
        focal = 1.0 * max(size)  # all views parallel to the image: no focal length in them
        K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    rotations, translations = [], []
    for view in px:
        found, rotation, translation = cv2.solvePnP(board, view, K, None)
        if not found:
            raise ComputationError("the pose of a checkerboard view could not be found; its corners are not a board")
        rotations.append(cv2.Rodrigues(rotation)[0])
        translations.append(translation.ravel())
    inner = np.array([K[0, 0], K[1, 1], 0, K[0, 2], K[1, 2], 0, 0, 0, 0, 0], dtype=float)
    return inner, np.array(rotations), np.array(translations)


def _project(state: State, board: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Corners (views, n, 2) px, rotated board and points in the camera (views, n, 3), ideal normalised points."""
    inner, rotations, translations = state
    rotated = np.einsum("vij,nj->vni", rotations, board)
    camera = rotated + translations[:, None]
    xy = camera[..., :2] / camera[..., 2:]
    lens = _intrinsics(inner, (1, 1))
    distorted = lens.distort_normalised(xy)
    return distorted @ lens.K[:2, :2].T + lens.K[:2, 2], rotated, camera, xy


def _cost(state: State, px: Floats, board: Floats) -> float:
    """Sum of squared residuals; infinite where the state is not a camera."""
    if min(state[0][:2]) <= 0:
        return float("inf")
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        cost = float(np.sum((px - _project(state, board)[0]) ** 2))
    return cost if np.isfinite(cost) else float("inf")


def _view_errors(state: State, px: Floats, board: Floats) -> Floats:
    difference = px - _project(state, board)[0]
    return np.sqrt(np.mean(np.sum(difference**2, axis=-1), axis=-1))


def _views_to_keep(errors: Floats, drop_percentile: float) -> Mask:
    """Views with a gross error never; above the percentile only where enough views are left."""
    keep = errors <= np.maximum(5.0 * np.median(errors), 1e-6)
    if len(errors) >= VIEWS_FOR_DROPPING:
        keep &= errors <= np.percentile(errors, drop_percentile)
    return keep if keep.sum() >= VIEWS_NEEDED else np.ones(len(errors), dtype=bool)


def _jacobians(state: State, board: Floats) -> tuple[Floats, Floats, Floats]:
    """Corners (v, n, 2) and their derivatives by the inner parameters (v, n, 2, 10) and the pose (v, n, 2, 6).

    The pose moves as ``R ← exp([ω]×) R``, ``t ← t + τ``, six parameters (ω, τ).
    """
    _, rotated, camera, xy = _project(state, board)
    px, inner, by_ideal = lens_jacobians(_intrinsics(state[0], (1, 1)), xy)
    z = camera[..., 2]
    by_point = np.zeros((*z.shape, 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = 1 / z
    by_point[..., 0, 2], by_point[..., 1, 2] = -xy[..., 0] / z, -xy[..., 1] / z
    by_point = by_ideal @ by_point
    pose = np.concatenate([np.cross(rotated[..., None, :], by_point), by_point], axis=-1)
    return px, inner, pose


def _refine(state: State, px: Floats, board: Floats, free: Mask) -> tuple[State, Floats]:
    """Levenberg-Marquardt to convergence; the state and the covariance of the inner parameters (10, 10)."""
    damping = 1e-3
    projected, by_inner, by_pose = _jacobians(state, board)
    cost = float(np.sum((px - projected) ** 2))
    for _ in range(100):
        A, B, C, a, c = _normal_equations(px - projected, by_inner[..., free], by_pose)
        while True:
            step_inner, step_pose = _solve(A, B, C, a, c, damping)
            trial = _moved(state, free, step_inner, step_pose)
            trial_cost = _cost(trial, px, board)
            if trial_cost <= cost or damping > 1e12:
                break
            damping *= 10
        if not trial_cost <= cost:
            break  # round-off: no step lowers the cost any more
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
    S = A - np.einsum("vij,vjk,vlk->il", B, np.linalg.inv(C), B)
    scale = np.sqrt(np.diag(A))
    inverse = np.linalg.pinv(S / np.outer(scale, scale)) / np.outer(scale, scale)
    # Corners are never exact; without this a perfect world would claim an infinite weight.
    covariance[np.ix_(free, free)] = inverse * max(cost / degrees, _CORNER_FLOOR**2)
    return state, covariance


def _normal_equations(r: Floats, by_inner: Floats, by_pose: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Blocks of JᵀJ and Jᵀr: inner (p, p), inner-pose (v, p, 6), pose (v, 6, 6), and right sides."""
    v, rows = len(r), r[0].size
    Ji, Jp, r = by_inner.reshape(v, rows, by_inner.shape[-1]), by_pose.reshape(v, rows, 6), r.reshape(v, rows)
    JiT, JpT = np.swapaxes(Ji, 1, 2), np.swapaxes(Jp, 1, 2)
    return (JiT @ Ji).sum(0), JiT @ Jp, JpT @ Jp, (JiT @ r[..., None]).sum(0)[:, 0], (JpT @ r[..., None])[..., 0]


def _solve(A: Floats, B: Floats, C: Floats, a: Floats, c: Floats, damping: float) -> tuple[Floats, Floats]:
    """One damped step: inner (p,) and poses (v, 6)."""
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


def _moved(state: State, free: Mask, step_inner: Floats, step_pose: Floats) -> State:
    inner, rotations, translations = state
    inner = inner.copy()
    inner[free] += step_inner
    turns = np.array([cv2.Rodrigues(omega)[0] for omega in step_pose[:, :3]])
    return inner, turns @ rotations, translations + step_pose[:, 3:]


def _poses_refined(
    inner: Floats, rotations: Floats, translations: Floats, px: Floats, board: Floats
) -> tuple[Floats, Floats]:
    """Poses of all views with the intrinsics held."""
    state = (inner, rotations, translations)
    state, _ = _refine(state, px, board, np.zeros(10, dtype=bool))
    return state[1], state[2]
