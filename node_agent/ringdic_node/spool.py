"""The node's durable store of images between capture and acknowledgement.

::

    SPOOL/<session>~<capture>~<moment>.pgm    the image, complete before its manifest exists
    SPOOL/<session>~<capture>~<moment>.json   its manifest: the commit point
    SPOOL/<session>~<capture>~<moment>.freed  tombstone: delivered and acknowledged, holds the hash
    SPOOL/.partial-…                          being written; removed at the next start
    SPOOL/.claim                              locked by the process that uses the spool

Every file is written aside, flushed to the disk and renamed, so a power cut leaves either the whole image with
its manifest or nothing that counts.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from ringdic_node.wire import CaptureKey, Manifest, WireError, decode_as, encode

try:
    import fcntl
except ImportError:  # not a POSIX system: simulated nodes on a PC, each with a folder of its own
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

TOMBSTONES_KEPT = 2000


class SpoolError(OSError):
    """The spool cannot store or read an image; the text says why."""


class Spool:
    """A folder of images that wait for their acknowledgement, safe against power cuts.

    Methods may be called from several threads.

    Parameters
    ----------
    folder : Path
        Created if it does not exist.
    reserve : int
        Bytes of free disk below which no further image is stored.
    """

    def __init__(self, folder: Path, *, reserve: int = 64 << 20) -> None:
        self.folder = Path(folder)
        self.reserve = reserve
        self.folder.mkdir(parents=True, exist_ok=True)
        self._claim: IO[bytes] | None = None

    def claim(self) -> None:
        """Reserve the spool for this process until it ends, and remove files that a power cut left half-written.

        Raises SpoolError if another process has it: two nodes on one spool would remove each other's images.
        """
        if fcntl is not None:
            self._claim = open(self.folder / ".claim", "ab")  # noqa: SIM115 - held open as long as the process lives
            try:
                fcntl.flock(self._claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                self._claim.close()
                raise SpoolError(f"the spool {self.folder} is in use by another ringdic-node; stop that one") from error
        self._sweep()

    def release(self) -> None:
        """End the reservation that `claim` made."""
        if self._claim is not None:
            self._claim.close()

    def _sweep(self) -> None:
        for partial in self.folder.glob(".partial-*"):
            partial.unlink(missing_ok=True)
        for image in self.folder.glob("*.pgm"):
            if not image.with_suffix(".json").exists():
                log.warning("spool: %s was never committed and is removed", image.name)
                image.unlink(missing_ok=True)
        tombstones = sorted(self.folder.glob("*.freed"), key=lambda path: path.stat().st_mtime)
        for old in tombstones[:-TOMBSTONES_KEPT]:
            old.unlink(missing_ok=True)

    @property
    def free(self) -> int:
        """Bytes that further images may take on this disk."""
        return max(shutil.disk_usage(self.folder).free - self.reserve, 0)

    def manifests(self) -> list[Manifest]:
        """Manifests of the images held, oldest moment first. A damaged pair is set aside as ``.damaged``."""
        manifests_held = []
        for path in self.folder.glob("*.json"):
            try:
                manifest = decode_as(Manifest, path.read_bytes())
                size = path.with_suffix(".pgm").stat().st_size
                if size != manifest.bytes:
                    raise SpoolError(f"the image has {size} bytes instead of {manifest.bytes}")
            except (WireError, OSError) as error:
                log.error("spool: %s is damaged and set aside: %s", path.name, error)
                path.rename(path.with_suffix(".damaged"))
                continue
            manifests_held.append(manifest)
        return sorted(manifests_held, key=lambda manifest: manifest.key.fire_at_ns)

    def tombstones(self) -> list[CaptureKey]:
        """Keys of the captures whose images were delivered and freed."""
        keys = []
        for path in self.folder.glob("*.freed"):
            session, capture_id, moment = path.stem.split("~")
            keys.append(CaptureKey(session, capture_id, int(moment)))
        return keys

    def store(self, manifest: Manifest, parts: Sequence[bytes | memoryview]) -> None:
        """Write an image and its manifest durably: after the return a power cut cannot lose them.

        Raises
        ------
        SpoolError
            The disk is too full, or an image of this capture is there already.
        """
        if manifest.bytes > self.free:
            raise SpoolError(
                f"the spool {self.folder} is full: {manifest.bytes} bytes needed, {self.free} free "
                f"above the reserve; {len(list(self.folder.glob('*.pgm')))} images wait for delivery"
            )
        image = self.folder / f"{manifest.key.stem}.pgm"
        if image.with_suffix(".json").exists() or image.with_suffix(".freed").exists():
            raise SpoolError(f"the spool has had an image of {manifest.key} already")
        self._write(image, parts)
        self._write(image.with_suffix(".json"), [encode(manifest)])
        _flush_folder(self.folder)

    def read(self, key: CaptureKey) -> bytes:
        """The bytes of a capture's image file; raises SpoolError if the spool does not hold it."""
        path = self.folder / f"{key.stem}.pgm"
        try:
            return path.read_bytes()
        except OSError as error:
            raise SpoolError(f"the image of {key} cannot be read from the spool: {error}") from error

    def remove(self, key: CaptureKey, sha256: str) -> bool:
        """Remove an acknowledged image if `sha256` is its own hash; returns whether it was removed.

        The tombstone is written first: after a crash in between the capture is still known as delivered.
        """
        manifest_path = self.folder / f"{key.stem}.json"
        try:
            manifest = decode_as(Manifest, manifest_path.read_bytes())
        except FileNotFoundError:
            return False
        if manifest.sha256 != sha256:
            log.error("spool: an acknowledgement of %s carries another hash; the image is kept", key)
            return False
        self._write(manifest_path.with_suffix(".freed"), [sha256.encode()])
        manifest_path.unlink(missing_ok=True)
        manifest_path.with_suffix(".pgm").unlink(missing_ok=True)
        _flush_folder(self.folder)
        return True

    def _write(self, path: Path, parts: Sequence[bytes | memoryview]) -> None:
        aside = path.with_name(f".partial-{path.name}")
        try:
            with open(aside, "wb") as file:
                for part in parts:
                    file.write(part)
                file.flush()
                os.fsync(file.fileno())
            os.replace(aside, path)
        except OSError as error:
            raise SpoolError(f"{path.name} cannot be written to the spool: {error}") from error


def image_digest(parts: Sequence[bytes | memoryview]) -> tuple[str, int]:
    """SHA-256 in hexadecimal, and length in bytes, of parts joined in order."""
    sha, length = hashlib.sha256(), 0
    for part in parts:
        sha.update(part)
        length += len(part)
    return sha.hexdigest(), length


def _flush_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
