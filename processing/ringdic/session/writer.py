"""Writing of session folders: images, JSON records, checksums. No image is ever overwritten.

The tree is drawn in `ringdic.session.folder`. An image is written under a temporary name, flushed, and
linked to its name, which never replaces another file. A capture's record is replaced atomically whenever a camera's
state changes.

Only one `Archive` of a process may write to a root folder.
"""

from __future__ import annotations

import hashlib
import logging
import shutil
import threading
import time
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ringdic.errors import InputError
from ringdic.session.files import PARTIAL, leads_out, link, place, replace_json
from ringdic.session.load import LOAD_FILE, LoadChannel, load_document, read_load, with_channel
from ringdic.session.names import CAPTURE_KINDS, capture_id, checked_name, split_capture_id
from ringdic.session.records import (
    REMEDY,
    CameraRecord,
    CaptureRecord,
    ImageDescription,
    SessionError,
    SessionRecord,
    read_capture_record,
    read_session_record,
)

log = logging.getLogger(__name__)


class SessionExistsError(SessionError, FileExistsError):
    """A session of this name exists already."""


class Archive:
    """The sessions under one folder.

    Parameters
    ----------
    root : the folder; created if absent.
    wall_ns : the time, ns since the Unix epoch.
    """

    def __init__(self, root: Path, wall_ns: Callable[[], int] = time.time_ns) -> None:
        self.root = Path(root)
        self.root.mkdir(parents=True, exist_ok=True)
        self._wall_ns = wall_ns
        self._lock = threading.RLock()

    def create_session(self, name: str, rig_toml: str, *, source: str = "capture") -> SessionWriter:
        """Create a new, empty session.

        Parameters
        ----------
        name : of the session and its folder.
        rig_toml : text of its rig file.
        source : "capture" or "import".

        Raises
        ------
        InputError
            The name is not usable or taken, or the rig file names no rig.
        """
        path = self.root / checked_name("the session name", name)
        with self._lock:
            if path.exists():
                raise SessionExistsError(f"the session '{name}' exists already in {self.root}; choose another name")
            return SessionWriter.create(path, name, rig_toml, source, self._wall_ns, self._lock)

    def open(self, name: str) -> SessionWriter:
        """The writer of an existing session. InputError where there is none of this name."""
        path = self.root / checked_name("the session name", name)
        if not (path / "session.json").is_file():
            raise SessionError(f"there is no session '{name}' in {self.root}")
        return SessionWriter(path, self._wall_ns, self._lock)

    def sessions(self) -> list[str]:
        """Names of the sessions, sorted."""
        return sorted(path.parent.name for path in self.root.glob("*/session.json"))

    def capture(self, session: str, capture_id: str) -> CaptureWriter | None:
        """The writer of a capture; None where there is none of these names."""
        path = self.root / session / "captures" / capture_id
        return CaptureWriter(path, self._wall_ns, self._lock) if (path / "capture.json").is_file() else None

    def close_unfinished(self, reason: str) -> list[str]:
        """Close captures that an earlier process left open; pending cameras end as failed with `reason`.

        Their images are archived all the same when a node still holds them. A capture whose record is damaged, or
        cannot be written, is left as it is and told in the log. Returns ``session/capture`` names.
        """
        closed = []
        for path in sorted(self.root.glob("*/captures/*/capture.json")):
            try:
                if not leads_out(self.root, path) and self._close_unfinished(path.parent, reason):
                    closed.append(f"{path.parents[2].name}/{path.parent.name}")
            except (SessionError, OSError) as error:
                log.error("a capture is left as it is: %s", error)
        return closed

    def _close_unfinished(self, path: Path, reason: str) -> bool:
        """Close the capture of a folder if it is open; whether it was."""
        for left in path.glob(f"{PARTIAL}*"):
            left.unlink(missing_ok=True)
        capture = CaptureWriter(path, self._wall_ns, self._lock)
        record = capture.record()
        if record.state != "open":
            return False
        capture.close(
            dict.fromkeys((name for name, entry in record.cameras.items() if entry.status == "pending"), reason)
        )
        return True


class SessionWriter:
    """Writer of one session folder.

    name : of the session. cameras : ids of the rig's cameras. camera_settings : table ``[capture]`` of the rig file.
    """

    def __init__(self, path: Path, wall_ns: Callable[[], int], lock: threading.RLock | None = None) -> None:
        self.path = Path(path)
        self._wall_ns = wall_ns
        self._lock = lock or threading.RLock()
        self.name = read_session_record(self.path / "session.json").session
        try:
            rig = tomllib.loads((self.path / "rig.toml").read_text(encoding="utf-8"))
            self.cameras: tuple[str, ...] = tuple(str(camera["id"]) for camera in rig.get("cameras", []))
            self.camera_settings: dict[str, Any] = dict(rig.get("capture", {}))
        except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
            raise SessionError(f"{self.path / 'rig.toml'}: not readable as a rig file ({error}); {REMEDY}") from error

    @classmethod
    def create(
        cls,
        path: Path,
        name: str,
        rig_toml: str,
        source: str,
        wall_ns: Callable[[], int],
        lock: threading.RLock | None = None,
    ) -> SessionWriter:
        """Create a new session folder.

        Parameters
        ----------
        path : the folder; its parents are created.
        name : of the session.
        rig_toml : text of its rig file.
        source : "capture" or "import".
        wall_ns : the time, ns since the Unix epoch.
        lock : held while records are changed; that of the archive where the session lies in one.

        Raises
        ------
        SessionError
            `rig_toml` is not TOML with a rig's name.
        """
        try:
            rig_name = tomllib.loads(rig_toml)["rig"]["name"]
        except (ValueError, RecursionError, KeyError, TypeError) as error:
            raise SessionError(f"the rig file of session '{name}' has no readable [rig] name: {error}") from error
        record = SessionRecord(name, str(rig_name), _iso(wall_ns()), source)
        path.mkdir(parents=True)
        try:
            (path / "captures").mkdir()
            place(path / "rig.toml", rig_toml.encode())
            replace_json(path / "session.json", record.to_json())
        except OSError:  # a full disk: the name stays free
            shutil.rmtree(path, ignore_errors=True)
            raise
        return cls(path, wall_ns, lock)

    def captures(self) -> list[CaptureRecord]:
        """The records of all captures, in order of their number."""
        with self._lock:
            records = [read_capture_record(path) for path in self.path.glob("captures/*/capture.json")]
        return sorted(records, key=lambda record: record.number)

    def capture(self, capture_id: str) -> CaptureWriter:
        """The writer of a capture. SessionError where the session has none of this id."""
        path = self.path / "captures" / capture_id
        if split_capture_id(capture_id) is None or not (path / "capture.json").is_file():
            raise SessionError(f"the session '{self.name}' has no capture '{capture_id}'")
        return CaptureWriter(path, self._wall_ns, self._lock)

    def count(self, kind: str) -> int:
        """Number of captures of a kind."""
        return sum(path.name.endswith(f"-{kind}") for path in self.path.glob("captures/*"))

    def begin_capture(
        self,
        kind: str,
        expected: Iterable[str],
        *,
        fire_at_ns: int | None = None,
        tolerance_ns: int | None = None,
        override: bool = False,
        settings: Mapping[str, Any] | None = None,
        settings_hash: str | None = None,
        armed: Mapping[str, Mapping[str, Any]] | None = None,
        frame_grid: Mapping[str, Any] | None = None,
    ) -> CaptureWriter:
        """Begin a capture: a folder with an open record in which every camera is pending.

        Parameters
        ----------
        kind : one of `ringdic.session.names.CAPTURE_KINDS`.
        expected : ids of the cameras.
        fire_at_ns : planned moment of the exposure, ns since the Unix epoch.
        tolerance_ns : skew between the cameras that is not flagged, ns.
        override : whether it is captured although cameras are missing.
        settings, settings_hash : camera settings that were asked for, and their hash.
        armed : by camera, what its node answered when it armed.
        frame_grid : of sensors that run freely, as in `CaptureRecord`.
        """
        if kind not in CAPTURE_KINDS:
            raise InputError(f"the capture kind '{kind}' is none of {', '.join(CAPTURE_KINDS)}")
        with self._lock:
            taken = [split_capture_id(path.name) for path in self.path.glob("captures/*")]
            number = 1 + max((numbered[0] for numbered in taken if numbered), default=0)
            record = CaptureRecord(
                capture_id(number, kind),
                number,
                kind,
                self.name,
                state="open",
                opened_at=_iso(self._wall_ns()),
                fire_at_ns=fire_at_ns,
                tolerance_ns=tolerance_ns,
                override=override,
                cameras={camera: CameraRecord(armed=(armed or {}).get(camera, {})) for camera in expected},
                settings=settings or {},
                settings_hash=settings_hash,
                frame_grid=frame_grid or {},
            )
            path = self.path / "captures" / record.capture_id
            path.mkdir()
            try:
                replace_json(path / "capture.json", record.to_json())
            except OSError:  # a full disk: the number stays free
                path.rmdir()
                raise
        return CaptureWriter(path, self._wall_ns, self._lock)


@dataclass(frozen=True)
class ArchivedImage:
    """Outcome of archiving an image: its file, and whether it is new, a repeat or in conflict with another image.

    verdict : "archived"; "repeat" where the same image was archived before; "conflict" where another one was, and this
    one is stored under another name. file : its name in the capture's folder.
    """

    verdict: str
    file: str


class CaptureWriter:
    """Writer of one capture folder.

    Every call reads the record again, so several writers of one process may be used on a capture.
    """

    def __init__(self, path: Path, wall_ns: Callable[[], int], lock: threading.RLock) -> None:
        self.path = Path(path)
        self._record_path = self.path / "capture.json"
        self._wall_ns = wall_ns
        self._lock = lock

    @property
    def capture_id(self) -> str:
        """Name of the capture and of its folder."""
        return self.path.name

    def record(self) -> CaptureRecord:
        """The capture's record as it stands on the disk."""
        with self._lock:
            return read_capture_record(self._record_path)

    def store(
        self, camera: str, description: ImageDescription, image: bytes, *, sha256: str | None = None
    ) -> ArchivedImage:
        """Archive an image under its camera's name.

        An identical repeat changes nothing; another image of the same camera is stored under another name. After
        the close, the camera's status becomes delivered-late.

        Parameters
        ----------
        camera : one of those that the capture expects.
        description : what came with the image; its checksum must be that of the bytes.
        image : the file's bytes, archived as they are.
        sha256 : the checksum of `image`, where the caller has computed it from these bytes.

        Raises
        ------
        ValueError
            The bytes have another checksum, or the camera is not expected.
        """
        if (sha256 or hashlib.sha256(image).hexdigest()) != description.sha256:
            raise ValueError(f"the image of camera {camera} does not have the checksum it came with")
        entry = CameraRecord(
            file=f"{camera}.{description.format}",
            sha256=description.sha256,
            bytes=len(image),
            width=description.width,
            height=description.height,
            time_ns=description.time_ns,
            exposure_us=description.exposure_us,
            metadata=description.metadata,
            settings_hash=description.settings_hash,
            clock_offset_ns=description.clock_offset_ns,
            clock_error_ns=description.clock_error_ns,
            clock_step_ns=description.clock_step_ns,
            row_time_ns=description.row_time_ns,
        )
        return self._store(camera, entry, image)

    def store_file(
        self, camera: str, source: Path, width: int, height: int, *, time_ns: int | None = None, link: bool = False
    ) -> ArchivedImage:
        """Archive an image file byte for byte, with its extension.

        Parameters
        ----------
        camera : one of those that the capture expects.
        source : the image file.
        width, height : of the image, px.
        time_ns : of the exposure, ns since the Unix epoch; None where nobody measured it.
        link : share the file on the disk instead of copying it, where the file system can; for a source that nobody
            writes to any more.
        """
        image = source.read_bytes()
        entry = CameraRecord(
            file=f"{camera}{source.suffix.lower()}",
            sha256=hashlib.sha256(image).hexdigest(),
            bytes=len(image),
            width=width,
            height=height,
            time_ns=time_ns,
            original=str(source),
        )
        return self._store(camera, entry, image, source if link else None)

    def _store(self, camera: str, entry: CameraRecord, image: bytes, shared: Path | None = None) -> ArchivedImage:
        """Archive an image, then enter it in the record. shared : a file to link to, in place of writing a copy."""
        if camera not in self.record().cameras:
            raise ValueError(f"camera {camera} is not expected in capture {self.capture_id}")
        assert entry.file is not None
        path = self.path / entry.file
        try:  # without the lock: the disk takes several images at a time
            if shared is None or not link(shared, path):
                place(path, image)
            verdict = "archived"
        except FileExistsError:
            if hashlib.sha256(path.read_bytes()).hexdigest() != entry.sha256:
                return self._keep_aside(camera, path, image)
            verdict = "repeat"
        with self._lock:
            record = self.record()
            before = record.cameras[camera]
            if before.sha256 == entry.sha256:
                return ArchivedImage("repeat", path.name)
            self._replace(record.with_image(camera, entry))
        return ArchivedImage(verdict, path.name)

    def _keep_aside(self, camera: str, path: Path, image: bytes) -> ArchivedImage:
        """Write a second, different image of a camera under another name; repeats of it are not written again."""
        sha256 = hashlib.sha256(image).hexdigest()
        number = 1
        while True:
            aside = path.with_name(f"{camera}.conflict-{number}{path.suffix}")
            try:
                place(aside, image)
            except FileExistsError:
                if hashlib.sha256(aside.read_bytes()).hexdigest() == sha256:
                    break
                number += 1
                continue
            break
        with self._lock:
            record = self.record()
            changed = record.with_conflict(camera, aside.name, sha256)
            if changed is not record:
                log.error("camera %s of %s sent another image; kept as %s", camera, self.capture_id, aside.name)
                self._replace(changed)
        return ArchivedImage("conflict", aside.name)

    def fail(self, camera: str, reason: str) -> None:
        """Record why a camera has no image; ignored where its image is archived."""
        with self._lock:
            record = self.record()
            changed = record.with_failure(camera, reason)
            if changed is not record:
                self._replace(changed)

    def annotate(self, note: str) -> CaptureRecord:
        """Replace the capture's note, and return its record; an empty note is removed.

        Raises SessionError where the note is longer than `ringdic.session.records.LONGEST_NOTE` characters.
        """
        with self._lock:
            record = self.record().with_note(note)
            self._replace(record)
        return record

    def store_load(self, channel: LoadChannel, *, replace: bool = False) -> tuple[LoadChannel, ...]:
        """Archive a load channel beside the capture, and return all that it has; other channels stay.

        Raises LoadConflictError where a channel of this name has other values, unless `replace` says to replace them.
        """
        with self._lock:
            before = read_load(self.path)
            channels = with_channel(before, channel, replace=replace)
            if channels != before:
                replace_json(self.path / LOAD_FILE, load_document(channels))
        return channels

    def close(self, failures: Mapping[str, str] | None = None) -> CaptureRecord:
        """End the capture and return its record.

        failures : the reason for each camera without an image.
        """
        with self._lock:
            record = self.record().closed(_iso(self._wall_ns()), failures or {})
            self._replace(record)
        return record

    def _replace(self, record: CaptureRecord) -> None:
        replace_json(self._record_path, record.to_json())


def _iso(wall_ns: int) -> str:
    return datetime.fromtimestamp(wall_ns / 1e9, UTC).isoformat(timespec="milliseconds")
