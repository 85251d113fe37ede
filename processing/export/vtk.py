"""Forms of the Visualization Toolkit: the VTKHDF file of all steps, and one XML PolyData file a step."""

from __future__ import annotations

import base64
from pathlib import Path
from xml.etree import ElementTree as ET

import h5py
import numpy as np
from numpy.typing import NDArray

from processing import vtkhdf
from processing.results import read_summary

_TYPES = {"f4": "Float32", "f8": "Float64", "u1": "UInt8", "i1": "Int8", "i8": "Int64"}


def export_vtkhdf(results_path: Path, out: Path) -> None:
    """Write the moving surface alone, without what is kept beside it."""
    with h5py.File(results_path, "r") as source, h5py.File(out, "w") as target:
        source.copy("VTKHDF", target)


def export_vtp(results_path: Path, out: Path) -> None:
    """Write ``STEP.vtp`` for every step and ``series.pvd``, which opens them as one series, into the folder ``out``."""
    names = read_summary(results_path)["steps"]
    with h5py.File(results_path, "r") as file:
        group = file["VTKHDF"]
        for step, name in enumerate(names):
            _write(out / f"{name}.vtp", _poly_data(group, step))
    series = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(series, "Collection")
    for step, name in enumerate(names):
        ET.SubElement(collection, "DataSet", timestep=str(step), part="0", file=f"{name}.vtp")
    _write(out / "series.pvd", series)


def _poly_data(group: h5py.Group, step: int) -> ET.Element:
    points = int(group["NumberOfPoints"][0])
    faces = group["Polygons/Connectivity"][:]
    root = ET.Element("VTKFile", type="PolyData", version="1.0", byte_order="LittleEndian", header_type="UInt64")
    piece = ET.SubElement(
        ET.SubElement(root, "PolyData"), "Piece", NumberOfPoints=str(points), NumberOfPolys=str(len(faces) // 3)
    )
    positions = ET.SubElement(piece, "Points")
    _array(positions, "Points", group["Points"][step * points : (step + 1) * points])
    polygons = ET.SubElement(piece, "Polys")
    _array(polygons, "connectivity", faces)
    _array(polygons, "offsets", group["Polygons/Offsets"][1:])
    for place in ("PointData", "CellData"):
        holder = ET.SubElement(piece, place)
        for name in group[place]:
            _array(holder, name, vtkhdf.read_step(group, place, name, step))
    return root


def _array(parent: ET.Element, name: str, values: NDArray[np.generic]) -> None:
    """Inline binary: base64 of the number of bytes and the bytes, both little-endian."""
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
