"""All cameras of a ring and their target adjusted together: what the direct linear transformation starts, ended.

Dots are observed as the centroids of the images of printed patches, lenses are known from the boards with their full
covariance, and the printed dots may lie off their places. Where the lens is free and centroids are taken for centres,
the focal length absorbs the difference and every diameter comes out too large, with no residual that would tell.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.calibration.adjustment import Problem, Solution, State, adjust
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.parameters import PER_CAMERA, Parameters
from ringdic.calibration.patch import PrintedSheet, Views, project_centres, project_patches, sheet_points, wrapped
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.session.rig import Target

log = logging.getLogger(__name__)

#: Corners of a board are not trusted to better than this, px a component.
_CORNER_SIGMA = 0.005
#: A centroid further off than this many σ is a gross error.
_GROSS = 6.0


@dataclass(frozen=True)
class TargetPrior:
    """How far the target may be from its description, as standard deviations; 0 holds it.

    dots : of a dot's place on the sheet, mm in each direction; what is found in the images takes the number's place.
    radius, pitch : mm. tilt : of the sheet in its surface, rad. The rows' distance is the scale of everything.
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
    """What the adjustment found beside the cameras.

    cameras : C ids, in the order of the parameters.
    covariance : (16 C + 3, 16 C + 3) of ``fx fy s cx cy k1 k2 p1 p2 k3``, ω, τ of each camera, then radius, pitch and
        tilt. A pose moves as ``R ← exp([ω]×) R``, ``t ← t + τ``; rad and mm. Zero for what was held.
    sheet : as adjusted.
    px_sigma : standard deviation of a centroid, px a component, from the residuals' median.
    print_sigma : the same of the print errors, mm a direction; 0 where the dots were held.
    rows, columns : (m,) dots seen. offsets, offsets_sigma : (m, 2) their print errors along arc and axis, mm.
    lens_chi2 : (C,) squared distance of the lens from the board's, in units of the board's covariance, a parameter:
        about 1 or less, or board and target contradict each other. NaN where no board was used.
    lens_scale : by what the boards' standard errors of the lenses had to be multiplied to agree with the target.
    chi2 : (C,) squared residuals of a camera's centroids in units of their variance, a degree of freedom: a camera far
        above 1 is worse than the others.
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
        """Standard errors of each camera's parameters. (C, 16)."""
        return np.sqrt(np.diag(self.covariance)[:-3]).reshape(-1, PER_CAMERA)

    @property
    def sheet_sigma(self) -> Floats:
        """Standard errors of radius, pitch (mm) and tilt (rad). (3,)."""
        return np.sqrt(np.diag(self.covariance)[-3:])

    def figures(self, target: Target) -> dict[str, Any]:
        """What an operator reads, as JSON values: the target as found, and a row a camera.

        Lengths mm, ``_px`` px; each ``_sigma`` is the standard error of what it follows.
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
        """Everything as JSON values."""
        return {
            "cameras": list(self.cameras),
            "covariance": self.covariance.tolist(),
            "sheet": [self.sheet.radius, self.sheet.pitch, self.sheet.tilt],
            "px_sigma": self.px_sigma,
            "print_sigma": self.print_sigma,
            "rows": self.rows.tolist(),
            "columns": self.columns.tolist(),
            "offsets": self.offsets.tolist(),
            "offsets_sigma": self.offsets_sigma.tolist(),
            "lens_chi2": [None if np.isnan(value) else float(value) for value in self.lens_chi2],
            "lens_scale": self.lens_scale,
            "chi2": self.chi2.tolist(),
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> BundleFit:
        """The fit of :meth:`to_dict`."""
        return cls(
            tuple(values["cameras"]),
            np.array(values["covariance"], dtype=float),
            PrintedSheet(*(float(value) for value in values["sheet"])),
            float(values["px_sigma"]),
            float(values["print_sigma"]),
            np.array(values["rows"], dtype=np.intp),
            np.array(values["columns"], dtype=np.intp),
            np.array(values["offsets"], dtype=float).reshape(-1, 2),
            np.array(values["offsets_sigma"], dtype=float).reshape(-1, 2),
            np.array([np.nan if value is None else value for value in values["lens_chi2"]], dtype=float),
            float(values["lens_scale"]),
            np.array(values["chi2"], dtype=float),
        )


def adjust_ring(
    calibrations: Mapping[str, CameraCalibration], target: Target, prior: TargetPrior | None = None
) -> tuple[dict[str, CameraCalibration], BundleFit]:
    """Cameras and target adjusted together.

    calibrations : of the single cameras by id, the start. Lenses fitted to a board are observations with their
        covariance, lenses given otherwise are held, and where distortion is not corrected focal lengths, skew and
        centre are free.
    prior : of the target; None is ``TargetPrior()``.

    Returns the calibrations with adjusted cameras, with dots at the places found (mm, the print errors in them), and
    the fit. Raises ComputationError where the dots do not determine the cameras.
    """
    prior = prior or TargetPrior()
    ids = tuple(calibrations)
    problem, start = _problem([calibrations[id_] for id_ in ids], target, prior)
    kept = np.ones(len(problem.px), dtype=bool)
    part, solution = problem, adjust(problem, start, prior.dots)
    for _ in range(4):
        lengths = np.linalg.norm(problem.px - problem.project(solution.state), axis=1)
        now = lengths <= _GROSS * max(solution.scales.px, 1e-6)
        if np.array_equal(now, kept):
            break
        kept = now
        part = problem.without(~kept)
        _require_dots(ids, part)
        solution = adjust(part, solution.state, solution.scales.print)
    log.info(
        "bundle of %d cameras: %d of %d centroids, %.4f px each, print errors %.3f mm, %d steps",
        len(ids),
        kept.sum(),
        len(kept),
        solution.scales.px,
        solution.scales.print,
        solution.iterations,
    )
    adjusted = {
        id_: _adjusted(calibrations[id_], number, problem, kept, solution.state) for number, id_ in enumerate(ids)
    }
    return adjusted, _fit(ids, part, solution)


def centroid_shift(
    camera: Camera,
    target: Target,
    rows: Indices,
    columns: Indices,
    *,
    sheet: PrintedSheet | None = None,
    rotation: Floats | None = None,
    translation: Floats | None = None,
) -> Floats:
    """Centroid of the image of each dot minus the image of its centre, for a target that was moved. (n, 2) px.

    Measured centroids less this are images of points, which lines of sight through them meet.

    rows, columns : (n,), from 1. sheet : as adjusted, else the nominal one.
    rotation : (3, 3) and translation : (3,) mm, of the target in the world; none leaves it in place.
    """
    sheet = sheet or PrintedSheet.nominal(target)
    state = Parameters.of(camera)
    R, t = state.rotation, state.translation
    t = t if translation is None else t + R @ np.asarray(translation, dtype=float)
    R = R if rotation is None else R @ np.asarray(rotation, dtype=float)
    n = len(rows)
    views = Views(
        np.tile(state.inner, (n, 1)),
        np.tile(R, (n, 1, 1)),
        np.tile(t, (n, 1)),
        sheet_points(target, sheet, rows, columns),
        sheet.radius,
    )
    return project_patches(views, target.dot_shape, target.dot_size_mm) - project_centres(views)


def _problem(given: list[CameraCalibration], target: Target, prior: TargetPrior) -> tuple[Problem, State]:
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
    poses = [Parameters.of(each.camera) for each in given]
    return problem, State(
        inner,
        np.array([each.rotation for each in poses]),
        np.array([each.translation for each in poses]),
        PrintedSheet.nominal(target),
        np.zeros((len(names), 2)),
    )


def _lens(given: CameraCalibration) -> tuple[Floats, Floats, Mask]:
    """Parameters of a lens (10,), what is known of them (10, 10), and which are free (10,)."""
    information, free = np.zeros((10, 10)), np.zeros(10, dtype=bool)
    if given.camera.intrinsics is None:
        free[:5] = True
    elif given.fit is not None:
        free = given.fit.sigma > 0
        sigma = given.fit.sigma[free]
        correlation = given.fit.covariance[np.ix_(free, free)] / np.outer(sigma, sigma)
        inflation = max(1.0, 2 * _CORNER_SIGMA**2 / max(given.fit.rms**2, 1e-12))
        information[np.ix_(free, free)] = np.linalg.pinv(correlation) / np.outer(sigma, sigma) / inflation
    return Parameters.of(given.camera).inner, information, free


def _require_dots(ids: tuple[str, ...], part: Problem) -> None:
    for number, id_ in enumerate(ids):
        found = int((part.camera == number).sum())
        if found < 12:
            raise ComputationError(
                f"camera {id_}: only {found} of its dots lie where a camera with its lens can see them; check that the "
                "images of board and target are of this camera, sharp and unscaled"
            )


def _adjusted(given: CameraCalibration, number: int, problem: Problem, kept: Mask, state: State) -> CameraCalibration:
    """One camera's calibration after the adjustment."""
    found = Parameters(state.inner[number], state.rotation[number], state.translation[number])
    camera = found.camera(given.camera)
    own = problem.camera == number
    keep = kept[own]
    dot = problem.dot[own & kept]
    centroid = problem.project(state)[own & kept]
    sz = sheet_points(problem.target, state.sheet, problem.rows, problem.columns) + state.offsets
    dots = replace(given.dots.chosen(keep), xyz=wrapped(sz[dot], state.sheet.radius))
    return replace(
        given,
        camera=camera,
        dots=dots,
        residuals=camera.undistort(dots.px) - camera.undistort(centroid),
        left_out=given.left_out + int((~keep).sum()),
        centroid_shift=centroid - problem.project_centres(state)[own & kept],
    )


def _fit(ids: tuple[str, ...], part: Problem, solution: Solution) -> BundleFit:
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
