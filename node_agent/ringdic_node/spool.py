"""The node's durable store of images from the capture until the controller has archived them, and beyond.

::

    SPOOL/<session>~<capture>~<moment>.pgm    the image, complete before its manifest exists
    SPOOL/<session>~<capture>~<moment>.json   its manifest: the commit point
    SPOOL/<session>~<capture>~<moment>.freed  delivered and acknowledged, holds the hash; the image may be removed
    SPOOL/aside/…                             what may be an image but has no usable manifest; never removed here
    SPOOL/.partial-…                          being written; completed or removed at the next start
    SPOOL/.claim                              locked by the process that uses the spool

Every file is written aside, flushed to the disk and renamed, so a power cut leaves either the whole image with
its manifest or nothing that counts. A manifest that this release cannot read stays where it is, with its image; those
that it writes can be read by all releases.

An acknowledgement can be forged where the network is open. A delivered image is therefore kept as long as there is
room, so that the controller can ask for it again, and the oldest is removed first.
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ringdic_node.image_file import digest_of_file, image_is_whole
from ringdic_node.wire import CaptureKey, Manifest, WireError, decode_as, encode_for_first_release

try:
    import fcntl
except ImportError:  # not a POSIX system: simulated nodes on a PC, each with a folder of its own
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

PARTIAL = ".partial-"
TOMBSTONES_KEPT = 2000
DELIVERED_KEPT = 1000  # images, beside the limit in bytes
FILE_COST = 64 << 10  # bytes that a manifest and the names in the folder take at most, beside the image


class SpoolError(OSError):
    """The spool cannot store or read an image; the text says why."""


@dataclass(frozen=True)
class SpoolContents:
    """What a spool holds, oldest moment first.

    waiting, delivered : manifests of images without and with an acknowledgement. unread : by the name of a manifest's
    file, why it or its image cannot be used; both stay in the spool.
    """

    waiting: tuple[Manifest, ...]
    delivered: tuple[Manifest, ...]
    unread: dict[str, str]


class Spool:
    """A folder of images that wait for their acknowledgement, safe against power cuts.

    Methods may be called from several threads.

    Parameters
    ----------
    folder : Path
        Created if it does not exist.
    reserve : int
        Bytes of free disk below which no further image is stored.
    keep : int
        Bytes of delivered images that are kept while there is room for further images.
    """

    def __init__(self, folder: Path, *, reserve: int = 64 << 20, keep: int = 1 << 30) -> None:
        self.folder = Path(folder)
        self.reserve = reserve
        self.keep = keep
        self.folder.mkdir(parents=True, exist_ok=True)
        self._claim: IO[bytes] | None = None
        self._lock = threading.RLock()  # guards what follows: by stem, oldest first
        self._delivered: OrderedDict[str, int] = OrderedDict()  # bytes of the image
        self._tombstones: OrderedDict[str, None] = OrderedDict()
        self._removed: list[CaptureKey] = []
        self._load()

    def claim(self) -> None:
        """Reserve the spool for this process until it ends, and put in order what a power cut left behind.

        Raises SpoolError if another process has it: two nodes on one spool would remove each other's images.
        """
        if fcntl is not None:
            self._claim = open(self.folder / ".claim", "ab")  # noqa: SIM115 - held open as long as the process lives
            try:
                fcntl.flock(self._claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                self._claim.close()
                raise SpoolError(f"the spool {self.folder} is in use by another ringdic-node; stop that one") from error
        self._recover()
        self._load()
        self._limit()

    def release(self) -> None:
        """End the reservation that `claim` made."""
        if self._claim is not None:
            self._claim.close()

    # What a power cut or another release left behind

    def _recover(self) -> None:
        for path in self._files(".damaged"):  # how earlier releases called a manifest that they could not read
            if path.with_suffix(".pgm").exists() and not path.with_suffix(".json").exists():
                path.rename(path.with_suffix(".json"))
        for partial in self.folder.glob(f"{PARTIAL}*.json"):
            self._complete(partial)
        for image in (*self.folder.glob(f"{PARTIAL}*.pgm"), *self._files(".pgm")):
            self._settle_image(image)
        for partial in self.folder.glob(f"{PARTIAL}*"):
            partial.unlink(missing_ok=True)

    def _complete(self, partial: Path) -> None:
        """Commit the image of a manifest that was written but not renamed, if the image is whole."""
        manifest_path = self.folder / partial.name.removeprefix(PARTIAL)
        image = manifest_path.with_suffix(".pgm")
        aside = image.with_name(PARTIAL + image.name)
        try:
            manifest = decode_as(Manifest, partial.read_bytes())
        except (WireError, OSError):
            return
        for path in (image, aside):
            if path.exists() and not manifest_path.exists() and digest_of_file(path) == manifest.sha256:
                os.replace(path, image)
                os.replace(partial, manifest_path)
                _flush_folder(self.folder)
                log.warning("spool: the image of %s, cut off while it was stored, is whole", manifest.key)

    def _settle_image(self, image: Path) -> None:
        """Put an image without a manifest aside; remove it if it was delivered, or breaks off."""
        stem = image.stem.removeprefix(PARTIAL)
        if (self.folder / f"{stem}.json").exists() and image.name == f"{stem}.pgm":
            return
        broken = image.stat().st_size == 0 or (image.name.startswith(PARTIAL) and not image_is_whole(image))
        if broken or (self.folder / f"{stem}.freed").exists():
            image.unlink()
            return
        folder = self.folder / "aside"
        folder.mkdir(exist_ok=True)
        number = sum(1 for _ in folder.glob(f"{stem}.*"))
        for path in (image, self.folder / f"{PARTIAL}{stem}.json"):
            if path.exists():
                path.rename(folder / f"{stem}.{number}{path.suffix}")
        log.error("spool: the image %s has no manifest; it is kept in %s", image.name, folder)

    def _files(self, suffix: str) -> list[Path]:
        """The files with a suffix, but for those that are being written."""
        return [path for path in self.folder.glob(f"*{suffix}") if not path.name.startswith(".")]

    def _load(self) -> None:
        with self._lock:
            self._delivered.clear()
            self._tombstones.clear()
            for path in sorted(self._files(".freed"), key=lambda path: path.stat().st_mtime_ns):
                image = path.with_suffix(".pgm")
                if image.exists() and path.with_suffix(".json").exists():
                    self._delivered[path.stem] = image.stat().st_size
                else:
                    self._tombstones[path.stem] = None

    # What it holds

    @property
    def free(self) -> int:
        """Bytes that further images may take on this disk; delivered images make room for them."""
        with self._lock:
            return max(self._spare() + sum(self._delivered.values()), 0)

    def _spare(self) -> int:
        return shutil.disk_usage(self.folder).free - self.reserve

    @property
    def aside(self) -> int:
        """Number of files that may be images but have no usable manifest."""
        return sum(1 for _ in (self.folder / "aside").glob("*.pgm"))

    def contents(self) -> SpoolContents:
        """Manifests of all images, and what cannot be used."""
        waiting: list[Manifest] = []
        delivered: list[Manifest] = []
        unread = {}
        for path in self._files(".json"):
            try:
                manifest = _manifest_at(path)
            except (WireError, OSError) as error:
                if path.stem in self._delivered:
                    continue  # it is archived, and leaves when its room is needed
                unread[path.name] = str(error)
                log.error("spool: %s stays in %s, but cannot be used: %s", path.name, self.folder, error)
                continue
            with self._lock:
                (delivered if path.stem in self._delivered else waiting).append(manifest)
        oldest_first = [sorted(each, key=lambda manifest: manifest.key.fire_at_ns) for each in (waiting, delivered)]
        return SpoolContents(tuple(oldest_first[0]), tuple(oldest_first[1]), unread)

    def manifests(self) -> list[Manifest]:
        """Manifests of the images that wait for their acknowledgement, oldest moment first."""
        return list(self.contents().waiting)

    def tombstones(self) -> list[CaptureKey]:
        """Keys of the captures whose images were delivered, whether they are still held or not."""
        with self._lock:
            keys = [key_of_stem(stem) for stem in (*self._tombstones, *self._delivered)]
        return [key for key in keys if key is not None]

    def take_removed(self) -> list[CaptureKey]:
        """Keys of the delivered images that were removed since the last call."""
        with self._lock:
            removed, self._removed = self._removed, []
        return removed

    def read(self, key: CaptureKey) -> bytes:
        """The bytes of a capture's image file; raises SpoolError if the spool does not hold it."""
        path = self.folder / f"{key.stem}.pgm"
        try:
            return path.read_bytes()
        except OSError as error:
            raise SpoolError(f"the image of {key} cannot be read from the spool: {error}") from error

    # What comes and goes

    def store(self, manifest: Manifest, parts: Sequence[bytes | memoryview]) -> None:
        """Write an image and its manifest durably: after the return a power cut cannot lose them.

        Raises
        ------
        SpoolError
            The disk is too full, or an image of this capture is there already.
        """
        image = self.folder / f"{manifest.key.stem}.pgm"
        manifest_path = image.with_suffix(".json")
        needed = manifest.bytes + FILE_COST
        with self._lock:
            if needed > self.free:
                raise SpoolError(
                    f"the spool {self.folder} is full: {needed} bytes needed, {self.free} free "
                    f"above the reserve; {len(self._files('.json'))} images wait for delivery"
                )
            if manifest_path.exists() or image.with_suffix(".freed").exists():
                raise SpoolError(f"the spool has had an image of {manifest.key} already")
            while self._delivered and self._spare() < needed:
                self._remove_oldest()
        # Both are on the disk before either gets its name: a full disk or a power cut leaves no image without manifest.
        described = self._write_aside(manifest_path, [encode_for_first_release(manifest)])
        try:
            written = self._write_aside(image, parts)
        except SpoolError:
            described.unlink(missing_ok=True)
            raise
        try:
            os.replace(written, image)
            os.replace(described, manifest_path)
        except OSError as error:
            raise SpoolError(f"{image.name} cannot be written to the spool: {error}") from error
        _flush_folder(self.folder)

    def deliver(self, key: CaptureKey, sha256: str) -> bool:
        """Note that an image was acknowledged, if `sha256` is its own hash; returns whether it was.

        The image is kept while there is room. Without room for the note the image counts as delivered until the
        process ends; then it is sent, and acknowledged, once more.
        """
        manifest_path = self.folder / f"{key.stem}.json"
        try:
            manifest = decode_as(Manifest, manifest_path.read_bytes())
        except (OSError, WireError):
            return False
        if manifest.sha256 != sha256:
            log.error("spool: an acknowledgement of %s carries another hash; the image is kept", key)
            return False
        with self._lock:
            if key.stem in self._delivered:
                return False
            self._note_delivered(key.stem, sha256)
            self._delivered[key.stem] = manifest.bytes
            self._limit()
        return True

    def _note_delivered(self, stem: str, sha256: str) -> None:
        path = self.folder / f"{stem}.freed"
        try:
            os.replace(self._write_aside(path, [sha256.encode()]), path)
            _flush_folder(self.folder)
        except OSError as error:
            log.warning("spool: %s", error)

    def _limit(self) -> None:
        with self._lock:
            while self._delivered and (
                len(self._delivered) > DELIVERED_KEPT or sum(self._delivered.values()) > self.keep
            ):
                self._remove_oldest()
            while len(self._tombstones) > TOMBSTONES_KEPT:
                (self.folder / f"{self._tombstones.popitem(last=False)[0]}.freed").unlink(missing_ok=True)

    def _remove_oldest(self) -> None:
        """Remove the image that was delivered first; its note stays, so that it is known as delivered."""
        stem, _ = self._delivered.popitem(last=False)
        if not (self.folder / f"{stem}.freed").exists():
            self._note_delivered(stem, "")
        for suffix in (".json", ".pgm"):
            (self.folder / f"{stem}{suffix}").unlink(missing_ok=True)
        _flush_folder(self.folder)
        self._tombstones[stem] = None
        key = key_of_stem(stem)
        if key is not None:
            self._removed.append(key)

    def _write_aside(self, path: Path, parts: Sequence[bytes | memoryview]) -> Path:
        aside = path.with_name(PARTIAL + path.name)
        try:
            with open(aside, "wb") as file:
                for part in parts:
                    file.write(part)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            aside.unlink(missing_ok=True)
            raise SpoolError(f"{path.name} cannot be written to the spool: {error}") from error
        return aside


def key_of_stem(stem: str) -> CaptureKey | None:
    """The capture that a file's name without suffix stands for; None where it stands for none."""
    try:
        session, capture_id, moment = stem.split("~")
        return CaptureKey(session, capture_id, int(moment))
    except ValueError:
        return None


def _manifest_at(path: Path) -> Manifest:
    """The manifest in a file whose image lies beside it. Raises WireError or OSError, whose text says what is wrong."""
    manifest: Manifest = decode_as(Manifest, path.read_bytes())
    if manifest.key.stem != path.stem:
        raise SpoolError(f"the manifest is of {manifest.key.stem}, its file has another name")
    size = path.with_suffix(".pgm").stat().st_size
    if size != manifest.bytes:
        raise SpoolError(f"the image has {size} bytes instead of {manifest.bytes}")
    return manifest


def _flush_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
