"""All steps as arrays: NumPy's npz and MATLAB's mat."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from processing.results import Results, read_results


def export_npz(results_path: Path, out: Path) -> None:
    """Write ``vertices_ref`` (N, 3), ``vertices`` (F, N, 3), ``faces`` (M, 3), ``lambda1``, ``lambda2``, ``J`` (F, M),
    ``E`` (F, M, 3, 3), ``correlation`` (F, N), ``sigma_xyz`` (F, N, 3) and ``pair`` (M,).

    mm, world frame; step 0 is the reference, with identity deformation; NaN where not measured.
    """  # fmt: skip
    with Path(out).open("wb") as file:  # given a name, savez would append a suffix to it
        np.savez(file, **arrays(read_results(results_path)))


def export_mat(results_path: Path, out: Path) -> None:
    """Write the arrays of the npz for MATLAB, level 5: ``faces`` and ``pair`` count from 1 (0: a face joins two pairs).

    ``steps`` and ``settings`` are text.
    """
    results = read_results(results_path)
    values = arrays(results)
    values["faces"] = np.asarray(results.faces, dtype=float) + 1
    values["pair"] = np.asarray(results.pair, dtype=float) + 1
    values["steps"] = np.array(results.steps, dtype=object)
    values["settings"] = results.settings
    with Path(out).open("wb") as file:
        savemat(file, values, do_compression=True, oned_as="column")


def arrays(results: Results) -> dict[str, Any]:
    """The arrays of the npz, in full precision."""
    F, M = len(results.steps), len(results.faces)
    scalars = {name: np.empty((F, M)) for name in ("lambda1", "lambda2", "J")}
    E = np.empty((F, M, 3, 3))
    for step in range(F):
        found = results.deformation(step)
        E[step] = found.E
        for name, values in scalars.items():
            values[step] = getattr(found, name)
    return {
        "vertices_ref": results.vertices_ref,
        "vertices": results.vertices,
        "faces": results.faces,
        **scalars,
        "E": E,
        "correlation": results.correlation,
        "sigma_xyz": results.sigma_xyz,
        "pair": results.pair,
    }
