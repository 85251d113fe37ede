"""Bundle adjustment of all cameras of a rig and their calibration target, started from separately calibrated cameras.

The observations are the centroids of the images of printed dots, taken as patches of a cylinder. The lenses are known
from the boards with their full covariance, and the dots may be printed off their nominal positions. (If centroids were
taken for images of the dots' centres, a free focal length would absorb the difference: every diameter would come out
too large, and no residual would show it.)
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Indices, Mask, Pixels, Vectors
from ringdic.calibration.adjustment import Problem, Solution, State, adjust
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.parameters import LENS, PER_CAMERA, POSE, CameraParameters
from ringdic.calibration.patch import (
    DotViews,
    PrintedSheet,
    cylinder_points,
    project_centres,
    project_patches,
    sheet_points,
)
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.session.json_values import from_json_value, json_value
from ringdic.session.rig import Target

log = logging.getLogger(__name__)

#: Least standard deviation of a board's corner that is supposed, px per component.
_CORNER_SIGMA = 0.005
#: A centroid whose residual is longer than this many σ is a gross error.
_GROSS = 6.0


@dataclass(frozen=True)
class TargetPrior:
    """Prior standard deviations of the target's geometry about its values in rig.toml; 0 fixes a nominal value.

    dots : of the print errors, mm in each direction; a start value, replaced by the estimate from the images.
    radius, pitch : of the printed surface and of its columns, mm. tilt : of the sheet in its surface, rad.

    The spacing of the rows is always fixed: it gives the world its scale.
    """

    dots: float = 0.03
    radius: float = 0.0
    pitch: float = 0.0
    tilt: float = 0.0

    def __post_init__(self) -> None:
        if not min(self.dots, self.radius, self.pitch, self.tilt) >= 0:
            raise ValueError("standard deviations of the target are not negative")


@dataclass(frozen=True)
class BundleFit:
    """Results of a bundle adjustment other than the cameras: covariance, target geometry and measures of fit.

    cameras : C ids, in the order of the parameters.
    covariance : (16 C + 3, 16 C + 3) of ``fx fy s cx cy k1 k2 p1 p2 k3`` (px or without unit), ω (rad) and τ (mm) of
        each camera, then radius, pitch (mm) and tilt (rad). The pose is changed as ``R ← exp([ω]×) R``, ``t ← t + τ``.
        Zero for fixed parameters.
    sheet : the adjusted geometry of the printed sheet.
    px_sigma : standard deviation of a centroid, px per component, estimated from the residuals.
    print_sigma : standard deviation of the print errors, mm per component; 0 where the dots were fixed.
    rows, columns : (m,) of the dots seen, from 1.
    offsets, offsets_sigma : (m, 2) mm, print errors of these dots along arc and axis, and their standard errors.
    lens_chi2 : (C,) squared Mahalanobis distance of the adjusted lens from the board's estimate, per parameter: about 1
        or less, unless board and target contradict each other. NaN where no board was used.
    lens_scale : factor by which the boards' standard errors of the lenses had to be enlarged to agree with the target.
    chi2 : (C,) squared residuals of a camera's centroids in units of their variance, per degree of freedom: far above 1
        for a camera that is worse than the others.
    """

    cameras: tuple[str, ...]
    covariance: Floats
    sheet: PrintedSheet
    px_sigma: float
    print_sigma: float
    rows: Indices
    columns: Indices
    offsets: Floats
    offsets_sigma: Floats
    lens_chi2: Floats
    lens_scale: float
    chi2: Floats

    def __post_init__(self) -> None:
        size = PER_CAMERA * len(self.cameras) + 3
        if self.covariance.shape != (size, size) or self.lens_chi2.shape != (len(self.cameras),):
            raise ValueError("the covariance of a bundle adjustment needs sixteen parameters a camera and three more")

    @property
    def camera_sigma(self) -> Floats:
        """Standard errors of each camera's parameters, (C, 16): px or without unit, then rad and mm."""
        return np.sqrt(np.diag(self.covariance)[:-3]).reshape(-1, PER_CAMERA)

    @property
    def sheet_sigma(self) -> Floats:
        """Standard errors of radius (mm), pitch (mm) and tilt (rad) of the sheet, (3,)."""
        return np.sqrt(np.diag(self.covariance)[-3:])

    def pose_covariance(self, ids: Sequence[str]) -> Floats:
        """Covariance (C, 6, 6) of the pose of each of C cameras, rad and mm. ids : of the cameras."""
        numbers = [PER_CAMERA * self.cameras.index(id_) + LENS for id_ in ids]
        return np.stack([self.covariance[k : k + POSE, k : k + POSE] for k in numbers])

    def figures(self, target: Target) -> dict[str, Any]:
        """Figures for the operator, as JSON values: the adjusted target, and one row for each camera.

        Names end in their unit; a name with ``_sigma`` is the standard error of the quantity before it.
        """
        radius, pitch, tilt = (float(value) for value in self.sheet_sigma)
        sigma = self.camera_sigma
        return {
            "centroid_sigma_px": self.px_sigma,
            "print_errors_rms_mm": self.print_sigma,
            "print_errors_largest_mm": float(np.linalg.norm(self.offsets, axis=1).max(initial=0.0)),
            "lens_scale": self.lens_scale,
            "radius_mm": self.sheet.radius,
            "radius_sigma_mm": radius,
            "pitch_mm": self.sheet.pitch,
            "pitch_sigma_mm": pitch,
            "seam_mm": self.sheet.seam(target),
            "tilt_deg": float(np.degrees(self.sheet.tilt)),
            "tilt_sigma_deg": float(np.degrees(tilt)),
            "cameras": [
                {
                    "camera": id_,
                    "focal_sigma_px": sigma[c, :2].tolist(),
                    "centre_sigma_px": sigma[c, 3:5].tolist(),
                    "turn_sigma_deg": np.degrees(sigma[c, 10:13]).tolist(),
                    "shift_sigma_mm": sigma[c, 13:].tolist(),
                    "chi2": float(self.chi2[c]),
                    "lens_chi2": None if np.isnan(self.lens_chi2[c]) else float(self.lens_chi2[c]),
                }
                for c, id_ in enumerate(self.cameras)
            ],
        }

    def to_dict(self) -> dict[str, Any]:
        """The fit as JSON values."""
        return {**json_value(self), "sheet": [self.sheet.radius, self.sheet.pitch, self.sheet.tilt]}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> BundleFit:
        """The fit from the JSON values of :meth:`to_dict`."""
        radius, pitch, tilt = values["sheet"]
        return from_json_value(cls, {**values, "sheet": {"radius": radius, "pitch": pitch, "tilt": tilt}})


def bundle_adjustment(
    calibrations: Mapping[str, CameraCalibration], target: Target, prior: TargetPrior | None = None
) -> tuple[dict[str, CameraCalibration], BundleFit]:
    """Adjust all cameras and the target together to the dots that the cameras see.

    Parameters
    ----------
    calibrations : separate calibrations by camera id, at which the adjustment starts. A lens that was fitted to a board
        counts as an observation with its covariance; a lens from a file is fixed; without distortion, focal lengths,
        skew and principal point are free.
    target : nominal geometry of the target.
    prior : standard deviations of the target's geometry about its nominal values; None is ``TargetPrior()``.

    Returns
    -------
    The calibrations with adjusted cameras and with the dots at their adjusted positions (mm, with print errors), and
    the fit.

    Raises
    ------
    ComputationError : the dots do not determine the cameras.
    """
    prior = prior or TargetPrior()
    ids = tuple(calibrations)
    problem, start = _problem([calibrations[id_] for id_ in ids], target, prior)
    inliers = np.ones(len(problem.px), dtype=bool)
    part, solution = problem, adjust(problem, start, prior.dots)
    for _ in range(4):
        lengths = np.linalg.norm(problem.px - problem.project(solution.state), axis=1)
        now = lengths <= _GROSS * max(solution.scales.px, 1e-6)
        if np.array_equal(now, inliers):
            break
        inliers = now
        part = problem.without(~inliers)
        _require_dots(ids, part)
        solution = adjust(part, solution.state, solution.scales.print)
    log.info(
        "bundle of %d cameras: %d of %d centroids, %.4f px each, print errors %.3f mm, %d steps",
        len(ids),
        inliers.sum(),
        len(inliers),
        solution.scales.px,
        solution.scales.print,
        solution.iterations,
    )
    adjusted = {
        id_: _adjusted_calibration(calibrations[id_], number, problem, inliers, solution)
        for number, id_ in enumerate(ids)
    }
    return adjusted, _fit(ids, part, solution)


def centroid_shift(
    camera: Camera,
    target: Target,
    rows: Indices,
    columns: Indices,
    *,
    rotation: Floats | None = None,
    translation: Vectors | None = None,
) -> Pixels:
    """Bias of the centroids of dots: centroid of the image of each dot minus the projection of its centre.

    Measured centroids minus this bias are projections of points, so that lines of sight through them meet.

    Parameters
    ----------
    rows, columns : (n,) of the dots, from 1.
    rotation, translation : (3, 3) and (3,) mm, motion of the target in the world since the calibration, or None.

    Returns
    -------
    (n, 2) px.
    """
    sheet = PrintedSheet.nominal(target)
    state = CameraParameters.of(camera)
    R, t = state.rotation, state.translation
    t = t if translation is None else t + R @ np.asarray(translation, dtype=float)
    R = R if rotation is None else R @ np.asarray(rotation, dtype=float)
    n = len(rows)
    views = DotViews(
        np.tile(state.inner, (n, 1)),
        np.tile(R, (n, 1, 1)),
        np.tile(t, (n, 1)),
        sheet_points(target, sheet, rows, columns),
        sheet.radius,
    )
    return project_patches(views, target.dot_shape, target.dot_size_mm) - project_centres(views)


def _problem(given: list[CameraCalibration], target: Target, prior: TargetPrior) -> tuple[Problem, State]:
    """Observations and prior knowledge of the adjustment, and the state of the single calibrations."""
    rows = np.concatenate([each.dots.rows for each in given])
    columns = np.concatenate([each.dots.columns for each in given])
    names, dot = np.unique(np.column_stack([columns, rows]), axis=0, return_inverse=True)
    lenses = [_lens(each) for each in given]
    inner = np.array([values for values, _, _ in lenses])
    sheet_sigma = np.array([prior.radius, prior.pitch, prior.tilt])
    free_cameras = np.column_stack([np.array([free for _, _, free in lenses]), np.ones((len(given), 6), dtype=bool)])
    problem = Problem(
        target=target,
        px=np.concatenate([each.dots.px for each in given]),
        camera=np.repeat(np.arange(len(given)), [len(each.dots) for each in given]),
        dot=dot.ravel(),
        rows=names[:, 1],
        columns=names[:, 0],
        lens=inner,
        lens_information=np.array([information for _, information, _ in lenses]),
        sheet_sigma=sheet_sigma,
        free=np.concatenate([free_cameras.ravel(), sheet_sigma > 0]),
    )
    poses = [CameraParameters.of(each.camera) for each in given]
    return problem, State(
        inner,
        np.array([each.rotation for each in poses]),
        np.array([each.translation for each in poses]),
        PrintedSheet.nominal(target),
        np.zeros((len(names), 2)),
    )


def _lens(given: CameraCalibration) -> tuple[Floats, Floats, Mask]:
    """Parameters of a camera's lens (10,), their prior information (10, 10), and which are free (10,)."""
    information, free = np.zeros((10, 10)), np.zeros(10, dtype=bool)
    if given.camera.intrinsics is None:
        free[:5] = True
    elif given.fit is not None:
        free = given.fit.sigma > 0
        sigma = given.fit.sigma[free]
        correlation = given.fit.covariance[np.ix_(free, free)] / np.outer(sigma, sigma)
        inflation = max(1.0, 2 * _CORNER_SIGMA**2 / max(given.fit.rms**2, 1e-12))
        information[np.ix_(free, free)] = np.linalg.pinv(correlation) / np.outer(sigma, sigma) / inflation
    return CameraParameters.of(given.camera).inner, information, free


def _require_dots(ids: tuple[str, ...], part: Problem) -> None:
    """Raise ComputationError, naming the camera, where fewer than 12 dots of one are inliers."""
    for number, id_ in enumerate(ids):
        count = int((part.camera == number).sum())
        if count < 12:
            raise ComputationError(
                f"camera {id_}: only {count} of its dots lie where a camera with its lens can see them; check that the "
                "images of board and target are of this camera, sharp and unscaled"
            )


def _adjusted_calibration(
    given: CameraCalibration, number: int, problem: Problem, inliers: Mask, solution: Solution
) -> CameraCalibration:
    """The calibration of camera ``number`` after the adjustment. inliers : (n,) observations without gross errors."""
    state = solution.state
    parameters = CameraParameters(state.inner[number], state.rotation[number], state.translation[number])
    camera = parameters.camera(given.camera)
    own = problem.camera == number
    dot = problem.dot[own & inliers]
    centroid = problem.project(state)[own & inliers]
    sz = sheet_points(problem.target, state.sheet, problem.rows, problem.columns) + state.offsets
    s, z = sz[dot].T
    xyz = cylinder_points(state.sheet.radius, s / state.sheet.radius, z)
    dots = replace(given.dots.subset(inliers[own]), xyz=xyz)
    return replace(
        given,
        camera=camera,
        dots=dots,
        residuals=camera.undistort(dots.px) - camera.undistort(centroid),
        left_out=given.left_out + int((~inliers[own]).sum()),
        centroid_shift=centroid - problem.project_centres(state)[own & inliers],
        held_out=solution.held_out[own[inliers]],
    )


def _fit(ids: tuple[str, ...], part: Problem, solution: Solution) -> BundleFit:
    """The fit of a solution of the problem without gross errors."""
    state = solution.state
    dots_sigma = np.sqrt(np.einsum("mii->mi", solution.dots_covariance))
    count = part.free[:-3].reshape(-1, PER_CAMERA)[:, :10].sum(axis=1)
    known = part.lens_information.any(axis=(1, 2))
    return BundleFit(
        ids,
        solution.covariance,
        state.sheet,
        solution.scales.px,
        solution.scales.print,
        part.rows,
        part.columns,
        state.offsets,
        dots_sigma if len(dots_sigma) else np.zeros_like(state.offsets),
        np.where(known, part.lens_gap(state) / np.maximum(count, 1), np.nan),
        solution.scales.lens,
        solution.chi2,
    )
