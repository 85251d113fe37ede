"""Export of all steps as arrays for Python: NumPy's npz."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ringdic.results.evaluation import EvaluatedResults
from ringdic.session.load import LoadSeries

_SCALARS = ("lambda1", "lambda2", "J")


def export_npz(results: EvaluatedResults, out: Path, load: Sequence[LoadSeries] = ()) -> None:
    """Write all results into one npz file, with the arrays of :func:`arrays` and of :func:`load_arrays`."""
    with Path(out).open("wb") as file:  # given a name, savez would append a suffix to it
        np.savez(file, **arrays(results), **load_arrays(load))


def arrays(results: EvaluatedResults) -> dict[str, Any]:
    """All results as arrays by name, in full precision, for F steps of N points and M triangles.

    ``vertices_ref`` (N, 3) and ``vertices`` (F, N, 3) mm, world frame; ``faces`` (M, 3); ``lambda1``, ``lambda2`` and
    ``J`` (F, M); ``E`` (F, M, 3, 3), Cartesian Green-Lagrange; ``correlation`` (F, N), C_LS; ``pair`` (M,), −1 where a
    triangle joins two camera pairs. Step 0 is the reference, with identity deformation. NaN where not measured. With a
    strain window, the arrays of deformation also as ``window_…``.

    Standard deviations by image noise and calibration together, by noise alone where the part of the calibration is
    unknown, NaN where nothing is known: ``sigma_xyz`` and ``sigma_displacement`` (F, N, 3) mm, and ``sigma_lambda``
    (F, M, 2), of λ1 and λ2. ``sigma_calibration`` (F, N, 3) mm, where it is known, is the part of the calibration in
    ``sigma_xyz``, an error that all points and steps share.
    """
    source = results.results
    F, N, M = len(source.steps), len(source.vertices_ref), len(source.faces)
    prefixes = ("", "window_") if results.window is not None else ("",)
    deformation: dict[str, Any] = {prefix + name: np.empty((F, M)) for prefix in prefixes for name in _SCALARS}
    deformation |= {f"{prefix}E": np.empty((F, M, 3, 3)) for prefix in prefixes}
    ends = {"sigma_xyz": (N, 3), "sigma_displacement": (N, 3), "sigma_lambda": (M, 2)}
    deviations: dict[str, Any] = {name: np.full((F, *end), np.nan) for name, end in ends.items()}
    for step in range(F):
        fields = results.step(step)
        for prefix in prefixes:
            for name in _SCALARS:
                deformation[prefix + name][step] = fields.face[prefix + name]
            deformation[f"{prefix}E"][step] = square(fields.face[f"{prefix}E_tensor"])
        for name, values in fields.joint_deviations("point").items():
            deviations[name][step] = values
        for name, values in fields.joint_deviations("face").items():
            deviations["sigma_lambda"][step, :, int(name[-1]) - 1] = values
    by_cameras = {} if source.sigma_calibration is None else {"sigma_calibration": source.sigma_calibration}
    return {
        "vertices_ref": source.vertices_ref,
        "vertices": np.stack([results.positions(step) for step in range(F)]),
        "faces": source.faces,
        **deformation,
        "correlation": source.correlation,
        **deviations,
        **by_cameras,
        "pair": source.pair,
    }


def load_arrays(load: Sequence[LoadSeries]) -> dict[str, Any]:
    """The load at the steps: ``load`` (F, C), NaN where not known, and ``load_channels`` (C,), as ``force [N]``.

    Empty without channels.
    """
    if not load:
        return {}
    values = np.array([series.values for series in load]).T
    return {"load": values, "load_channels": np.array([series.heading for series in load])}


def square(six: np.ndarray) -> np.ndarray:
    """Symmetric tensors (..., 3, 3) from their components ``six`` (..., 6) in the order xx yy zz xy yz xz."""
    return six[..., [[0, 3, 5], [3, 1, 4], [5, 4, 2]]]
