"""Description of a rig by the laboratory, read from ``rig.toml`` and checked: target, checkerboard, cameras, pairs."""

from __future__ import annotations

import itertools
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, Strict, StrictFloat, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from ringdic.errors import InputError
from ringdic.session.names import is_file_name
from ringdic.settings import TABLE, faults


def _usable_id(camera_id: str) -> str:
    if not is_file_name(camera_id):
        raise ValueError(f"{camera_id!r} is not usable: images are named by it; use letters and digits")
    return camera_id


def _two_numbers(value: Any) -> Any:
    if value is not None and not (isinstance(value, list | tuple) and len(value) == 2):
        raise ValueError(f"must be a list of 2 numbers, not {value!r}")
    return value


def _list_of_cameras(value: Any) -> Any:
    if not isinstance(value, list | tuple):
        raise ValueError(f"must be one table a camera, each under two pairs of brackets, not {value!r}")
    return value


def _list_of_pairs(value: Any) -> Any:
    if not isinstance(value, list | tuple):
        raise ValueError(f"must be a list of pairs of camera ids, not {value!r}")
    for pair in value:
        if not isinstance(pair, list | tuple) or len(pair) != 2 or pair[0] == pair[1]:
            raise ValueError(f"has {pair!r}, which is not a pair of cameras")
    return value


Positive = Annotated[float, Strict(), Field(gt=0)]
Count = Annotated[int, Strict(), Field(ge=2)]
Squares = Annotated[int, Strict(), Field(ge=4)]
Pairs = tuple[tuple[str, str], ...]


@dataclass(frozen=True, config=TABLE)
class Target:
    """The calibration object: a cylinder with dots on a grid, the axis along z.

    radius_mm : of the cylinder. rows, columns : of the grid. row_spacing_mm : along z. first_row_z_mm : z of the
    lowest row. column_spacing_mm : along the arc. dot_size_mm : edge or diameter of a dot.
    """

    kind: Literal["dot-cylinder"]
    radius_mm: Positive
    rows: Count
    row_spacing_mm: Positive
    first_row_z_mm: StrictFloat
    columns: Count
    column_spacing_mm: Positive
    dot_size_mm: Positive
    dot_shape: Literal["square", "circle"] = "square"

    def __post_init__(self) -> None:
        if (self.columns - 1) * self.column_spacing_mm + self.dot_size_mm >= 2 * math.pi * self.radius_mm:
            raise ValueError(
                f"{self.columns} columns at {self.column_spacing_mm} mm do not fit round the radius of "
                f"{self.radius_mm} mm"
            )

    @property
    def column_angle(self) -> float:
        """Angle between neighbouring columns, rad."""
        return self.column_spacing_mm / self.radius_mm


@dataclass(frozen=True, config=TABLE)
class Board:
    """The checkerboard from which the lenses are calibrated. squares : (across, along). square_mm : their edge."""

    kind: Literal["checkerboard"]
    squares: Annotated[tuple[Squares, Squares], BeforeValidator(_two_numbers)]
    square_mm: Positive

    @property
    def inner_corners(self) -> tuple[int, int]:
        """Inner corners (across, along)."""
        return self.squares[0] - 1, self.squares[1] - 1


@dataclass(frozen=True, config=TABLE)
class RigCamera:
    """One camera of the ring, with its nominal position as it was set up by hand.

    id : names its images and its node. azimuth_deg : about z, nominal, good to ± 5°. height_mm, distance_mm : of the
    camera over z = 0 and from the axis. rotation_deg : of the image about the line of sight. intrinsics : file of a
    lens that was calibrated before.
    """

    id: Annotated[str, AfterValidator(_usable_id)]
    azimuth_deg: StrictFloat
    height_mm: StrictFloat | None = None
    distance_mm: StrictFloat | None = None
    rotation_deg: StrictFloat = 0.0
    intrinsics: str | None = None


@dataclass(frozen=True, config=TABLE)
class CaptureSettings:
    """Settings of the cameras while they capture.

    exposure_us : µs. gain : analogue. colour_gains : (red, blue). period_us : of the frames, µs. tolerance_us : skew
    between the cameras that is not flagged, µs. None leaves a setting to the camera or the controller.
    """

    exposure_us: StrictFloat | None = None
    gain: StrictFloat | None = None
    colour_gains: Annotated[tuple[StrictFloat, StrictFloat] | None, BeforeValidator(_two_numbers)] = None
    period_us: StrictFloat | None = None
    tolerance_us: StrictFloat | None = None


@dataclass(frozen=True, config=TABLE)
class Rig:
    """A rig as ``rig.toml`` describes it. pairs : ids of two cameras each, the reference camera first."""

    name: str
    target: Target
    board: Board
    cameras: tuple[RigCamera, ...]
    pairs: Pairs
    capture: CaptureSettings = CaptureSettings()

    def camera(self, camera_id: str) -> RigCamera:
        """The camera of an id; KeyError if the rig has none."""
        for camera in self.cameras:
            if camera.id == camera_id:
                return camera
        raise KeyError(camera_id)


@dataclass(frozen=True, config=TABLE)
class _Name:
    """The table ``[rig]``."""

    name: str

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("name is empty")


@dataclass(frozen=True, config=TABLE)
class _ListedPairs:
    """The table ``[pairs]``."""

    pairs: Annotated[Pairs, BeforeValidator(_list_of_pairs)] = ()

    def __post_init__(self) -> None:
        if not self.pairs:
            raise ValueError("pairs is empty; leave the table out to use every adjacent pair")


@dataclass(frozen=True, config=TABLE)
class _RigFile:
    """The tables of a ``rig.toml``."""

    rig: _Name
    target: Target
    board: Board
    cameras: Annotated[tuple[RigCamera, ...], BeforeValidator(_list_of_cameras)]
    capture: CaptureSettings = CaptureSettings()
    pairs: _ListedPairs | None = None

    def __post_init__(self) -> None:
        ids = [camera.id for camera in self.cameras]
        if len(ids) < 2:
            raise ValueError("[[cameras]] needs at least two cameras")
        for camera_id in ids:
            if ids.count(camera_id) > 1:
                raise ValueError(f"camera id '{camera_id}' occurs more than once")
        for camera_id in itertools.chain.from_iterable(self.pairs.pairs if self.pairs else ()):
            if camera_id not in ids:
                raise ValueError(f"[pairs] names camera '{camera_id}', which [[cameras]] does not have")


_RIG_FILE = TypeAdapter(_RigFile)


def adjacent_pairs(cameras: tuple[RigCamera, ...]) -> Pairs:
    """Every pair of neighbouring cameras, in the order in which they are listed.

    The last camera and the first are a pair too where the ring is closed: they are at most 90° apart, and the cameras
    stand once around.
    """
    ids = [camera.id for camera in cameras]
    pairs = list(itertools.pairwise(ids))
    azimuths = [camera.azimuth_deg for camera in cameras]
    steps = [_wrapped(b - a) for a, b in itertools.pairwise([*azimuths, azimuths[0]])]
    if len(ids) > 2 and abs(steps[-1]) <= 90.0 and abs(sum(steps)) > 180.0:
        pairs.append((ids[-1], ids[0]))
    return tuple(pairs)


def read_rig(path: Path) -> Rig:
    """Read the rig that a TOML file describes. InputError names the file and the key at fault."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; it must describe the target, the board and the cameras")
    try:
        return parse_rig(path.read_text(encoding="utf-8"))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (ValueError, RecursionError) as error:  # also numbers without end, and tables in tables without end
        raise InputError(f"{path}: not readable as TOML ({error})") from error


def parse_rig(text: str) -> Rig:
    """Parse and check the text of a ``rig.toml``.

    Without ``[pairs]``, every adjacent pair of cameras is one.

    Raises
    ------
    InputError
        A key is missing, unknown or has a value that is not allowed; the sentence names it.
    tomllib.TOMLDecodeError
        The text is not TOML.
    """
    tables = tomllib.loads(text)
    try:
        file = _RIG_FILE.validate_python(tables)
    except ValidationError as error:
        raise InputError(faults(error, _RigFile)) from error
    pairs = file.pairs.pairs if file.pairs else adjacent_pairs(file.cameras)
    return Rig(file.rig.name, file.target, file.board, file.cameras, pairs, file.capture)


def _wrapped(angle_deg: float) -> float:
    """An angle in [-180°, 180°)."""
    return (angle_deg + 180.0) % 360.0 - 180.0
