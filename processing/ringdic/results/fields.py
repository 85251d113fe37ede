"""The table of scalar fields of a result, and the arrays of one step from which they are computed.

Every strain is a function of the two principal values E1, E2 of the Green-Lagrange strain and of their directions, so
few arrays are stored and the table gives the function for each field. A rigid motion changes displacements, the
Euler-Almansi tensor and directions in the current configuration; stretches, J, principal strains, magnitudes,
equivalent strain, shear and isotropy do not depend on it. Linear strain would count a rotation as strain, so it is
always computed after the rigid motion is removed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from dataclasses import field as member
from functools import partial
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Indices, Points
from ringdic.strain import families as strain
from ringdic.strain.deformation import Deformation, deformation
from ringdic.strain.rigid_motion import RigidMotion
from ringdic.strain.window import StrainWindow
from ringdic.uncertainty.window import WindowScatter

#: Arrays of a result that not every run has. "point" : a number a vertex. "vector" : three numbers a vertex.
#: "face" : two numbers a triangle.
OPTIONAL_ARRAYS = {
    "sigma_displacement": "vector", "sigma_lambda": "face", "chi2": "point", "sigma_calibration": "vector",
    "sigma_displacement_calibration": "vector", "sigma_lambda_calibration": "face",
}  # fmt: skip


def _itself(values: Floats) -> Floats:
    return values


@dataclass(frozen=True)
class Field:
    """A scalar field: its name, unit and location, and the function that computes it from arrays of a step.

    location : "point" or "face". centre : middle of the diverging colour scale, None for a sequential one.
    rigid : whether removing the rigid motion changes it. group : heading under which lists of fields show it.
    of : names of the arrays that it is computed from; its own name by default. also : names of arrays that it takes too
        where they are known. value : the function of these arrays, (N, ...) of the vertices or (M, ...) of the
        triangles, which returns (N,) or (M,). through : function that is applied to each array in ``of`` before, which
        fields of one family share.
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
    also: tuple[str, ...] = ()
    through: Callable[[Floats], Floats] = _itself

    def __post_init__(self) -> None:
        if self.location not in ("point", "face"):
            raise ValueError(f"a field lies on points or faces, not '{self.location}'")
        if not self.of:
            object.__setattr__(self, "of", (self.name,))

    def row(self) -> dict[str, Any]:
        """The field's description as JSON values: all but the function that computes it."""
        names = ("name", "label", "unit", "location", "centre", "rigid", "group")
        return {name: getattr(self, name) for name in names}

    def from_arrays(
        self,
        array: Callable[[str], Floats],
        rigid_motion_removed: bool = False,
        through: Callable[[str], Floats] | None = None,
    ) -> Floats:
        """Values of the field, (N,) or (M,) by its location, in its unit.

        array : function that returns the array of a name in ``of`` or ``also``, and raises KeyError for a name in
        ``also`` that is not known. rigid_motion_removed : the values after the rigid motion is removed.
        through : function that returns the array of a name in ``of`` as the field's own ``through`` makes it, where it
        is known already; None computes it.
        """
        suffix = "_without_rigid_motion" if self.rigid and rigid_motion_removed else ""
        with np.errstate(invalid="ignore", divide="ignore"):
            first = through or (lambda name: self.through(array(name)))
            arrays = [first(name + suffix) for name in self.of]
            for name in self.also:
                with suppress(KeyError):
                    arrays.append(array(name))
            return self.value(*arrays)


def _column(index: int, values: Floats) -> Floats:
    return values[..., index]


def _length(values: Floats) -> Floats:
    return np.asarray(np.linalg.norm(values, axis=-1))


def _stretch(E: Floats) -> Floats:
    return np.sqrt(1.0 + 2.0 * E)


def _seth_hill(m: float, E: Floats) -> Floats:
    """Principal strain of the Seth-Hill family m from the Green-Lagrange one E, without cancellation at small E."""
    return strain.seth_hill_of_log(0.5 * np.log1p(2.0 * E), m)


def _bazant(E: Floats) -> Floats:
    """Principal strain of Bažant's family with m = 1, ½ (λ - 1/λ), from the Green-Lagrange one E."""
    return np.sinh(0.5 * np.log1p(2.0 * E))


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
    """The fields of a family of strains: both principal strains, magnitude, equivalent strain and largest shear.

    principal : the family's principal strain from an array in ``of``.
    """
    symbol = f"{label} {name}" if name in "Ee" else label
    for suffix, scalar, measure, centre in _SCALARS:
        text = f"{symbol}{suffix}, {scalar}" if name in "Ee" and suffix in "12" else f"{symbol}, {scalar}"
        group = f"{label} strain"
        yield Field(name + suffix, text, "", "face", centre, False, group, of, measure, through=principal)


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
    """The field computed from the deformation over the strain window instead of that of the triangle."""
    return replace(
        entry, name=f"window_{entry.name}", label=f"Window: {entry.label}", group="Over the strain window",
        of=("window_E1", "window_E2"), value=_OVER_STRETCHES.get(entry.name, entry.value),
    )  # fmt: skip


def joint_deviation(noise: Floats, calibration: Floats | None = None) -> Floats:
    """Standard deviations by image noise and calibration together: the root of the sum of the squares.

    noise, calibration : (N, 3) mm of the vertices, or (M,) of the triangles. Returns the same shape and unit: the part
    of the noise alone where that of the calibration is unknown, None or NaN.
    """
    return noise if calibration is None else np.hypot(noise, np.nan_to_num(calibration))


def _joint_length(*parts: Floats) -> Floats:
    return _length(joint_deviation(*parts))


def _strain_sigma(E: Floats, *of_stretch: Floats) -> Floats:
    return _stretch(E) * joint_deviation(*of_stretch)  # dE = λ dλ


#: Arrays of standard deviations by image noise, and for each the array of those by the calibration.
_CAUSES = {
    "sigma_xyz": "sigma_calibration", "sigma_displacement": "sigma_displacement_calibration",
    "sigma_lambda1": "sigma_lambda_calibration1", "sigma_lambda2": "sigma_lambda_calibration2",
}  # fmt: skip


def _deviations(name: str, label: str, unit: str, location: str, array: str) -> Iterator[Field]:
    """The three fields of a standard deviation: by image noise and calibration together, and by each of them alone.

    array : name of the array of those by image noise.
    """
    stem, digit = (name[:-1], name[-1]) if name[-1].isdigit() else (name, "")
    joint, alone = (joint_deviation, _itself) if location == "face" else (_joint_length, _length)
    text = f"Standard deviation of {label}"
    for end, cause, of, also, value in (
        ("", "", array, (_CAUSES[array],), joint),
        ("_noise", " by the image noise", array, (), alone),
        ("_calibration", " by the calibration", _CAUSES[array], (), alone),
    ):
        yield Field(stem + end + digit, text + cause, unit, location, None, False, "Uncertainty", (of,), value, also)


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
    *_deviations("sigma", "the position", "mm", "point", "sigma_xyz"),
    *_deviations("sigma_displacement", "the displacement", "mm", "point", "sigma_displacement"),
    *_deviations("sigma_lambda1", "λ1", "", "face", "sigma_lambda1"),
    *_deviations("sigma_lambda2", "λ2", "", "face", "sigma_lambda2"),
    *(
        Field(f"sigma_E{k}", f"Standard deviation of E{k}", "", "face", None, False, "Uncertainty",
              (f"E{k}", f"sigma_lambda{k}"), _strain_sigma, (f"sigma_lambda_calibration{k}",))
        for k in (1, 2)
    ),
    *(
        Field(f"window_sigma_lambda{k}", f"Window: Standard deviation of λ{k} by the image noise", "", "face", None,
              False, "Uncertainty")
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
#: Components of a symmetric tensor in the order of VTK.
_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


@dataclass(frozen=True)
class StepFields:
    """The arrays of one step from which every field follows, in full precision.

    point : (N, ...) of the vertices, by name. face : (M, ...) of the triangles, by name.
    Scalars have no second axis; vectors are (·, 3), symmetric tensors (·, 6) in the order xx yy zz xy yz xz.
    Standard deviations are here in their two parts, by image noise and by the calibration; fields join them.
    """

    point: dict[str, Floats]
    face: dict[str, Floats]
    _strains: dict[tuple[Callable[[Floats], Floats], str], Floats] = member(
        default_factory=dict, init=False, repr=False
    )

    @property
    def names(self) -> set[str]:
        """Names of all arrays."""
        return {*self.point, *self.face}

    def joint_deviations(self, location: str) -> dict[str, Floats]:
        """Standard deviations by image noise and calibration together, by noise alone where nothing else is known.

        location : "point" for ``sigma_xyz`` and ``sigma_displacement`` (N, 3) mm, "face" for ``sigma_lambda1`` and
        ``sigma_lambda2`` (M,); those that are known.
        """
        arrays = self.point if location == "point" else self.face
        return {
            name: joint_deviation(arrays[name], arrays.get(calibration))
            for name, calibration in _CAUSES.items()
            if name in arrays
        }

    def scalar(self, entry: Field, rigid_motion_removed: bool = False) -> Floats:
        """Values of a field in its unit, (N,) where its location is "point", (M,) where it is "face"."""
        arrays = self.point if entry.location == "point" else self.face

        def through(name: str) -> Floats:
            """The array of a name as the field takes it; those of the last family are kept for its other fields."""
            if entry.through is _itself:
                return arrays[name]
            values = self._strains.get((entry.through, name))
            if values is None:
                values = entry.through(arrays[name])
                for other in [key for key in self._strains if key[0] is not entry.through]:
                    self._strains.pop(other, None)
                self._strains[entry.through, name] = values
            return values

        return entry.from_arrays(arrays.__getitem__, rigid_motion_removed, through)


def field(name: str) -> Field:
    """The field of a name; raises KeyError where there is none.

    The names are those of the table ``FIELDS``; ``seth_hill1:M``, ``seth_hill2:M``, ``seth_hill_magnitude:M``, … with
    any exponent M; and ``window_`` before the name of any field of strain, for that field over the strain window.
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
    """The fields of the Seth-Hill family of strains with one exponent."""
    fields = _family("seth_hill", f"Seth-Hill m = {exponent:g}", partial(_seth_hill, exponent))
    return tuple(replace(entry, name=f"{entry.name}:{exponent:g}") for entry in fields)


def available(names: Collection[str]) -> tuple[Field, ...]:
    """The fields of the table that can be computed from the arrays of some names."""
    return tuple(entry for entry in FIELDS if set(entry.of) <= set(names))


def compute_fields(
    reference: Points,
    current: Points,
    faces: Indices,
    to_reference: RigidMotion,
    quality: StepFields,
    pair: Indices,
    window: StrainWindow | None = None,
    scatter: WindowScatter | None = None,
    known_deformation: Deformation | None = None,
    both_tensors: bool = True,
) -> StepFields:
    """All arrays of one step: displacements, deformation, strain over the windows, and quality.

    Parameters
    ----------
    reference, current : (N, 3) mm, positions of the vertices at the reference and at the step, NaN where lost.
    faces : (M, 3) vertex indices.
    to_reference : the rigid motion that takes the step back onto the reference.
    quality : correlation and standard deviations at the step, of `Results.quality`.
    pair : (M,) index of the camera pair of each triangle.
    window : adds strain over these windows to that of the triangles.
    scatter : adds standard deviations of the strain over the windows, where those of the displacements are known.
    known_deformation : from the reference to the step; computed where it is None.
    both_tensors : whether to add the Euler-Almansi tensor, from which no field follows.
    """
    deformed = deformation(reference, current, faces) if known_deformation is None else known_deformation
    point = {
        "displacement": current - reference,
        "displacement_without_rigid_motion": to_reference.apply(current) - reference,
        **quality.point,
    }
    face = {
        **_deformation_arrays(deformed, both_tensors),
        **_linear(deformed, to_reference),
        "isotropy": deformed.isotropy,
        "area": deformed.area,
        "face_correlation": quality.point["correlation"][faces].max(axis=1),
        "pair": pair.astype(float),
        **quality.face,
    }
    if window is not None:
        over = window.deformation(current, reference)
        face |= {f"window_{name}": values for name, values in _deformation_arrays(over, both_tensors).items()}
        if scatter is not None and "sigma_displacement" in quality.point:
            sigma = scatter.stretch_sigma(over, quality.point["sigma_displacement"])
            face["window_sigma_lambda1"], face["window_sigma_lambda2"] = sigma.T
    return StepFields(point, face)


def _deformation_arrays(deformed: Deformation, both_tensors: bool) -> dict[str, Floats]:
    """Area ratio, stretches, principal strains, directions and strain tensors of a deformation, by name."""
    names = ("J", "lambda1", "lambda2", "E1", "E2", *_DIRECTIONS)
    tensors = {"E_tensor": _six(deformed.E)} | ({"e_tensor": _six(deformed.e)} if both_tensors else {})
    return {**{name: getattr(deformed, name) for name in names}, **tensors}


def _linear(deformed: Deformation, to_reference: RigidMotion) -> dict[str, Floats]:
    """Principal linear strains after the rigid motion; they count each triangle's remaining rotation as strain."""
    values = strain.infinitesimal_principal(deformed.F, deformed.normal_reference, to_reference.R)
    return dict(zip(("linear1", "linear2"), values, strict=True))


def _six(tensor: Floats) -> Floats:
    """The components (..., 6) of symmetric tensors (..., 3, 3) in the order of VTK."""
    return np.take(tensor.reshape(*tensor.shape[:-2], 9), [3 * i + j for i, j in _SYMMETRIC], axis=-1)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise KeyError(text) from None
