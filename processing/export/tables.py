"""Points and faces of every step as tables of comma-separated values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.fields import FIELDS
from processing.results import read_field, read_mesh, read_positions, read_summary


def export_csv(results_path: Path, out: Path) -> None:
    """Write ``STEP-points.csv`` and ``STEP-faces.csv`` for every step into the folder ``out``.

    The first line names the columns with their units; vertices count from 0; what was not measured is empty.
    """
    mesh = read_mesh(results_path)
    for step, name in enumerate(read_summary(results_path)["steps"]):
        columns: dict[str, list[tuple[str, NDArray[np.generic]]]] = {"point": [], "face": []}
        positions = read_positions(results_path, step)
        for i, axis in enumerate("xyz"):
            columns["point"].append((f"{axis}_reference [mm]", mesh.vertices[:, i]))
            columns["point"].append((f"{axis} [mm]", positions[:, i]))
        for i in range(3):
            columns["face"].append((f"vertex{i + 1}", mesh.faces[:, i]))
        for entry in FIELDS:
            unit = f" [{entry.unit}]" if entry.unit else ""
            columns[entry.location].append((entry.name + unit, read_field(results_path, entry.name, step)[0]))
        _write(out / f"{name}-points.csv", columns["point"])
        _write(out / f"{name}-faces.csv", columns["face"])


def _write(path: Path, columns: list[tuple[str, NDArray[np.generic]]]) -> None:
    texts = []
    for _, values in columns:
        if np.issubdtype(values.dtype, np.integer):
            texts.append([str(value) for value in values])
        else:
            digits = ".6f" if values.dtype == np.float64 else ".7g"
            texts.append(["" if np.isnan(value) else format(value, digits) for value in values.tolist()])
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(header for header, _ in columns) + "\n")
        file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))
