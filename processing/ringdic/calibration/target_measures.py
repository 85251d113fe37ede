"""Which measures of the target explain all cameras at once: those of rig.toml, or others, and by how much they are off.

Hypotheses are compared by how well each explains the lenses that the cameras' images of the target imply: that all
measures are right, that one of row spacing, radius or column spacing is wrong, or two. A camera that no hypothesis
explains counts with a limited weight, so that one lens that was touched is not taken for a wrong target.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats, Vectors
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.patch import PrintedSheet
from ringdic.calibration.target_evidence import CameraEvidence, SheetChange, camera_evidence
from ringdic.session.rig import Target

#: Squared Mahalanobis distance of two lenses beyond which they contradict each other: for ten parameters, χ² exceeds it
#: by chance in one of 10¹⁶ cameras, and in one of 10⁵ where errors are 1.6 times as large as stated.
CONTRADICTION = 100.0
#: By how much a hypothesis must lower the misfit for each measure that it releases: six standard errors.
_GAIN = 36.0
_MOST_ROUNDS = 6
#: Change of a measure, as a part of it, over which the evidence is taken for linear.
_LINEAR = 3e-4


@dataclass(frozen=True)
class TargetMeasures:
    """The target's measures as the images have them, in relation to one another.

    wrong : the measure that is off: "rows", "radius", "columns", "radius and columns", or "" where those of rig.toml
        explain the images best.
    sheet : radius (mm), column spacing (mm) and tilt (rad) of the printed sheet, for the row spacing of rig.toml.
    off, sigma : deviation of the measure that is wrong as a part of it, and its standard error; of two, the larger.
    evidence : of each camera. change : the sheet minus that with which the cameras were fitted there. stated_change :
        (3,) mm, mm, rad, the sheet of rig.toml minus that.
    """

    wrong: str
    sheet: PrintedSheet
    off: float
    sigma: float
    evidence: tuple[CameraEvidence, ...]
    change: SheetChange
    stated_change: Vectors


def target_measures(
    calibrations: Mapping[str, CameraCalibration], target: Target, tolerance: tuple[float, float] = (0.002, 0.002)
) -> TargetMeasures | None:
    """The simplest measures of the target that explain what all cameras see of it.

    calibrations : by camera id, of each camera alone, with its lens from the boards. tolerance : deviations of radius
    and column spacing that say nothing, as parts of them.

    None where no camera's image of the target determines its lens.
    """
    nominal = np.array([target.radius_mm, target.column_spacing_mm, 0.0])
    low, high = 0.5 * nominal - [0, 0, 0.2], 1.8 * nominal + [0, 0, 0.2]
    views = _views_of_a_dot(calibrations)
    evidence = _evidence(calibrations, target, nominal)
    if not evidence:
        return None

    def followed(fit: _Fit, others: slice, rounds: int) -> _Round:
        """The cheapest of some hypotheses, with evidence taken at its own sheet."""
        now = _Round(fit, evidence, nominal, nominal)
        for _ in range(rounds):
            if np.all(np.abs(now.fit.sheet[:2] / now.at[:2] - 1) < _LINEAR):
                break
            at = np.clip(now.fit.sheet, low, high)
            again = _evidence(calibrations, target, at)
            fits = _fits(again, nominal, at, views, tolerance)[others]
            now = _Round(min(fits, key=lambda each: each.cost), again, nominal, at)
        return now

    as_stated, *others = _fits(evidence, nominal, nominal, views, tolerance)
    best = min(others, key=lambda fit: fit.cost)
    contradiction = any(each.distance(SheetChange(as_stated.sheet - nominal)) > CONTRADICTION for each in evidence)
    stated = followed(as_stated, slice(0, 1), 2)
    if not contradiction and best.cost >= as_stated.cost:
        return stated.measures
    # What is far off looks wrong for every hypothesis, until the one with the most freedom is followed there.
    other = followed(best if best.cost < as_stated.cost else others[-1], slice(1, None), _MOST_ROUNDS)
    return min(stated, other, key=lambda each: each.fit.cost).measures


@dataclass(frozen=True)
class _Fit:
    """A hypothesis with its best values. cost : misfit of all cameras and its own price.

    sheet, covariance : (3,) mm, mm, rad and (3, 3).
    """

    wrong: str
    sheet: Vectors
    covariance: Floats
    cost: float
    off: float
    sigma: float


@dataclass(frozen=True)
class _Round:
    """A hypothesis, and the evidence for it.

    nominal, at : (3,) mm, mm, rad, the sheet of rig.toml and that with which the evidence was taken.
    """

    fit: _Fit
    evidence: tuple[CameraEvidence, ...]
    nominal: Vectors
    at: Vectors

    @property
    def measures(self) -> TargetMeasures:
        """The hypothesis as the measures of the target."""
        fit, change = self.fit, SheetChange(self.fit.sheet - self.at, self.fit.covariance)
        sheet, stated = PrintedSheet(*map(float, fit.sheet)), self.nominal - self.at
        return TargetMeasures(fit.wrong, sheet, fit.off, fit.sigma, self.evidence, change, stated)


def _evidence(
    calibrations: Mapping[str, CameraCalibration], target: Target, sheet: Vectors
) -> tuple[CameraEvidence, ...]:
    """Evidence of the cameras whose dots determine their lens, for a sheet (3,) mm, mm, rad."""
    evidence = []
    for calibration in calibrations.values():
        try:
            evidence.append(camera_evidence(calibration, target, PrintedSheet(*sheet)))
        except np.linalg.LinAlgError:
            continue
    return tuple(evidence)


def _views_of_a_dot(calibrations: Mapping[str, CameraCalibration]) -> float:
    """Mean number of cameras that see a dot: one print error counts as often."""
    dots = np.concatenate([np.column_stack([each.dots.rows, each.dots.columns]) for each in calibrations.values()])
    return len(dots) / len(np.unique(dots, axis=0))


def _fits(
    evidence: Sequence[CameraEvidence], nominal: Vectors, at: Vectors, views: float, tolerance: tuple[float, float]
) -> list[_Fit]:
    """The best values of every hypothesis, the first that nothing is wrong but for the tolerance of the measures.

    at : (3,), where the evidence was taken. The tilt of the sheet, which rig.toml does not state, is always free.
    """
    radius, columns, tilt = np.diag([nominal[0], nominal[1], 1.0])
    hypotheses = [
        ("", [radius, columns, tilt]),
        ("rows", [radius + columns, tilt]),
        ("radius", [radius, tilt]),
        ("columns", [columns, tilt]),
        ("radius and columns", [radius, columns, tilt]),
    ]
    return [
        _fit(name, np.column_stack(basis), evidence, nominal, at, views, None if name else np.array(tolerance))
        for name, basis in hypotheses
    ]


def _fit(
    name: str,
    basis: Floats,
    evidence: Sequence[CameraEvidence],
    nominal: Vectors,
    at: Vectors,
    views: float,
    tolerance: Floats | None,
) -> _Fit:
    """The best values of one hypothesis, sheet = nominal + basis q. basis : (3, k). tolerance : (k − 1,) of q, or None.

    A camera's misfit counts up to the limit of a contradiction. The least sum is sought from the values that all
    cameras together would have and from those that each one would.
    """
    normals = [each.normal() for each in evidence]
    matrices = np.array([basis.T @ N @ basis for N, _ in normals])
    pulls = np.array([basis.T @ (b + N @ (at - nominal)) for N, b in normals])
    everyone = np.ones(len(evidence), dtype=bool)
    best = (math.inf, np.zeros(basis.shape[1]), everyone)
    for start in [everyone, *(np.eye(len(evidence), dtype=bool) if len(evidence) > 1 else [])]:
        used = start
        for _ in range(5):
            q = _bounded(matrices[used].sum(axis=0), pulls[used].sum(axis=0), tolerance)
            misfit = np.array([each.misfit(nominal + basis @ q - at) for each in evidence])
            now = misfit < CONTRADICTION
            if now.any() and not np.array_equal(now, used):
                used = now
                continue
            break
        cost = float(np.minimum(misfit, CONTRADICTION).sum())
        if cost < best[0]:
            best = (cost, q, used)
    cost, q, used = best
    covariance = views * np.linalg.pinv(matrices[used].sum(axis=0))
    sigma = np.sqrt(np.diag(covariance))
    released = len(q) - 1 if name else 0
    most = int(np.argmax(np.abs(q[:released]))) if released else 0
    off, own = (float(q[most]), float(sigma[most])) if released else (0.0, 0.0)
    if name == "rows":  # all other measures are as much smaller
        off, own = 1 / (1 + off) - 1, own / (1 + off) ** 2
    return _Fit(name, nominal + basis @ q, basis @ covariance @ basis.T, cost + _GAIN * views * released, off, own)


def _bounded(N: Floats, b: Vectors, tolerance: Floats | None) -> Vectors:
    """Solution q (k,) of ``N q = b``; all but the last, the tilt, are at most the tolerance (k − 1,) in size."""
    q = np.asarray(np.linalg.lstsq(N, b, rcond=None)[0])
    if tolerance is None:
        return q
    most = np.append(tolerance, np.inf)
    held = np.zeros(len(q), dtype=bool)
    for _ in range(len(tolerance)):
        held |= np.abs(q) > most
        q = np.clip(q, -most, most)
        q[~held] = np.linalg.lstsq(N[np.ix_(~held, ~held)], b[~held] - N[np.ix_(~held, held)] @ q[held], rcond=None)[0]
    return np.clip(q, -most, most)
