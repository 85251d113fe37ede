"""Import of a folder of images as a session folder, of the same form as that of a captured session.

::

    SRC/rig.toml
    SRC/board/<camera>/*.{png,jpg,tif}      checkerboard views, any number a camera
    SRC/target/<camera>.{png,jpg,tif}       calibration object
    SRC/specimen/<camera>/*.{png,jpg,tif}   steps in natural order; the first is the reference configuration
    SRC/static/<camera>/*.{png,jpg,tif}     optional: captures of the specimen at rest, as at the reference
    SRC/mask/<camera>.png                   optional region of interest on the reference image

Everything is decoded and checked before the session appears, so a refused folder leaves nothing behind.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ringdic.errors import InputError
from ringdic.session.files import PARTIAL, place
from ringdic.session.images import read_gray, read_mask
from ringdic.session.names import CAPTURE_KINDS, CaptureKind
from ringdic.session.numbering import number_conflict, shifted_numbers
from ringdic.session.rig import Rig, read_rig
from ringdic.session.writer import SessionExistsError, SessionWriter

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm")

#: Kinds of which every capture needs all cameras, and what one capture is called. Of the others, a camera may have
#: more views than another.
_COMPLETE = {"specimen": "step", "static": "capture"}


@dataclass(frozen=True)
class _View:
    """One image to import, and the capture it belongs to: the `index`-th of its kind."""

    kind: CaptureKind
    index: int
    camera: str
    path: Path


def import_images(
    src: Path,
    session: Path,
    *,
    wall_ns: Callable[[], int] = time.time_ns,
) -> Path:
    """Create a session folder from a folder of images, after checking every image.

    Parameters
    ----------
    src : the folder that holds ``rig.toml`` and the images.
    session : the session folder to create; it must not exist.
    wall_ns : the time that is written into the records, ns since the Unix epoch.

    Returns
    -------
    The session's path.

    Raises
    ------
    InputError
        A missing folder or image, an unreadable or truncated image, images of one camera that differ in size, an
        empty mask, unequal numbers of steps, file numbers that do not agree, or a session that exists already.
    """
    src, session = Path(src), Path(session)
    if session.exists():
        raise SessionExistsError(f"{session} exists already; import into a new session folder")
    if not src.is_dir():
        raise InputError(f"{src}: no such folder; give the folder that holds rig.toml and the images")
    rig = read_rig(src / "rig.toml")
    views = _views(src, rig)
    sizes = _checked_sizes(views)
    masks = _checked_masks(src, rig, sizes)
    session.parent.mkdir(parents=True, exist_ok=True)
    partial = session.with_name(f"{PARTIAL}{session.name}-{os.getpid()}")
    try:
        writer = SessionWriter.create(
            partial, session.name, (src / "rig.toml").read_text(encoding="utf-8"), "import", wall_ns
        )
        _copy_lens_files(src, partial, rig)
        _write_captures(writer, views, sizes)
        _copy_masks(masks, partial)
        os.rename(partial, session)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return session


def _views(src: Path, rig: Rig) -> list[_View]:
    """Every image of the folder, capture by capture. InputError where a camera's images are missing."""
    views: list[_View] = []
    kinds: tuple[CaptureKind, ...] = ("board", "specimen", "static")
    for kind in kinds:
        if kind != "static" or (src / kind).is_dir():
            views += _views_of_kind(src, rig, kind)
            _warn_of_unknown_cameras(src / kind, rig)
    views += [_View("target", 0, camera.id, _target(src, camera.id)) for camera in rig.cameras]
    order = {kind: number for number, kind in enumerate(CAPTURE_KINDS)}
    return sorted(views, key=lambda view: (order[view.kind], view.index))


def _views_of_kind(src: Path, rig: Rig, kind: CaptureKind) -> list[_View]:
    views: list[_View] = []
    counts: dict[str, int] = {}
    names: dict[str, list[str]] = {}
    for camera in rig.cameras:
        if kind == "board" and camera.intrinsics is not None and not (src / kind / camera.id).is_dir():
            continue  # its lens is given
        images = _images(src / kind / camera.id, kind, camera.id)
        counts[camera.id], names[camera.id] = len(images), [path.name for path in images]
        views += [_View(kind, index, camera.id, path) for index, path in enumerate(images)]
    if kind in _COMPLETE and len(set(counts.values())) > 1:
        listed = ", ".join(f"{camera} {count}" for camera, count in counts.items())
        raise InputError(
            f"{src / kind}: the cameras have different numbers of {_COMPLETE[kind]}s ({listed}); "
            f"every {_COMPLETE[kind]} needs all cameras"
        )
    if kind in _COMPLETE:
        _check_numbers(src / kind, names)
    return views


def _check_numbers(folder: Path, names: dict[str, list[str]]) -> None:
    """Warn where the file numbers of a camera are shifted. InputError where cameras lack different frames.

    names : of the files of each camera of a folder, in natural order.
    """
    conflict = number_conflict(names)
    if conflict is None:
        return
    (one, other), (first, second) = conflict.cameras, conflict.only
    if conflict.shift:
        log.warning("%s", shifted_numbers(conflict))
        return
    raise InputError(
        f"{folder}: the file numbers do not agree, so images of different moments would be paired: camera '{one}' has "
        f"{_listed(first)}, which '{other}' lacks, and '{other}' has {_listed(second)}, which '{one}' lacks; remove "
        "the frames that a camera lacks from all cameras"
    )


def _listed(numbers: Sequence[int]) -> str:
    """Numbers as text, at most five of them."""
    return ", ".join(map(str, numbers[:5])) + (f" and {len(numbers) - 5} more" if len(numbers) > 5 else "")


def _images(folder: Path, kind: str, camera: str) -> list[Path]:
    """The image files of a camera in natural order; at least one."""
    if not folder.is_dir():
        raise InputError(
            f"{folder}: the {kind} folder of camera '{camera}' is missing; "
            "every camera of rig.toml needs one, named by its id"
        )
    images = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
    if not images:
        raise InputError(f"{folder}: no image of camera '{camera}'; use {', '.join(SUFFIXES)}")
    return sorted(images, key=natural_order)


def _target(src: Path, camera: str) -> Path:
    """The one image of the calibration object that a camera has."""
    folder = src / "target"
    images = [folder / f"{camera}{suffix}" for suffix in SUFFIXES if (folder / f"{camera}{suffix}").is_file()]
    images += [p for s in SUFFIXES if (p := folder / f"{camera}{s.upper()}").is_file() and p not in images]
    if not images:
        raise InputError(
            f"{folder}: no image of the calibration object for camera '{camera}'; "
            f"put it there as {camera}.png, .jpg or .tif"
        )
    if len(images) > 1:
        names = ", ".join(path.name for path in images)
        raise InputError(f"{folder}: more than one image for camera '{camera}' ({names}); keep one")
    return images[0]


def _warn_of_unknown_cameras(folder: Path, rig: Rig) -> None:
    known = {camera.id for camera in rig.cameras}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.is_dir() and path.name not in known:
            log.warning("%s is left out: rig.toml has no camera '%s'", path, path.name)


def _checked_sizes(views: Sequence[_View]) -> dict[str, tuple[int, int]]:
    """Decode every image; the size of each camera's images, (height, width) px.

    InputError where an image is damaged, or two images of a camera differ in size.
    """
    sizes: dict[str, tuple[int, int]] = {}
    first: dict[str, Path] = {}
    for view in views:
        height, width = read_gray(view.path).shape
        known = sizes.setdefault(view.camera, (height, width))
        first.setdefault(view.camera, view.path)
        if known != (height, width):
            raise InputError(
                f"{view.path}: {width} x {height} px, but {first[view.camera]} of the same "
                f"camera '{view.camera}' has {known[1]} x {known[0]} px; all images of a camera must have one size"
            )
    return sizes


def _checked_masks(src: Path, rig: Rig, sizes: dict[str, tuple[int, int]]) -> dict[str, Path]:
    """The masks by camera. sizes : (height, width) px of each camera's images. InputError where one does not fit."""
    known = {camera.id for camera in rig.cameras}
    masks = {}
    for path in sorted((src / "mask").glob("*.png")):
        if path.stem not in known:
            raise InputError(f"{path}: rig.toml has no camera '{path.stem}'; name a mask by its camera's id")
        read_mask(path, sizes[path.stem])
        masks[path.stem] = path
    return masks


def _write_captures(writer: SessionWriter, views: Sequence[_View], sizes: dict[str, tuple[int, int]]) -> None:
    captures: dict[tuple[CaptureKind, int], list[_View]] = {}
    for view in views:
        captures.setdefault((view.kind, view.index), []).append(view)
    for (kind, _), members in captures.items():
        capture = writer.begin_capture(kind, [view.camera for view in members])
        for view in members:
            height, width = sizes[view.camera]
            capture.store_file(view.camera, view.path, width, height)
        capture.close()


def _copy_masks(masks: dict[str, Path], folder: Path) -> None:
    if masks:
        (folder / "mask").mkdir()
    for camera, path in masks.items():
        place(folder / "mask" / f"{camera}.png", path.read_bytes())


def _copy_lens_files(src: Path, folder: Path, rig: Rig) -> None:
    """Copy the lens files that ``rig.toml`` names beside itself. InputError where one is missing or lies elsewhere."""
    for camera in rig.cameras:
        if camera.intrinsics is None:
            continue
        source, copy = src / camera.intrinsics, (folder / camera.intrinsics).resolve()
        if not source.is_file():
            raise InputError(f"{source}: the intrinsics file of camera '{camera.id}' is missing")
        if not copy.is_relative_to(folder.resolve()):
            raise InputError(
                f"the intrinsics file '{camera.intrinsics}' of camera '{camera.id}' must lie in the folder of rig.toml"
            )
        if not copy.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            place(copy, source.read_bytes())


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key by which step 10 follows step 9."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]
