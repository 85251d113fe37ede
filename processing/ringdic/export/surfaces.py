"""Export of every step as a surface: PLY with fields and colours, GLB with colours.

Triangles with a corner that was not measured are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices
from ringdic.results.colours import colours
from ringdic.results.evaluation import EvaluatedResults
from ringdic.results.fields import Field, StepFields

_GLTF_FROM_WORLD = 1e-3 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
DEFAULT_COLOUR = "displacement"


def export_ply(results: EvaluatedResults, out: Path, colour: str = DEFAULT_COLOUR) -> None:
    """Write ``STEP.ply`` (binary, mm) for every step, with all fields and with colours.

    Fields are properties of the vertices or faces. colour : name of the field that is coloured, with one scale for all
    steps.
    """
    paint = _Paint(results, colour)
    for step, name in enumerate(results.steps):
        fields = results.step(step)
        mesh, indices, whole = results.measured(step)
        solid = _solid(mesh.vertices, mesh.faces, paint.vertices(fields)[indices])
        for entry in results.fields:
            values = fields.scalar(entry).astype(np.float32)
            if entry.location == "point":
                solid.vertex_attributes[entry.name] = values[indices]
            else:
                solid.face_attributes[entry.name] = values[whole]
        solid.export(out / f"{name}.ply", file_type="ply")


def export_glb(results: EvaluatedResults, out: Path, colour: str = DEFAULT_COLOUR) -> None:
    """Write ``STEP.glb`` for every step, coloured by a field with one scale for all steps.

    By the conventions of glTF lengths are metres and y points upwards (z of the target).
    """
    paint = _Paint(results, colour)
    for step, name in enumerate(results.steps):
        mesh, indices, _ = results.measured(step)
        solid = _solid(mesh.vertices @ _GLTF_FROM_WORLD.T, mesh.faces, paint.vertices(results.step(step))[indices])
        solid.export(out / f"{name}.glb", file_type="glb")


def _solid(vertices: Floats, faces: Indices, rgba: NDArray[np.uint8]) -> trimesh.Trimesh:
    """A trimesh surface with vertex colours (N, 4); a surface without points has no colours."""
    return trimesh.Trimesh(vertices, faces, vertex_colors=rgba if len(rgba) else None, process=False)


class _Paint:
    """Colours of the vertices by one field; a field of faces is averaged at each vertex over its triangles."""

    def __init__(self, results: EvaluatedResults, name: str) -> None:
        self._entry: Field = results.field(name)
        self._limits = results.limits(name)
        self._faces = results.results.faces
        self._count = len(results.results.vertices_ref)

    def vertices(self, fields: StepFields) -> NDArray[np.uint8]:
        """Colours of the vertices, RGBA (N, 4) uint8."""
        values = fields.scalar(self._entry)
        if self._entry.location == "face":
            values = self._at_vertices(values)
        rgb = colours(values, *self._limits, diverging=self._entry.centre is not None)
        return np.column_stack([np.rint(255 * rgb), np.full(len(rgb), 255.0)]).astype(np.uint8)

    def _at_vertices(self, values: Floats) -> Floats:
        known = np.isfinite(values)
        corners = self._faces[known].ravel()
        total = np.bincount(corners, np.repeat(values[known], 3), self._count)
        with np.errstate(invalid="ignore"):
            return np.asarray(total / np.bincount(corners, minlength=self._count))
