"""A virtual extensometer: the length between two material points, along the surface and straight."""

from __future__ import annotations

from typing import Any

import numpy as np

from ringdic.measure.path import shortest_path
from ringdic.measure.place import Place
from ringdic.measure.table import Table
from ringdic.results.evaluation import EvaluatedResults

_UNITS = dict.fromkeys(("along_surface", "straight"), "mm")


def extensometer(results: EvaluatedResults, start: Place, end: Place) -> Table:
    """Length between two material points at every step, mm, and engineering strain ``L / L0 - 1``; one row per step.

    ``along_surface`` is the length of the material line that was the shortest path in the reference; ``straight`` is
    the chord. L0 is the length at the step with which each step is compared. Raises ComputationError if the places lie
    on parts of the surface that do not touch.
    """
    source = results.results
    mesh = source.mesh
    path = shortest_path(mesh, start, end)
    rows: list[dict[str, Any]] = []
    for step, name in enumerate(results.steps):
        now, before = source.vertices[step], source.reference_positions(step, results.evaluation.previous)
        row: dict[str, Any] = {"step": step, "capture": name}
        lengths = {
            "along_surface": [path.length(vertices, mesh.faces) for vertices in (now, before)],
            "straight": [
                float(np.linalg.norm(end.at(vertices, mesh.faces) - start.at(vertices, mesh.faces)))
                for vertices in (now, before)
            ],
        }
        row |= {kind: length for kind, (length, _) in lengths.items()}
        row |= {f"strain_{kind}": length / known - 1.0 for kind, (length, known) in lengths.items()}
        rows.append(row)
    note = (
        f"from {start.label} to {end.label}; the way along the surface crosses {len(path.edges)} edges; "
        "strain is the change of length over the length before"
    )
    return Table.of_rows(rows, _UNITS, [note])
