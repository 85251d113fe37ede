"""Export of all steps for MATLAB and Octave, with the field names of MultiDIC (Solav et al. 2018)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

from ringdic.arrays import Floats
from ringdic.errors import InputError
from ringdic.export.arrays import arrays, load_arrays
from ringdic.results.evaluation import EvaluatedResults
from ringdic.session.load import LoadSeries
from ringdic.strain.deformation import Deformation
from ringdic.strain.rigid_motion import RigidMotion
from ringdic.strain.window import StrainWindow

log = logging.getLogger(__name__)

_LARGEST = 2**31 - 2**20  # bytes of one variable of a level 5 file


def export_mat(results: EvaluatedResults, out: Path, load: Sequence[LoadSeries] = ()) -> None:
    """Write a level 5 MAT file; indices in it count from 1.

    ``DIC3DPPresults`` is the structure that MultiDIC's post-processing makes and its plots read: Points3D, Faces, Disp,
    RBM, Deform and others as cells with one entry a step; fields with the ending ``_ARBM`` have the rigid motion
    removed; Deform_window holds the strain over the window if there is one. Deformation is in single precision. Beside
    it stand the arrays of the npz (`ringdic.export.arrays`), standard deviations among them, where ``faces`` and
    ``pair`` count from 1 (0: a triangle joins two pairs), ``steps`` and ``settings`` as
    text, and the load at the steps where it is known.

    Raises InputError where a level 5 file cannot hold it.
    """
    source = results.results
    values = arrays(results)
    values["faces"] = np.asarray(source.faces, dtype=float) + 1
    values["pair"] = np.asarray(source.pair, dtype=float) + 1
    values["steps"] = np.array(source.steps, dtype=object)
    values["settings"] = source.settings
    values |= load_arrays(load)
    if load:
        values["load_channels"] = np.array([series.heading for series in load], dtype=object)
    values["DIC3DPPresults"] = post_processing(results)
    with Path(out).open("wb") as file:
        savemat(file, values, do_compression=True, oned_as="column")


def post_processing(results: EvaluatedResults) -> dict[str, Any]:
    """The structure DIC3DPPresults by field; cells are object arrays (1, F)."""
    source = results.results
    F = len(source.steps)
    structure = _surface(results)
    bytes_each = F * len(source.faces) * 4 * _floats_a_face()
    if bytes_each > _LARGEST:
        raise InputError(
            f"{F} steps of {len(source.faces):,} triangles are more than a MAT file of level 5 can hold; "
            "export npz or vtkhdf"
        )
    wanted: list[tuple[str, bool, StrainWindow | None]] = [("Deform", False, None)]
    if results.window is not None:
        wanted.append(("Deform_window", False, results.window))
    wanted.append(("Deform_ARBM", True, None))
    room = _LARGEST // bytes_each
    for name, removed, window in wanted[:room]:
        structure[name] = _deform(results, removed, window)
    for name, _, _ in wanted[room:]:
        log.warning("%s is left out: with it, the file would be larger than MATLAB's level 5 allows", name)
    return structure


def _surface(results: EvaluatedResults) -> dict[str, Any]:
    """Points, triangles, displacements and rigid motions."""
    source, F = results.results, len(results.steps)
    faces = source.faces
    motions = [_motion(results, step) for step in range(F)]
    points = [results.positions(step) for step in range(F)]
    back = [motion.apply(xyz) for motion, xyz in zip(motions, points, strict=True)]
    moved = [xyz - _before(results, step) for step, xyz in enumerate(points)]
    without = [xyz - _before(results, step) for step, xyz in enumerate(back)]
    ids = {camera.id: index for index, camera in enumerate(source.cameras, start=1)}
    return {
        "Points3D": _cells(points),
        "Points3D_ARBM": _cells(back),
        "Faces": faces.astype(float) + 1,
        "corrComb": _cells([column(source.correlation[step]) for step in range(F)]),
        "FaceCorrComb": _cells([column(source.correlation[step][faces].max(axis=1)) for step in range(F)]),
        "FacePairInds": column(source.pair.astype(float) + 1),
        "PointPairInds": column(source.vertex_pair.astype(float) + 1),
        "pairIndices": np.array([[_camera_number(name, ids) for name in pair] for pair in source.pairs], dtype=float),
        "Disp": {
            "DispVec": _cells(moved),
            "DispMgn": _cells([column(np.linalg.norm(u, axis=1)) for u in moved]),
            "DispVec_ARBM": _cells(without),
            "DispMgn_ARBM": _cells([column(np.linalg.norm(u, axis=1)) for u in without]),
        },
        "FaceCentroids": _cells([xyz[faces].mean(axis=1) for xyz in points]),
        "FaceCentroids_ARBM": _cells([xyz[faces].mean(axis=1) for xyz in back]),
        "FaceIsoInd": _cells([column(results.step(step).face["isotropy"]) for step in range(F)]),
        "RBM": {
            "RotMat": _cells([motion.R for motion in motions]),
            "TransVec": _cells([motion.t for motion in motions]),
        },
    }


def _deform(results: EvaluatedResults, rigid_motion_removed: bool, window: StrainWindow | None) -> dict[str, Any]:
    how = results.evaluation
    removed = rigid_motion_removed or how.rigid_motion_removed
    steps = [
        _named(results.results.deformation(step, removed, how.previous, window)) for step in range(len(results.steps))
    ]
    return {name: _cells([step[name] for step in steps]) for name in steps[0]}


def _named(deformation: Deformation) -> dict[str, NDArray[np.float32]]:
    """Deformation of one step by MultiDIC's field names: tensors (3, 3, M), vectors (M, 3), scalars (M, 1)."""
    C = np.einsum("mki,mkj->mij", deformation.F, deformation.F)
    tensors = {"Fmat": deformation.F, "Cmat": C, "Emat": deformation.E, "emat": deformation.e}
    vectors = {
        "d3": deformation.normal_current,
        "Epc1vec": deformation.direction1_reference, "Epc2vec": deformation.direction2_reference,
        "Epc1vecCur": deformation.direction1_current, "Epc2vecCur": deformation.direction2_current,
        "epc1vec": deformation.direction1_current, "epc2vec": deformation.direction2_current,
    }  # fmt: skip
    scalars = {
        "Lamda1": deformation.lambda1, "Lamda2": deformation.lambda2, "J": deformation.J,
        "Emgn": deformation.E_magnitude, "emgn": deformation.e_magnitude,
        "Epc1": deformation.E1, "Epc2": deformation.E2, "epc1": deformation.e1, "epc2": deformation.e2,
        "EShearMax": deformation.E_shear, "eShearMax": deformation.e_shear,
        "Eeq": deformation.E_equivalent, "eeq": deformation.e_equivalent,
        "Area": np.where(np.isfinite(deformation.J), deformation.area, np.nan),
    }  # fmt: skip
    named = {
        **{name: np.moveaxis(values, 0, -1) for name, values in tensors.items()},
        **vectors,
        **{name: column(values) for name, values in scalars.items()},
    }
    return {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in named.items()}


def _floats_a_face() -> int:
    one = np.ones((1, 3, 3))
    parts = dict.fromkeys(Deformation.__dataclass_fields__, one[:, 0, 0])
    parts |= {name: one[:, 0] for name in parts if name.startswith("direction")}
    parts |= dict.fromkeys(("F", "E", "directors_reference", "directors_current"), one)
    return sum(values.size for values in _named(Deformation(**parts)).values())


def _before(results: EvaluatedResults, step: int) -> Floats:
    return results.results.reference_positions(step, results.evaluation.previous)


def _motion(results: EvaluatedResults, step: int) -> RigidMotion:
    """Rigid motion that takes exported positions back onto the reference; the identity if it is removed already."""
    if results.evaluation.rigid_motion_removed:
        return RigidMotion(np.eye(3), np.zeros(3))
    return results.results.motion(step, results.evaluation.previous)


def _camera_number(name: str, order: dict[str, int]) -> int:
    """Number of a camera as MultiDIC names cameras; for a name that is no number, its position in the ring, from 1."""
    return int(name) if name.isascii() and name.isdigit() else order.get(name, 0)


def column(values: Floats) -> Floats:
    """Scalars ``values`` (n,) of any unit as a column (n, 1), MATLAB's form of a vector."""
    return np.asarray(values, dtype=float).reshape(-1, 1)


def _cells(entries: list[Any]) -> NDArray[np.object_]:
    cells = np.empty((1, len(entries)), dtype=object)
    for index, entry in enumerate(entries):
        cells[0, index] = entry
    return cells
