"""Fields, scales and statistics for a report, gathered in one pass, because evaluating a step is costly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.measure.region import area_weights, statistics
from ringdic.pictures.scale import Scale, on_faces
from ringdic.results.evaluation import EvaluatedResults
from ringdic.results.fields import Field
from ringdic.results.ranges import Ranges, even_limits


@dataclass(frozen=True)
class Gathered:
    """Ranges, statistics and values of a run's fields over its steps.

    steps : names. shown : indices of the steps that get maps. scales : by field, with limits for all steps.
    faces : by field and shown step, values on the triangles (M,) in the unit of the field. values : by field and shown
    step, the finite values (n,) of its points or triangles. statistics : by field and step.
    """

    steps: tuple[str, ...]
    shown: tuple[int, ...]
    scales: dict[str, Scale]
    faces: dict[tuple[str, int], NDArray[np.float32]]
    values: dict[tuple[str, int], NDArray[np.float32]]
    statistics: dict[tuple[str, int], dict[str, Any]]


def gather(
    results: EvaluatedResults,
    names: Sequence[str],
    shown: Sequence[int],
    progress: Callable[[float], None] = lambda _: None,
) -> Gathered:
    """Evaluate the named fields, where the run has them, at every step. shown : steps whose values maps need."""
    fields = [entry for name in names for entry in results.fields if entry.name == name]
    ranges = Ranges(fields)
    weights = area_weights(results.results.mesh, results.results.mesh.areas)
    faces: dict[tuple[str, int], NDArray[np.float32]] = {}
    values: dict[tuple[str, int], NDArray[np.float32]] = {}
    figures: dict[tuple[str, int], dict[str, Any]] = {}
    for step in range(len(results.steps)):
        arrays = results.step(step)
        ranges.add(arrays)
        for entry in fields:
            scalar = arrays.scalar(entry)
            figures[entry.name, step] = statistics(scalar, weights[entry.location])
            if step in shown:
                values[entry.name, step] = scalar[np.isfinite(scalar)].astype(np.float32)
                faces[entry.name, step] = on_faces(results, entry, step).astype(np.float32)
        progress((step + 1) / len(results.steps))
    scales = {entry.name: _scale(entry, row) for entry, row in zip(fields, ranges.table(), strict=True)}
    return Gathered(results.steps, tuple(shown), scales, faces, values, figures)


def _scale(entry: Field, row: dict[str, Any]) -> Scale:
    return Scale(entry, *even_limits(row["range"], entry.centre))
