"""Verification of session folders: every image that a record names is there, whole and unchanged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ringdic.errors import InputError
from ringdic.session.files import PARTIAL, checksum
from ringdic.session.load import LOAD_FILE, read_load
from ringdic.session.names import split_capture_id
from ringdic.session.records import CameraRecord, CaptureRecord, SessionError, read_capture_record, read_session_record


@dataclass(frozen=True)
class Verification:
    """What the verification of a session folder showed.

    session : the folder. images : images that are as their records say. size : their bytes. faults : a sentence by the
    path of each image that is missing or changed and each record that cannot be read; none where all is well. notes : a
    sentence for each file of a capture that no record names, such as a second image of one camera.
    """

    session: Path
    images: int
    size: int
    faults: dict[Path, str]
    notes: tuple[str, ...]


def session_folders(archive: Path) -> tuple[Path, ...]:
    """Folders of an archive that are sessions, by name. Raises InputError where there is no such archive folder."""
    archive = Path(archive)
    if not archive.is_dir():
        raise InputError(f"{archive}: no such archive folder")
    return tuple(
        sorted(
            folder
            for folder in archive.iterdir()
            if not folder.name.startswith(".") and not folder.is_symlink() and (folder / "session.json").is_file()
        )
    )


def verify_session(session: Path) -> Verification:
    """Read every image of a session and hold it against the size and checksum in its record.

    Nothing is changed. Takes about as long as reading the images.
    """
    session = Path(session)
    images, size = 0, 0
    faults: dict[Path, str] = {}
    notes: list[str] = []
    try:
        read_session_record(session / "session.json")
    except SessionError as error:
        faults[session / "session.json"] = str(error)
    for folder in capture_folders(session):
        try:
            record = read_capture_record(folder / "capture.json")
        except SessionError as error:
            faults[folder / "capture.json"] = str(error)
            continue
        for camera, entry in _images(record):
            image = folder / (entry.file or "")
            fault = _image_fault(image, entry)
            if fault is None:
                images, size = images + 1, size + image.stat().st_size
            else:
                faults[image] = (
                    f"{image}: the image of camera {camera} in {record.capture_id} {fault}; copy it back from a backup"
                )
        try:
            read_load(folder)
        except SessionError as error:
            faults[folder / LOAD_FILE] = str(error)
        notes.extend(_strays(folder, record))
    return Verification(session, images, size, faults, tuple(notes))


def capture_folders(session: Path) -> tuple[Path, ...]:
    """Folders of a session that are named as captures, in order of their names; a link is none."""
    captures = Path(session) / "captures"
    if not captures.is_dir():
        return ()
    return tuple(sorted(each for each in captures.iterdir() if split_capture_id(each.name) and not each.is_symlink()))


def _images(record: CaptureRecord) -> Iterator[tuple[str, CameraRecord]]:
    """Entries of the images that a record names, by their cameras: the cameras' own, and others that came for them."""
    for camera, entry in record.cameras.items():
        if entry.file is not None:
            yield camera, entry
        for name, sha256 in entry.conflicts.items():
            yield camera, CameraRecord(file=name, sha256=sha256)


def _image_fault(image: Path, entry: CameraRecord) -> str | None:
    """What is wrong with an image, as the end of a sentence; None where it is as its record says."""
    if image.is_symlink() or not image.is_file():
        return "is not there"
    length = image.stat().st_size
    if entry.bytes is not None and length != entry.bytes:
        return f"has {length} bytes instead of {entry.bytes}"
    if entry.sha256 is not None and checksum(image) != entry.sha256:
        return "has changed: its checksum is not the archived one"
    return None


def _strays(folder: Path, record: CaptureRecord) -> Iterator[str]:
    named = {entry.file for _, entry in _images(record)} | {"capture.json", LOAD_FILE}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(PARTIAL):
            yield f"{path}: left by an interrupted write; the controller removes it"
        elif path.name not in named:
            yield f"{path}: no record names this file"
