"""The rig as the laboratory describes it: ``rig.toml`` read, checked and frozen. Standard library only."""

from __future__ import annotations

import itertools
import math
import tomllib
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from ringdic.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Target:
    """The calibration object: a cylinder with dots on a grid. Lengths mm; column spacing along the arc."""

    kind: str
    radius_mm: float
    rows: int
    row_spacing_mm: float
    first_row_z_mm: float
    columns: int
    column_spacing_mm: float
    dot_size_mm: float
    dot_shape: str = "square"

    def __post_init__(self) -> None:
        _require(self.kind == "dot-cylinder", f"[target] kind '{self.kind}' is not known; use 'dot-cylinder'")
        _require(self.dot_shape in ("square", "circle"), "[target] dot_shape must be 'square' or 'circle'")
        for name in ("radius_mm", "row_spacing_mm", "column_spacing_mm", "dot_size_mm"):
            _require(getattr(self, name) > 0, f"[target] {name} must be positive")
        _require(self.rows >= 2 and self.columns >= 2, "[target] needs at least 2 rows and 2 columns")
        used = (self.columns - 1) * self.column_spacing_mm + self.dot_size_mm
        _require(
            used < 2 * math.pi * self.radius_mm,
            f"[target] {self.columns} columns at {self.column_spacing_mm} mm do not fit round the radius",
        )

    @property
    def column_angle(self) -> float:
        """Angle between neighbouring columns, rad."""
        return self.column_spacing_mm / self.radius_mm


@dataclass(frozen=True)
class Board:
    """The checkerboard of the intrinsics: squares (across, along), edge in mm."""

    kind: str
    squares: tuple[int, int]
    square_mm: float

    def __post_init__(self) -> None:
        _require(self.kind == "checkerboard", f"[board] kind '{self.kind}' is not known; use 'checkerboard'")
        _require(
            len(self.squares) == 2 and min(self.squares) >= 4,
            "[board] squares must be two numbers, 4 or more",
        )
        object.__setattr__(self, "squares", (int(self.squares[0]), int(self.squares[1])))
        _require(self.square_mm > 0, "[board] square_mm must be positive")

    @property
    def inner_corners(self) -> tuple[int, int]:
        """Inner corners (across, along)."""
        return self.squares[0] - 1, self.squares[1] - 1


@dataclass(frozen=True)
class RigCamera:
    """One camera of the ring as set up by hand: nominal azimuth good to ± 5°."""

    id: str
    azimuth_deg: float
    height_mm: float | None = None
    distance_mm: float | None = None
    rotation_deg: float = 0.0
    intrinsics: str | None = None

    def __post_init__(self) -> None:
        _require(
            bool(self.id) and "/" not in self.id and self.id not in (".", ".."),
            f"camera id '{self.id}' is not usable",
        )


@dataclass(frozen=True)
class CaptureSettings:
    """What the cameras are told: exposure in µs, gains, frame period and the tolerated skew."""

    exposure_us: float | None = None
    gain: float | None = None
    colour_gains: tuple[float, float] | None = None
    period_us: float | None = None
    tolerance_us: float | None = None


@dataclass(frozen=True)
class Rig:
    """Everything ``rig.toml`` says. ``pairs`` are camera ids, reference camera first."""

    name: str
    target: Target
    board: Board
    cameras: tuple[RigCamera, ...]
    pairs: tuple[tuple[str, str], ...]
    capture: CaptureSettings = CaptureSettings()

    def camera(self, camera_id: str) -> RigCamera:
        """The camera of this id; KeyError if the rig has none."""
        for camera in self.cameras:
            if camera.id == camera_id:
                return camera
        raise KeyError(camera_id)


def adjacent_pairs(cameras: tuple[RigCamera, ...]) -> tuple[tuple[str, str], ...]:
    """Every adjacent pair in ring order, closed when the cameras go all the way round (largest gap ≤ 90°)."""
    ids = [camera.id for camera in cameras]
    pairs = list(itertools.pairwise(ids))
    if len(ids) > 2 and abs(_wrapped(cameras[0].azimuth_deg - cameras[-1].azimuth_deg)) <= 90.0:
        pairs.append((ids[-1], ids[0]))
    return tuple(pairs)


def read_rig(path: Path) -> Rig:
    """The rig described by a TOML file; InputError names the file and the key at fault."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; it must describe the target, the board and the cameras")
    try:
        return parse_rig(path.read_text(encoding="utf-8"))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not readable as TOML ({error})") from error


def parse_rig(text: str) -> Rig:
    """The rig described by the text of a ``rig.toml``."""
    tables = tomllib.loads(text)
    _refuse_unknown(tables, {"rig", "target", "board", "cameras", "capture", "pairs"}, "")
    for name in ("rig", "target", "board", "cameras"):
        _require(name in tables, f"[{name}] is missing")
    rig = _table(tables["rig"], "[rig]")
    _refuse_unknown(rig, {"name"}, "[rig] ")
    _require(bool(rig.get("name")), "[rig] name is missing")
    entries = tables["cameras"]
    _require(isinstance(entries, list), "cameras must be one [[cameras]] table a camera, with two pairs of brackets")
    cameras = tuple(_build(RigCamera, entry, f"[[cameras]] number {i + 1} ") for i, entry in enumerate(entries))
    _require(len(cameras) >= 2, "[[cameras]] needs at least two cameras")
    ids = [camera.id for camera in cameras]
    for camera_id in ids:
        _require(ids.count(camera_id) == 1, f"camera id '{camera_id}' occurs more than once")
    return Rig(
        name=_typed(rig["name"], "str", "[rig] name"),
        target=_build(Target, tables["target"], "[target] "),
        board=_build(Board, tables["board"], "[board] "),
        cameras=cameras,
        pairs=_pairs(tables.get("pairs"), cameras),
        capture=_build(CaptureSettings, tables.get("capture", {}), "[capture] "),
    )


def _pairs(table: Any, cameras: tuple[RigCamera, ...]) -> tuple[tuple[str, str], ...]:
    if table is None:
        return adjacent_pairs(cameras)
    table = _table(table, "[pairs]")
    _refuse_unknown(table, {"pairs"}, "[pairs] ")
    listed = table.get("pairs", [])
    _require(isinstance(listed, list), f"[pairs] pairs must be a list of pairs of camera ids, not {listed!r}")
    ids = [camera.id for camera in cameras]
    pairs = []
    for pair in listed:
        two = isinstance(pair, list) and len(pair) == 2 and pair[0] != pair[1]
        _require(two, f"[pairs] {pair!r} is not a pair of cameras")
        for camera_id in pair:
            _require(camera_id in ids, f"[pairs] names camera '{camera_id}', which [[cameras]] does not have")
        pairs.append((pair[0], pair[1]))
    _require(bool(pairs), "[pairs] pairs is empty; leave the table out to use every adjacent pair")
    return tuple(pairs)


def _build(kind: type[T], table: Any, where: str) -> T:
    """One frozen dataclass from one TOML table, with unknown, missing and mistyped keys named."""
    known = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
    table = _table(table, where.strip())
    _refuse_unknown(table, set(known), where)
    values: dict[str, Any] = {}
    for name, field in known.items():
        if name not in table:
            _require(field.default is not MISSING, f"{where}{name} is missing")
            continue
        values[name] = _typed(table[name], str(field.type), where + name)
    return kind(**values)


_WANTED = {"float": "a number", "int": "a whole number", "str": "text in quotes"}


def _typed(value: Any, annotation: str, where: str) -> Any:
    """A TOML value as the field's annotation wants it: a number, a whole number, text, or two numbers."""
    wanted = annotation.split(" | ")[0]
    if wanted.startswith("tuple["):
        inner = wanted.removeprefix("tuple[").removesuffix("]").split(", ")
        _require(
            isinstance(value, list) and len(value) == len(inner),
            f"{where} must be a list of {len(inner)} numbers, not {value!r}",
        )
        return tuple(_typed(each, kind, where) for each, kind in zip(value, inner, strict=True))
    if wanted == "str":
        written = f' (write "{value}")' if isinstance(value, int | float) else ""
        _require(isinstance(value, str), f"{where} must be {_WANTED[wanted]}, not {value!r}{written}")
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    _require(
        number and (wanted == "float" or isinstance(value, int)), f"{where} must be {_WANTED[wanted]}, not {value!r}"
    )
    return float(value) if wanted == "float" else value


def _table(value: Any, header: str) -> dict[str, Any]:
    _require(isinstance(value, dict), f"{header} must be a table, not {value!r}")
    return dict(value)


def _refuse_unknown(table: dict[str, Any], known: set[str], where: str) -> None:
    for key in table:
        _require(key in known, f"{where}unknown key '{key}'; known are {', '.join(sorted(known))}")


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise InputError(sentence)


def _wrapped(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0
