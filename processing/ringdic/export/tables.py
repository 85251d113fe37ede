"""Export of the points and triangles of every step as tables of comma-separated values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ringdic.results.evaluation import EvaluatedResults
from ringdic.session.load import LoadSeries


def export_csv(results: EvaluatedResults, out: Path, load: Sequence[LoadSeries] = ()) -> None:
    """Write ``STEP-points.csv`` and ``STEP-faces.csv`` for every step into the folder ``out``.

    The first line names the columns with their units; vertices count from 0; what was not measured is empty. The
    columns ``…_reference`` hold what the step is compared with. Each triangle has the centroid of its corners there
    and the displacement of the centroid. ``load.csv`` has the load at each step, where there is any.
    """
    if load:
        _write_load(out / "load.csv", results.steps, load)
    for step, name in enumerate(results.steps):
        columns: dict[str, list[tuple[str, NDArray[np.generic]]]] = {"point": [], "face": []}
        faces, positions = results.results.faces, results.positions(step)
        before = results.results.reference_positions(step, results.evaluation.previous)
        centroids, moved = (values[faces].mean(axis=1) for values in (before, positions - before))
        for i in range(3):
            columns["face"].append((f"vertex{i + 1}", faces[:, i]))
        for i, axis in enumerate("xyz"):
            columns["point"].append((f"{axis}_reference [mm]", before[:, i]))
            columns["point"].append((f"{axis} [mm]", positions[:, i]))
            columns["face"].append((f"centroid_{axis}_reference [mm]", centroids[:, i]))
        for i, axis in enumerate("xyz"):
            columns["face"].append((f"centroid_displacement_{axis} [mm]", moved[:, i]))
        fields = results.step(step)
        for entry in results.fields:
            unit = f" [{entry.unit}]" if entry.unit else ""
            columns[entry.location].append((entry.name + unit, fields.scalar(entry).astype(np.float32)))
        _write(out / f"{name}-points.csv", columns["point"])
        _write(out / f"{name}-faces.csv", columns["face"])


def _write_load(path: Path, steps: Sequence[str], load: Sequence[LoadSeries]) -> None:
    lines = [",".join(("step", "capture", *(series.heading for series in load)))]
    for step, name in enumerate(steps):
        values = ("" if np.isnan(series.values[step]) else f"{series.values[step]:.9g}" for series in load)
        lines.append(",".join((str(step), name, *values)))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write(path: Path, columns: list[tuple[str, NDArray[np.generic]]]) -> None:
    texts = []
    for _, values in columns:
        if np.issubdtype(values.dtype, np.integer):
            texts.append([str(value) for value in values])
        else:
            digits = ".6f" if values.dtype == np.float64 else ".9g"
            texts.append(["" if np.isnan(value) else format(value, digits) for value in values.tolist()])
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(header for header, _ in columns) + "\n")
        file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))
