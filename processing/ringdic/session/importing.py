"""A folder of images made into a session of the same form that captures make.

::

    SRC/rig.toml
    SRC/board/<camera>/*.{png,jpg,tif}      checkerboard views, any number a camera
    SRC/target/<camera>.{png,jpg,tif}       calibration object
    SRC/specimen/<camera>/*.{png,jpg,tif}   steps in natural order; the first is the reference configuration
    SRC/static/<camera>/*.{png,jpg,tif}     optional: the specimen at rest beside the reference, again and again
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
from ringdic.session.files import place
from ringdic.session.images import read_gray, read_mask
from ringdic.session.rig import Rig, parse_rig, read_rig
from ringdic.session.writer import SessionExistsError, SessionWriter

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm")

_COUNTED = {"specimen": "step", "static": "capture"}

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class _View:
    """One image to import: where it goes and how large it must be found to be."""

    kind: str
    index: int
    camera: str
    path: Path


def import_folder(
    src: Path,
    session: Path,
    *,
    progress: Progress | None = None,
    wall_ns: Callable[[], int] = time.time_ns,
) -> Path:
    """Make the session folder `session` of the images under `src`; return its path.

    Parameters
    ----------
    progress : callable (done, total, file name), optional
    wall_ns : callable
        The time that the records carry.

    Raises
    ------
    InputError
        A missing folder or image, an unreadable or truncated image, images of one camera that differ in size,
        an empty mask, unequal numbers of steps, or a session that exists already.
    """
    src, session = Path(src), Path(session)
    if session.exists():
        raise SessionExistsError(f"{session} exists already; import into a new session folder")
    if not src.is_dir():
        raise InputError(f"{src}: no such folder; give the folder that holds rig.toml and the images")
    rig = read_rig(src / "rig.toml")
    views = _find_views(src, rig)
    sizes = _check_images(views, progress or (lambda done, total, name: None))
    masks = _check_masks(src, rig, views, sizes)
    session.parent.mkdir(parents=True, exist_ok=True)
    partial = session.with_name(f".partial-{session.name}-{os.getpid()}")
    try:
        _write(partial, session.name, src, views, sizes, masks, wall_ns)
        os.rename(partial, session)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return session


def _find_views(src: Path, rig: Rig) -> list[_View]:
    views: list[_View] = []
    for kind in ("board", "specimen", "static"):
        if kind == "static" and not (src / kind).is_dir():
            continue
        steps: dict[str, int] = {}
        for camera in rig.cameras:
            if kind == "board" and camera.intrinsics is not None and not (src / kind / camera.id).is_dir():
                continue
            images = _images(src / kind / camera.id, kind, camera.id)
            steps[camera.id] = len(images)
            views += [_View(kind, index, camera.id, path) for index, path in enumerate(images)]
        if kind != "board" and len(set(steps.values())) > 1:
            told = ", ".join(f"{camera} {count}" for camera, count in steps.items())
            raise InputError(
                f"{src / kind}: the cameras have different numbers of {_COUNTED[kind]}s ({told}); "
                f"every {_COUNTED[kind]} needs all cameras"
            )
        _tell_strangers(src / kind, rig)
    for camera in rig.cameras:
        views.append(_View("target", 0, camera.id, _target(src, camera.id)))
    order = {"board": 0, "target": 1, "specimen": 2, "static": 3}
    return sorted(views, key=lambda view: (order[view.kind], view.index))


def _images(folder: Path, kind: str, camera: str) -> list[Path]:
    if not folder.is_dir():
        raise InputError(
            f"{folder}: the {kind} folder of camera '{camera}' is missing; "
            "every camera of rig.toml needs one, named by its id"
        )
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
    if not found:
        raise InputError(f"{folder}: no image of camera '{camera}'; use {', '.join(SUFFIXES)}")
    return sorted(found, key=natural_order)


def _target(src: Path, camera: str) -> Path:
    folder = src / "target"
    found = [folder / f"{camera}{suffix}" for suffix in SUFFIXES if (folder / f"{camera}{suffix}").is_file()]
    found += [p for s in SUFFIXES if (p := folder / f"{camera}{s.upper()}").is_file() and p not in found]
    if not found:
        raise InputError(
            f"{folder}: no image of the calibration object for camera '{camera}'; "
            f"put it there as {camera}.png, .jpg or .tif"
        )
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{folder}: more than one image for camera '{camera}' ({names}); keep one")
    return found[0]


def _tell_strangers(folder: Path, rig: Rig) -> None:
    known = {camera.id for camera in rig.cameras}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.is_dir() and path.name not in known:
            log.warning("%s is left out: rig.toml has no camera '%s'", path, path.name)


def _check_images(views: Sequence[_View], progress: Progress) -> dict[str, tuple[int, int]]:
    """Decode every image; return (height, width) a camera."""
    sizes: dict[str, tuple[int, int]] = {}
    first: dict[str, Path] = {}
    for done, view in enumerate(views):
        progress(done, len(views), view.path.name)
        height, width = read_gray(view.path).shape
        known = sizes.setdefault(view.camera, (height, width))
        first.setdefault(view.camera, view.path)
        if known != (height, width):
            raise InputError(
                f"{view.path}: {width} x {height} px, but {first[view.camera]} of the same "
                f"camera '{view.camera}' has {known[1]} x {known[0]} px; all images of a camera must have one size"
            )
    progress(len(views), len(views), "")
    return sizes


def _check_masks(src: Path, rig: Rig, views: Sequence[_View], sizes: dict[str, tuple[int, int]]) -> dict[str, Path]:
    folder = src / "mask"
    if not folder.is_dir():
        return {}
    known = {camera.id for camera in rig.cameras}
    masks = {}
    for path in sorted(folder.glob("*.png")):
        if path.stem not in known:
            raise InputError(f"{path}: rig.toml has no camera '{path.stem}'; name a mask by its camera's id")
        read_mask(path, sizes[path.stem])
        masks[path.stem] = path
    return masks


def _write(
    folder: Path,
    name: str,
    src: Path,
    views: Sequence[_View],
    sizes: dict[str, tuple[int, int]],
    masks: dict[str, Path],
    wall_ns: Callable[[], int],
) -> None:
    rig_toml = (src / "rig.toml").read_text(encoding="utf-8")
    writer = SessionWriter.create(folder, name, rig_toml, "import", wall_ns)
    for camera in parse_rig(rig_toml).cameras:
        if camera.intrinsics is not None:
            _copy_intrinsics(src, folder, camera.intrinsics, camera.id)
    captures: dict[tuple[str, int], list[_View]] = {}
    for view in views:
        captures.setdefault((view.kind, view.index), []).append(view)
    for (kind, _), members in captures.items():
        capture = writer.begin_capture(kind, [view.camera for view in members])
        for view in members:
            height, width = sizes[view.camera]
            capture.store_file(view.camera, view.path, width, height)
        capture.close()
    if masks:
        (folder / "mask").mkdir()
    for camera_id, path in masks.items():
        place(folder / "mask" / f"{camera_id}.png", path.read_bytes())


def _copy_intrinsics(src: Path, folder: Path, name: str, camera: str) -> None:
    """The file that rig.toml names beside itself stays beside it."""
    source, copy = src / name, (folder / name).resolve()
    if not source.is_file():
        raise InputError(f"{source}: the intrinsics file of camera '{camera}' is missing")
    if not copy.is_relative_to(folder.resolve()):
        raise InputError(f"the intrinsics file '{name}' of camera '{camera}' must lie in the folder of rig.toml")
    if not copy.exists():
        copy.parent.mkdir(parents=True, exist_ok=True)
        place(copy, source.read_bytes())


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key by which step 10 follows step 9."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]
