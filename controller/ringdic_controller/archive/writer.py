"""Sessions as folders: images, JSON records, checksums. The folders are the truth; nothing is overwritten.

The tree is drawn in `ringdic.session.folder`. An image is written aside, flushed, and linked to its name, which
refuses to replace another. A capture's record is replaced as a whole whenever a camera's state changes.

One `Archive` a process writes to a root folder.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import threading
import time
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ringdic.errors import InputError
from ringdic_node.wire import CAPTURE_KINDS, Manifest, WireError, checked_name

from ringdic_controller.rig.capture import Skew

log = logging.getLogger(__name__)

SCHEMA = 1
_CAPTURE = re.compile(r"(\d{4,})-([a-z]+)")


class SessionError(InputError):
    """A session that does not exist, exists already, or is not a session; the text tells which."""


class SessionExistsError(SessionError, FileExistsError):
    """The session's name is taken."""


class Archive:
    """All sessions under one folder.

    Parameters
    ----------
    root : Path
        Made if absent.
    wall_ns : callable
        The time, ns since the Unix epoch.
    """

    def __init__(self, root: Path, wall_ns: Callable[[], int] = time.time_ns) -> None:
        self.root = Path(root)
        self.root.mkdir(parents=True, exist_ok=True)
        self._wall_ns = wall_ns
        self._lock = threading.RLock()

    def create_session(self, name: str, rig_toml: str, *, source: str = "capture") -> SessionWriter:
        """A new, empty session. Raises SessionError if the name is unusable or taken."""
        path = self.root / _session_name(name)
        with self._lock:
            if path.exists():
                raise SessionExistsError(f"the session '{name}' exists already in {self.root}; choose another name")
            return SessionWriter.create(path, name, rig_toml, source, self._wall_ns, self._lock)

    def open(self, name: str) -> SessionWriter:
        """An existing session. Raises SessionError."""
        path = self.root / _session_name(name)
        if not (path / "session.json").is_file():
            raise SessionError(f"there is no session '{name}' in {self.root}")
        return SessionWriter(path, self._wall_ns, self._lock)

    def sessions(self) -> list[str]:
        """Names of the sessions, sorted."""
        return sorted(path.parent.name for path in self.root.glob("*/session.json"))

    def capture(self, session: str, capture_id: str) -> CaptureWriter | None:
        """The capture, or None where there is none of that name."""
        path = self.root / session / "captures" / capture_id
        return CaptureWriter(path, self._wall_ns, self._lock) if (path / "capture.json").is_file() else None

    def close_unfinished(self, reason: str) -> list[str]:
        """Close captures that an earlier process left open; pending cameras end as failed with `reason`.

        Their images are archived all the same when a node still holds them. Returns ``session/capture`` names.
        """
        closed = []
        for path in sorted(self.root.glob("*/captures/*/capture.json")):
            for left in path.parent.glob(".partial-*"):
                left.unlink(missing_ok=True)
            capture = CaptureWriter(path.parent, self._wall_ns, self._lock)
            record = capture.record()
            if record["state"] == "open":
                pending = [c for c, entry in record["cameras"].items() if entry["status"] == "pending"]
                capture.close(dict.fromkeys(pending, reason))
                closed.append(f"{record['session']}/{record['capture_id']}")
        return closed


class SessionWriter:
    """One session folder, open for captures."""

    def __init__(self, path: Path, wall_ns: Callable[[], int], lock: threading.RLock | None = None) -> None:
        self.path = Path(path)
        self._wall_ns = wall_ns
        self._lock = lock or threading.RLock()
        header = _read_json(self.path / "session.json")
        self.name: str = header["session"]
        rig = tomllib.loads((self.path / "rig.toml").read_text(encoding="utf-8"))
        self.cameras: tuple[str, ...] = tuple(str(camera["id"]) for camera in rig.get("cameras", []))
        self.camera_settings: dict[str, Any] = dict(rig.get("capture", {}))

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
        """A new session folder at `path`; SessionError if `rig_toml` is not TOML with a rig's name."""
        try:
            rig_name = tomllib.loads(rig_toml)["rig"]["name"]
        except (tomllib.TOMLDecodeError, KeyError, TypeError) as error:
            raise SessionError(f"the rig file of session '{name}' has no readable [rig] name: {error}") from error
        if source not in ("capture", "import"):
            raise ValueError(f"a session's source is 'capture' or 'import', not {source!r}")
        path.mkdir(parents=True)
        (path / "captures").mkdir()
        place(path / "rig.toml", rig_toml.encode())
        header = {"schema": SCHEMA, "session": name, "rig": rig_name, "created": _iso(wall_ns()), "source": source}
        replace_json(path / "session.json", header)
        return cls(path, wall_ns, lock)

    def captures(self) -> list[dict[str, Any]]:
        """The records of all captures, in order of their number."""
        with self._lock:
            records = [_read_json(path) for path in self.path.glob("captures/*/capture.json")]
        return sorted(records, key=lambda record: record["number"])

    def capture(self, capture_id: str) -> CaptureWriter:
        """The capture of this id. Raises SessionError."""
        path = self.path / "captures" / capture_id
        if not _CAPTURE.fullmatch(capture_id) or not (path / "capture.json").is_file():
            raise SessionError(f"the session '{self.name}' has no capture '{capture_id}'")
        return CaptureWriter(path, self._wall_ns, self._lock)

    def count(self, kind: str) -> int:
        """How many captures of a kind there are."""
        return sum(path.name.endswith(f"-{kind}") for path in self.path.glob("captures/*"))

    def begin_capture(
        self,
        kind: str,
        expected: Iterable[str],
        *,
        fire_at_ns: int | None = None,
        tolerance_ns: int | None = None,
        override: bool = False,
    ) -> CaptureWriter:
        """A new capture, open, with every expected camera pending."""
        if kind not in CAPTURE_KINDS:
            raise InputError(f"the capture kind '{kind}' is none of {', '.join(CAPTURE_KINDS)}")
        with self._lock:
            taken = [_CAPTURE.fullmatch(path.name) for path in self.path.glob("captures/*")]
            number = 1 + max((int(match[1]) for match in taken if match), default=0)
            path = self.path / "captures" / f"{number:04d}-{kind}"
            path.mkdir()
            record = {
                "schema": SCHEMA,
                "capture_id": path.name,
                "number": number,
                "kind": kind,
                "session": self.name,
                "state": "open",
                "opened_at": _iso(self._wall_ns()),
                "closed_at": None,
                "fire_at_ns": fire_at_ns,
                "skew_ns": None,
                "tolerance_ns": tolerance_ns,
                "skew_exceeded": None,
                "override": override,
                "cameras": {camera: _blank() for camera in expected},
            }
            replace_json(path / "capture.json", record)
        return CaptureWriter(path, self._wall_ns, self._lock)


@dataclass(frozen=True)
class Stored:
    """What became of an image: archived, repeat (it was there), or conflict (another was; kept aside as `file`)."""

    verdict: str
    file: str


class CaptureWriter:
    """One capture folder. Every call reads the record afresh, so several writers of one process may be used."""

    def __init__(self, path: Path, wall_ns: Callable[[], int], lock: threading.RLock) -> None:
        self.path = Path(path)
        self._wall_ns = wall_ns
        self._lock = lock

    @property
    def capture_id(self) -> str:
        return self.path.name

    def record(self) -> dict[str, Any]:
        """The capture's record as it stands."""
        with self._lock:
            return _read_json(self.path / "capture.json")

    def store(self, camera: str, manifest: Manifest, image: bytes, *, sha256: str | None = None) -> Stored:
        """Archive an image of a node under its camera's name.

        sha256 : of `image`, if the caller has computed it from these bytes.

        The image's bytes must have the manifest's hash. An identical repeat changes nothing; another image of
        the same camera is kept aside and the first stays. After the close, the camera's status becomes late.
        """
        if (sha256 or hashlib.sha256(image).hexdigest()) != manifest.sha256:
            raise ValueError(f"the image of camera {camera} does not have the checksum it came with")
        entry = {
            "width": manifest.width,
            "height": manifest.height,
            "time_ns": manifest.time_ns,
            "exposure_us": manifest.exposure_us,
            "metadata": manifest.metadata,
        }
        return self._store(camera, f".{manifest.format}", image, manifest.sha256, entry)

    def store_file(self, camera: str, source: Path, width: int, height: int, *, link: bool = False) -> Stored:
        """Archive the file `source` byte for byte, with its extension.

        link : share the file on the disk instead of copying it, where the file system can; for a source that nobody
        writes to any more.
        """
        image = source.read_bytes()
        entry = {"width": width, "height": height, "original": str(source)}
        sha256 = hashlib.sha256(image).hexdigest()
        return self._store(camera, source.suffix.lower(), image, sha256, entry, source if link else None)

    def _store(
        self, camera: str, suffix: str, image: bytes, sha256: str, entry: dict[str, Any], shared: Path | None = None
    ) -> Stored:
        if camera not in self.record()["cameras"]:
            raise ValueError(f"camera {camera} is not expected in capture {self.capture_id}")
        path = self.path / f"{camera}{suffix}"
        try:  # without the lock: the disk takes several images at a time
            if shared is None or not _linked(shared, path):
                place(path, image)
            verdict = "archived"
        except FileExistsError:
            if hashlib.sha256(path.read_bytes()).hexdigest() != sha256:
                return self._keep_aside(camera, path, image)
            verdict = "repeat"
        with self._lock:
            record = self.record()
            if record["cameras"][camera]["sha256"] == sha256:
                return Stored("repeat", path.name)
            status = "ok" if record["state"] == "open" else "late"
            reason = None if status == "ok" else f"the image arrived after the close at {record['closed_at']}"
            record["cameras"][camera] = {
                **_blank(),
                "status": status,
                "reason": reason,
                "file": path.name,
                "sha256": sha256,
                "bytes": len(image),
                **entry,
            }
            if record["state"] == "closed":
                _set_skew(record)
            replace_json(self.path / "capture.json", record)
        return Stored(verdict, path.name)

    def _keep_aside(self, camera: str, path: Path, image: bytes) -> Stored:
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
        log.error("camera %s of %s sent another image; kept as %s", camera, self.capture_id, aside.name)
        return Stored("conflict", aside.name)

    def fail(self, camera: str, reason: str) -> None:
        """Note why a camera has no image; an archived image is never overruled."""
        with self._lock:
            record = self.record()
            entry = record["cameras"][camera]
            if entry["status"] in ("pending", "failed") and entry["reason"] != reason:
                entry.update(status="failed", reason=reason)
                replace_json(self.path / "capture.json", record)

    def close(self, failures: dict[str, str] | None = None) -> dict[str, Any]:
        """End the capture; `failures` tells the reason for every camera without an image. Returns the record."""
        with self._lock:
            record = self.record()
            for camera, entry in record["cameras"].items():
                if entry["status"] in ("pending", "failed"):
                    reason = (failures or {}).get(camera) or entry["reason"] or "no image arrived before the close"
                    entry.update(status="failed", reason=reason)
            if record["state"] == "open":
                record.update(state="closed", closed_at=_iso(self._wall_ns()))
            _set_skew(record)
            replace_json(self.path / "capture.json", record)
        return record


def verify(session: Path) -> list[str]:
    """Recompute every checksum of a session folder; return a sentence for each image that is not as recorded."""
    problems = []
    for path in sorted(Path(session).glob("captures/*/capture.json")):
        record = _read_json(path)
        recorded = {"capture.json"}
        for camera, entry in record["cameras"].items():
            if entry["file"] is None:
                continue
            recorded.add(entry["file"])
            where = f"{record['capture_id']}/{entry['file']}"
            image = path.parent / entry["file"]
            if not image.is_file():
                problems.append(f"{where}: the image of camera {camera} is missing")
            elif hashlib.sha256(image.read_bytes()).hexdigest() != entry["sha256"]:
                problems.append(f"{where}: the image of camera {camera} differs from its checksum")
        for image in path.parent.iterdir():
            if image.name not in recorded:
                problems.append(f"{record['capture_id']}/{image.name}: the record does not know this file")
    return problems


def place(path: Path, content: bytes) -> None:
    """Write a file that is complete from the moment it has its name; raises FileExistsError, never replaces."""
    aside = _write_aside(path, content)
    try:
        os.link(aside, path)
    finally:
        aside.unlink()
    _flush_folder(path.parent)


def _linked(source: Path, path: Path) -> bool:
    """Give a file a second name; False where the file system cannot. Raises FileExistsError, never replaces."""
    try:
        os.link(source, path)
    except FileExistsError:
        raise
    except OSError:
        return False
    return True


def replace_json(path: Path, document: dict[str, Any]) -> None:
    """Replace a JSON file as a whole: a reader sees the old one or the new one."""
    aside = _write_aside(path, json.dumps(document, indent=1).encode() + b"\n")
    os.replace(aside, path)
    _flush_folder(path.parent)


def _write_aside(path: Path, content: bytes) -> Path:
    aside = path.with_name(f".partial-{path.name}-{os.getpid()}-{threading.get_ident()}")
    with open(aside, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return aside


def _flush_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _session_name(name: str) -> str:
    try:
        return checked_name("the session name", name)
    except WireError as error:
        raise SessionError(str(error)) from error


def _blank() -> dict[str, Any]:
    return {
        "status": "pending",
        "reason": None,
        "file": None,
        "sha256": None,
        "bytes": None,
        "width": None,
        "height": None,
        "time_ns": None,
        "exposure_us": None,
        "metadata": {},
        "original": None,
    }


def _set_skew(record: dict[str, Any]) -> None:
    skew = Skew.of((entry["time_ns"] for entry in record["cameras"].values()), record["tolerance_ns"])
    record.update(skew_ns=skew.skew_ns, skew_exceeded=skew.exceeded)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SessionError(f"{path} cannot be read: {error}") from error
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise SessionError(f"{path} is not a record of schema {SCHEMA}")
    return document


def _iso(wall_ns: int) -> str:
    return datetime.fromtimestamp(wall_ns / 1e9, UTC).isoformat(timespec="milliseconds")
