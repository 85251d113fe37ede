"""Reading of results.h5: all results of a run, or its summary, its mesh, the positions or a field at one step.

The layout of the file is drawn in `ringdic.results.layout`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Points
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.mesh.mesh import Mesh
from ringdic.results import vtkhdf
from ringdic.results.fields import OPTIONAL_ARRAYS, Field, available
from ringdic.results.fields import field as field_of
from ringdic.results.layout import SCHEMA
from ringdic.results.results import MATCH_ARRAYS, Matches, Results
from ringdic.results.unmeasured import UnmeasuredPlaces
from ringdic.session.json_text import parse_json
from ringdic.strain.rigid_motion import RigidMotion

# What h5py and numpy raise for a file whose parts are damaged or missing.
_DAMAGE = (LookupError, ValueError, TypeError, AttributeError, OSError, RuntimeError, SystemError, MemoryError)
_DEEPEST = 8  # groups within groups; a results file has three


def read_results(path: Path, matches: bool = True) -> Results:
    """Read all results in a file; fields are not read, since they follow from the positions.

    matches : whether to read the 2D matches as well.
    Raises InputError for a file that is missing, unreadable, unfinished or of another schema.
    """
    with _open(path) as file:
        own, group = file["ringdic"], file["VTKHDF"]
        steps = tuple(parse_json(own.attrs["steps"]))
        F, N = len(steps), len(own["reference"])
        measured = group["PointData/measured"][:].reshape(F, N).astype(bool)
        optional: dict[str, Any] = {
            name: vtkhdf.read_steps(group, name, kind, F) for name, kind in OPTIONAL_ARRAYS.items()
        }
        return Results(
            rig=str(own.attrs["rig"]),
            steps=steps,
            cameras=tuple(_read_camera(own["cameras"], name) for name in parse_json(own.attrs["cameras"])),
            pairs=_pairs(own),
            vertices_ref=own["reference"][:],
            vertices=np.where(measured[..., None], group["Points"][:].reshape(F, N, 3), np.nan),
            faces=own["faces"][:],
            pair=own["pair"][:],
            vertex_pair=own["vertex_pair"][:],
            correlation=group["PointData/correlation"][:].reshape(F, N).astype(float),
            sigma_xyz=group["PointData/sigma_xyz"][:].reshape(F, N, 3).astype(float),
            status=group["PointData/status"][:].reshape(F, N),
            matches=_read_matches(own["matches"]) if matches else (),
            settings=_text(own, "settings"),
            calibration=parse_json(_text(own, "calibration")),
            summary=parse_json(_text(own, "summary")),
            unmeasured=_read_unmeasured(own),
            **optional,
        )


def read_summary(path: Path) -> dict[str, Any]:
    """Read a file's contents except its arrays, as JSON values: rig, steps, cameras, pairs, counts, table of fields.

    ``fields`` : name, label, unit, location, centre, group, rigid (whether removing the rigid motion changes it),
    ``range`` (2nd to 98th percentile over all steps after the reference), ``steps`` ([least, greatest] of each step,
    null where nothing was measured), and ``range_without_rigid_motion``, ``steps_without_rigid_motion`` where rigid.
    """
    with _open(path) as file:
        own = file["ringdic"]
        return {
            "schema": int(own.attrs["schema"]),
            "rig": str(own.attrs["rig"]),
            "steps": parse_json(own.attrs["steps"]),
            "cameras": parse_json(own.attrs["cameras"]),
            "pairs": parse_json(own.attrs["pairs"]),
            "points": len(own["reference"]),
            "faces": len(own["faces"]),
            "fields": parse_json(own.attrs["fields"]),
            "summary": parse_json(_text(own, "summary")),
        }


def read_unmeasured(path: Path) -> tuple[UnmeasuredPlaces, ...]:
    """Textured places of each camera's reference image that were not measured; empty in a file without them."""
    with _open(path) as file:
        return _read_unmeasured(file["ringdic"])


def read_mesh(path: Path) -> Mesh:
    """The surface in the reference configuration."""
    with _open(path) as file:
        return Mesh(file["ringdic/reference"][:], file["ringdic/faces"][:])


def read_positions(path: Path, step: int, rigid_motion_removed: bool = False) -> Points:
    """Positions of the vertices at one step, (N, 3) mm in the world frame, NaN where lost.

    Raises InputError for a step that the file does not have.
    """
    with _open(path) as file:
        own = file["ringdic"]
        _check_step(path, own, step)
        positions = _positions(file, step)
        return _rigid_motion(own, step).apply(positions) if rigid_motion_removed else positions


def read_field(path: Path, name: str, step: int, rigid_motion_removed: bool = False) -> tuple[NDArray[np.float32], str]:
    """Values of one scalar field at one step, in the field's unit, and its location.

    The values are (N,) where the location is "point", (M,) where it is "face"; NaN where lost.
    Raises InputError for a field or a step that the file does not have.
    """
    with _open(path) as file:
        own, group = file["ringdic"], file["VTKHDF"]
        _check_step(path, own, step)
        entry = _field_in(path, group, name)
        place = "PointData" if entry.location == "point" else "CellData"

        def array(stored: str) -> Floats:
            if stored != "displacement_without_rigid_motion":
                return np.asarray(vtkhdf.read_step(group, place, stored, step), dtype=float)
            return np.asarray(_rigid_motion(own, step).apply(_positions(file, step)) - own["reference"][:])

        return entry.from_arrays(array, rigid_motion_removed).astype(np.float32), entry.location


def _positions(file: h5py.File, step: int) -> Points:
    """Positions (N, 3) mm at a step, NaN where lost."""
    group, rows = file["VTKHDF"], len(file["ringdic/reference"])
    positions = group["Points"][step * rows : (step + 1) * rows]
    positions[vtkhdf.read_step(group, "PointData", "measured", step) == 0] = np.nan
    return np.asarray(positions)


def _rigid_motion(own: h5py.Group, step: int) -> RigidMotion:
    return RigidMotion(own["rigid_motion/R"][step], own["rigid_motion/t"][step])


def _field_in(path: Path, group: h5py.Group, name: str) -> Field:
    """The field of a name; InputError where the file does not have the arrays that it follows from."""
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


@contextmanager
def _open(path: Path) -> Iterator[h5py.File]:
    """Context with an open results file. InputError names the file where it is missing, damaged or of another kind."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such results file; process the session first")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise InputError(f"{path}: not readable as HDF5 ({error})") from error
    with file:
        try:
            state = path.stat()
            _check_that_it_stands_alone(path, state.st_mtime_ns, state.st_size)
            _check_schema(path, file)
            yield file
        except InputError:
            raise
        except _DAMAGE as error:
            raise InputError(f"{path}: the results are damaged ({error}); process the session again") from error


@lru_cache(maxsize=64)
def _check_that_it_stands_alone(path: Path, _changed_ns: int, _size: int) -> None:
    """Refuse a file whose data lie in other files, which HDF5 would read whatever they are. Nothing of ours does so."""

    with h5py.File(path, "r") as file:
        for name, item in _links_of(file, ""):
            apart = isinstance(item, h5py.Dataset) and (item.is_virtual or item.external)
            if apart or isinstance(item, h5py.ExternalLink):
                raise InputError(f"{path}: '{name}' lies in another file, as no results of RingDIC do; it is not read")


def _links_of(group: h5py.Group, prefix: str, depth: int = 0) -> Iterator[tuple[str, object]]:
    """Names of everything in a group and below, with the datasets, and the links to elsewhere in place of their ends.

    h5py's own walk ends with an error of the interpreter in a damaged file.
    """
    if depth > _DEEPEST:
        raise InputError(f"{prefix}: groups within groups, as no results of RingDIC have; process the session again")
    for name in group:
        link = group.get(name, getlink=True)
        item = group[name] if isinstance(link, h5py.HardLink) else link
        yield f"{prefix}{name}", item
        if isinstance(item, h5py.Group):
            yield from _links_of(item, f"{prefix}{name}/", depth + 1)


def _check_schema(path: Path, file: h5py.File) -> None:
    """Refuse a file that is not a whole results file of the schema that this version reads."""
    if "ringdic" not in file or "VTKHDF" not in file:
        raise InputError(f"{path}: an HDF5 file, but not results of a processing run")
    schema = file["ringdic"].attrs.get("schema")
    if schema is None:
        raise InputError(f"{path}: the results were not written to their end; process the session again")
    if int(schema) != SCHEMA:
        remedy = "update RingDIC, or process the session again" if schema > SCHEMA else "process the session again"
        raise InputError(f"{path}: results of schema {int(schema)}, but this version reads schema {SCHEMA}; {remedy}")


def _check_step(path: Path, own: h5py.Group, step: int) -> None:
    count = len(parse_json(own.attrs["steps"]))
    if not 0 <= step < count:
        raise InputError(f"{path}: no step {step}; there are {count}, from 0, the reference")


def _pairs(own: h5py.Group) -> tuple[tuple[str, str], ...]:
    return tuple((first, second) for first, second in parse_json(own.attrs["pairs"]))


def _text(own: h5py.Group, name: str) -> str:
    return str(own[name].asstr()[()])


def _read_camera(cameras: h5py.Group, name: str) -> Camera:
    group = cameras[name]
    size = (int(group["size"][0]), int(group["size"][1]))
    lens = Intrinsics(group["K"][:], group["distortion"][:], size) if "K" in group else None
    return Camera(name, group["P"][:], size, lens)


def _read_unmeasured(own: h5py.Group) -> tuple[UnmeasuredPlaces, ...]:
    """Unmeasured places of all cameras, in the order of the cameras."""
    groups = own.get("unmeasured", {})
    return tuple(
        UnmeasuredPlaces(
            name, groups[name]["px"][:].astype(float), float(groups[name].attrs["spacing"]),
            groups[name]["status"][:], groups[name]["area"][:],
        )
        for name in parse_json(own.attrs["cameras"])
        if name in groups
    )  # fmt: skip


def _read_matches(groups: h5py.Group) -> tuple[Matches, ...]:
    """The matches in the groups "0", "1", …, in this order."""
    matches = []
    for name in sorted(filter(str.isdigit, groups), key=int):
        group = groups[name]
        arrays = {array: group[array][:] for array in ("xy", "vertex", *MATCH_ARRAYS)}
        cameras = tuple(parse_json(group.attrs["cameras"]))
        matches.append(Matches(cameras=cameras, seconds=parse_json(group.attrs["seconds"]), **arrays))
    return tuple(matches)
