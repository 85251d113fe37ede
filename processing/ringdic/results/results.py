"""The results of a processing run, and the one HDF5 file that keeps them.

::

    results.h5
      VTKHDF/                    moving triangles with the arrays that all fields follow from: opens in ParaView (a lost
                                 point stays at its reference position there, with ``measured`` = 0 and NaN fields)
      ringdic/                   attributes: schema, rig, steps, pairs, cameras, fields (JSON where not plain)
        reference                (N, 3) mm
        faces, pair, vertex_pair
        rigid_motion/R, t        per step, the motion that takes it back onto the reference
        cameras/<id>/            P, size, and K, distortion where the lens is known
        matches/<k>/             2D matches of a camera pair, or of a camera alone: xy, px, c_ls, sigma, status, vertex
        settings, calibration, summary    text: TOML, JSON, JSON

What follows from the stored arrays is computed when it is read: a step takes about 100 bytes a point, 130 a triangle.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.mesh.mesh import Mesh
from ringdic.results import vtkhdf
from ringdic.results.fields import Field, StepFields, StepQuality, available, compute_fields
from ringdic.results.fields import field as field_of
from ringdic.settings import settings_of_run
from ringdic.strain.deformation import Deformation, deformation
from ringdic.strain.rigid_motion import RigidMotion, motion_to_reference
from ringdic.strain.window import StrainWindow
from ringdic.uncertainty.strain import overlap
from ringdic.uncertainty.window import WindowScatter, window_scatter

SCHEMA = 2

#: Arrays of a result that not every run has, and whether they have a number or a vector a point, or two numbers a face.
WHERE_KNOWN = {
    "sigma_displacement": "vector", "sigma_lambda": "face", "chi2": "point", "sigma_calibration": "vector",
    "sigma_displacement_calibration": "vector", "sigma_lambda_calibration": "face",
}  # fmt: skip


@dataclass(frozen=True)
class Matches:
    """2D matches of a camera pair at F steps, or of a camera alone that followed its own points in time.

    cameras : the C ids, reference camera first. xy : (n, 2) px in the reference image. px : (F, C, n, 2) in their
    images. c_ls : (F, n). sigma : (F, C, n, 2) px. status : (F, n), 0 good. vertex : (n,) index of the vertex, or -1.
    seconds : time spent by stage. Of a camera alone, xy is the place as it was matched from another camera, px at the
    reference the projection of the vertex, from which the point is followed, and sigma there that of xy.
    """

    cameras: tuple[str, ...]
    xy: Floats
    px: Floats
    c_ls: Floats
    sigma: Floats
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
    """Everything a run found. F steps including the reference, N vertices, M triangles; mm, world frame.

    rig : its name. steps : (F) capture ids. cameras : all that were calibrated. pairs : camera ids of the pairs.
    vertices_ref : (N, 3), finite. vertices : (F, N, 3), NaN where lost. faces : (M, 3), normals outwards.
    pair : (M,) index of the pair, -1 where a face joins two. vertex_pair : (N,).
    correlation : (F, N) C_LS, the largest over the images used. sigma_xyz : (F, N, 3). status : (F, N), 0 measured.
    settings : TOML text. calibration, summary : JSON values.
    sigma_displacement : (F, N, 3) mm; sigma_lambda : (F, M, 2), of λ1 and λ2 of each triangle; chi2 : (F, N), a degree
    of freedom. sigma_calibration, sigma_displacement_calibration : (F, N, 3) mm, sigma_lambda_calibration : (F, M, 2),
    by the covariance of the cameras alone. Each None where it was not found.
    """

    rig: str
    steps: tuple[str, ...]
    cameras: tuple[Camera, ...]
    pairs: tuple[tuple[str, str], ...]
    vertices_ref: Floats
    vertices: Floats
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
        where_known = {name: (F, *ends[kind]) for name, kind in WHERE_KNOWN.items()}
        _check(self, {name: shape for name, shape in where_known.items() if getattr(self, name) is not None})
        if not np.isfinite(self.vertices_ref).all():
            raise ValueError("a vertex without a reference position cannot be tracked; leave it out")
        Mesh(self.vertices_ref, self.faces)

    @property
    def mesh(self) -> Mesh:
        """The surface in the reference configuration."""
        return Mesh(self.vertices_ref, self.faces)

    @property
    def window_mm(self) -> float:
        """Width of the strain window that the run was told to use; 0 for the triangles alone."""
        return settings_of_run(self.settings).strain.window_mm

    @property
    def radius_px(self) -> int | None:
        """Radius of the subsets that the run was told to use; None where the settings do not say."""
        group = settings_of_run(self.settings).correlation
        return group.radius_px if "radius_px" in group.model_fields_set else None

    @property
    def pixels_a_mm(self) -> float:
        """How large a mm is in the images, px: the median over the points, across the line of sight of the first camera
        of each one's pair. NaN where no camera is known."""
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
        """What the windows make of the displacements' scatter; None where that or the size of the subsets is unknown.

        Subsets are taken to lie as far apart in the images as the points do on the surface seen squarely.
        """
        scale, radius = self.pixels_a_mm, self.radius_px
        if self.sigma_displacement is None or radius is None or not np.isfinite(scale):
            return None
        return window_scatter(window, lambda apart: overlap(apart * scale, radius), (2 * radius + 1) / scale)

    def before(self, step: int, previous: bool = False) -> Floats:
        """Positions (N, 3) mm that a step is compared with: the reference, or the step before it (NaN where lost)."""
        return self.vertices[step - 1] if previous and step > 0 else self.vertices_ref

    def motion(self, step: int, previous: bool = False) -> RigidMotion:
        """The rigid motion that takes a step back onto the reference, or onto the step before it."""
        return motion_to_reference(self.before(step, previous), self.vertices[step])

    def deformation(
        self,
        step: int,
        rigid_motion_removed: bool = False,
        previous: bool = False,
        window: StrainWindow | None = None,
    ) -> Deformation:
        """Every deformation field of a step, in full precision.

        previous : from the step before it, not from the reference. window : over its windows, not of the triangles.
        """
        current = self.vertices[step]
        if rigid_motion_removed:
            current = self.motion(step, previous).apply(current)
        if window is not None:
            return window.deformation(current, self.before(step, previous))
        return deformation(self.before(step, previous), current, self.faces)

    def fields(
        self,
        step: int,
        window: StrainWindow | None = None,
        previous: bool = False,
        rigid_motion_removed: bool = False,
        scatter: WindowScatter | None = None,
    ) -> StepFields:
        """The arrays of a step that every field follows from; the arguments as of :meth:`deformation`.

        scatter : of the windows, for the standard deviations of strain over them.
        """
        motion, current = self.motion(step, previous), self.vertices[step]
        if rigid_motion_removed:
            motion, current = RigidMotion(np.eye(3), np.zeros(3)), motion.apply(current)
        certainty = self.certainty(step, previous)
        return compute_fields(
            self.before(step, previous), current, self.faces, motion, certainty, self.pair, window, scatter
        )

    def certainty(self, step: int, previous: bool = False) -> StepQuality:
        """What is known of each point and triangle beside its place; previous as of :meth:`deformation`."""
        of_motion = None if previous else step  # what cameras add is known of the motion since the reference
        return StepQuality(
            self.correlation[step],
            self.sigma_xyz[step],
            self._since(self.sigma_displacement, step, previous),
            self._stretches_since(step, previous),
            _at(self.chi2, step),
            _at(self.sigma_calibration, step),
            _at(self.sigma_displacement_calibration, of_motion),
            _at(self.sigma_lambda_calibration, of_motion),
        )

    def _since(self, sigma: Floats | None, step: int, previous: bool) -> Floats | None:
        """Standard deviations of a step's motion, since the reference or since the step before it.

        Half of the variance of a motion since the reference is the reference image's, half the step's own: two
        motions differ by the halves of the two steps.
        """
        if sigma is None or not previous or step < 2:
            return _at(sigma, step)
        return np.asarray(np.sqrt(0.5 * (sigma[step] ** 2 + sigma[step - 1] ** 2)))

    def _stretches_since(self, step: int, previous: bool) -> Floats | None:
        """The same of the stretches: the step before turned and sized the triangle, so both have their mean."""
        sigma = self._since(self.sigma_lambda, step, previous)
        if sigma is None or not previous or step < 2:
            return sigma
        mean = np.sqrt(np.mean(sigma**2, axis=1, keepdims=True) / self.deformation(step - 1).J[:, None])
        return np.broadcast_to(mean, sigma.shape)


def _at(known: Floats | None, step: int | None) -> Floats | None:
    return None if known is None or step is None else known[step]


def read_results(path: Path, matches: bool = True) -> Results:
    """The results of a file, as they were written (fields are not read: they follow from the positions).

    matches : whether the 2D matches are wanted as well.
    """
    with _open(path) as file:
        own, group = file["ringdic"], file["VTKHDF"]
        steps = tuple(json.loads(own.attrs["steps"]))
        F, N = len(steps), len(own["reference"])
        measured = group["PointData/measured"][:].reshape(F, N).astype(bool)
        known: dict[str, Any] = {name: vtkhdf.read_steps(group, name, kind, F) for name, kind in WHERE_KNOWN.items()}
        return Results(
            rig=str(own.attrs["rig"]),
            steps=steps,
            cameras=tuple(_read_camera(own["cameras"], name) for name in json.loads(own.attrs["cameras"])),
            pairs=_pairs(own),
            vertices_ref=own["reference"][:],
            vertices=np.where(measured[..., None], group["Points"][:].reshape(F, N, 3), np.nan),
            faces=own["faces"][:],
            pair=own["pair"][:],
            vertex_pair=own["vertex_pair"][:],
            correlation=group["PointData/correlation"][:].reshape(F, N).astype(float),
            sigma_xyz=group["PointData/sigma_xyz"][:].reshape(F, N, 3).astype(float),
            status=group["PointData/status"][:].reshape(F, N),
            matches=tuple(_read_matches(own["matches"][str(k)]) for k in range(len(own["matches"]) if matches else 0)),
            settings=_text(own, "settings"),
            calibration=json.loads(_text(own, "calibration")),
            summary=json.loads(_text(own, "summary")),
            **known,
        )


def read_summary(path: Path) -> dict[str, Any]:
    """What a file holds, as JSON values: rig, steps, cameras, pairs, counts, the table of fields with their ranges.

    ``fields`` : name, label, unit, location, centre, group, rigid (whether removing the rigid motion changes it),
    ``range`` (2nd to 98th percentile over all steps after the reference), ``steps`` ([least, greatest] of each step,
    null where nothing was measured), and ``range_without_rigid_motion``, ``steps_without_rigid_motion`` where rigid.
    """
    with _open(path) as file:
        own = file["ringdic"]
        return {
            "schema": int(own.attrs["schema"]),
            "rig": str(own.attrs["rig"]),
            "steps": json.loads(own.attrs["steps"]),
            "cameras": json.loads(own.attrs["cameras"]),
            "pairs": json.loads(own.attrs["pairs"]),
            "points": len(own["reference"]),
            "faces": len(own["faces"]),
            "fields": json.loads(own.attrs["fields"]),
            "summary": json.loads(_text(own, "summary")),
        }


def read_mesh(path: Path) -> Mesh:
    """The surface in the reference configuration."""
    with _open(path) as file:
        return Mesh(file["ringdic/reference"][:], file["ringdic/faces"][:])


def read_positions(path: Path, step: int, rigid_motion_removed: bool = False) -> Floats:
    """Positions of the vertices at one step. (N, 3) mm, NaN where lost. Raises InputError for a step it has not."""
    with _open(path) as file:
        group, own = file["VTKHDF"], file["ringdic"]
        _check_step(path, own, step)
        rows = len(own["reference"])
        positions = group["Points"][step * rows : (step + 1) * rows]
        positions[vtkhdf.read_step(group, "PointData", "measured", step) == 0] = np.nan
        motion = RigidMotion(own["rigid_motion/R"][step], own["rigid_motion/t"][step])
        return motion.apply(positions) if rigid_motion_removed else positions


def read_field(path: Path, name: str, step: int, rigid_motion_removed: bool = False) -> tuple[NDArray[np.float32], str]:
    """One scalar field at one step, and whether it lies on each "point" (N,) or each "face" (M,); NaN where lost.

    Raises InputError for a field or a step that the results do not have.
    """
    with _open(path) as file:
        own, group = file["ringdic"], file["VTKHDF"]
        _check_step(path, own, step)
        entry = _field_in(path, group, name)
        place = "PointData" if entry.location == "point" else "CellData"

        def array(stored: str) -> Floats:
            if stored != "displacement_without_rigid_motion":
                return np.asarray(vtkhdf.read_step(group, place, stored, step), dtype=float)
            rows = len(own["reference"])
            positions = group["Points"][step * rows : (step + 1) * rows]
            positions[vtkhdf.read_step(group, "PointData", "measured", step) == 0] = np.nan
            motion = RigidMotion(own["rigid_motion/R"][step], own["rigid_motion/t"][step])
            return np.asarray(motion.apply(positions) - own["reference"][:])

        return entry.from_arrays(array, rigid_motion_removed).astype(np.float32), entry.location


def _field_in(path: Path, group: h5py.Group, name: str) -> Field:
    """The field of a name if the file has what it follows from."""
    stored = {*group["PointData"], *group["CellData"]}
    try:
        entry = field_of(name)
    except KeyError:
        raise InputError(f"no field '{name}'; there are {', '.join(f.name for f in available(stored))}") from None
    if set(entry.of) <= stored:
        return entry
    if name.startswith("window_"):
        raise InputError(
            f"{path}: no field '{name}': the run had no strain window; process with --set strain.window_mm=5, "
            "or export these results with --window 5"
        )
    raise InputError(f"{path}: no field '{name}': the run did not find it")


def _open(path: Path) -> h5py.File:
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such results file; process the session first")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise InputError(f"{path}: not readable as HDF5 ({error})") from error
    if "ringdic" not in file or "VTKHDF" not in file:
        file.close()
        raise InputError(f"{path}: an HDF5 file, but not results of a processing run")
    return file


def _check_step(path: Path, own: h5py.Group, step: int) -> None:
    count = len(json.loads(own.attrs["steps"]))
    if not 0 <= step < count:
        raise InputError(f"{path}: no step {step}; there are {count}, from 0, the reference")


def _check(holder: object, shapes: dict[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        if np.shape(getattr(holder, name)) != shape:
            raise ValueError(f"{name} has shape {np.shape(getattr(holder, name))}, wanted {shape}")


def _pairs(own: h5py.Group) -> tuple[tuple[str, str], ...]:
    return tuple((first, second) for first, second in json.loads(own.attrs["pairs"]))


def _text(own: h5py.Group, name: str) -> str:
    return str(own[name].asstr()[()])


def _read_camera(cameras: h5py.Group, name: str) -> Camera:
    group = cameras[name]
    size = (int(group["size"][0]), int(group["size"][1]))
    lens = Intrinsics(group["K"][:], group["distortion"][:], size) if "K" in group else None
    return Camera(name, group["P"][:], size, lens)


def _read_matches(group: h5py.Group) -> Matches:
    arrays = {name: group[name][:] for name in ("xy", "px", "c_ls", "sigma", "status", "vertex")}
    cameras = tuple(json.loads(group.attrs["cameras"]))
    return Matches(cameras=cameras, seconds=json.loads(group.attrs["seconds"]), **arrays)
