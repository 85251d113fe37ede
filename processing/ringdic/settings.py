"""Settings of a processing run: groups with names, defaults and bounds, read from TOML and from ``name=value`` pairs.

An unknown name, a wrong type and a choice that this version does not have are refused, never ignored. The sentences of
a refusal serve every TOML file that is checked by a pydantic model: the rig's and the controller's too.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic.fields import FieldInfo

from ringdic.errors import InputError
from ringdic.findings import CODES

#: Of a table in a TOML file: unknown keys are refused, and so are infinite and undefined numbers.
TABLE = ConfigDict(extra="forbid", allow_inf_nan=False)


class _Group(BaseModel):
    model_config = ConfigDict(**TABLE, frozen=True)


def name_without_unit(name: str) -> str:
    """A setting's name inside the correlation, where all lengths are in px."""
    return name.removesuffix("_px")


class CorrelationGroup(_Group):
    """Settings of the 2D correlation, with their defaults and bounds.

    radius_px, step_px : subset radius (half the side of a square, less half a pixel) and spacing of the points, px.
    order : of the subset's shape functions, 1 affine, 2 quadratic.
    subset : its shape; always cut by the mask.
    interpolation : degree of the B-spline of the current image.
    tolerance : px; iteration stops when the next step would move the subset's rim by less (root mean square). The next
        step is judged by how the last two shrank (after one: by how those of other points did). It stops too when steps
        below 1e-5 px shrink no more. Below 1e-6 px all is computed in double precision, at a fifth of the speed.
    max_iterations : after so many the point is lost, or sooner when its steps predict that these will not suffice.
    zncc_min : zero-mean normalised cross-correlation below which a point is lost.

    Errors due to interpolation and tolerance, at radius 20 and speckle of 1.0, 1.5, 2.0 px (standard deviation of
    its blur): a cubic is biased by up to 4.1, 0.75, 0.22 thousandths of a pixel, a quintic by 0.99, 0.06, 0.01. A
    tolerance of 2e-3 leaves 0.2 thousandths where noise makes 3.5, and a mean of less than 0.01.
    """

    radius_px: int = Field(default=20, ge=2, le=500)
    step_px: int = Field(default=10, ge=1)
    order: Literal[1, 2] = 1
    subset: Literal["circle", "square"] = "circle"
    interpolation: Literal["quintic", "cubic"] = "quintic"
    tolerance: float = Field(default=2e-3, gt=0)
    max_iterations: int = Field(default=50, ge=1)
    zncc_min: float = Field(default=0.7, ge=-1, lt=1)

    @property
    def keywords(self) -> dict[str, Any]:
        """The settings under their names in the correlation, which are without units."""
        return {name_without_unit(name): value for name, value in self}

    def at_scale(self, scale: float) -> CorrelationGroup:
        """The settings for smaller images of the same scene, with no fewer pixels than a subset needs.

        scale : size of the images, 1 where these settings hold.
        """
        radius, step = max(10, round(self.radius_px * scale)), max(5, round(self.step_px * scale))
        return self.model_copy(update={"radius_px": radius, "step_px": step})

    @classmethod
    def limits(cls, name: str) -> dict[str, float]:
        """The least and the largest value of a numeric setting, as ``min`` and ``max`` where there are such."""
        info = cls.model_fields[name]
        choices = get_args(info.annotation)
        if choices:
            return {"min": min(choices), "max": max(choices)}
        ends = {"min": "ge", "max": "le"}
        return {end: getattr(each, kind) for end, kind in ends.items() for each in info.metadata if hasattr(each, kind)}


class CalibrationGroup(_Group):
    """Settings of the calibration of the cameras.

    method : each camera by the direct linear transformation (dlt), or from there all cameras, their lenses and the
        target adjusted together (bundle); the default is dlt where the settings' own method is paper.
    distortion : whether the lens is measured on the checkerboard and corrected.
    radial_terms, tangential, skew : number of radial terms, and whether the lens may have tangential terms and skew.
    terms : a lens gets as many of these terms as the checkerboard views determine (largest), or those with the smallest
        information criterion (criterion).
    drop_percentile : checkerboard views whose error lies above this percentile are left out and the lens is fitted
        again; 100 keeps all views.
    print_error_mm, radius_error_mm, pitch_error_mm, tilt_error_deg : for method bundle; prior standard deviations of
        the dots' positions, the target's radius, the spacing of its columns and the rotation of the printed sheet about
        their values in rig.toml; 0 fixes a quantity at that value.
    refine_poses : where cameras have moved since the calibration or between the steps, their poses are estimated again
        from the matches of the specimen; by the method paper never.
    """

    method: Literal["dlt", "bundle"] = "bundle"
    distortion: bool = True
    radial_terms: Literal[2, 3] = 3
    tangential: bool = True
    skew: bool = True
    terms: Literal["largest", "criterion"] = "largest"
    drop_percentile: float = Field(default=80.0, gt=0, le=100)
    print_error_mm: float = Field(default=0.03, ge=0, le=5)
    radius_error_mm: float = Field(default=0.0, ge=0, le=5)
    pitch_error_mm: float = Field(default=0.0, ge=0, le=5)
    tilt_error_deg: float = Field(default=0.0, ge=0, le=5)
    refine_poses: bool = True


class SurfaceGroup(_Group):
    """Settings of the surface: how its parts become one, and which matches it is made of.

    merge : how the cameras' charts, or the pairs' surfaces, become one: which triangles of an overlap are removed
        first, those worst by correlation, by distance to the other surfaces, by orientation against theirs, or by all
        of these and the nearness to the border (combined); none leaves the surfaces one over the other.
    incidence_deg : largest angle between a line of sight and the surface's normal at which a camera is used.
    sigma_max_px : largest standard deviation of a match; a point with a larger one, as where the speckle ends, is lost.
    """

    merge: Literal["none", "correlation", "distance", "orientation", "combined"] = "combined"
    incidence_deg: float = Field(default=65.0, gt=0, lt=90)
    sigma_max_px: float = Field(default=0.05, gt=0)


class StrainGroup(_Group):
    """Settings of the strain.

    window_mm : width of the window over which strain is fitted, in addition to that of each triangle; 0: no window.
    """

    window_mm: float = Field(default=0.0, ge=0, le=1000)


class Settings(_Group):
    """Settings of a processing run, in groups.

    method : best measures every point by all cameras that see it, with the curvature of the surface and of its
        displacement, after a bundle adjustment of the cameras. paper works as Solav et al. (2018): each camera by the
        direct linear transformation, each pair of neighbouring cameras a surface of its own, flat subsets.
    accept : codes of findings (`ringdic.findings.CODES`) that do not forbid to use the results.
    """

    method: Literal["best", "paper"] = "best"
    accept: tuple[str, ...] = ()
    correlation: CorrelationGroup = CorrelationGroup()
    calibration: CalibrationGroup = CalibrationGroup()
    surface: SurfaceGroup = SurfaceGroup()
    strain: StrainGroup = StrainGroup()

    @model_validator(mode="before")
    @classmethod
    def _calibration_of_the_method(cls, values: Any) -> Any:
        """Unless it is given, the calibration's method is that of the settings' method."""
        if not isinstance(values, dict) or values.get("method") != "paper":
            return values
        calibration = values.get("calibration", {})
        if isinstance(calibration, CalibrationGroup):
            calibration = calibration.model_dump(exclude_unset=True)
        return {**values, "calibration": {"method": "dlt", **calibration}} if isinstance(calibration, dict) else values

    @field_validator("accept")
    @classmethod
    def _known_codes(cls, codes: tuple[str, ...]) -> tuple[str, ...]:
        for code in codes:
            if code not in CODES:
                raise ValueError(f"{_nearest(code, list(CODES))} is no code of a finding; known are {', '.join(CODES)}")
        return codes

    def at_scale(self, scale: float) -> Settings:
        """The settings for smaller images of the same scene.

        scale : size of the images, 1 where these settings hold.
        """
        return self.model_copy(update={"correlation": self.correlation.at_scale(scale)})

    def to_toml(self) -> str:
        """Write the settings as the text of a TOML file that `load_settings` reads back."""
        above = {"method", "accept"}
        lines = [f"{name} = {_toml(value)}" for name, value in self.model_dump(include=above).items()] + [""]
        for group, values in self.model_dump(exclude=above).items():
            lines += [f"[{group}]", *(f"{name} = {_toml(value)}" for name, value in values.items()), ""]
        return "\n".join(lines)


#: Settings of the paper: cameras by the direct linear transformation, affine subsets, surfaces pair by pair.
PAPER = Settings(method="paper")


def load_settings(path: Path | None = None, overrides: Sequence[str] = ()) -> Settings:
    """Read settings from a TOML file and from ``group.name=value`` pairs, or ``method=value``.

    Parameters
    ----------
    path : the file; None takes the defaults.
    overrides : pairs that win over the file, the last one over those before.

    Raises
    ------
    InputError
        The file cannot be read, or a name, type or value is not known; the sentence names it.
    """
    tables: dict[str, Any] = {}
    if path is not None:
        path = Path(path)
        if not path.is_file():
            raise InputError(f"{path}: no such settings file")
        try:
            tables = tomllib.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:  # also numbers without end, and tables in tables without end
            raise InputError(f"{path}: not readable as TOML ({error})") from error
    for override in overrides:
        _set(tables, override)
    try:
        return Settings.model_validate(tables)
    except ValidationError as error:
        source = "settings" if path is None else f"{path} and --set" if overrides else str(path)
        raise InputError(f"{source}: {faults(error, Settings, _SETTINGS)}") from error


@lru_cache(maxsize=4)
def settings_of_run(text: str) -> Settings:
    """Settings of a finished run, from the TOML text that is stored in its results.

    Names of another version's settings are ignored, and settings that the text does not give have their defaults.
    Raises InputError where the text is not TOML or a value is not one of this version's.
    """
    try:
        tables = tomllib.loads(text)
        known: dict[str, Any] = {}
        for group, values in tables.items():
            if isinstance(values, dict):
                values = {name: value for name, value in values.items() if name in _fields(_inner(Settings, group))}
            if group in Settings.model_fields:
                known[group] = values
        return Settings.model_validate(known)
    except ValidationError as error:
        raise InputError(f"the run's settings: {faults(error, Settings, _SETTINGS)}") from error
    except (ValueError, RecursionError, AttributeError) as error:
        raise InputError(f"the run's settings are not readable as TOML ({error})") from error


def _set(tables: dict[str, Any], override: str) -> None:
    """Enter a ``group.name=value`` pair in the tables."""
    name, equals, text = override.partition("=")
    group, dot, key = name.strip().partition(".")
    if equals and not dot and _inner(Settings, group) is None and group in Settings.model_fields:
        tables[group] = _value(text.strip())
        return
    if not (equals and dot and group and key):
        raise InputError(f"--set {override}: not of the form group.name=value, such as correlation.radius_px=20")
    table = tables.setdefault(group, {})
    if not isinstance(table, dict):
        raise InputError(f"--set {override}: '{group}' is not a group of settings")
    table[key] = _value(text.strip())


def _value(text: str) -> Any:
    """A value as TOML reads it; a bare word is text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


# Messages of validation errors -------------------------------------------------------------------

#: Where in a file a fault lies: names of tables and keys, and numbers of entries in lists.
Location = tuple[int | str, ...]

_WANTED = {
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **dict.fromkeys(("string_type", "path_type"), "text in quotes"),
    **dict.fromkeys(("model_type", "dataclass_type"), "a table"),
}


def toml_key(model: type, at: Location) -> str:
    """Name of a key in a TOML file, for messages to the operator: ``[http] port``, ``[[cameras]] number 1 id``.

    model : pydantic model or dataclass of the file. at : location of the key in it; empty for the whole file.
    """
    words: list[str] = []
    for depth, part in enumerate(at):
        if isinstance(part, int):
            words.append(f"number {part + 1}")
        elif depth == 0 and _inner(model, part) is not None:
            in_list = get_origin(_fields(model)[part].annotation) is tuple
            words.append(f"[[{part}]]" if in_list else f"[{part}]")
        else:
            words.append(part)
    return " ".join(words)


def _unknown_toml_key(model: type, at: Location, known: Sequence[str]) -> str:
    sentence = f"{toml_key(model, at[:-1])} unknown key {_nearest(str(at[-1]), known)}; known are {', '.join(known)}"
    return sentence.strip()


@dataclass(frozen=True)
class Wording:
    """How messages about the keys of a kind of file are worded.

    key : function of the model and a key's location; returns the key's name. unknown : function of the model, the
    location of an unknown key and the known keys; returns the message.
    """

    key: Callable[[type, Location], str] = toml_key
    unknown: Callable[[type, Location, Sequence[str]], str] = _unknown_toml_key


def faults(error: ValidationError, model: type, wording: Wording = Wording()) -> str:
    """Messages of a validation error, one sentence for each fault: the key, what is wrong, what is allowed.

    Parameters
    ----------
    error : the validation error.
    model : the pydantic model or dataclass that raised it.
    wording : how keys are named.
    """
    return "; ".join(_fault(each, model, wording) for each in error.errors())


def _fault(error: Any, model: type, wording: Wording) -> str:
    kind, at, given = error["type"], error["loc"], error["input"]
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return wording.unknown(model, at, _known_keys(model, at))
    where = wording.key(model, at)
    if kind == "missing":
        return f"{where} is missing"
    if kind == "value_error":
        return f"{where} {error['ctx']['error']}".strip()
    if kind == "literal_error" and isinstance(given, str):
        return f"{where} {given!r} is not known; use {error['ctx']['expected']}"
    wanted = _WANTED.get(kind)
    must = f"must be {wanted}" if wanted else error["msg"].replace("Input should be", "must be")
    number = isinstance(given, int | float) and not isinstance(given, bool)
    hint = f' (write "{given}")' if kind == "string_type" and number else ""
    return f"{where} {must}, not {given!r}{hint}"


def _known_keys(model: type, at: Location) -> list[str]:
    """The keys that may stand where an unknown one does."""
    table: type | None = model
    for part in at[:-1]:
        if isinstance(part, str) and table is not None:
            table = _inner(table, part)
    return list(_fields(table))


def _nearest(key: str, known: Sequence[str]) -> str:
    """A key in quotes, with the known one that is spelt most alike, if one is."""
    near = get_close_matches(key, known, 1)
    return f"'{key}' (did you mean '{near[0]}'?)" if near else f"'{key}'"


def _fields(model: type | None) -> dict[str, FieldInfo]:
    """The fields of a pydantic model or dataclass; none of anything else."""
    fields: dict[str, FieldInfo] = getattr(model, "model_fields", None) or getattr(model, "__pydantic_fields__", {})
    return fields


def _inner(model: type, name: str) -> type | None:
    """The model of a table, or of each table of a list, that a field holds; None where it holds a plain value."""
    annotation = _fields(model)[name].annotation if name in _fields(model) else None
    return next((each for each in (annotation, *get_args(annotation)) if _fields(each)), None)


#: Settings of former versions for which the method stands now.
_GONE = ("surface.method", "surface.curvature", "tracking")


def _setting(_: type, at: Location) -> str:
    """A setting's name in the interface: ``correlation.radius_px``."""
    return ".".join(str(part) for part in at)


def _unknown_setting(model: type, at: Location, known: Sequence[str]) -> str:
    if _setting(model, at) in _GONE:
        return f"{_setting(model, at)} is no longer a setting; choose method=best, or method=paper for the paper's way"
    if len(at) < 2:
        return f"unknown group of settings {_nearest(_setting(model, at), known)}; known are {', '.join(known)}"
    name = _nearest(_setting(model, at), [f"{at[0]}.{key}" for key in known])
    return f"unknown setting {name}; [{at[0]}] has {', '.join(known)}"


_SETTINGS = Wording(_setting, _unknown_setting)
