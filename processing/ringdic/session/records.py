"""The JSON records of a session folder: ``session.json`` and each capture's ``capture.json``, typed and checked.

A record of another schema is refused. Unknown fields are ignored when a record is read and
preserved when it is written again. Times are integers, ns since the Unix epoch, or ISO 8601 text in UTC.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from ringdic.errors import InputError
from ringdic.session.json_text import read_json
from ringdic.session.names import capture_id, is_file_name

SCHEMA = 1

_STATUSES = ("pending", "ok", "delivered-late", "failed")
_EARLIER_WORDS = {"late": "delivered-late"}  # of a status in records of earlier releases
#: What to do about a damaged session.
REMEDY = "copy it back, or import the session again"
_UNKNOWN = "unknown"
LONGEST_NOTE = 2000  # characters of the note of a capture
# Fields that are left out of the file where there is nothing to say, so that earlier records stay as they are.
_OMITTED = (
    "settings", "settings_hash", "armed", "conflicts", "clock_offset_ns", "clock_error_ns", "clock_step_ns",
    "row_time_ns", "skew_error_ns", "readout_ns", "frame_grid", "note",
)  # fmt: skip

R = TypeVar("R", bound="_Record")


class SessionError(InputError):
    """A session or a record of it that does not exist, exists already or cannot be used; the message says which."""


class _NewerSchemaError(SessionError):
    """A record that a newer version has written: it is not damaged."""


@dataclass(frozen=True)
class _Record:
    """A JSON object whose fields are those of the class, in order; `unknown` are all others of the object."""

    unknown: Mapping[str, Any] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        for each in fields(self):
            value, (wanted, types) = getattr(self, each.name), _TYPES[str(each.type)]
            if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
                raise SessionError(f"'{each.name}' must be {wanted}, not {value!r}")

    @classmethod
    def _of(cls: type[R], document: Mapping[str, Any]) -> R:
        """The record that a JSON object holds. SessionError names a field that is missing or has the wrong type."""
        if not isinstance(document, Mapping):
            raise SessionError(f"a table of fields is wanted, not {document!r}")
        names = [each.name for each in fields(cls) if each.name != _UNKNOWN]
        values = {name: document[name] for name in names if name in document}
        required = [each.name for each in fields(cls) if each.default is each.default_factory is MISSING]
        for name in required:
            if name not in values:
                raise SessionError(f"the field '{name}' is missing")
        unknown = {name: value for name, value in document.items() if name not in names}
        return cls(**values, unknown=unknown)

    def _fields(self) -> dict[str, Any]:
        names = [each.name for each in fields(self) if each.name != _UNKNOWN]
        values = {name: getattr(self, name) for name in names}
        told = {name: value for name, value in values.items() if name not in _OMITTED or value not in (None, "", {})}
        return {**told, **self.unknown}


_TYPES: dict[str, tuple[str, tuple[type, ...]]] = {
    "str": ("text", (str,)),
    "str | None": ("text or null", (str, type(None))),
    "int": ("a whole number", (int,)),
    "int | None": ("a whole number or null", (int, type(None))),
    "float | None": ("a number or null", (int, float, type(None))),
    "bool": ("true or false", (bool,)),
    "bool | None": ("true, false or null", (bool, type(None))),
    "Mapping[str, Any]": ("a table", (Mapping,)),
    "Mapping[str, CameraRecord]": ("a table with an entry for each camera", (Mapping,)),
}


@dataclass(frozen=True)
class SessionRecord(_Record):
    """Record of a session, stored in ``session.json``: its name, its rig and the source of its images.

    session : name of the session. rig : name of the rig. created : ISO 8601. source : "capture" or "import".
    """

    session: str
    rig: str
    created: str
    source: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source not in ("capture", "import"):
            raise SessionError(f"a session's 'source' is 'capture' or 'import', not {self.source!r}")

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> SessionRecord:
        """Parse the record from the JSON object of a ``session.json``. Raises SessionError."""
        return cls._of(_without_schema(document))

    def to_json(self) -> dict[str, Any]:
        """The record as the JSON object of a ``session.json``."""
        return {"schema": SCHEMA, **self._fields()}


@dataclass(frozen=True)
class ImageDescription:
    """Description of an image that comes from a camera: checksum, size, time of exposure, metadata.

    sha256 : hexadecimal digits. width, height : px. time_ns : measured time of the exposure. exposure_us : µs.
    metadata : JSON values from the camera. format : extension of the file, without the dot. settings_hash : of the
    settings that the camera was locked to. clock_offset_ns, clock_error_ns, clock_step_ns, row_time_ns : as in
    `CameraRecord`.
    """

    sha256: str
    width: int
    height: int
    time_ns: int | None = None
    exposure_us: float | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    format: str = "pgm"
    settings_hash: str | None = None
    clock_offset_ns: int | None = None
    clock_error_ns: int | None = None
    clock_step_ns: int | None = None
    row_time_ns: float | None = None


@dataclass(frozen=True)
class CameraRecord(_Record):
    """One camera's entry in the record of a capture.

    status : "pending" while the image is awaited, "ok", "delivered-late" where it came after the close, "failed";
    "late" of earlier releases is read as "delivered-late". reason : why it was delivered late or failed, or what
    speaks against the image. file : name of the image in the capture's folder. sha256, bytes : of that file. width,
    height : px. time_ns : measured time of the exposure, on the controller's clock where `clock_offset_ns` is
    known. exposure_us : µs. metadata : JSON values from the camera. original : the file that was imported. The rest
    is written only where there is something to say. settings_hash : of the settings that the camera was locked to.
    armed : what the camera's node answered when it armed. conflicts : checksums of other images that came for this
    camera, by the names of their files. clock_offset_ns : offset of the node's clock that `time_ns` is corrected
    by; clock_error_ns : bound of its error; clock_step_ns : by how much that clock was set after the node was
    armed. row_time_ns : from one row of the image to the next, of a sensor with a rolling shutter.
    """

    status: str = "pending"
    reason: str | None = None
    file: str | None = None
    sha256: str | None = None
    bytes: int | None = None
    width: int | None = None
    height: int | None = None
    time_ns: int | None = None
    exposure_us: float | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    original: str | None = None
    settings_hash: str | None = None
    armed: Mapping[str, Any] = field(default_factory=dict)
    conflicts: Mapping[str, Any] = field(default_factory=dict)
    clock_offset_ns: int | None = None
    clock_error_ns: int | None = None
    clock_step_ns: int | None = None
    row_time_ns: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "status", _EARLIER_WORDS.get(self.status, self.status))
        if self.status not in _STATUSES:
            raise SessionError(f"'status' is one of {', '.join(_STATUSES)}, not {self.status!r}")
        if self.file is not None and not is_file_name(self.file):
            raise SessionError(f"'file' must be a name in the capture's folder, not {self.file!r}")
        for name, sha256 in self.conflicts.items():
            if not is_file_name(name) or not isinstance(sha256, str):
                raise SessionError(
                    f"'conflicts' must have a checksum by the name of each file, not {name!r}: {sha256!r}"
                )

    @property
    def readout_ns(self) -> int | None:
        """Time from the first to the last row of the image, ns; None where it is not known."""
        if self.row_time_ns is None or self.height is None:
            return None
        return round(self.row_time_ns * (self.height - 1))

    @property
    def lacks_image(self) -> bool:
        """Whether no image of this camera has been archived."""
        return self.status in ("pending", "failed")

    def archived_as(self, sha256: str) -> str | None:
        """`sha256` if an image with this checksum is archived, as the camera's or beside it; else that of the camera's.

        None where there is none.
        """
        return sha256 if sha256 in self.conflicts.values() else self.sha256

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> CameraRecord:
        """Parse the entry from its JSON object. Raises SessionError."""
        return cls._of(document)

    def to_json(self) -> dict[str, Any]:
        """The entry as a JSON object."""
        return self._fields()


@dataclass(frozen=True)
class CaptureRecord(_Record):
    """Record of one capture, stored in its ``capture.json``: its times, and the state of each camera's image.

    capture_id : ``NNNN-kind``, of `number` and `kind`. session : name of the session. state : "open" or "closed".
    opened_at, closed_at : ISO 8601. fire_at_ns : planned moment of the exposure. skew_ns : spread of the cameras'
    measured times, None where fewer than two measured one. tolerance_ns : skew that is not flagged. skew_exceeded :
    whether it is larger, or a camera's clock is not known as well as that. override : captured although cameras
    were missing. cameras : an entry for each camera that an image is expected of. settings, settings_hash : camera
    settings that were asked for, and their hash. skew_error_ns : bound of the skew's error from the cameras'
    clocks. readout_ns : time from the first to the last row of an image, of the slowest rolling shutter: within one
    image a moving body is seen over so long, whatever the skew. frame_grid : period, spread and each camera's
    deviation, ns, of sensors that run freely. note : what the operator noted of the capture.
    """

    capture_id: str
    number: int
    kind: str
    session: str
    state: str
    opened_at: str | None = None
    closed_at: str | None = None
    fire_at_ns: int | None = None
    skew_ns: int | None = None
    tolerance_ns: int | None = None
    skew_exceeded: bool | None = None
    override: bool = False
    cameras: Mapping[str, CameraRecord] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    settings_hash: str | None = None
    skew_error_ns: int | None = None
    readout_ns: int | None = None
    frame_grid: Mapping[str, Any] = field(default_factory=dict)
    note: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.capture_id != capture_id(self.number, self.kind):
            raise SessionError(f"'capture_id' {self.capture_id!r} is not that of number {self.number}, {self.kind!r}")
        if self.state not in ("open", "closed"):
            raise SessionError(f"'state' is 'open' or 'closed', not {self.state!r}")

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> CaptureRecord:
        """Parse the record from the JSON object of a ``capture.json``. Raises SessionError."""
        document = _without_schema(document)
        entries = document.get("cameras", {})
        if not isinstance(entries, Mapping):
            raise SessionError(f"'cameras' must have one record a camera, not {entries!r}")
        cameras = {}
        for camera, entry in entries.items():
            try:
                cameras[camera] = CameraRecord.from_json(entry)
            except SessionError as error:
                raise SessionError(f"camera '{camera}': {error}") from error
        return cls._of({**document, "cameras": cameras})

    def to_json(self) -> dict[str, Any]:
        """The record as the JSON object of a ``capture.json``."""
        entries = {camera: entry.to_json() for camera, entry in self.cameras.items()}
        return {"schema": SCHEMA, **self._fields(), "cameras": entries}

    def exposed_late_ns(self, camera: str) -> int | None:
        """Time from the planned moment to a camera's measured exposure, ns; None where either is not known.

        It is negative if the exposure was early. It says nothing of when the image was delivered.
        """
        time_ns = self.cameras[camera].time_ns
        return None if time_ns is None or self.fire_at_ns is None else time_ns - self.fire_at_ns

    def with_entry(self, camera: str, entry: CameraRecord) -> CaptureRecord:
        """The record with another entry for a camera; the skew of a closed capture is computed again."""
        changed = replace(self, cameras={**self.cameras, camera: entry})
        return changed._with_skew() if self.state == "closed" else changed

    def with_image(self, camera: str, image: CameraRecord) -> CaptureRecord:
        """The record with a camera's image, which is late after the close; what the camera was armed to is kept.

        image : entry with all that is known of the image. Its reason says if the camera held other settings than those
        that were asked for.
        """
        before, late = self.cameras[camera], self.state == "closed"
        reasons = [f"the image arrived after the close at {self.closed_at}"] if late else []
        if image.settings_hash and self.settings_hash and image.settings_hash != self.settings_hash:
            exposure = "" if image.exposure_us is None else f", exposure {image.exposure_us:g} µs"
            reasons.append(
                f"taken with other settings ({image.settings_hash[:8]}…{exposure}) than the capture's "
                f"({self.settings_hash[:8]}…), because somebody armed the camera in between; capture again"
            )
        if before.conflicts:
            reasons.append(_conflict_sentence(before.conflicts))
        entry = replace(
            image,
            status="delivered-late" if late else "ok",
            reason="; ".join(reasons) or None,
            armed=before.armed,
            conflicts=before.conflicts,
            unknown=before.unknown,
        )
        return self.with_entry(camera, entry)

    def with_conflict(self, camera: str, file: str, sha256: str) -> CaptureRecord:
        """The record with another image of a camera that has one: both are named, the first stays the camera's."""
        entry = self.cameras[camera]
        if sha256 in (entry.sha256, *entry.conflicts.values()):
            return self
        conflicts = {**entry.conflicts, file: sha256}
        other = (entry.reason or "").removesuffix(_conflict_sentence(entry.conflicts)).removesuffix("; ")
        reason = "; ".join(part for part in (other, _conflict_sentence(conflicts)) if part)
        return self.with_entry(camera, replace(entry, conflicts=conflicts, reason=reason))

    def with_note(self, note: str) -> CaptureRecord:
        """The record with another note of the operator; an empty one removes it. SessionError where it is too long."""
        note = note.strip()
        if len(note) > LONGEST_NOTE:
            raise SessionError(
                f"the note of {self.capture_id} has {len(note)} characters; shorten it to {LONGEST_NOTE} at most"
            )
        return replace(self, note=note or None)

    def with_failure(self, camera: str, reason: str) -> CaptureRecord:
        """The record with the reason why a camera has no image; unchanged where its image is archived."""
        entry = self.cameras[camera]
        if not entry.lacks_image or (entry.status == "failed" and entry.reason == reason):
            return self
        entry = replace(entry, status="failed", reason=reason)
        return replace(self, cameras={**self.cameras, camera: entry})

    def closed(self, at: str, failures: Mapping[str, str]) -> CaptureRecord:
        """The record at the end of the capture: cameras without an image are marked as failed, the skew is computed.

        at : the time of the close, ISO 8601. failures : reasons, by camera.
        """
        cameras = dict(self.cameras)
        for camera, entry in cameras.items():
            if entry.lacks_image:
                reason = failures.get(camera) or entry.reason or "no image arrived before the close"
                cameras[camera] = replace(entry, status="failed", reason=reason)
        closed = replace(self, cameras=cameras)
        if self.state == "open":
            closed = replace(closed, state="closed", closed_at=at)
        return closed._with_skew()

    def _with_skew(self) -> CaptureRecord:
        timed = [entry for entry in self.cameras.values() if entry.time_ns is not None]
        readouts = [entry.readout_ns for entry in timed if entry.readout_ns is not None]
        readout = max(readouts, default=None)
        times = [entry.time_ns for entry in timed if entry.time_ns is not None]
        if len(times) < 2:
            return replace(self, skew_ns=None, skew_error_ns=None, skew_exceeded=None, readout_ns=readout)
        skew = max(times) - min(times)
        errors = sorted(entry.clock_error_ns for entry in timed if entry.clock_error_ns is not None)
        worst = max([skew, *errors[-1:]])
        exceeded = None if self.tolerance_ns is None else worst > self.tolerance_ns
        error = sum(errors[-2:]) if errors else None
        return replace(self, skew_ns=skew, skew_error_ns=error, skew_exceeded=exceeded, readout_ns=readout)


def _conflict_sentence(conflicts: Mapping[str, Any]) -> str:
    files = ", ".join(conflicts)
    return f"a different image of this camera came as well and is kept as {files}; look at both" if files else ""


def read_session_record(path: Path) -> SessionRecord:
    """Read and check a ``session.json``. SessionError names the file and the field at fault."""
    return _read(path, SessionRecord.from_json)


def read_capture_record(path: Path) -> CaptureRecord:
    """Read and check a ``capture.json``. SessionError names the file and the field at fault."""
    return _read(path, CaptureRecord.from_json)


def _read(path: Path, from_json: Callable[[Mapping[str, Any]], R]) -> R:
    try:
        document = read_json(path)
    except OSError as error:
        raise SessionError(f"{path}: cannot be read ({error.strerror}); {REMEDY}") from error
    except ValueError as error:
        raise SessionError(f"{path}: not readable as JSON ({error}); {REMEDY}") from error
    try:
        return from_json(document)
    except _NewerSchemaError as error:
        raise SessionError(f"{path}: {error}; update RingDIC") from error
    except SessionError as error:
        raise SessionError(f"{path}: {error}; {REMEDY}") from error


def _without_schema(document: Any) -> dict[str, Any]:
    """The other fields of a record. SessionError where it is no JSON object or has another schema."""
    if not isinstance(document, Mapping):
        raise SessionError("not a record of a session")
    schema = document.get("schema")
    if schema != SCHEMA:
        error = _NewerSchemaError if isinstance(schema, int) and schema > SCHEMA else SessionError
        raise error(f"a record of schema {schema!r}, but this version reads schema {SCHEMA}")
    return {name: value for name, value in document.items() if name != "schema"}
