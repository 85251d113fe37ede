"""The fields of a result: one table of what there is, and their values at one step.

A rigid motion changes displacements, the Euler-Almansi tensor and directions in the current configuration; stretches,
J, principal strains, magnitudes, equivalent strain, shear and isotropy are the same with and without it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.deformation import deformation
from processing.rigid_motion import RigidMotion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Field:
    """One scalar field.

    location : "point" or "face". centre : where a diverging colour scale has its middle, None for a sequential one.
    rigid : whether removing the rigid motion changes it. stored, part : the stored array and which of its columns this
    is; -1 for the length of the row, None where the array is the field itself.
    """

    name: str
    label: str
    unit: str
    location: str
    centre: float | None = None
    rigid: bool = False
    stored: str = ""
    part: int | None = None

    def __post_init__(self) -> None:
        if self.location not in ("point", "face"):
            raise ValueError(f"a field lies on points or faces, not '{self.location}'")
        if not self.stored:
            object.__setattr__(self, "stored", self.name)


FIELDS = (
    Field("displacement", "Displacement", "mm", "point", None, True, "displacement", -1),
    Field("displacement_x", "Displacement x", "mm", "point", 0.0, True, "displacement", 0),
    Field("displacement_y", "Displacement y", "mm", "point", 0.0, True, "displacement", 1),
    Field("displacement_z", "Displacement z", "mm", "point", 0.0, True, "displacement", 2),
    Field("J", "Area ratio J", "", "face", 1.0),
    Field("lambda1", "Smaller stretch λ1", "", "face", 1.0),
    Field("lambda2", "Larger stretch λ2", "", "face", 1.0),
    Field("E1", "Green-Lagrange, smaller principal E1", "", "face", 0.0),
    Field("E2", "Green-Lagrange, larger principal E2", "", "face", 0.0),
    Field("e1", "Euler-Almansi, smaller principal e1", "", "face", 0.0),
    Field("e2", "Euler-Almansi, larger principal e2", "", "face", 0.0),
    Field("E_magnitude", "Green-Lagrange, magnitude |E|", "", "face"),
    Field("e_magnitude", "Euler-Almansi, magnitude |e|", "", "face"),
    Field("E_equivalent", "Green-Lagrange, equivalent", "", "face"),
    Field("e_equivalent", "Euler-Almansi, equivalent", "", "face"),
    Field("E_shear", "Green-Lagrange, largest shear", "", "face"),
    Field("e_shear", "Euler-Almansi, largest shear", "", "face"),
    Field("isotropy", "Shape of the triangle (1 equilateral)", "", "face"),
    Field("area", "Area in the reference", "mm²", "face"),
    Field("correlation", "Correlation C_LS (0 best)", "", "point"),
    Field("face_correlation", "Correlation C_LS, worst corner", "", "face"),
    Field("sigma", "Standard deviation of the position", "mm", "point", None, False, "sigma_xyz", -1),
    Field("pair", "Camera pair", "", "face"),
)

#: Scalars of the deformation that are stored as they are.
_SCALARS = (
    "J", "lambda1", "lambda2", "E1", "E2", "e1", "e2", "E_magnitude", "e_magnitude", "E_equivalent", "e_equivalent",
    "E_shear", "e_shear", "isotropy",
)  # fmt: skip
_DIRECTIONS = ("direction1_reference", "direction2_reference", "direction1_current", "direction2_current")
#: VTK's order of a symmetric tensor.
_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


@dataclass(frozen=True)
class StepFields:
    """Arrays of one step, float32, by name: ``point`` (N, ...) and ``face`` (M, ...)."""

    point: dict[str, NDArray[np.float32]]
    face: dict[str, NDArray[np.float32]]


def field(name: str) -> Field:
    """The field of a name; KeyError if there is none."""
    for entry in FIELDS:
        if entry.name == name:
            return entry
    raise KeyError(name)


def compute_fields(
    vertices_ref: Array,
    vertices: Array,
    faces: NDArray[np.int64],
    to_reference: RigidMotion,
    correlation: Array,
    sigma_xyz: Array,
    pair: NDArray[np.int64],
) -> StepFields:
    """All fields of one step.

    Parameters
    ----------
    vertices_ref, vertices, sigma_xyz : (N, 3) mm. faces : (M, 3). correlation : (N,) C_LS. pair : (M,).
    to_reference : the motion that takes the step back onto the reference.

    Vectors are (·, 3); tensors (·, 6) in the order xx yy zz xy yz xz.
    """
    found = deformation(vertices_ref, vertices, faces)
    point = {
        "displacement": vertices - vertices_ref,
        "displacement_without_rigid_motion": to_reference.apply(vertices) - vertices_ref,
        "correlation": correlation,
        "sigma_xyz": sigma_xyz,
    }
    face = {name: getattr(found, name) for name in (*_SCALARS, *_DIRECTIONS)}
    face["E_tensor"] = _six(found.E)
    face["e_tensor"] = _six(found.e)
    face["area"] = np.where(np.isfinite(found.J), found.area, np.nan)
    face["face_correlation"] = correlation[faces].max(axis=1)
    face["pair"] = pair
    return StepFields(
        {name: np.asarray(values, dtype=np.float32) for name, values in point.items()},
        {name: np.asarray(values, dtype=np.float32) for name, values in face.items()},
    )


def pick(entry: Field, stored: NDArray[np.float32]) -> NDArray[np.float32]:
    """The scalar of a field from its stored array (n,) or (n, 3)."""
    if entry.part is None:
        return stored
    if entry.part < 0:
        return np.asarray(np.linalg.norm(stored, axis=-1), dtype=np.float32)
    return np.ascontiguousarray(stored[..., entry.part])


def _six(tensor: Array) -> Array:
    return np.stack([tensor[..., i, j] for i, j in _SYMMETRIC], axis=-1)
