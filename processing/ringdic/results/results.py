"""The results of a processing run: positions of a triangulated surface at every step, and the matches in the images."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Pixels, Points
from ringdic.geometry.camera import Camera
from ringdic.mesh.mesh import Mesh
from ringdic.results.fields import OPTIONAL_ARRAYS, StepFields, compute_fields
from ringdic.results.unmeasured import UnmeasuredPlaces
from ringdic.settings import settings_of_run
from ringdic.strain.deformation import Deformation, deformation
from ringdic.strain.rigid_motion import RigidMotion, motion_to_reference
from ringdic.strain.window import StrainWindow
from ringdic.uncertainty.strain import subset_correlation
from ringdic.uncertainty.window import WindowScatter, window_scatter

#: Arrays of `Matches` with one entry a step.
MATCH_ARRAYS = ("px", "c_ls", "sigma", "status")


@dataclass(frozen=True)
class Matches:
    """2D matches at F steps, of a camera pair (C = 2) or of one camera that was tracked by itself (C = 1).

    cameras : the C ids, reference camera first.
    xy : (n, 2) px, the matched points in the reference image. For a camera alone: the pixel as matched from
        another camera.
    px : (F, C, n, 2) px, the matches in the images of each camera. For a camera alone px[0] is the projection of the
        vertex, from which the point is tracked.
    c_ls : (F, n) C_LS of the correlation, 0 best.
    sigma : (F, C, n, 2) px, standard deviations of px. For a camera alone sigma[0] is that of xy.
    status : (F, n), 0 for a good match.
    vertex : (n,) index of the mesh vertex of each point, -1 for none.
    seconds : time spent, by stage.
    """

    cameras: tuple[str, ...]
    xy: Pixels
    px: Pixels
    c_ls: Floats
    sigma: Pixels
    status: NDArray[np.int8]
    vertex: Indices
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, steps, views = len(self.xy), len(self.px), len(self.cameras)
        in_images = (steps, views, n, 2)
        expected = {"px": in_images, "c_ls": (steps, n), "sigma": in_images, "status": (steps, n)}
        _check(self, {**expected, "xy": (n, 2), "vertex": (n,)})


@dataclass(frozen=True)
class Results:
    """Results of a run: F steps including the reference, N vertices, M triangles; positions in mm, world frame.

    rig : name of the rig. steps : (F) capture ids, the reference first. cameras : all that were calibrated.
    pairs : camera ids of each pair.
    vertices_ref : (N, 3) mm, finite. vertices : (F, N, 3) mm, NaN where lost.
    faces : (M, 3) vertex indices, normals outwards. pair : (M,) index of the pair that measured the triangle, -1 where
        a triangle joins two pairs. vertex_pair : (N,) index of the pair that measured the vertex.
    correlation : (F, N) C_LS, the largest over the images used. sigma_xyz : (F, N, 3) mm, standard deviations due to
        image noise alone. status : (F, N), 0 measured.
    matches : the 2D matches, of each pair or of each camera. settings : TOML text. calibration, summary : JSON values.
    sigma_displacement : (F, N, 3) mm, and sigma_lambda : (F, M, 2), of λ1 and λ2, both due to image noise alone.
    chi2 : (F, N) reprojection residual of the point, χ² a degree of freedom.
    unmeasured : textured places of the cameras' reference images that were not measured.
    sigma_calibration, sigma_displacement_calibration : (F, N, 3) mm, and sigma_lambda_calibration : (F, M, 2), due to
        the covariance of the cameras' parameters alone.

    The arrays with default None are None where they are not known. Standard deviations are kept in parts, by cause;
    fields and exports join the parts, and name one alone by the ending ``_noise`` or ``_calibration``.
    """

    rig: str
    steps: tuple[str, ...]
    cameras: tuple[Camera, ...]
    pairs: tuple[tuple[str, str], ...]
    vertices_ref: Points
    vertices: Points
    faces: Indices
    pair: Indices
    vertex_pair: Indices
    correlation: Floats
    sigma_xyz: Floats
    status: NDArray[np.int8]
    matches: tuple[Matches, ...] = ()
    settings: str = ""
    calibration: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)
    unmeasured: tuple[UnmeasuredPlaces, ...] = ()
    sigma_displacement: Floats | None = None
    sigma_lambda: Floats | None = None
    chi2: Floats | None = None
    sigma_calibration: Floats | None = None
    sigma_displacement_calibration: Floats | None = None
    sigma_lambda_calibration: Floats | None = None

    def __post_init__(self) -> None:
        F, N, M = len(self.steps), len(self.vertices_ref), len(self.faces)
        per_vertex = {"correlation": (F, N), "sigma_xyz": (F, N, 3), "status": (F, N), "vertex_pair": (N,)}
        _check(self, {**per_vertex, "vertices_ref": (N, 3), "vertices": (F, N, 3), "faces": (M, 3), "pair": (M,)})
        ends = {"point": (N,), "vector": (N, 3), "face": (M, 2)}
        optional = {name: (F, *ends[kind]) for name, kind in OPTIONAL_ARRAYS.items()}
        _check(self, {name: shape for name, shape in optional.items() if getattr(self, name) is not None})
        if not np.isfinite(self.vertices_ref).all():
            raise ValueError("a vertex without a reference position cannot be tracked; leave it out")
        Mesh(self.vertices_ref, self.faces)

    @property
    def mesh(self) -> Mesh:
        """The surface in the reference configuration."""
        return Mesh(self.vertices_ref, self.faces)

    @property
    def window_mm(self) -> float:
        """Width of the strain window in the run's settings; 0 for strain of the triangles alone."""
        return settings_of_run(self.settings).strain.window_mm

    @property
    def radius_px(self) -> int | None:
        """Radius of the subsets in the run's settings; None where the settings do not give it."""
        group = settings_of_run(self.settings).correlation
        return group.radius_px if "radius_px" in group.model_fields_set else None

    @property
    def pixels_per_mm(self) -> float:
        """Image scale, px a mm: the median over the vertices, measured across the line of sight of the first camera of
        each vertex's pair. NaN where no camera is known."""
        cameras = {camera.id: camera for camera in self.cameras}
        scales = [np.empty(0)]
        for index, pair in enumerate(self.pairs):
            camera, xyz = cameras.get(pair[0]), self.vertices_ref[self.vertex_pair == index]
            if camera is not None and len(xyz):
                across = np.cross(xyz - camera.centre, [0.0, 0.0, 1.0])
                across *= 0.5 / np.linalg.norm(across, axis=1, keepdims=True)
                scales.append(np.linalg.norm(camera.project(xyz + across) - camera.project(xyz - across), axis=1))
        scale = np.concatenate(scales)
        return float(np.nanmedian(scale)) if np.isfinite(scale).any() else float("nan")

    def scatter(self, window: StrainWindow) -> WindowScatter | None:
        """Propagation of the displacements' noise to the stretches over strain windows.

        Distances of subsets in the images are taken as the points' distances on the surface times the image scale.
        None where the displacements' standard deviations, the subset radius or the image scale are unknown.
        """
        scale, radius = self.pixels_per_mm, self.radius_px
        if self.sigma_displacement is None or radius is None or not np.isfinite(scale):
            return None
        return window_scatter(window, lambda apart: subset_correlation(apart * scale, radius), (2 * radius + 1) / scale)

    def reference_positions(self, step: int, previous: bool = False) -> Points:
        """Positions (N, 3) mm that displacements count from: the reference, or the step before it; NaN where lost."""
        return self.vertices[step - 1] if previous and step > 0 else self.vertices_ref

    def motion(self, step: int, previous: bool = False) -> RigidMotion:
        """Least-squares rigid motion that takes a step back onto the reference, or onto the step before it."""
        return motion_to_reference(self.reference_positions(step, previous), self.vertices[step])

    def deformation(
        self,
        step: int,
        rigid_motion_removed: bool = False,
        previous: bool = False,
        window: StrainWindow | None = None,
    ) -> Deformation:
        """Deformation of the triangles at a step: deformation gradient, stretches and strains, in full precision.

        rigid_motion_removed : the step is first moved back by its rigid motion.
        previous : the deformation since the step before, instead of since the reference.
        window : fit the deformation over these windows instead of over each triangle.
        """
        current = self.vertices[step]
        if rigid_motion_removed:
            current = self.motion(step, previous).apply(current)
        if window is not None:
            return window.deformation(current, self.reference_positions(step, previous))
        return deformation(self.reference_positions(step, previous), current, self.faces)

    def fields(
        self,
        step: int,
        window: StrainWindow | None = None,
        previous: bool = False,
        rigid_motion_removed: bool = False,
        scatter: WindowScatter | None = None,
    ) -> StepFields:
        """The arrays of a step from which every field follows.

        window : adds strain over these windows to that of the triangles.
        previous : compares with the step before, instead of with the reference.
        rigid_motion_removed : the step is first moved back by its rigid motion.
        scatter : adds standard deviations of the strain over the windows, see `Results.scatter`.
        """
        motion, current = self.motion(step, previous), self.vertices[step]
        if rigid_motion_removed:
            motion, current = RigidMotion(np.eye(3), np.zeros(3)), motion.apply(current)
        reference, quality = self.reference_positions(step, previous), self.quality(step, previous)
        return compute_fields(reference, current, self.faces, motion, quality, self.pair, window, scatter)

    def quality(self, step: int, previous: bool = False) -> StepFields:
        """Collect the correlation coefficients and the known standard deviations of a step, by name of the field.

        previous : those of the motion since the step before, instead of since the reference; the part of
        the calibration is then unknown and left out.
        """
        known = {name: values[step] for name in OPTIONAL_ARRAYS if (values := getattr(self, name)) is not None}
        if previous:
            known.pop("sigma_displacement_calibration", None)
            known.pop("sigma_lambda_calibration", None)
            known |= self._noise_since_step_before(step) if step >= 2 else {}
        point = {"correlation": self.correlation[step], "sigma_xyz": self.sigma_xyz[step]}
        face: dict[str, Floats] = {}
        for name, values in known.items():
            if OPTIONAL_ARRAYS[name] == "face":
                face[f"{name}1"], face[f"{name}2"] = values.T
            else:
                point[name] = values
        return StepFields(point, face)

    def _noise_since_step_before(self, step: int) -> dict[str, Floats]:
        """Standard deviations of displacements (N, 3) mm and stretches (M, 2) since the step before, as far as known.

        Half of the variance of a motion since the reference comes from the reference image and half from the step's
        own. The reference image cancels between two steps, which leaves their own halves. Both stretches get the mean
        variance of the two, because the principal directions have turned in between, divided by the area ratio of the
        step before, because the triangle has changed its size.
        """
        known: dict[str, Floats] = {}
        for name in ("sigma_displacement", "sigma_lambda"):
            sigma = getattr(self, name)
            if sigma is not None:
                known[name] = np.sqrt(0.5 * (sigma[step] ** 2 + sigma[step - 1] ** 2))
        if (sigma := known.get("sigma_lambda")) is not None:
            mean = np.sqrt(np.mean(sigma**2, axis=1, keepdims=True) / self.deformation(step - 1).J[:, None])
            known["sigma_lambda"] = np.broadcast_to(mean, sigma.shape)
        return known


def _check(holder: object, shapes: dict[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        if np.shape(getattr(holder, name)) != shape:
            raise ValueError(f"{name} has shape {np.shape(getattr(holder, name))}, wanted {shape}")
