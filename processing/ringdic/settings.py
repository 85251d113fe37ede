"""What a processing run is told: groups of settings from a TOML file and from ``name=value`` pairs.

An unknown name, a wrong type and a choice that this version does not have are refused, never ignored.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ringdic.errors import InputError


class _Group(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CorrelationGroup(_Group):
    """2D matching. Radius and step in px; tolerance of the iteration in px."""

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
        """The same under the names that the correlation uses inside."""
        return {
            "radius": self.radius_px,
            "step": self.step_px,
            "order": self.order,
            "subset": self.subset,
            "interpolation": self.interpolation,
            "tolerance": self.tolerance,
            "max_iterations": self.max_iterations,
            "zncc_min": self.zncc_min,
        }


class CalibrationGroup(_Group):
    """Cameras: the direct linear transformation (dlt), or from there the adjustment of all together (bundle).

    distortion : the lens is measured on the checkerboard and corrected.
    radial_terms, tangential, skew : terms that the lens may have. terms : it gets as many of them as the checkerboard
    views determine (largest), or those of the smallest information criterion (criterion).
    drop_percentile : checkerboard views whose error lies above it are dropped and the rest is fitted again; 100 keeps
    all views.
    print_error_mm, radius_error_mm, pitch_error_mm, tilt_error_deg : of the bundle: how far, as standard deviations,
    the dots, the target's radius, its columns' spacing and the turn of the sheet on it may be from what rig.toml
    says; 0 holds them.
    refine_poses : of surface.method global: where cameras have moved between the steps, their poses are found again
    from the points that they follow.
    """

    method: Literal["dlt", "bundle"] = "dlt"
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
    refine_poses: bool = False


class SurfaceGroup(_Group):
    """How matches become a surface, and where the surface is looked for.

    method : the surfaces of the camera pairs side by side (pairs), or one lattice over the surface whose points all
    cameras measure together (global).
    merge : of the pairs' surfaces into one, and which triangles of an overlap go first: the worst by correlation, by
    distance to the other surfaces, by orientation against theirs, or by these and the nearness to the border
    (combined); none leaves the surfaces one over the other.
    radius_mm : of the cylinder from which the search sets out; 0 takes the target's.
    reach_mm : how far from it the surface may lie. incidence_deg : the steepest angle of view that is used.
    sigma_max_px : a point whose match has a larger standard deviation, where the speckle ends, is lost.
    spacing_mm : of the lattice; 0 takes the correlation's step as the cameras see it. curvature : of the warps between
    cameras, from the measured shape and held (geometry), or none.
    """

    method: Literal["pairs", "global"] = "pairs"
    merge: Literal["none", "correlation", "distance", "orientation", "combined"] = "combined"
    radius_mm: float = Field(default=0.0, ge=0)
    reach_mm: float = Field(default=20.0, gt=0)
    incidence_deg: float = Field(default=65.0, gt=0, lt=90)
    sigma_max_px: float = Field(default=0.05, gt=0)
    spacing_mm: float = Field(default=0.0, ge=0)
    curvature: Literal["geometry", "none"] = "geometry"


class TrackingGroup(_Group):
    """How a camera follows its points in time; of the global method.

    two_pass : second derivatives that the neighbours' displacements show are held in a second pass of first order.
    update_reference : a point lost against the reference image is sought from the last image that showed it.
    """

    two_pass: bool = True
    update_reference: bool = True


class StrainGroup(_Group):
    """Strain. window_mm : width of the window it is fitted over, beside that of each triangle alone; 0: no window."""

    window_mm: float = Field(default=0.0, ge=0, le=1000)


class Settings(_Group):
    """All settings of a processing run."""

    correlation: CorrelationGroup = CorrelationGroup()
    calibration: CalibrationGroup = CalibrationGroup()
    surface: SurfaceGroup = SurfaceGroup()
    tracking: TrackingGroup = TrackingGroup()
    strain: StrainGroup = StrainGroup()

    @model_validator(mode="after")
    def _poses_need_many_views(self) -> Settings:
        if self.calibration.refine_poses and self.surface.method != "global":
            raise ValueError(
                "calibration.refine_poses needs surface.method=global: two cameras alone do not tell a camera's motion "
                "from the surface's"
            )
        return self

    def to_toml(self) -> str:
        """The settings as the text of a TOML file that :func:`load_settings` reads back."""
        lines: list[str] = []
        for group, values in self.model_dump().items():
            lines += [f"[{group}]", *(f"{name} = {_toml(value)}" for name, value in values.items()), ""]
        return "\n".join(lines)


#: As the paper measured: cameras by the direct linear transformation, flat subsets, pair by pair.
PAPER = Settings()
#: The most exact: all cameras adjusted together, one surface with its own curvature, two passes in time.
BEST = Settings(calibration=CalibrationGroup(method="bundle"), surface=SurfaceGroup(method="global"))


def load_settings(path: Path | None = None, overrides: Sequence[str] = ()) -> Settings:
    """Settings from a TOML file (or the defaults), changed by ``group.name=value`` pairs, the last one winning.

    Raises InputError : the file cannot be read, or a name, type or value is not known; the sentence names it.
    """
    tables: dict[str, Any] = {}
    if path is not None:
        path = Path(path)
        if not path.is_file():
            raise InputError(f"{path}: no such settings file")
        try:
            tables = tomllib.loads(path.read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: not readable as TOML ({error})") from error
    for override in overrides:
        _set(tables, override)
    try:
        return Settings.model_validate(tables)
    except ValidationError as error:
        source = "settings" if path is None else f"{path} and --set" if overrides else str(path)
        raise InputError(f"{source}: {'; '.join(_sentence(e) for e in error.errors())}") from error


def _set(tables: dict[str, Any], override: str) -> None:
    name, equals, text = override.partition("=")
    group, dot, key = name.strip().partition(".")
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
    except tomllib.TOMLDecodeError:
        return text


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else repr(value)


_WANTED = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "string": "text",
    "model": "a group of settings",
}


def _sentence(error: Any) -> str:
    where = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        group = Settings.model_fields.get(str(error["loc"][0]))
        if len(error["loc"]) > 1 and group is not None:
            known = ", ".join(group.default.__class__.model_fields)
            return f"unknown setting '{where}'; [{error['loc'][0]}] has {known}"
        return f"unknown group of settings '{where}'; known are {', '.join(Settings.model_fields)}"
    if error["type"] == "value_error":
        return f"{where}: {error['ctx']['error']}".removeprefix(": ")
    wanted = _WANTED.get(error["type"].split("_")[0])
    must = f"must be {wanted}" if wanted else error["msg"].replace("Input should be", "must be")
    return f"{where} {must}, not {error['input']!r}"
