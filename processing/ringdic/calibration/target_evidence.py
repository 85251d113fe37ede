"""What the image of the target alone says about a camera's lens and the target's measures, held against the boards.

Each camera is fitted to its dots with every parameter of its lens free, knowing nothing of the boards. The lens that
comes out agrees with that of the boards within their errors, if the lens was not touched in between and the target has
the measures of rig.toml. Both kinds of fault move the lens, in different ways: a lens that was refocused moves one
camera's focal length; a wrong radius moves those of all cameras, by amounts that the radius determines.

Only ratios of the target's measures can be known. A target whose rows, columns, radius and dots are all larger by the
same factor gives the same images from a distance larger by that factor. So the distance of the rows is taken as given,
and the radius, the distance of the columns and the tilt of the printed sheet are told in relation to it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ringdic.arrays import Floats, Mask, Pixels, Vectors
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.parameters import LENS, CameraParameters
from ringdic.calibration.patch import DotViews, PrintedSheet, patch_jacobians, sheet_jacobians, sheet_points
from ringdic.session.rig import Target

#: Robust weights: residuals longer than this many σ count linearly. Median of the length of a vector of two numbers of
#: variance 1.
_HUBER, _MEDIAN_LENGTH = 3.0, 1.1774
#: Least standard deviation of a dot's place that is supposed, mm.
_DOT_FLOOR = 5e-4
_MOST_STEPS = 12
#: The lens is fitted with standard errors of the boards this many times as large, so that what the dots do not
#: determine stays where it is; one linear step from there gives the lens of the dots alone. Where that step lowers
#: their squared residuals by more than so many variances, the boards are left out.
_LOOSE, _PULLED = 10.0, 25.0
#: Standard errors of a lens that no board was used for. From a file: of focal lengths, their ratio, skew and centre as
#: parts of the focal length, and of the five distortion terms. Without a lens, only that pixels are square is known.
_FILE, _FILE_TERMS = (1e-3, 3e-4, 3e-4, 1e-3), (2e-3, 1e-2, 2e-4, 2e-4, 1e-2)
_BARE, _BARE_TERMS = (1.0, 3e-3, 3e-3, 1.0), (1.0, 10.0, 1.0, 1.0, 100.0)


@dataclass(frozen=True)
class BoardLens:
    """What is known of a camera's lens without its target.

    values : (10,) fx fy s cx cy k1 k2 p1 p2 k3, px or without unit. covariance : (10, 10) of these. free : (10,) bool,
    the parameters that are not fixed. size : (width, height) of the image, px.
    """

    values: Floats
    covariance: Floats
    free: Mask
    size: tuple[int, int]

    @classmethod
    def of(cls, calibration: CameraCalibration) -> BoardLens:
        """The lens that the boards give, that of a file, or, without either, one with square pixels.

        The covariance of a fit to boards is that of as many corners as are independent.
        """
        inner, fit, size = CameraParameters.of(calibration.camera).inner, calibration.fit, calibration.camera.size
        if fit is not None:
            return cls(inner, fit.covariance * fit.redundancy_factor, fit.sigma > 0, size)
        bare = calibration.camera.intrinsics is None
        (focal, ratio, skew, centre), terms = (_BARE, _BARE_TERMS) if bare else (_FILE, _FILE_TERMS)
        f = float(np.sqrt(inner[0] * inner[1]))
        if bare:
            inner = np.array([f, f, 0.0, 0.5 * (size[0] - 1), 0.5 * (size[1] - 1), *np.zeros(5)])
        covariance = np.diag([0.0, 0.0, (f * skew) ** 2, *[(f * centre) ** 2] * 2, *np.square(terms)])
        covariance[:2, :2] = f * f * (focal**2 + 0.5 * ratio**2 * np.eye(2))
        return cls(inner, covariance, np.ones(LENS, dtype=bool), size)

    def mirrored(self, across: bool, along: bool) -> BoardLens:
        """The lens as images would show it that are mirrored left to right, upside down, or both (turned by 180°)."""
        x, y = (-1.0 if each else 1.0 for each in (across, along))
        signs = np.array([1, 1, x * y, x, y, 1, 1, y, x, 1])
        values = signs * self.values
        values[3:5] += [(self.size[0] - 1) * across, (self.size[1] - 1) * along]
        return BoardLens(values, self.covariance * np.outer(signs, signs), self.free, self.size)


@dataclass(frozen=True)
class SheetChange:
    """Change of radius (mm), pitch (mm) and tilt (rad) of a sheet: values (3,), and their covariance (3, 3)."""

    values: Vectors
    covariance: Floats = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True)
class CameraEvidence:
    """Lens of one camera as its image of the target alone has it, and what that says about the target's measures.

    camera : its id. lens : (10,) fx fy s cx cy k1 k2 p1 p2 k3, px or without unit. covariance : (10, 10) of these.
    by_sheet : (10, 3) derivatives of the lens with respect to radius, pitch (mm) and tilt (rad) of the sheet.
    sheet_information, sheet_pull : (3, 3) and (3,), what the residuals of the dots themselves say about the sheet:
        normal matrix and right side, per variance, with lens and pose eliminated.
    dot_sigma : mm, RMS distance of a dot from its place in one direction of the target's surface.
    px_sigma : the same in the image, px.
    board : the lens without the target.
    """

    camera: str
    lens: Floats
    covariance: Floats
    by_sheet: Floats
    sheet_information: Floats
    sheet_pull: Vectors
    dot_sigma: float
    px_sigma: float
    board: BoardLens

    def gap(self, sheet: SheetChange, board: BoardLens | None = None) -> tuple[Floats, Floats]:
        """Lens by the target minus that by the boards (p,), and its covariance (p, p), of the free parameters.

        In px or without unit. sheet : change of the sheet's measures from those that the camera was fitted with.
        board : lens to compare with, None for the camera's own.
        """
        board = board or self.board
        free = board.free & self.board.free
        gap = self.lens + self.by_sheet @ sheet.values - board.values
        covariance = self.covariance + board.covariance + self.by_sheet @ sheet.covariance @ self.by_sheet.T
        return gap[free], covariance[np.ix_(free, free)]

    def distance(self, sheet: SheetChange, board: BoardLens | None = None) -> float:
        """Squared Mahalanobis distance of the two lenses: about 10, their parameters, if nothing contradicts.

        sheet, board : as for :meth:`gap`.
        """
        gap, covariance = self.gap(sheet, board)
        return float(gap @ _solved(covariance, gap))

    def focal_gap(self, sheet: SheetChange) -> tuple[float, float]:
        """By which part both focal lengths are longer by the target, where all else agrees, and the standard error.

        sheet : as for :meth:`gap`.
        """
        off, sigma, _ = self._change_that_fits(sheet, np.eye(1, 3))
        return float(off[0]), float(sigma[0])

    def distance_if_refocused(self, sheet: SheetChange) -> float:
        """The distance of the two lenses after a change of focal length and principal point.

        sheet : (3,) mm, mm, rad, as for :meth:`gap`.
        """
        return self._change_that_fits(sheet, np.eye(3))[2]

    def _change_that_fits(self, sheet: SheetChange, which: Floats) -> tuple[Floats, Floats, float]:
        """Change of the boards' lens that fits the target best, its standard errors, and the distance that is left.

        which : (j, 3), combinations of the focal lengths as a part of them and the principal point's x and y, px.
        """
        gap, covariance = self.gap(sheet)
        ways = np.zeros((3, LENS))
        ways[0, :2], ways[1, 3], ways[2, 4] = self.board.values[:2], 1.0, 1.0
        ways = (which @ ways)[:, self.board.free]
        weighted = _solved(covariance, np.column_stack([gap, ways.T]))
        N = ways @ weighted[:, 1:]
        change = _solved(N, ways @ weighted[:, 0])
        left = float(gap @ weighted[:, 0] - change @ N @ change)
        return change, np.sqrt(np.diag(_solved(N, np.eye(len(N))))), left

    def misfit(self, sheet: Vectors) -> float:
        """The distance, and by how much the residuals of the dots exceed their least, in units of their variance.

        sheet : (3,) mm, mm, rad, change of the sheet's measures.
        """
        best = _solved(self.sheet_information, self.sheet_pull)
        off = sheet - best
        return self.distance(SheetChange(sheet)) + float(off @ self.sheet_information @ off)

    def normal(self) -> tuple[Floats, Vectors]:
        """Normal matrix (3, 3) and right side (3,) of the misfit as a function of the sheet's mm, mm and rad."""
        gap, covariance = self.gap(SheetChange(np.zeros(3)))
        by_sheet = self.by_sheet[self.board.free]
        weighted = _solved(covariance, np.column_stack([by_sheet, gap]))
        pull = self.sheet_pull - by_sheet.T @ weighted[:, 3]
        return self.sheet_information + by_sheet.T @ weighted[:, :3], pull


def camera_evidence(calibration: CameraCalibration, target: Target, sheet: PrintedSheet) -> CameraEvidence:
    """Fit a camera to its dots with a free lens, for a target with the measures of ``sheet``.

    Raises numpy.linalg.LinAlgError where the dots do not determine the lens.
    """
    board = BoardLens.of(calibration)
    at = np.flatnonzero(board.free)
    free = np.append(board.free, np.ones(6, dtype=bool))
    k, p = int(free.sum()), len(at)
    information = np.zeros((k, k))
    information[:p, :p] = _solved(board.covariance[np.ix_(at, at)], np.eye(p)) / _LOOSE**2
    state = CameraParameters.of(calibration.camera)
    for _ in range(_MOST_STEPS):
        J, by_dot, r = _linearised(state, calibration, target, sheet)
        W = _weights(by_dot, r)
        J = J[..., np.append(free, np.ones(3, dtype=bool))]
        JW = np.einsum("nia,nij->anj", J, W)
        N, b = np.einsum("anj,njb->ab", JW, J), np.einsum("anj,nj->a", JW, r)
        to_free = _solved(N[:k, :k], b[:k])
        squares = float(np.einsum("ni,nij,nj->", r, W, r)) - float(to_free @ b[:k])
        variance = max(squares / max(2 * len(r) - k, 1), _DOT_FLOOR**2)
        right = b[:k] + variance * information[:, :p] @ (board.values - state.inner)[at]
        step = np.zeros(LENS + 6)
        step[free] = _solved(N[:k, :k] + variance * information, right)
        if step[free] @ right < 1e-2 * variance:  # it changes nothing by more than a tenth of its standard error
            if not information.any() or to_free @ b[:k] < _PULLED * variance:
                break
            information[:] = 0.0
            continue
        state = state.plus(step)
    by_rest = _solved(N[:k, :k], N[:k, k:])
    lens, covariance, by_sheet = state.inner.copy(), np.zeros((LENS, LENS)), np.zeros((LENS, 3))
    lens[at] += to_free[:p]
    covariance[np.ix_(at, at)] = variance * _solved(N[:k, :k], np.eye(k))[:p, :p]
    by_sheet[at] = -by_rest[:p]
    return CameraEvidence(
        calibration.dots.camera, lens, covariance, by_sheet,
        (N[k:, k:] - N[k:, :k] @ by_rest) / variance, (b[k:] - by_rest.T @ b[:k]) / variance,
        float(np.sqrt(variance)), float(np.sqrt(2 * variance * np.mean(by_dot**2))), board,
    )  # fmt: skip


def _linearised(
    state: CameraParameters, calibration: CameraCalibration, target: Target, sheet: PrintedSheet
) -> tuple[Floats, Floats, Pixels]:
    """Derivatives of the dots' centroids by camera and sheet (n, 2, 19) and by their places (n, 2, 2), and residuals.

    The residuals are (n, 2) px; the places are along arc and axis, mm.
    """
    dots = calibration.dots
    n = len(dots)
    views = DotViews(
        np.tile(state.inner, (n, 1)),
        np.tile(state.rotation, (n, 1, 1)),
        np.tile(state.translation, (n, 1)),
        sheet_points(target, sheet, dots.rows, dots.columns),
        sheet.radius,
    )
    px, by_lens, by_pose, by_dot, by_radius = patch_jacobians(views, target.dot_shape, target.dot_size_mm)
    by_sheet = by_dot @ sheet_jacobians(target, dots.rows, dots.columns)
    return np.concatenate([by_lens, by_pose, by_radius, by_sheet], axis=-1), by_dot, dots.px - px


def _weights(by_dot: Floats, r: Pixels) -> Floats:
    """Weight matrices (n, 2, 2) mm²/px² of centroids, of robust least squares: px² times these is a variance in mm².

    Half of the variance is supposed to be the print's, seen through the camera, and half the image's. by_dot :
    (n, 2, 2) px/mm. r : (n, 2) px, residuals.
    """
    square = np.einsum("nij,nkj->nik", by_dot, by_dot)
    W = np.linalg.inv(0.5 * square + 0.25 * np.mean(np.trace(square, axis1=1, axis2=2)) * np.eye(2))
    length = np.sqrt(np.einsum("ni,nij,nj->n", r, W, r))
    sigma = float(np.median(length)) / _MEDIAN_LENGTH
    return np.asarray(W * np.minimum(1.0, _HUBER * sigma / np.maximum(length, 1e-300))[:, None, None])


def _solved(A: Floats, b: Floats) -> Floats:
    """Solution of ``A x = b`` for a symmetric A (k, k) whose parameters have different units; b : (k,) or (k, j)."""
    scale = 1 / np.sqrt(np.diag(A))
    right = scale * b if b.ndim == 1 else scale[:, None] * b
    x = np.linalg.solve(A * np.outer(scale, scale), right)
    return np.asarray(scale * x if b.ndim == 1 else scale[:, None] * x)
