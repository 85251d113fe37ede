"""Time series of fields at material points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ringdic.measure.place import Place
from ringdic.measure.table import Table
from ringdic.results.evaluation import EvaluatedResults


def time_series(results: EvaluatedResults, places: Sequence[Place], fields: Sequence[str] = ()) -> Table:
    """Position and fields of material points at every step; one row per point and step.

    Fields of points are interpolated at the place, fields of triangles are those of its triangle. fields : names; all
    fields unless given. Raises InputError for an unknown field.
    """
    entries = [results.field(name) for name in fields] if fields else list(results.fields)
    faces = results.results.faces
    rows: list[dict[str, Any]] = []
    for step, name in enumerate(results.steps):
        arrays = results.step(step)
        values = {entry.name: arrays.scalar(entry) for entry in entries}
        positions = results.positions(step)
        for number, place in enumerate(places):
            x, y, z = place.at(positions, faces)
            row: dict[str, Any] = {"place": place.label, "step": step, "capture": name, "x": x, "y": y, "z": z}
            for entry in entries:
                here = values[entry.name]
                row[entry.name] = float(place.at(here, faces) if entry.location == "point" else here[place.face])
            rows.insert((number + 1) * (step + 1) - 1, row)  # all steps of a point in succession
    units = {"x": "mm", "y": "mm", "z": "mm", **{entry.name: entry.unit for entry in entries}}
    return Table.of_rows(rows, units, _notes(results, places))


def _notes(results: EvaluatedResults, places: Sequence[Place]) -> list[str]:
    reference = results.results.vertices_ref
    return [
        f"{place.label} is in triangle {place.face}, in the reference at "
        f"({', '.join(f'{c:.3f}' for c in np.asarray(place.at(reference, results.results.faces)))}) mm"
        for place in places
    ]
