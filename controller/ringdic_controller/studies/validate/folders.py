"""Session folders of rendered images, in the form that captures and imports make."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ringdic.session.writer import SessionWriter

from ringdic_controller.studies.validate.image_cache import ImageCache, RenderedShot


def make_session(
    path: Path,
    rig_toml: str,
    captures: Sequence[tuple[str, Mapping[str, RenderedShot]]],
    cache: ImageCache,
    *,
    calibration: Path | None = None,
    wall_ns: Callable[[], int] = time.time_ns,
) -> Path:
    """Make a session folder of rendered images at ``path``, unless there is one, and return its path.

    captures : the kind of each and its images by camera, which share their files with the cache. calibration : a
    session whose stored calibrations are copied; their keys include the images, so one of other images is not used.
    """
    if not (path / "session.json").is_file():
        shutil.rmtree(path, ignore_errors=True)
        aside = path.with_name(f".partial-{path.name}")
        shutil.rmtree(aside, ignore_errors=True)
        writer = SessionWriter.create(aside, path.name, rig_toml, "import", wall_ns)
        for kind, shots in captures:
            capture = writer.begin_capture(kind, list(shots))
            for id_, shot in shots.items():
                size = shot.camera.width, shot.camera.height
                capture.store_file(id_, cache.path(shot), *size, time_ns=shot.time_ns, link=True)
            capture.close()
        aside.rename(path)
    if calibration is not None and (calibration / "calibration").is_dir():
        (path / "calibration").mkdir(exist_ok=True)
        for file in (calibration / "calibration").glob("*.json"):
            shutil.copy2(file, path / "calibration" / file.name)
    return path
