"""Every step as a surface: PLY with fields, GLB with colours. Triangles that lost a corner are left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from processing.fields import FIELDS
from processing.mesh import Mesh
from processing.results import read_field, read_mesh, read_positions, read_summary

#: A sequential scale from dark blue to yellow, evenly rising in lightness; rows are RGB, 0 … 255.
_SCALE = np.array([[40, 24, 90], [50, 80, 140], [34, 140, 140], [96, 200, 96], [250, 230, 40]], dtype=float)
_GLTF_FROM_WORLD = 1e-3 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def export_ply(results_path: Path, out: Path) -> None:
    """Write ``STEP.ply`` (binary, mm) for every step, with every field as a property of its vertices or faces."""
    for step, name in enumerate(read_summary(results_path)["steps"]):
        mesh, kept, whole = _measured(results_path, step)
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        for entry in FIELDS:
            values, location = read_field(results_path, entry.name, step)
            if location == "point":
                solid.vertex_attributes[entry.name] = values[kept]
            else:
                solid.face_attributes[entry.name] = values[whole]
        solid.export(out / f"{name}.ply", file_type="ply")


def export_glb(results_path: Path, out: Path) -> None:
    """Write ``STEP.glb`` for every step, coloured by the length of the displacement, one scale for all steps.

    glTF's conventions: metres, y upwards (the target's z).
    """
    summary = read_summary(results_path)
    displacement = next(row for row in summary["fields"] if row["name"] == "displacement")
    low, high = displacement["range"] or (0.0, 0.0)
    for step, name in enumerate(summary["steps"]):
        mesh, kept, _ = _measured(results_path, step)
        values, _ = read_field(results_path, "displacement", step)
        colours = _colours(values[kept], low, high)
        solid = trimesh.Trimesh(mesh.vertices @ _GLTF_FROM_WORLD.T, mesh.faces, vertex_colors=colours, process=False)
        solid.export(out / f"{name}.glb", file_type="glb")


def _measured(results_path: Path, step: int) -> tuple[Mesh, NDArray[np.int64], NDArray[np.bool_]]:
    """The measured part of a step, the old index of its vertices, and which triangles it has."""
    moved = Mesh(read_positions(results_path, step), read_mesh(results_path).faces)
    whole = moved.whole_faces()
    mesh, kept = Mesh(moved.vertices, moved.faces[whole]).compact()
    return mesh, kept, whole


def _colours(values: NDArray[np.float32], low: float, high: float) -> NDArray[np.uint8]:
    """RGBA (n, 4) on the sequential scale from ``low`` to ``high``."""
    share = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0) * (len(_SCALE) - 1)
    rgb = np.stack([np.interp(share, np.arange(len(_SCALE)), _SCALE[:, i]) for i in range(3)], axis=1)
    return np.column_stack([rgb, np.full(len(rgb), 255.0)]).astype(np.uint8)
