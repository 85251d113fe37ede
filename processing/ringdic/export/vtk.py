"""Export for the Visualization Toolkit: one VTKHDF file of all steps, or one XML PolyData file a step."""

from __future__ import annotations

import base64
from pathlib import Path
from xml.etree import ElementTree as ET

import h5py
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask
from ringdic.results import vtkhdf
from ringdic.results.evaluation import EvaluatedResults
from ringdic.results.fields import StepFields

_TYPES = {"f4": "Float32", "f8": "Float64", "u1": "UInt8", "i1": "Int8", "i8": "Int64"}
Arrays = dict[str, NDArray[np.generic]]


def export_vtkhdf(results: EvaluatedResults, out: Path) -> None:
    """Write the moving surface with all fields, vectors and tensors into one VTKHDF file."""
    with h5py.File(out, "w") as file:
        group = vtkhdf.create_group(file, results.results.faces, len(results.results.vertices_ref), len(results.steps))
        for step in range(len(results.steps)):
            positions, point, cell = _step(results, step)
            vtkhdf.write_step(group, step, positions, point, cell)


def export_vtp(results: EvaluatedResults, out: Path) -> None:
    """Write ``STEP.vtp`` for every step and ``series.pvd``, which opens them as one series, into the folder ``out``."""
    for step, name in enumerate(results.steps):
        positions, point, cell = _step(results, step)
        _write(out / f"{name}.vtp", _poly_data(positions, results.results.faces, point, cell))
    series = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(series, "Collection")
    for step, name in enumerate(results.steps):
        ET.SubElement(collection, "DataSet", timestep=str(step), part="0", file=f"{name}.vtp")
    _write(out / "series.pvd", series)


def _step(results: EvaluatedResults, step: int) -> tuple[Floats, Arrays, Arrays]:
    """Positions of a step (N, 3) mm, and its arrays of the points and of the triangles.

    VTK cannot draw NaN: a lost point stays at its reference position and is marked by the array ``measured``.
    """
    current = results.positions(step)
    measured: Mask = np.asarray(np.isfinite(current).all(axis=1))
    flags: Arrays = {
        "measured": measured.astype(np.uint8),
        "status": results.results.status[step].astype(np.int8),
    }
    fields = results.step(step)
    point, cell = (_arrays(results, fields, location) for location in ("point", "face"))
    return np.where(measured[:, None], current, results.results.vertices_ref), point | flags, cell


def _arrays(results: EvaluatedResults, fields: StepFields, location: str) -> Arrays:
    """Vectors and tensors, and the scalar fields that are neither a component nor the length of one of these.

    Vectors of standard deviations are those by noise and calibration together, and by the calibration alone.
    """
    arrays = (fields.point if location == "point" else fields.face) | fields.joint_deviations(location)
    wide = {name: values for name, values in arrays.items() if values.ndim > 1}
    scalars = {
        entry.name: fields.scalar(entry)
        for entry in results.fields
        if entry.location == location and (entry.name.endswith("_noise") or not any(name in wide for name in entry.of))
    }
    return {name: np.asarray(values, dtype=np.float32) for name, values in (wide | scalars).items()}


def _poly_data(positions: Floats, faces: Indices, point: Arrays, cell: Arrays) -> ET.Element:
    root = ET.Element("VTKFile", type="PolyData", version="1.0", byte_order="LittleEndian", header_type="UInt64")
    piece = ET.SubElement(
        ET.SubElement(root, "PolyData"), "Piece", NumberOfPoints=str(len(positions)), NumberOfPolys=str(len(faces))
    )
    _array(ET.SubElement(piece, "Points"), "Points", positions)
    polygons = ET.SubElement(piece, "Polys")
    _array(polygons, "connectivity", faces.astype(np.int64).ravel())
    _array(polygons, "offsets", np.arange(3, faces.size + 1, 3, dtype=np.int64))
    for place, arrays in (("PointData", point), ("CellData", cell)):
        holder = ET.SubElement(piece, place)
        for name, values in arrays.items():
            _array(holder, name, values)
    return root


def _array(parent: ET.Element, name: str, values: NDArray[np.generic]) -> None:
    """Add an array as inline binary: base64 of the number of bytes followed by the bytes, both little-endian."""
    values = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    components = values.shape[1] if values.ndim == 2 else 1
    element = ET.SubElement(
        parent, "DataArray", type=_TYPES[values.dtype.str[1:]], Name=name,
        NumberOfComponents=str(components), format="binary",
    )  # fmt: skip
    data = values.tobytes()
    element.text = base64.b64encode(np.array([len(data)], dtype="<u8").tobytes() + data).decode("ascii")


def _write(path: Path, root: ET.Element) -> None:
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
