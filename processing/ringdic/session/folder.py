"""The session folder: the interface between capture and processing. Standard library only.

::

    SESSION/
      rig.toml                    the rig as used
      session.json                schema, session, rig, created, source (capture | import)
      captures/
        0001-board/               NNNN-kind; kinds: board, target, specimen, static
          capture.json            the record: per camera status, file, SHA-256, times, exposure, metadata
          201.pgm …               one image a camera, byte for byte as delivered
        0002-target/ …
        0003-specimen/ …          the first specimen capture is the reference, the others are the steps
      mask/<camera>.png           optional region of interest on the reference image
      calibration/                cameras as calibrated, kept under a key of what they rest on
      work/                       outputs of the tasks of processing, under keys of what they rest on; may be removed
      results/
        0001/ …                   one folder a processing run, written aside and renamed: results.h5, settings.toml,
                                  calibration.json, summary.json
      live/
        0005-specimen/ …          the newest steps as shown while the capturing goes on: results.h5 of the reference and
                                  that step; older ones are taken away
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from typing import Any
from uuid import uuid4

from ringdic.errors import InputError
from ringdic.session.rig import Rig, read_rig

KINDS = ("board", "target", "specimen", "static")
_MEND = "copy it back, or import the session again"
_LIVE_KEPT = 5  # the operator may stay at one while newer ones come
_CAPTURE_NAME = re.compile(r"(\d{4,})-(board|target|specimen|static)")


@dataclass(frozen=True)
class Capture:
    """One capture of a session. ``images`` maps camera ids to the image files that arrived."""

    id: str
    number: int
    kind: str
    folder: Path
    images: dict[str, Path]
    record: dict[str, Any]


@dataclass(frozen=True)
class Session:
    """A session folder, read. Captures are in order of their number."""

    path: Path
    name: str
    rig: Rig
    captures: tuple[Capture, ...]

    def of_kind(self, kind: str) -> tuple[Capture, ...]:
        """The captures of one kind, in order."""
        return tuple(capture for capture in self.captures if capture.kind == kind)

    def mask(self, camera_id: str) -> Path | None:
        """The region of interest given for a camera, if any."""
        path = self.path / "mask" / f"{camera_id}.png"
        return path if path.is_file() else None

    def runs(self) -> tuple[Path, ...]:
        """Finished processing runs, oldest first."""
        return runs(self.path)


def open_session(path: Path) -> Session:
    """The session of a folder; InputError says what is missing."""
    path = Path(path)
    _require_session(path)
    header = _read_json(path / "session.json")
    captures = sorted(_captures(path / "captures"), key=lambda capture: capture.number)
    return Session(path, str(header.get("session", path.name)), read_rig(path / "rig.toml"), tuple(captures))


def runs(path: Path) -> tuple[Path, ...]:
    """Finished processing runs of a session folder, oldest first."""
    results = Path(path) / "results"
    if not results.is_dir():
        return ()
    return tuple(sorted(p for p in results.iterdir() if p.is_dir() and p.name.isdigit()))


def newest_results(path: Path, run: int | None = None) -> Path:
    """The results file of the newest run, or of the run of a number.

    InputError if the session has not been processed or has no such run.
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
    """The folders of single steps that were processed at once, oldest first; each is named by its capture."""
    live = Path(path) / "live"
    if not live.is_dir():
        return ()
    found = [folder for folder in live.iterdir() if _CAPTURE_NAME.fullmatch(folder.name)]
    return tuple(sorted(found, key=lambda folder: int(folder.name.partition("-")[0])))


@contextmanager
def new_live(path: Path, capture_id: str) -> Iterator[Path]:
    """A folder to write a single step's results into; it takes its place when everything is written.

    Older ones are taken away, but for the last few: one may be being looked at.
    """
    live = Path(path) / "live"
    live.mkdir(exist_ok=True)
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
    """A run being written. ``folder`` is where to write now; ``final`` where it lies once it is whole."""

    folder: Path
    final: Path | None = None


@contextmanager
def new_run(path: Path) -> Iterator[NewRun]:
    """A folder to write a run into; it gets its number when everything is written, and never replaces another.

    A run that fails leaves nothing behind.
    """
    results = Path(path) / "results"
    results.mkdir(exist_ok=True)
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


def _require_session(path: Path) -> None:
    if not path.is_dir():
        raise InputError(f"{path}: no such session folder")
    if not (path / "session.json").is_file():
        raise InputError(
            f"{path}: not a session (no session.json); "
            f"a folder of images becomes one with 'ringdic import {path} SESSION'"
        )


def _captures(folder: Path) -> Iterator[Capture]:
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        match = _CAPTURE_NAME.fullmatch(path.name)
        if not match or not (path / "capture.json").is_file():
            continue
        record = _read_json(path / "capture.json")
        frames = record.get("cameras", {})
        if not isinstance(frames, dict) or not all(isinstance(frame, dict) for frame in frames.values()):
            raise InputError(f"{path / 'capture.json'}: 'cameras' must have one record a camera; {_MEND}")
        images = {camera_id: path / frame["file"] for camera_id, frame in frames.items() if frame.get("file")}
        for camera_id, image in images.items():
            if not image.is_file():
                raise InputError(
                    f"{image}: the record of {path.name} names this image of camera {camera_id}, but it is not there; "
                    f"{_MEND}"
                )
        yield Capture(path.name, int(match[1]), match[2], path, images, record)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not readable as JSON ({error}); {_MEND}") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: not a record of a session; {_MEND}")
    return value
