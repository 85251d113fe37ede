"""The VTKHDF group of a results file: triangles that move in time, as ParaView and VTK read them.

The layout follows the VTK file format specification, "VTKHDF", version 2.0, type PolyData: the steps of every array lie
one after the other; connectivity and constant arrays are stored once and all steps point to them.
"""

from __future__ import annotations

from collections.abc import Mapping

import h5py
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Points

_CELL_GROUPS = ("Vertices", "Lines", "Polygons", "Strips")


def create_group(file: h5py.File, faces: Indices, points: int, steps: int) -> h5py.Group:
    """Create the VTKHDF group for a surface with constant triangles; its arrays are filled by `write_step`.

    faces : (M, 3) vertex indices. points : number of vertices. steps : number of steps.
    """
    group = file.create_group("VTKHDF", track_order=True)
    group.attrs["Version"] = np.array([2, 0], dtype=np.int64)
    group.attrs["Type"] = np.bytes_("PolyData")
    group.create_dataset("NumberOfPoints", data=np.array([points], dtype=np.int64))
    group.create_dataset("Points", shape=(steps * points, 3), dtype=np.float64)
    for name in _CELL_GROUPS:
        cells = np.asarray(faces, dtype=np.int64) if name == "Polygons" else np.empty((0, 3), dtype=np.int64)
        part = group.create_group(name)
        part.create_dataset("NumberOfCells", data=np.array([len(cells)], dtype=np.int64))
        part.create_dataset("NumberOfConnectivityIds", data=np.array([cells.size], dtype=np.int64))
        part.create_dataset("Connectivity", data=cells.ravel())
        part.create_dataset("Offsets", data=np.arange(0, cells.size + 1, 3, dtype=np.int64))
    group.create_group("PointData", track_order=True)
    group.create_group("CellData", track_order=True)
    timeline = group.create_group("Steps")
    timeline.attrs["NSteps"] = np.int64(steps)
    timeline.create_dataset("Values", data=np.arange(steps, dtype=np.float64))
    timeline.create_dataset("NumberOfParts", data=np.ones(steps, dtype=np.int64))
    timeline.create_dataset("PartOffsets", data=np.zeros(steps, dtype=np.int64))
    timeline.create_dataset("PointOffsets", data=points * np.arange(steps, dtype=np.int64))
    timeline.create_dataset("CellOffsets", data=np.zeros((steps, 4), dtype=np.int64))
    timeline.create_dataset("ConnectivityIdOffsets", data=np.zeros((steps, 4), dtype=np.int64))
    timeline.create_group("PointDataOffsets")
    timeline.create_group("CellDataOffsets")
    return group


def write_step(
    group: h5py.Group,
    step: int,
    positions: Points,
    point: Mapping[str, NDArray[np.generic]],
    cell: Mapping[str, NDArray[np.generic]],
) -> None:
    """Write the positions and the arrays of one step.

    positions : (N, 3) mm, all finite. point : arrays (N, ...) of the vertices by name. cell : arrays (M, ...) of the
    triangles by name.
    """
    rows = len(positions)
    group["Points"][step * rows : (step + 1) * rows] = positions
    for place, arrays in (("PointData", point), ("CellData", cell)):
        for name, values in arrays.items():
            _array(group, place, name, values)[step * len(values) : (step + 1) * len(values)] = values


def write_constant(group: h5py.Group, name: str, values: NDArray[np.generic]) -> None:
    """Write an array of the triangles that is the same at every step.

    values : (M, ...), in the unit of the field of this name.
    """
    group["CellData"].create_dataset(name, data=values)
    steps = int(group["Steps"].attrs["NSteps"])
    group["Steps/CellDataOffsets"].create_dataset(name, data=np.zeros(steps, dtype=np.int64))


def read_step(group: h5py.Group, place: str, name: str, step: int) -> NDArray[np.generic]:
    """Read one array at one step: (N, ...) or (M, ...), in the unit of the field of this name.

    place : "PointData" for an array of the vertices, "CellData" for one of the triangles.
    """
    rows = int(group["NumberOfPoints" if place == "PointData" else "Polygons/NumberOfCells"][0])
    start = int(group["Steps"][f"{place}Offsets"][name][step])
    return np.asarray(group[place][name][start : start + rows])


def read_steps(group: h5py.Group, name: str, kind: str, steps: int) -> Floats | None:
    """Read one array at all steps, in the unit of the field of this name; None where the group does not have it.

    kind : "point" for an array (F, N), "vector" for (F, N, 3), "face" for (F, M, 2), whose two components are stored
    under the name with 1 and 2 appended. steps : their number F.
    """
    places = [f"CellData/{name}{k}" for k in (1, 2)] if kind == "face" else [f"PointData/{name}"]
    if not all(place in group for place in places):
        return None
    parts = [group[place][:].astype(float) for place in places]
    stored = np.stack(parts, axis=-1) if kind == "face" else parts[0]
    return stored.reshape(steps, -1, *stored.shape[1:])


def _array(group: h5py.Group, place: str, name: str, values: NDArray[np.generic]) -> h5py.Dataset:
    """The dataset of an array at all steps, created when its first step is written."""
    if name not in group[place]:
        steps = int(group["Steps"].attrs["NSteps"])
        group[place].create_dataset(name, shape=(steps * len(values), *values.shape[1:]), dtype=values.dtype)
        offsets = len(values) * np.arange(steps, dtype=np.int64)
        group["Steps"][f"{place}Offsets"].create_dataset(name, data=offsets)
    return group[place][name]
