"""The surface at every step: each camera's pixels triangulated from all views, one step at a time.

Points are tracked in each camera against its own reference image, from where the camera shows the reference position,
so an error of that position cancels in the displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels, Points
from ringdic.calibration.drift import drift_findings
from ringdic.calibration.motion_findings import left_out_finding, motion_figures, motion_findings
from ringdic.calibration.moved_cameras import CameraMotions, find_moved_cameras
from ringdic.charts.agreement import triangulate_agreeing
from ringdic.charts.chart import texture_of
from ringdic.charts.instants import two_instants
from ringdic.charts.surface import ReferenceSurface
from ringdic.charts.tracking import CameraMatches, interpolate_matches
from ringdic.charts.views import facing_pairs
from ringdic.charts.weights import CELL_STEPS, smooth_sigma
from ringdic.correlation import Status
from ringdic.errors import ComputationError
from ringdic.findings import Finding
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint, surface_outliers
from ringdic.mesh.mesh import Mesh
from ringdic.results.results import Matches, Results
from ringdic.results.series import StepCache
from ringdic.results.unmeasured import UnmeasuredPlaces
from ringdic.results.writer import map_in_order
from ringdic.settings import Settings
from ringdic.strain.deformation import deformation
from ringdic.uncertainty.matches import match_uncertainty
from ringdic.uncertainty.noise import camera_noise
from ringdic.uncertainty.position import (
    along_surface,
    covariance,
    disagreement,
    position_gain,
    reference_covariance,
    step_covariance,
)
from ringdic.uncertainty.strain import corner_correlations, stretch_sigma

_LEAST_SIGMA = 1e-3  # px, lower limit of a match's standard deviation

#: Function of a camera's index and a step from 1 on; returns the matches of its grid, None where it has no image.
MatchesOfStep = Callable[[int, int], CameraMatches | None]


@dataclass(frozen=True)
class CameraView:
    """The k points of the surface that one camera sees.

    vertex : (k,) indices of the points. px : (k, 2) px, where the camera shows their reference positions, from which
    they are tracked.
    """

    vertex: Indices
    px: Pixels


def camera_view(camera: Camera, k: int, surface: ReferenceSurface) -> CameraView:
    """The points of a surface that camera number k sees."""
    vertex = np.flatnonzero(np.isfinite(surface.px[k, :, 0]))
    return CameraView(vertex, camera.project(surface.xyz[vertex]))


@dataclass(frozen=True)
class CameraStep:
    """Matches at one step of the k points that one camera sees, in the order of its `CameraView`.

    px : (k, 2) px, NaN where there is no match. sigma : (k, 2) px, as the correlation states it. weight : (k, 2) px,
    standard deviations by which the view was weighted, NaN where it was not used. c_ls : (k,). status : (k,), 0 good.
    """

    px: Pixels
    sigma: NDArray[np.float32]
    weight: NDArray[np.float32]
    c_ls: NDArray[np.float32]
    status: NDArray[np.int8]

    @property
    def used(self) -> Mask:
        """Which of the views, (k,) bool, the points were triangulated from."""
        return np.isfinite(self.weight[:, 0])


@dataclass(frozen=True)
class SurfaceStep:
    """The surface at one step: N points, C cameras.

    xyz : (N, 3) mm, NaN where lost. cameras : matches of each of the C cameras. status : (N,), 0 measured. chi2,
    degrees : (N,). residual : (C,) px, mean vertical residual of each camera.
    """

    xyz: Points
    cameras: tuple[CameraStep, ...]
    status: NDArray[np.int8]
    chi2: Floats
    degrees: Indices
    residual: Floats


class SurfaceSeries:
    """Series of results of a surface that all cameras measure together.

    Parameters
    ----------
    rig : its name.
    cameras : the C cameras as they stood at the reference.
    pairs : ids of neighbouring cameras.
    charts : names of the charts.
    names : (F,) of the steps, the reference first.
    surface : at the reference.
    matches : function that returns the matches of a camera at a step.
    settings : of the run.
    cache : for the points in space of every step.
    unmeasured : textured places that are not part of the surface.
    unmatched : for each camera why it has no depths, an empty sentence where it has.
    moved : how the cameras moved between the calibration and the reference; None where that was not checked.
    """

    def __init__(
        self, rig: str, cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]], charts: Sequence[str],
        names: Sequence[str], surface: ReferenceSurface, matches: MatchesOfStep, settings: Settings, cache: StepCache,
        unmeasured: Sequence[UnmeasuredPlaces] = (), unmatched: Sequence[str] = (),
        moved: CameraMotions | None = None,
    ) -> None:  # fmt: skip
        self._unmeasured, self._unmatched = tuple(unmeasured), list(unmatched) or [""] * len(cameras)
        self.names, self.surface, self._cameras, self._charts = tuple(names), surface, tuple(cameras), tuple(charts)
        self._settings, self._cache = settings, cache
        self._views = [camera_view(camera, c, surface) for c, camera in enumerate(cameras)]
        self._textures = [texture_of(surface.texture[k, view.vertex]) for k, view in enumerate(self._views)]
        self._motions: dict[int, CameraMotions] = {} if moved is None else {0: moved}
        self._instants: list[Finding] = []
        self._contradictions: dict[int, CameraMotions] = {}
        self._drift = np.full((len(self.names), len(cameras)), np.nan)
        self._measured = np.ones(len(self.names))
        residuals = [surface.px[c, view.vertex] - view.px for c, view in enumerate(self._views)]
        self._drift[0] = [float(np.mean(one[:, 1])) if len(one) else np.nan for one in residuals]
        # In the image of its own camera a point lies on a whole pixel by definition.
        others = [
            one[surface.own[view.vertex] != c] for c, (one, view) in enumerate(zip(residuals, self._views, strict=True))
        ]
        self._residual = float(np.sqrt(np.mean(np.concatenate(others) ** 2)))
        c_ls: list[list[Floats]] = [[] for _ in cameras]
        steps = range(1, len(self.names))
        for k, step in enumerate(map_in_order(lambda k: self._measure(k, matches), steps), start=1):
            cache.put(k, step)
            self._measured[k] = np.mean(step.status == 0)
            instants = two_instants(cameras, surface.xyz, step.xyz, self.names[k])
            self._instants += [] if instants is None else [instants]
            self._drift[k] = self._drift[0] + step.residual
            for samples, one in zip(c_ls, step.cameras, strict=True):
                samples.append(_sample(one.c_ls))
        self._grey_noise = [
            camera_noise(float(surface.grey_noise[c]), np.array(rows), _sample(self._textures[c].contrast))
            if rows and len(self._views[c].vertex)
            else float(surface.grey_noise[c])
            for c, rows in enumerate(c_ls)
        ]
        self.reference = self._reference(rig, pairs)
        self._prepare_uncertainty()

    @property
    def drift(self) -> dict[str, Floats]:
        """Mean vertical residual (F,) px of each camera that was used, by id."""
        known = zip(self._cameras, self._drift.T, strict=True)
        return {camera.id: values for camera, values in known if np.isfinite(values[0])}

    def motions_at(self, step: int) -> CameraMotions | None:
        """How cameras moved since the reference, or for step 0 since the calibration; None where none moved."""
        motions = self._motions.get(step)
        return motions if motions is not None and motions.moved.any() else None

    @property
    def measured(self) -> Floats:
        """Share of the points that each step measured, (F,), no unit, 0 to 1."""
        return self._measured

    @property
    def agreement(self) -> dict[str, Any]:
        """How well the cameras agree at the reference, as JSON values.

        Mean number of views of a point, RMS residual of the cameras (px), numbers of lost points by reason, distances
        between the charts where they overlap (mm), and the motion of cameras that have moved.
        """
        reasons = {int(reason): reason.name.lower() for kind in (Status, LostPoint) for reason in kind}
        return {
            "views": float(np.isfinite(self.surface.px[..., 0]).sum(axis=0).mean()),
            "residual_px": self._residual,
            "lost": {reasons[int(reason)]: int(number) for reason, number in self.surface.lost},
            **_distances(self.surface.mismatch, self._charts),
            "moved_cameras": motion_figures(self._motions, self.names),
        }

    @property
    def findings(self) -> list[Finding]:
        """Cameras that share no measured point with another, and cameras that moved."""
        alone = "camera {} shares no measured point of the surface with another, though it has depths"
        idle = [
            Finding("camera-unmatched", why or alone.format(camera.id), (camera.id,), self.names[0])
            for camera, view, why in zip(self._cameras, self._views, self._unmatched, strict=True)
            if why or not len(view.vertex)
        ]
        if self._settings.method == "paper":
            return [*idle, *drift_findings(self.drift, self.names)]
        left_out = [left_out_finding(one, self.names[k]) for k, one in sorted(self._contradictions.items())]
        return [*idle, *left_out, *self._instants, *motion_findings(self._motions, self.names)]

    def _measure(self, k: int, matches: MatchesOfStep) -> SurfaceStep:
        """Triangulate the points of step k from all cameras."""
        px, weight = (np.full(self.surface.px.shape, np.nan) for _ in range(2))
        status = np.full(px.shape[:2], Status.NOT_REACHED, np.int8)
        tracked = [self._track(c, matches(c, k), px[c], weight[c], status[c]) for c in range(len(px))]
        cameras = self._placed(k, px, weight, status)
        points, used = triangulate_agreeing(cameras, px, weight)
        turned = self._oblique(cameras, points.xyz, px)
        again = np.flatnonzero(turned.any(axis=0))
        if len(again):  # surface that has turned away from a camera
            px[turned], status[turned] = np.nan, LostPoint.OBLIQUE
            some, used[:, again] = triangulate_agreeing(cameras, px[:, again], weight[:, again])
            points.xyz[again], points.chi2[again], points.degrees[again] = some.xyz, some.chi2, some.degrees
        enough = np.isfinite(px[..., 0]).sum(axis=0) >= 2
        lost: Mask = np.asarray(~np.isfinite(points.xyz).all(axis=1))
        overall = np.where(lost, np.where(enough, LostPoint.RESIDUAL, status.max(axis=0)), 0).astype(np.int8)
        moved = np.where(lost[:, None], np.nan, points.xyz - self.surface.xyz)
        overall[surface_outliers(self.surface.neighbours, moved)] = LostPoint.SURFACE
        measured = overall == 0
        used &= measured
        xyz = np.where(measured[:, None], points.xyz, np.nan)
        residual = np.full(len(cameras), np.nan)
        steps = []
        for c, (camera, view, (sigma, c_ls)) in enumerate(zip(cameras, self._views, tracked, strict=True)):
            at = np.flatnonzero(used[c])
            if len(at):
                residual[c] = float(np.mean((px[c, at] - camera.project(xyz[at]))[:, 1]))
            weight[c, ~used[c]] = np.nan
            weights = weight[c, view.vertex].astype(np.float32)
            steps.append(CameraStep(px[c, view.vertex], sigma, weights, c_ls, status[c, view.vertex]))
        return SurfaceStep(
            xyz, tuple(steps), overall, np.where(measured, points.chi2, np.nan), np.where(measured, points.degrees, 0),
            residual,
        )  # fmt: skip

    def _placed(self, k: int, px: Pixels, sigma: Pixels, status: NDArray[np.int8]) -> tuple[Camera, ...]:
        """The cameras at step k, from the points (C, N, 2) px tracked in them and their standard deviations.

        The matches of a camera that contradicts all others, as one that shows another instant, are taken out.
        """
        if not self._settings.calibration.refine_poses or self._settings.method == "paper":
            return self._cameras
        try:
            motions = find_moved_cameras(self._cameras, px, sigma)
            if motions.contradicting >= 0:
                self._contradictions[k], c = motions, motions.contradicting
                status[c, np.isfinite(px[c, :, 0])] = LostPoint.RESIDUAL
                px[c], sigma[c] = np.nan, np.nan
                motions = find_moved_cameras(self._cameras, px, sigma)
        except ComputationError:  # too few points to say
            return self._cameras
        self._motions[k] = motions
        return motions.moved_cameras

    def _track(
        self, c: int, matches: CameraMatches | None, px: Pixels, weight: Pixels, status: NDArray[np.int8]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Pixels of the points in camera c at a step, from the matches of its grid, None where there are none.

        px, weight (N, 2) px and status (N,) of all points are filled. Returns the standard deviations (k, 2) px and
        C_LS (k,) of the matches of the points that the camera sees, NaN where there is none.
        """
        view, group = self._views[c], self._settings
        if matches is None or not len(view.vertex):
            return np.full((len(view.vertex), 2), np.nan, np.float32), np.full(len(view.vertex), np.nan, np.float32)
        pixels = interpolate_matches(matches, view.px)
        with np.errstate(invalid="ignore"):
            uncertain = (pixels.status == 0) & (pixels.sigma > group.surface.sigma_max_px).any(axis=1)
        status[view.vertex] = np.where(uncertain, LostPoint.UNCERTAIN, pixels.status)
        good = status[view.vertex] == 0
        vertex, sigma = view.vertex[good], pixels.sigma[good]
        px[vertex] = pixels.px[good]
        cell = CELL_STEPS * group.correlation.step_px
        weight[vertex] = smooth_sigma(view.px[good], np.maximum(sigma, _LEAST_SIGMA), cell)
        lost = np.where(good, 1.0, np.nan)
        return (pixels.sigma * lost[:, None]).astype(np.float32), (pixels.c_ls * lost).astype(np.float32)

    def _oblique(self, cameras: Sequence[Camera], xyz: Points, px: Pixels) -> Mask:
        """Which views (C, n) of points (n, 3) mm with pixels (C, n, 2) are more oblique than the settings allow."""
        normals = Mesh(xyz, self.surface.faces).vertex_normals
        limit = np.cos(np.radians(self._settings.surface.incidence_deg))
        oblique = np.zeros(px.shape[:2], bool)
        for camera, at, out in zip(cameras, px, oblique, strict=True):
            seen = np.flatnonzero(np.isfinite(at[:, 0]))
            with np.errstate(invalid="ignore"):
                out[seen] = camera.incidence_cosine(xyz[seen], normals[seen]) < limit
        return oblique

    def _reference(self, rig: str, pairs: Sequence[tuple[str, str]]) -> Results:
        """The results of the reference alone, without standard deviations."""
        surface = self.surface
        facing, vertex_pair = _facing_pairs(self._cameras, pairs, surface, self._views)
        corners = vertex_pair[surface.faces]
        n = len(surface.xyz)
        return Results(
            rig=rig,
            steps=self.names[:1],
            cameras=self._cameras,
            pairs=facing,
            vertices_ref=surface.xyz,
            vertices=surface.xyz[None],
            faces=surface.faces,
            pair=np.where((corners == corners[:, :1]).all(axis=1), corners[:, 0], -1),
            vertex_pair=vertex_pair,
            correlation=surface.c_ls[None],
            sigma_xyz=np.full((1, n, 3), np.nan),
            status=np.zeros((1, n), np.int8),
            matches=tuple(
                Matches(
                    cameras=(camera.id,),
                    xy=surface.px[c, view.vertex],
                    px=view.px[None, None],
                    c_ls=np.zeros((1, len(view.vertex))),
                    sigma=surface.sigma[c, view.vertex].astype(float)[None, None],
                    status=np.zeros((1, len(view.vertex)), np.int8),
                    vertex=view.vertex,
                )
                for c, (camera, view) in enumerate(zip(self._cameras, self._views, strict=True))
                if len(view.vertex)
            ),
            settings=self._settings.to_toml(),
            chi2=(surface.chi2 / np.where(surface.degrees > 0, surface.degrees, 1))[None],
            unmeasured=self._unmeasured,
        )

    def _prepare_uncertainty(self) -> None:
        """Compute what the standard deviations of all steps share, and complete the reference with its own."""
        surface, cameras = self.surface, self._cameras
        group = self._settings.correlation
        normals = Mesh(surface.xyz, surface.faces).vertex_normals
        self._label = along_surface(cameras, surface.own, surface.xyz, normals)
        self._gain = position_gain(cameras, surface.xyz, surface.sigma)
        px = np.full_like(surface.px, np.nan)
        for c, view in enumerate(self._views):
            px[c, view.vertex] = view.px
        self._scatter = surface.scatter * disagreement(surface.chi2, surface.degrees).astype(np.float32)[:, None]
        self._correlation = corner_correlations(px, surface.faces, group.radius_px, group.order)
        sigma = _root(reference_covariance(self._gain, self._scatter, surface.own, self._label))
        n, m = len(surface.xyz), len(surface.faces)
        self.reference = replace(
            self.reference, sigma_xyz=sigma[None], sigma_displacement=np.zeros((1, n, 3)),
            sigma_lambda=np.zeros((1, m, 2)),
        )  # fmt: skip

    def at(self, step: int) -> Results:
        """Results of the reference and of a later step; for step 0 those of the reference alone."""
        if not step:
            return self.reference
        one: SurfaceStep = self._cache.get(step)
        reference, surface = self.reference, self.surface
        total = self._pixel_sigma(one) * disagreement(one.chi2, one.degrees).astype(np.float32)[:, None]
        gain = position_gain(self._cameras, one.xyz, self._dense([camera.weight for camera in one.cameras]))
        half = total / np.float32(np.sqrt(2.0))  # the share of either image
        displacement = _root(covariance(gain, total))
        position = _root(step_covariance((self._gain, gain), self._scatter, (half, half), surface.own, self._label))
        strains = deformation(surface.xyz, one.xyz, surface.faces)
        stretches = stretch_sigma(strains, surface.xyz, surface.faces, gain, self._correlation, total)
        lost = ~np.isfinite(one.xyz).all(axis=1)
        position[lost], displacement[lost] = np.nan, np.nan
        stretches[~np.isfinite(strains.J)] = np.nan
        c_ls = np.full(len(one.xyz), np.nan)
        for view, camera in zip(self._views, one.cameras, strict=True):
            at = view.vertex[camera.used]
            c_ls[at] = np.fmax(c_ls[at], camera.c_ls[camera.used])
        chi2 = one.chi2 / np.where(one.degrees > 0, one.degrees, 1)

        def both(name: str, values: NDArray[Any]) -> NDArray[Any]:
            return np.stack([getattr(reference, name)[0], values])

        return replace(
            reference,
            steps=(self.names[0], self.names[step]),
            vertices=both("vertices", one.xyz),
            correlation=both("correlation", c_ls),
            sigma_xyz=both("sigma_xyz", position),
            status=both("status", one.status),
            sigma_displacement=both("sigma_displacement", displacement),
            sigma_lambda=both("sigma_lambda", stretches),
            chi2=both("chi2", chi2),
            matches=tuple(self._matches(each, one, total) for each in reference.matches),
        )

    def _dense(self, values: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Values (C, N, 2) of all points, NaN for those that a camera does not see, from those of its view (k, 2)."""
        out = np.full(self.surface.px.shape, np.nan, np.float32)
        for row, view, one in zip(out, self._views, values, strict=True):
            row[view.vertex] = one
        return out

    def _pixel_sigma(self, step: SurfaceStep) -> NDArray[np.float32]:
        """Standard deviations (C, N, 2) px of the displacements in each camera, due to noise and to other change."""
        total = []
        for variance, one, texture in zip(self._grey_noise, step.cameras, self._textures, strict=True):
            parts = match_uncertainty(
                one.sigma.astype(float), one.c_ls.astype(float), (texture, texture), (variance, variance)
            )
            each = np.sqrt(parts.reference**2 + parts.current**2 + parts.systematic**2)
            total.append(each.astype(np.float32))
        return self._dense(total)

    def _matches(self, reference: Matches, step: SurfaceStep, total: NDArray[np.float32]) -> Matches:
        """Matches of one camera at the reference and at a step; good ones that contradict other cameras are marked."""
        c = [camera.id for camera in self._cameras].index(reference.cameras[0])
        one = step.cameras[c]
        status = np.where((one.status == 0) & ~one.used, LostPoint.RESIDUAL, one.status).astype(np.int8)
        return replace(
            reference,
            px=np.stack([reference.px[0], one.px[None]]),
            c_ls=np.stack([reference.c_ls[0], one.c_ls]),
            sigma=np.stack([reference.sigma[0], total[c, reference.vertex][None]]),
            status=np.stack([reference.status[0], status]),
        )


def _distances(mismatch: Floats, charts: Sequence[str]) -> dict[str, Any]:
    """Distances between the charts as JSON values: for every two, and as mean and standard deviation over all.

    mismatch : (J, 8), of `ReferenceSurface`. charts : their names.
    """
    rows: list[dict[str, Any]] = []
    for first, second, points, mean, std, bias, rms, largest in mismatch.tolist():
        figures = {"mean_mm": mean, "std_mm": std, "bias_mm": bias, "rms_mm": rms, "largest_mm": largest}
        rows.append({"charts": [charts[int(first)], charts[int(second)]], "points": int(points), **figures})
    if not rows:
        return {"mismatch_mm": None, "mismatch_std_mm": None, "mismatches": rows}
    weights = mismatch[:, 2] / mismatch[:, 2].sum()
    mean, square = weights @ mismatch[:, 3], weights @ (mismatch[:, 3] ** 2 + mismatch[:, 4] ** 2)
    return {"mismatch_mm": float(mean), "mismatch_std_mm": float(np.sqrt(square - mean**2)), "mismatches": rows}


def _facing_pairs(
    cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]], surface: ReferenceSurface, views: Sequence[CameraView]
) -> tuple[tuple[tuple[str, str], ...], Indices]:
    """Pair of cameras that face each point most squarely, of those that measured it.

    Returns the pairs of camera ids, with pairs that are not listed in the rig appended, and the index (N,) of each
    point's pair among them.
    """
    normals = Mesh(surface.xyz, surface.faces).vertex_normals
    squarely = np.full((len(cameras), len(normals)), -2.0)
    for camera, view, out in zip(cameras, views, squarely, strict=True):
        out[view.vertex] = np.nan_to_num(
            camera.incidence_cosine(surface.xyz[view.vertex], normals[view.vertex]), nan=-2.0
        )
    return facing_pairs(cameras, pairs, squarely)


def _root(covariances: Floats) -> Floats:
    """Standard deviations (n, 3) of covariances (n, 3, 3)."""
    return np.sqrt(np.einsum("nii->ni", covariances))


def _sample(values: NDArray[Any]) -> NDArray[Any]:
    """An evenly spaced sample of about two thousand of some values (n,), enough for their median."""
    return values[:: max(1, len(values) // 2000)]
