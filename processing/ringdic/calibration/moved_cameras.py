"""Cameras that moved or were refocused, found and followed by matched points of a specimen.

All other cameras hold the world where it is. The cost ``Σ ρ(r / σ) + Σ_c ρ_c(p_cᵀ Σ_c⁻¹ p_c)`` is minimised over the
points and a small motion p_c = (ω, τ, φ) of each camera: of its pose, and the relative change φ of its focal length. r
are the reprojection residuals with Huber's ρ; Σ_c is the covariance of a camera that stands still. ρ_c is the cost of
Geman and McClure: a camera's prior counts the less the more the points contradict it (iteratively reweighted least
squares), so that the motion of one camera is not spread over all. Where that shows a motion, cameras are freed one
after the other, that which explains most first, its pose, its focal length or both, and all others stand still; where
more than three or half have moved, all are free, and the smallest motion that fits is taken. The points are eliminated
from the normal equations (Schur complement).

Two cameras that see a point each along one line tell all of their motion against each other but its scale. What moves
all cameras alike cannot be told from a rigid motion of the body.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ringdic.arrays import Floats, Mask, Pixels
from ringdic.calibration.adjustment import HUBER, huber_weights
from ringdic.calibration.parameters import LENS, PER_CAMERA, POSE, CameraParameters, projection_jacobians
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import reprojection_residuals, triangulate

#: Parameters of a camera's motion: ω (rad), τ (mm), and the relative change of the focal length.
MOTION = POSE + 1
#: Shift of a camera's image beyond which it has moved, or its lens was refocused, px.
MOVED_PX = 0.06
#: Shift of the images where all cameras moved, px, beyond which the motion of each is not known.
ADRIFT_PX = 3.0
_FOLLOWED_BY_TWO_PX = 1.0  # least motion that is followed with two cameras
_FARTHEST_PX = 60.0  # greatest motion that is followed; more would be another image, not a bump
#: Most points that are used, and fewest that are needed.
_MOST, _FEWEST = 3000, 50
_STILL_PX, _UNKNOWN_PX = 0.02, 0.3  # px, motion in the image of a camera that stands still, and of one that may move
_MOST_REFOCUSED = 0.2  # relative change of a focal length, beyond which points that contradict one another lead
_FIXED = 1e-12  # standard deviation of the relative change of a focal length that is not freed
_TAIL = 3.0  # squares of σ, for each of the six parameters of a pose, at which a motion's weight is a quarter
#: Robust ratio of residuals to their standard deviations, and their RMS, px, beyond which motions of the cameras do not
#: explain them. A lens that its model does not describe quite leaves some hundredths of a pixel.
UNEXPLAINED, _UNEXPLAINED_PX = 3.0, 0.1
_MEDIAN_OF_CHI2 = 2.0 * np.log(2.0)  # with two degrees of freedom
_FEW = 3  # cameras at most that are freed alone
_PRICE = 50.0  # squares of σ that a freed pose must explain, and a freed focal length
_SCREENED, _SCREENING_STEPS = 600, 5  # points, and steps of a fit, by which the camera to be freed is chosen
_FREE_PX, _ALL_FREE_PX = 30.0, 1.0  # px, standard deviation of a motion where few cameras moved, and where most did
_GAIN = 0.5  # squares of σ an observation, least gain by a motion; noise gives 0.3 on a patch of a hundred points
_LOOSE_STEPS, _STEPS = 2, 14
_BEGINNING = 1000  # points of the loose steps, after which all are used
_SETTLED = 1e-3  # px, greatest motion in the image in the last step


@dataclass(frozen=True)
class CameraMotions:
    """Small motions of C cameras since they were calibrated, or since the reference.

    cameras : before the motion.
    motion : (C, 7) ω (rad), τ (mm) and φ, by which ``R ← exp([ω]×) R``, ``t ← t + τ``, ``f ← (1 + φ) f``. covariance :
        (7 C, 7 C) of it.
    freed : (C,) bool, which of the cameras may have moved; the others stand still but for what is not known of them.
    shift : (C, 2) px, median shift of the points' images by the motion, and effect : (C,) px, RMS of its length; NaN
        for a camera without points.
    lens_effect : (C,) px, the part of effect that is due to the change of the focal length alone.
    before, after : (C,) px, RMS reprojection error of each camera's points without the motion and with it, else NaN.
    misfit : (C,) robust ratio of each camera's residuals, with the motion, to their standard deviations, else NaN.
    scale : factor, 1 or more, by which the standard deviations of the pixels must be multiplied to fit the residuals.
    gain : decrease of the residuals' robust cost, in squares of σ, for each observation that the moved cameras concern.
    contradicting : index of the one camera without which all others agree, where no motion explains the residuals; else
        -1.
    used : number of points that were used.
    """

    cameras: tuple[Camera, ...]
    motion: Floats
    covariance: Floats
    freed: Mask
    shift: Pixels
    effect: Floats
    lens_effect: Floats
    before: Floats
    after: Floats
    misfit: Floats
    scale: float
    gain: float
    contradicting: int
    used: int

    @property
    def moved(self) -> Mask:
        """Which of the cameras, (C,) bool, moved by more than `MOVED_PX` in their images, as the residuals bear out."""
        return np.asarray(self.freed & (np.nan_to_num(self.effect) > MOVED_PX) & (self.gain > _GAIN))

    @property
    def refocused(self) -> Mask:
        """Which of the cameras that moved, (C,) bool, did so in part or in all by a change of the focal length."""
        return np.asarray(self.moved & (np.nan_to_num(self.lens_effect) > MOVED_PX))

    @property
    def unexplained(self) -> bool:
        """Whether the residuals are too large for cameras that moved only, or a motion is too large to be believed."""
        if np.nanmax(self.effect, initial=0.0) > _FARTHEST_PX:
            return True
        large = (np.nan_to_num(self.misfit) > UNEXPLAINED) & (np.nan_to_num(self.after) > _UNEXPLAINED_PX)
        return bool(large.any())

    @property
    def adrift(self) -> bool:
        """Whether all cameras are free, and two at least moved farther than the smallest motion that fits will tell."""
        free = self.freed[np.isfinite(self.effect)]
        return len(free) > 2 and bool(free.all()) and int((np.nan_to_num(self.effect) > ADRIFT_PX).sum()) > 1

    @property
    def followed(self) -> bool:
        """Whether the motions are known well enough to be used.

        Two cameras tell hardly more of a small motion than that there is one.
        """
        if np.nanmax(self.effect, initial=0.0) > _FARTHEST_PX:
            return False
        return len(self.cameras) > 2 or bool(np.nanmax(self.effect) > _FOLLOWED_BY_TWO_PX)

    @property
    def moved_cameras(self) -> tuple[Camera, ...]:
        """The cameras after the motion where any of them moved and was followed, else as they were."""
        if not (self.moved.any() and self.followed):
            return self.cameras
        return tuple(
            _after(CameraParameters.of(camera), each).camera(camera)
            for camera, each in zip(self.cameras, self.motion, strict=True)
        )


def still_cameras(cameras: Sequence[Camera]) -> CameraMotions:
    """No motion of C cameras, where too few points tell of one."""
    count = len(cameras)
    nothing = np.full(count, np.nan)
    return CameraMotions(
        tuple(cameras), np.zeros((count, MOTION)), np.zeros((MOTION * count,) * 2), np.zeros(count, dtype=bool),
        np.full((count, 2), np.nan), nothing, nothing, nothing, nothing, nothing, 1.0, 0.0, -1, 0,
    )  # fmt: skip


def find_moved_cameras(
    cameras: Sequence[Camera], px: Pixels, sigma: Pixels | float, covariance: Floats | None = None, *, most: int = _MOST
) -> CameraMotions:
    """Find which cameras moved, and how, from matched points of a specimen.

    Parameters
    ----------
    cameras : the C cameras, with the poses that they had.
    px : (C, n, 2) image px, NaN where a camera does not see the point.
    sigma : (C, n, 2) px, standard deviations of the pixels, or one number.
    covariance : (C, 6, 6) of the poses, rad and mm, to which the motion of a camera that stands still, 0.02 px in its
        image, is added; None for that alone.
    most : number of points that are used.

    Raises
    ------
    ComputationError : fewer than 50 points are seen by two cameras.
    """
    known = np.zeros((len(cameras), POSE, POSE)) if covariance is None else covariance
    fit = _Fit(cameras, px, sigma, known, most)
    none = np.zeros(len(cameras), dtype=bool)
    still = fit.information(none, none)
    fit.begin(fit.information(~none, none, _UNKNOWN_PX))
    fit.settle(lambda: still / (1.0 + fit.squares(still) / (_TAIL * POSE))[:, None, None] ** 2)
    motions = fit.motions()
    if not motions.moved.any():
        return motions
    best = _fewest_moved(fit)
    motions = best.motions()
    return replace(motions, contradicting=best.contradicting()) if motions.unexplained else motions


@dataclass(frozen=True)
class _Freed:
    """Which cameras' poses and focal lengths are free, (C,) bool each, and by how many px in the images."""

    poses: Mask
    lenses: Mask
    px: float

    def options(self, c: int) -> Iterator[_Freed]:
        """What may be freed beside these: the pose of camera c, its focal length, or both."""
        this = np.arange(len(self.poses)) == c
        for pose, lens in ((True, False), (False, True), (True, True)):
            yield _Freed(self.poses | (this & pose), self.lenses | (this & lens), self.px)


def _fewest_moved(fit: _Fit) -> _Fit:
    """The fit that explains the points best with the fewest free cameras: at most three and half of them, or all.

    One camera after the other is freed, that whose free pose explains most. Two cameras do not tell a motion from
    another focal length.
    """
    none = np.zeros(len(fit.cameras), dtype=bool)
    if len(none) == 2:
        return fit.freed(_Freed(~none, none, _ALL_FREE_PX))[1]
    whole = [fit.freed(_Freed(poses, lenses, _ALL_FREE_PX)) for poses, lenses in ((~none, none), (none, ~none))]
    whole.append(fit.freed(_Freed(~none, ~none, _ALL_FREE_PX)))
    best = min(whole, key=lambda each: each[0])
    screened, freed, last = fit.thinned(_SCREENED), _Freed(none, none, _FREE_PX), np.inf
    while (changed := freed.poses | freed.lenses).sum() < min(len(none) // 2, _FEW):
        c = min(
            np.flatnonzero(~changed), key=lambda k: screened.freed(next(freed.options(int(k))), _SCREENING_STEPS)[0]
        )
        trials = [(*fit.freed(each), each) for each in freed.options(int(c))]
        price, trial, freed = min(trials, key=lambda each: each[0])
        if price >= last:
            break
        last = price
        if price < best[0]:
            best = price, trial
    return best[1]


class _Fit:
    """Least-squares fit of the motions of C cameras and of the points that they see, step by step."""

    def __init__(
        self, cameras: Sequence[Camera], px: Pixels, sigma: Pixels | float, known: Floats, most: int
    ) -> None:  # fmt: skip
        px = np.asarray(px, dtype=np.float64)
        sigma = np.broadcast_to(np.asarray(sigma, dtype=np.float64), px.shape)
        shared = np.flatnonzero((np.isfinite(px).all(axis=2) & np.isfinite(sigma).all(axis=2)).sum(axis=0) >= 2)
        if len(shared) < _FEWEST:
            raise ComputationError(
                f"{len(shared)} points are seen by two cameras; finding cameras that moved needs at least {_FEWEST}"
            )
        chosen = shared[np.linspace(0, len(shared) - 1, min(len(shared), most)).astype(int)]
        px, sigma = px[:, chosen], sigma[:, chosen]
        xyz = triangulate(cameras, px)
        whole = np.isfinite(xyz).all(axis=1)
        self.cameras, self.px, self.sigma, self.xyz = tuple(cameras), px[:, whole], sigma[:, whole], xyz[whole]
        self.seen: Mask = np.asarray(np.isfinite(self.px + self.sigma).all(axis=2))
        self.start = [CameraParameters.of(camera) for camera in cameras]
        self.motion, self.covariance = np.zeros((len(cameras), MOTION)), np.zeros((MOTION * len(cameras),) * 2)
        self.scale, self._known, self._standing = 1.0, known, self._deviations()
        self._first, self.free = self.xyz, np.ones(len(cameras), dtype=bool)
        self.residuals = reprojection_residuals(cameras, self.xyz, self.px)

    def begin(self, prior: Floats) -> None:
        """Take the first steps with a part of the points. prior : (C, 7, 7) information matrices of the motions."""
        part = self.thinned(_BEGINNING)
        for _ in range(_LOOSE_STEPS):
            part.step(prior)
        self.motion = part.motion
        self._triangulate()

    def restarted(self) -> _Fit:
        """A fit to the same points from the beginning."""
        other = copy.copy(self)
        other.xyz, other.motion = self._first, np.zeros_like(self.motion)
        return other

    def cost(self) -> float:
        """Robust cost of the residuals after the motions so far, in squares of the pixels' own standard deviations."""
        residuals = reprojection_residuals(self._moved(), self.xyz, self.px)
        return _huber_cost(residuals[self.seen] / self.sigma[self.seen])

    def thinned(self, most: int) -> _Fit:
        """A fit to a part of the points, at the motions and with the scale of this one."""
        other, chosen = copy.copy(self), np.linspace(0, len(self.xyz) - 1, min(len(self.xyz), most)).astype(int)
        other.px, other.sigma, other.seen = self.px[:, chosen], self.sigma[:, chosen], self.seen[:, chosen]
        other.xyz, other._first, other.residuals = self.xyz[chosen], self._first[chosen], self.residuals[:, chosen]
        return other

    def freed(self, free: _Freed, most: int = _STEPS) -> tuple[float, _Fit]:
        """Price of a fit with free cameras, in squares of σ, and the fit. most : number of its steps."""
        trial, prior = self.restarted(), self.information(free.poses, free.lenses, free.px)
        trial.free = free.poses | free.lenses
        trial.settle(lambda: prior, most)
        none = np.zeros(len(self.cameras), dtype=bool)
        unmoved = float(self.squares(self.information(none, none), trial.motion)[~trial.free].sum())
        price = _PRICE * int(free.poses.sum() + free.lenses.sum())
        return trial.cost() / self.scale**2 + unmoved + price, trial

    def information(self, poses: Mask, lenses: Mask, px: float = 0.0) -> Floats:
        """Information matrices (C, 7, 7) of the motions of cameras whose poses and lenses, (C,) bool each, are free.

        px : standard deviation of these motions in the images. The others stand still.
        """
        moving = np.where(poses, px, _STILL_PX)
        covariance = np.eye(MOTION) * ((self._standing * moving[:, None]) ** 2)[:, None, :]
        covariance[:, :POSE, :POSE] += self._known
        covariance[:, POSE, POSE] = np.where(lenses, self._standing[:, POSE] * px, _FIXED) ** 2
        return np.asarray(np.linalg.inv(covariance), dtype=float)

    def _deviations(self) -> Floats:
        """Motions (C, 7) in rad, mm and without unit by each of which the points move by about 1 px in the images."""
        rows = []
        for c, (first, seen) in enumerate(zip(self.start, self.seen, strict=True)):
            focal, far = first.inner[0], np.median((self.xyz @ first.rotation.T + first.translation)[:, 2])
            radius = (
                np.sqrt(np.mean(np.sum((self.px[c, seen] - first.inner[3:5]) ** 2, axis=1))) if seen.any() else focal
            )
            rows.append([*[1.0 / focal] * 3, *[far / focal] * 3, 1.0 / radius])
        return np.array(rows)

    def squares(self, information: Floats, motion: Floats | None = None) -> Floats:
        """Squared Mahalanobis length (C,) of the motions, or of others (C, 7), by information matrices (C, 7, 7)."""
        p = self.motion if motion is None else motion
        return np.asarray(np.einsum("ci,cij,cj->c", p, information, p))

    def settle(self, prior: Callable[[], Floats], most: int = _STEPS) -> None:
        """Take steps until they are negligible, or as many as are allowed.

        prior : function that returns the information (C, 7, 7) of the motions. most : number of steps.
        """
        for _ in range(most):
            if (np.abs(self.step(prior())) / self._standing).max() < _SETTLED:
                break

    def step(self, prior: Floats) -> Floats:
        """Take one Gauss-Newton step of motions and points; returns that of the motions, (C, 7) rad, mm and no unit.

        prior : (C, 7, 7) information matrices of the motions.
        """
        count, n = len(self.cameras), len(self.xyz)
        poses = [_after(first, each) for first, each in zip(self.start, self.motion, strict=True)]
        rows = [
            (np.flatnonzero(seen), *projection_jacobians(pose, self.xyz[seen]))
            for seen, pose in zip(self.seen, poses, strict=True)
        ]
        residuals = [self.px[c, at] - expected for c, (at, expected, _, _) in enumerate(rows)]
        self.scale = self._robust_scale(residuals)
        N, right = scipy.linalg.block_diag(*prior), -np.einsum("cij,cj->ci", prior, self.motion)
        H, h, B = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3, count, MOTION))
        for c, ((at, _, by_parameters, by_point), r) in enumerate(zip(rows, residuals, strict=True)):
            w = huber_weights(r, self.scale * self.sigma[c, at])
            by_focal = by_parameters[:, :, :3] @ self.start[c].inner[:3]
            A = np.concatenate([by_parameters[:, :, LENS:], by_focal[..., None]], axis=2)
            weighted, across = A * w[..., None], by_point * w[..., None]
            N[MOTION * c : MOTION * (c + 1), MOTION * c : MOTION * (c + 1)] += np.tensordot(
                A, weighted, ((0, 1), (0, 1))
            )
            right[c] += np.tensordot(weighted, r, ((0, 1), (0, 1)))
            H[at] += across.transpose(0, 2, 1) @ by_point
            h[at] += np.einsum("nri,nr->ni", across, r)
            B[at, :, c] = across.transpose(0, 2, 1) @ A
        H += 1e-12 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        solved = np.linalg.inv(H) @ np.concatenate([B.reshape(n, 3, -1), h[..., None]], axis=2)
        flat = B.reshape(3 * n, -1).T
        N -= flat @ solved[..., :-1].reshape(3 * n, -1)
        size = 1 / np.sqrt(np.diag(N))
        self.covariance = np.linalg.inv(N * np.outer(size, size)) * np.outer(size, size)
        step = self.covariance @ (right.ravel() - flat @ solved[..., -1].ravel())
        self.motion = self.motion + step.reshape(count, MOTION)
        self.motion[:, POSE] = self.motion[:, POSE].clip(-_MOST_REFOCUSED, _MOST_REFOCUSED)
        self._triangulate()  # as a step of the points too would diverge after large motions
        return step.reshape(count, MOTION)

    def _triangulate(self) -> None:
        """Put the points where the cameras see them after their motions so far."""
        again = triangulate(self._moved(), self.px)
        self.xyz = np.where(np.isfinite(again), again, self.xyz)

    def _moved(self) -> list[Camera]:
        """The cameras after their motions so far."""
        rows = zip(self.start, self.motion, self.cameras, strict=True)
        return [_after(first, each).camera(camera) for first, each, camera in rows]

    def _gain(self, after: Pixels, which: Mask) -> float:
        """Decrease of the residuals' robust cost by the motions, for each observation of the points that they concern.

        after : (C, n, 2) px, residuals with the motions. which : (C,) bool, cameras whose points count.
        """
        concerned = self.seen & self.seen[which].any(axis=0)
        if not concerned.any():
            return 0.0
        spread = self.scale * self.sigma[concerned]
        before, now = (_huber_cost(r[concerned] / spread) for r in (self.residuals, after))
        return (before - now) / int(concerned.sum())

    def motions(self) -> CameraMotions:
        """The motions so far, and measures of the fit."""
        moved = self._moved()
        shift, (effect, by_lens, misfit) = np.full((len(moved), 2), np.nan), np.full((3, len(moved)), np.nan)
        residuals = reprojection_residuals(moved, self.xyz, self.px)
        for c, (before, after, seen) in enumerate(zip(self.cameras, moved, self.seen, strict=True)):
            if seen.any():
                shifts = after.project(self.xyz[seen]) - before.project(self.xyz[seen])
                shift[c], effect[c] = np.median(shifts, axis=0), np.sqrt(np.mean(np.sum(shifts**2, axis=1)))
                by_lens[c] = np.abs(self.motion[c, POSE]) / self._standing[c, POSE]
                square = np.sum((residuals[c, seen] / self.sigma[c, seen]) ** 2, axis=1)
                misfit[c] = np.sqrt(np.median(square) / _MEDIAN_OF_CHI2)
        gain = self._gain(residuals, np.nan_to_num(effect) > MOVED_PX)
        return CameraMotions(
            self.cameras, self.motion, self.covariance, self.free, shift, effect, by_lens, _rms(self.residuals),
            _rms(residuals), misfit, self.scale, gain, -1, len(self.xyz),
        )  # fmt: skip

    def contradicting(self) -> int:
        """Index of the one camera without which all others agree, before any motion; -1 where there is none."""
        costs = np.full(len(self.cameras), np.inf)
        for c in range(len(self.cameras)):
            px = self.px.copy()
            px[c] = np.nan
            r = reprojection_residuals(self.cameras, triangulate(self.cameras, px), px)
            seen = np.isfinite(r[..., 0])
            degrees = 2 * int(seen.sum()) - 3 * int(seen.any(axis=0).sum())
            if degrees >= _FEWEST:
                costs[c] = _huber_cost(r[seen] / self.sigma[seen]) / degrees
        order = np.argsort(costs)
        agree = len(costs) > 2 and costs[order[0]] < UNEXPLAINED and costs[order[1]] > UNEXPLAINED * costs[order[0]]
        return int(order[0]) if agree else -1

    def _robust_scale(self, residuals: Sequence[Floats]) -> float:
        """Robust ratio, 1 or more, of the residuals, (k, 2) px of each camera, to their standard deviations.

        It is the square root of the median, over the points, of χ² in units of its expected median; a point seen by m
        cameras has 2 m − 3 degrees of freedom.
        """
        square, views = np.zeros(len(self.xyz)), self.seen.sum(axis=0)
        for r, sigma, seen in zip(residuals, self.sigma, self.seen, strict=True):
            square[seen] += np.sum((r / sigma[seen]) ** 2, axis=1)
        median = 2.0 * scipy.special.gammaincinv(0.5 * np.maximum(2 * views - 3, 1), 0.5)  # of the χ² distribution
        return max(1.0, float(np.sqrt(np.median((square / median)[views >= 2]))))


def _huber_cost(ratios: Floats) -> float:
    """Sum of Huber's cost over residuals in units of their standard deviations; infinite where one is undefined."""
    r = np.abs(ratios)
    cost = float(np.sum(np.where(r < HUBER, r**2, 2 * HUBER * r - HUBER**2)))
    return cost if np.isfinite(cost) else np.inf


def motion_parameters(camera: Camera) -> Floats:
    """Derivatives (16, 7) of a camera's parameters, px, rad and mm, with respect to those of its motion."""
    out = np.zeros((PER_CAMERA, MOTION))
    out[LENS:, :POSE] = np.eye(POSE)
    out[:3, POSE] = CameraParameters.of(camera).inner[:3]  # fx, fy and the skew
    return out


def _after(start: CameraParameters, motion: Floats) -> CameraParameters:
    """The parameters of a camera after a motion (7,): ω (rad), τ (mm) and φ."""
    lens = np.zeros(LENS)
    lens[:3] = motion[POSE] * start.inner[:3]
    return start.plus(np.concatenate([lens, motion[:POSE]]))


def _rms(residuals: Pixels) -> Floats:
    """RMS length of the residuals (C, n, 2) px of each camera, (C,) px, NaN for one without points."""
    squares = np.sum(residuals**2, axis=2)
    count = np.isfinite(squares).sum(axis=1)
    return np.sqrt(np.where(count > 0, np.nansum(squares, axis=1) / np.maximum(count, 1), np.nan))
