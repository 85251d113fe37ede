"""The session folder: the interface between capture and processing.

::

    SESSION/
      rig.toml                    the rig as used
      session.json                schema, session, rig, created, source (capture | import)
      captures/
        0001-board/               NNNN-kind, see `ringdic.session.names`
          capture.json            the record, see `ringdic.session.records`: per camera status, file, SHA-256, times,
                                  exposure, metadata
          load.json               optional: force, travel, … at the capture, see `ringdic.session.load`
          201.pgm …               one image per camera, the camera's bytes unchanged
        0002-target/ …
        0003-specimen/ …          the first specimen capture is the reference, the others are the steps
      mask/<camera>.png           optional region of interest on the reference image
      calibration/                calibrated cameras, each stored under a hash of its inputs
      work/                       outputs of the tasks of processing, each under a hash of its inputs; may be removed
      results/
        0001/ …                   one folder a processing run, renamed once complete: results.h5, settings.toml,
                                  calibration.json, summary.json
      live/
        0005-specimen/ …          the newest steps, processed during the capture: results.h5 of the reference and
                                  that step; older ones are removed
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from uuid import uuid4

from ringdic.errors import InputError
from ringdic.session.files import leads_out
from ringdic.session.load import LoadChannel, read_load
from ringdic.session.names import CAPTURE_KINDS, split_capture_id
from ringdic.session.records import REMEDY, CaptureRecord, SessionError, read_capture_record, read_session_record
from ringdic.session.rig import Rig, read_rig

_ABANDONED_S = 24 * 3600.0  # age at which a folder that is being written belongs to a process that was killed
_LIVE_KEPT = 5  # single steps that stay; the operator may look at one while newer ones come


@dataclass(frozen=True)
class Capture:
    """One capture of a session.

    id : name of its folder, of which `number` and `kind` are the parts. images : the image files that arrived, by
    camera.
    """

    id: str
    number: int
    kind: str
    folder: Path
    images: dict[str, Path]
    record: CaptureRecord

    @property
    def load(self) -> tuple[LoadChannel, ...]:
        """The load channels archived beside the capture, read from its folder. Raises SessionError if damaged."""
        return read_load(self.folder)


@dataclass(frozen=True)
class Session:
    """Contents of a session folder: its name, its rig and its captures, in order of their number.

    path : the folder.
    """

    path: Path
    name: str
    rig: Rig
    captures: tuple[Capture, ...]

    def of_kind(self, kind: str) -> tuple[Capture, ...]:
        """The captures of a kind, in order. kind : one of `ringdic.session.names.CAPTURE_KINDS`."""
        return tuple(capture for capture in self.captures if capture.kind == kind)

    def mask(self, camera_id: str) -> Path | None:
        """Image file of the region of interest on a camera's reference image; None where none was drawn."""
        path = self.path / "mask" / f"{camera_id}.png"
        _refuse_link_elsewhere(self.path, path)
        return path if path.is_file() else None

    def runs(self) -> tuple[Path, ...]:
        """Folders of the finished processing runs, oldest first."""
        return runs(self.path)


def open_session(path: Path) -> Session:
    """Read a session folder: its rig, its records, and the paths of its images.

    InputError says which file is missing or damaged.
    """
    path = Path(path)
    _require_session(path)
    record = read_session_record(path / "session.json")
    captures = sorted(_captures(path / "captures"), key=lambda capture: capture.number)
    return Session(path, record.session, read_rig(path / "rig.toml"), tuple(captures))


def runs(path: Path) -> tuple[Path, ...]:
    """Folders of the finished processing runs of a session folder, oldest first."""
    results = Path(path) / "results"
    if not results.is_dir():
        return ()
    return tuple(sorted(p for p in results.iterdir() if p.is_dir() and is_run_name(p.name)))


def is_run_name(name: str) -> bool:
    """Whether a folder of results has the name of a finished processing run: its number."""
    return name.isascii() and name.isdigit() and len(name) < 10


def newest_results(path: Path, run: int | None = None) -> Path:
    """Path of the results file of a processing run.

    Parameters
    ----------
    path : the session folder.
    run : the run's number; None takes the newest.

    Raises
    ------
    InputError
        The session has not been processed or has no such run.
    """
    finished = runs(path)
    if run is not None and finished:
        chosen = [folder for folder in finished if int(folder.name) == run]
        if not chosen:
            raise InputError(f"{path}: no run {run}; there are {', '.join(folder.name for folder in finished)}")
        return chosen[0] / "results.h5"
    if not finished:
        _require_session(Path(path))
        raise InputError(f"{path}: no results yet; run 'ringdic process {path}' first")
    return finished[-1] / "results.h5"


def live_results(path: Path) -> tuple[Path, ...]:
    """Folders of the results of single steps that were processed during the capture, oldest first.

    Each is named by the step's capture. path : the session folder.
    """
    live = Path(path) / "live"
    if not live.is_dir():
        return ()
    numbered = [(parts[0], folder) for folder in live.iterdir() if (parts := _capture_of(folder))]
    return tuple(folder for _, folder in sorted(numbered))


@contextmanager
def new_live(path: Path, capture_id: str) -> Iterator[Path]:
    """Context with a temporary folder for a single step's results, renamed to its final name when the context ends.

    Results of older steps are removed, except for the newest few. A step that fails leaves nothing behind.

    Parameters
    ----------
    path : the session folder.
    capture_id : the step's capture.
    """
    live = Path(path) / "live"
    live.mkdir(exist_ok=True)
    _remove_abandoned(live)
    partial = live / f".{capture_id}-{uuid4().hex}"
    partial.mkdir()
    try:
        yield partial
        final = live / capture_id
        if final.exists():
            final.rename(live / f".old-{uuid4().hex}")
        partial.rename(final)
    except BaseException:
        rmtree(partial, ignore_errors=True)
        raise
    for old in (*live_results(path)[:-_LIVE_KEPT], *live.glob(".old-*")):
        rmtree(old, ignore_errors=True)


@dataclass
class NewRun:
    """A processing run that is being written. folder : where to write. final : path of the complete run."""

    folder: Path
    final: Path | None = None


@contextmanager
def new_run(path: Path) -> Iterator[NewRun]:
    """Context with a temporary folder for a processing run, renamed to the run's number when the context ends.

    It never replaces another run; a run that fails leaves nothing behind. path : the session folder.
    """
    results = Path(path) / "results"
    results.mkdir(exist_ok=True)
    _remove_abandoned(results)
    number = 1 + max((int(p.name) for p in runs(path)), default=0)
    while True:
        partial = results / f".{number:04d}.partial"
        try:
            partial.mkdir()
            break
        except FileExistsError:  # another run is at work, or one was killed: leave its folder alone
            number += 1
    run = NewRun(partial)
    try:
        yield run
        while (results / f"{number:04d}").exists():
            number += 1
        run.final = results / f"{number:04d}"
        partial.rename(run.final)
    except BaseException:
        rmtree(partial, ignore_errors=True)
        raise


def _remove_abandoned(folder: Path) -> None:
    """Remove temporary folders that nobody has written into for long: those of runs and steps that were killed."""
    for partial in folder.glob(".*"):
        with suppress(OSError):  # another process removes it, too
            newest = max(item.stat().st_mtime for item in (partial, *partial.rglob("*")))
            if partial.is_dir() and not partial.is_symlink() and time.time() - newest > _ABANDONED_S:
                rmtree(partial, ignore_errors=True)


def _require_session(path: Path) -> None:
    if not path.is_dir():
        raise InputError(f"{path}: no such session folder")
    if not (path / "session.json").is_file():
        raise InputError(
            f"{path}: not a session (no session.json); "
            f"a folder of images becomes one with 'ringdic import {path} SESSION'"
        )


def _captures(folder: Path) -> Iterator[Capture]:
    """The captures in a folder, unordered. SessionError where an image that a record names is not there."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        parts = _capture_of(path)
        if parts is None or not (path / "capture.json").is_file():
            continue
        record = read_capture_record(path / "capture.json")
        images = {camera: path / entry.file for camera, entry in record.cameras.items() if entry.file}
        for camera, image in images.items():
            _refuse_link_elsewhere(folder / "..", image)
            if not image.is_file():
                raise SessionError(
                    f"{image}: the record of {path.name} names this image of camera {camera}, but it is not there; "
                    f"{REMEDY}"
                )
        yield Capture(path.name, *parts, path, images, record)


def _refuse_link_elsewhere(session: Path, file: Path) -> None:
    """SessionError for a file that is a link to a place outside the archive, the folder that the session lies in."""
    if leads_out(session / "..", file):
        raise SessionError(f"{file}: a link that leads out of the archive; copy the file itself there")


def _capture_of(folder: Path) -> tuple[int, str] | None:
    """Number and kind of the capture that a folder is named by; None where it is named otherwise."""
    parts = split_capture_id(folder.name)
    return parts if parts is not None and parts[1] in CAPTURE_KINDS else None
