"""The fields of a result: one table of what there is, and their values at one step.

Every strain is a function of the two principal values E1, E2 and of directions, so few arrays are kept and the table
says how each field follows from them. A rigid motion changes displacements, the Euler-Almansi tensor and directions in
the current configuration; stretches, J, principal strains, magnitudes, equivalent strain, shear and isotropy are the
same with and without it. Linear strain would take a rotation for strain and is always that after the rigid motion.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Indices
from ringdic.strain import families as strain
from ringdic.strain.deformation import Deformation, deformation
from ringdic.strain.rigid_motion import RigidMotion
from ringdic.strain.window import StrainWindow
from ringdic.uncertainty.window import WindowScatter


def _itself(values: Floats) -> Floats:
    return values


@dataclass(frozen=True)
class Field:
    """One scalar field.

    location : "point" or "face". centre : where a diverging colour scale has its middle, None for a sequential one.
    rigid : whether removing the rigid motion changes it. group : heading under which lists of fields show it.
    of, value : the arrays that it follows from, by name, and how.
    """

    name: str
    label: str
    unit: str
    location: str
    centre: float | None = None
    rigid: bool = False
    group: str = "Quality"
    of: tuple[str, ...] = ()
    value: Callable[..., Floats] = _itself

    def __post_init__(self) -> None:
        if self.location not in ("point", "face"):
            raise ValueError(f"a field lies on points or faces, not '{self.location}'")
        if not self.of:
            object.__setattr__(self, "of", (self.name,))

    def row(self) -> dict[str, Any]:
        """The field in a catalogue, as JSON values."""
        names = ("name", "label", "unit", "location", "centre", "rigid", "group")
        return {name: getattr(self, name) for name in names}

    def from_arrays(self, array: Callable[[str], Floats], rigid_motion_removed: bool = False) -> Floats:
        """Its values, from what ``array`` knows under the names in ``of``."""
        suffix = "_without_rigid_motion" if self.rigid and rigid_motion_removed else ""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.value(*(array(name + suffix) for name in self.of))


def _column(index: int, values: Floats) -> Floats:
    return values[..., index]


def _length(values: Floats) -> Floats:
    return np.asarray(np.linalg.norm(values, axis=-1))


def _stretch(E: Floats) -> Floats:
    return np.sqrt(1.0 + 2.0 * E)


def _seth_hill(m: float, E: Floats) -> Floats:
    """Principal strain of the Seth-Hill family m from that of Green-Lagrange; small strains keep their digits."""
    return strain.seth_hill_of_log(0.5 * np.log1p(2.0 * E), m)


def _bazant(E: Floats) -> Floats:
    """The same of Bažant's family with m = 1, ½ (λ - 1/λ)."""
    return np.sinh(0.5 * np.log1p(2.0 * E))


def _scalar(measure: Callable[[Floats, Floats], Floats], principal: Callable[[Floats], Floats], *two: Floats) -> Floats:
    return measure(*(principal(values) for values in two))


_SCALARS: tuple[tuple[str, str, Callable[[Floats, Floats], Floats], float | None], ...] = (
    ("1", "smaller principal", lambda first, second: first, 0.0),
    ("2", "larger principal", lambda first, second: second, 0.0),
    ("_magnitude", "magnitude", strain.magnitude, None),
    ("_equivalent", "equivalent", strain.equivalent, None),
    ("_shear", "largest shear", strain.shear, None),
)


def _family(
    name: str, label: str, principal: Callable[[Floats], Floats], of: tuple[str, str] = ("E1", "E2")
) -> Iterator[Field]:
    symbol = f"{label} {name}" if name in "Ee" else label
    for suffix, scalar, measure, centre in _SCALARS:
        text = f"{symbol}{suffix}, {scalar}" if name in "Ee" and suffix in "12" else f"{symbol}, {scalar}"
        value = partial(_scalar, measure, principal)
        yield Field(name + suffix, text, "", "face", centre, group=f"{label} strain", of=of, value=value)


_DEFORMATION = (
    Field("J", "Area ratio J", "", "face", 1.0, group="Stretch"),
    Field("lambda1", "Smaller stretch λ1", "", "face", 1.0, group="Stretch"),
    Field("lambda2", "Larger stretch λ2", "", "face", 1.0, group="Stretch"),
    *_family("E", "Green-Lagrange", partial(_seth_hill, strain.GREEN_LAGRANGE)),
    *_family("e", "Euler-Almansi", partial(_seth_hill, strain.EULER_ALMANSI)),
    *_family("hencky", "Hencky", partial(_seth_hill, strain.HENCKY)),
    *_family("biot", "Biot", partial(_seth_hill, strain.BIOT)),
    *_family("bazant", "Bažant (m = 1)", _bazant),
    *_family("linear", "Linear (infinitesimal)", _itself, ("linear1", "linear2")),
)
_OVER_STRETCHES: dict[str, Callable[..., Floats]] = {
    "J": lambda E1, E2: _stretch(E1) * _stretch(E2),
    "lambda1": lambda E1, E2: _stretch(E1),
    "lambda2": lambda E1, E2: _stretch(E2),
}
_OVER_WINDOW = ("J", "lambda1", "lambda2", "E1", "E2", "E_magnitude", "E_equivalent", "E_shear", "hencky1", "hencky2")


def _windowed(entry: Field) -> Field:
    """The same field over the strain window."""
    return replace(
        entry, name=f"window_{entry.name}", label=f"Window: {entry.label}", group="Over the strain window",
        of=("window_E1", "window_E2"), value=_OVER_STRETCHES.get(entry.name, entry.value),
    )  # fmt: skip


def _strain_sigma(E: Floats, sigma_stretch: Floats) -> Floats:
    return _stretch(E) * sigma_stretch  # dE = λ dλ


FIELDS = (
    Field("displacement", "Displacement", "mm", "point", None, True, "Displacement", ("displacement",), _length),
    *(
        Field(
            f"displacement_{axis}", f"Displacement {axis}", "mm", "point", 0.0, True, "Displacement",
            ("displacement",), partial(_column, i),
        )
        for i, axis in enumerate("xyz")
    ),
    *_DEFORMATION,
    *(_windowed(entry) for entry in _DEFORMATION if entry.name in _OVER_WINDOW),
    Field("sigma", "Standard deviation of the position", "mm", "point", None, False, "Uncertainty",
          ("sigma_xyz",), _length),
    Field("sigma_displacement", "Standard deviation of the displacement", "mm", "point", None, False, "Uncertainty",
          ("sigma_displacement",), _length),
    *(
        Field(f"sigma_lambda{k}", f"Standard deviation of λ{k}", "", "face", None, False, "Uncertainty")
        for k in (1, 2)
    ),
    *(
        Field(f"sigma_E{k}", f"Standard deviation of E{k}", "", "face", None, False, "Uncertainty",
              (f"E{k}", f"sigma_lambda{k}"), _strain_sigma)
        for k in (1, 2)
    ),
    *(
        Field(f"window_sigma_lambda{k}", f"Window: Standard deviation of λ{k}", "", "face", None, False, "Uncertainty")
        for k in (1, 2)
    ),
    Field("sigma_calibration", "Standard deviation of the position by the calibration", "mm", "point", None, False,
          "Uncertainty", ("sigma_calibration",), _length),
    Field("sigma_total", "Standard deviation of the position by noise and calibration", "mm", "point", None, False,
          "Uncertainty", ("sigma_xyz", "sigma_calibration"), lambda *parts: _length(np.concatenate(parts, axis=-1))),
    Field("sigma_displacement_calibration", "Standard deviation of the displacement by the calibration", "mm", "point",
          None, False, "Uncertainty", ("sigma_displacement_calibration",), _length),
    *(
        Field(f"sigma_lambda_calibration{k}", f"Standard deviation of λ{k} by the calibration", "", "face", None, False,
              "Uncertainty")
        for k in (1, 2)
    ),
    Field("chi2", "Disagreement of the cameras, χ² a degree of freedom", "", "point"),
    Field("correlation", "Correlation C_LS (0 best)", "", "point"),
    Field("face_correlation", "Correlation C_LS, worst corner", "", "face"),
    Field("isotropy", "Shape of the triangle (1 equilateral)", "", "face"),
    Field("area", "Area in the reference", "mm²", "face", of=("area", "E1"),
          value=lambda area, E1: np.where(np.isfinite(E1), area, np.nan)),
    Field("pair", "Camera pair", "", "face"),
)  # fmt: skip

_DIRECTIONS = ("direction1_reference", "direction2_reference", "direction1_current", "direction2_current")
#: VTK's order of a symmetric tensor.
_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


@dataclass(frozen=True)
class StepFields:
    """Arrays of one step by name, in full precision: ``point`` (N, ...) and ``face`` (M, ...).

    Vectors are (·, 3); symmetric tensors (·, 6) in the order xx yy zz xy yz xz.
    """

    point: dict[str, Floats]
    face: dict[str, Floats]

    @property
    def names(self) -> set[str]:
        """The arrays there are."""
        return {*self.point, *self.face}

    def scalar(self, entry: Field, rigid_motion_removed: bool = False) -> Floats:
        """The values of a field, (N,) or (M,)."""
        arrays = self.point if entry.location == "point" else self.face
        return entry.from_arrays(arrays.__getitem__, rigid_motion_removed)


@dataclass(frozen=True)
class StepQuality:
    """What is known of each point and triangle beside its place, at one step; None where it is not known.

    correlation : (N,) C_LS. sigma_xyz, sigma_displacement : (N, 3) mm and sigma_lambda : (M, 2), by the noise of the
    images. chi2 : (N,). sigma_calibration, sigma_displacement_calibration : (N, 3) mm and sigma_lambda_calibration :
    (M, 2), by the covariance of the cameras.
    """

    correlation: Floats
    sigma_xyz: Floats
    sigma_displacement: Floats | None = None
    sigma_lambda: Floats | None = None
    chi2: Floats | None = None
    sigma_calibration: Floats | None = None
    sigma_displacement_calibration: Floats | None = None
    sigma_lambda_calibration: Floats | None = None

    def fields(self) -> StepFields:
        """What is known, as arrays of the points and the triangles."""
        on_points = (
            "correlation", "sigma_xyz", "sigma_displacement", "chi2", "sigma_calibration",
            "sigma_displacement_calibration",
        )  # fmt: skip
        point = {name: getattr(self, name) for name in on_points}
        face: dict[str, Floats] = {}
        for name in ("sigma_lambda", "sigma_lambda_calibration"):
            if (sigma := getattr(self, name)) is not None:
                face[f"{name}1"], face[f"{name}2"] = sigma.T
        return StepFields({name: values for name, values in point.items() if values is not None}, face)


def field(name: str) -> Field:
    """The field of a name; KeyError if there is none.

    Beside those of the table, ``seth_hill1:M``, ``seth_hill2:M``, ``seth_hill_magnitude:M``, … for any exponent M, and
    every field of deformation as ``window_…``.
    """
    for entry in FIELDS:
        if entry.name == name:
            return entry
    if name.startswith("window_"):
        inner = field(name.removeprefix("window_"))
        if inner.of == ("E1", "E2"):
            return _windowed(inner)
    family, colon, exponent = name.partition(":")
    for entry in seth_hill_fields(_number(exponent)) if colon else ():
        if entry.name.partition(":")[0] == family:
            return entry
    raise KeyError(name)


def seth_hill_fields(exponent: float) -> tuple[Field, ...]:
    """The fields of the Seth-Hill family with any exponent."""
    fields = _family("seth_hill", f"Seth-Hill m = {exponent:g}", partial(_seth_hill, exponent))
    return tuple(replace(entry, name=f"{entry.name}:{exponent:g}") for entry in fields)


def available(names: Collection[str]) -> tuple[Field, ...]:
    """The fields of the table that follow from the arrays there are."""
    return tuple(entry for entry in FIELDS if set(entry.of) <= set(names))


def compute_fields(
    reference: Floats,
    current: Floats,
    faces: Indices,
    to_reference: RigidMotion,
    certainty: StepQuality,
    pair: Indices,
    window: StrainWindow | None = None,
    scatter: WindowScatter | None = None,
    found: Deformation | None = None,
    both_tensors: bool = True,
) -> StepFields:
    """All arrays of one step.

    Parameters
    ----------
    reference, current : (N, 3) mm, NaN where lost. faces : (M, 3). pair : (M,).
    to_reference : the motion that takes the step back onto the reference.
    window : the windows of the triangles, for strain over a window beside that of each triangle.
    scatter : of the windows, for its standard deviations where those of the displacements are known.
    found : the deformation from one to the other, where it is known.
    both_tensors : the Euler-Almansi tensor too, which no field follows from.
    """
    found = deformation(reference, current, faces) if found is None else found
    known = certainty.fields()
    point = {
        "displacement": current - reference,
        "displacement_without_rigid_motion": to_reference.apply(current) - reference,
        **known.point,
    }
    face = {
        **_of_deformation(found, both_tensors),
        **_linear(found, to_reference),
        "isotropy": found.isotropy,
        "area": found.area,
        "face_correlation": certainty.correlation[faces].max(axis=1),
        "pair": pair.astype(float),
        **known.face,
    }
    if window is not None:
        over = window.deformation(current, reference)
        face |= {f"window_{name}": values for name, values in _of_deformation(over, both_tensors).items()}
        if scatter is not None and certainty.sigma_displacement is not None:
            sigma = scatter.stretch_sigma(over, certainty.sigma_displacement)
            face["window_sigma_lambda1"], face["window_sigma_lambda2"] = sigma.T
    return StepFields(point, face)


def _of_deformation(found: Deformation, both_tensors: bool) -> dict[str, Floats]:
    names = ("J", "lambda1", "lambda2", "E1", "E2", *_DIRECTIONS)
    tensors = {"E_tensor": _six(found.E)} | ({"e_tensor": _six(found.e)} if both_tensors else {})
    return {**{name: getattr(found, name) for name in names}, **tensors}


def _linear(found: Deformation, to_reference: RigidMotion) -> dict[str, Floats]:
    """Principal linear strains, after the rigid motion: what is left of the rotation counts as strain."""
    values = strain.infinitesimal_principal(found.F, found.normal_reference, to_reference.R)
    return dict(zip(("linear1", "linear2"), values, strict=True))


def _six(tensor: Floats) -> Floats:
    return np.take(tensor.reshape(*tensor.shape[:-2], 9), [3 * i + j for i, j in _SYMMETRIC], axis=-1)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise KeyError(text) from None
