"""``ringdic validate --bodies``: render the gallery, measure every row, and show the errors."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
from ringdic.calibration.calibrated_rig import calibrate_rig
from ringdic.cli.console import say, show_table
from ringdic.errors import RingdicError
from ringdic.jobs.pipeline import process_session
from ringdic.progress import Progress, Report, progress_bar
from ringdic.results.reader import read_results
from ringdic.session.folder import open_session
from ringdic.settings import Settings, load_settings
from ringdic_node.virtual_rig.render import load_renderer

from ringdic_controller.studies.gallery.comparison import judged
from ringdic_controller.studies.gallery.picture import draw_row
from ringdic_controller.studies.gallery.rows import (
    GalleryRow,
    calibration_scenes,
    gallery_rig,
    gallery_rows,
    rendered_shots,
)
from ringdic_controller.studies.gallery.sample import SurfaceSample
from ringdic_controller.studies.gallery.tables import AIMS, GalleryEntry, write_gallery
from ringdic_controller.studies.validate.folders import make_session
from ringdic_controller.studies.validate.image_cache import ImageCache, RenderedShot

#: What faults of the program raise: they end a row of a study, and the others are still measured.
FAULTS = (cv2.error, ValueError, IndexError, ArithmeticError)
Captures = list[tuple[str, dict[str, RenderedShot]]]


def run_gallery(
    folder: Path,
    *,
    scale: float,
    only: Sequence[str] = (),
    overrides: Sequence[str] = (),
    images_only: bool = False,
) -> dict[str, Any]:
    """Measure the rows of the gallery, write tables and pictures into ``folder`` and return the table as JSON values.

    scale : of the images. only : names of rows, bodies or rigs; all if empty. overrides : settings other than the
    defaults, as ``group.name=value``. images_only : render missing images and stop. Images of an earlier run in the
    folder are used again; every row is measured anew.
    Raises InputError for a name or a setting that does not exist.
    """
    rows, settings = gallery_rows(only), gallery_settings(scale, overrides)
    about = {"folder": str(folder), "scale": scale, "settings": ", ".join(overrides) or "at the defaults"}
    folder.mkdir(parents=True, exist_ok=True)
    load_renderer()
    with progress_bar() as report:
        gallery = _Gallery(folder, scale, settings, report)
        entries = []
        for k, row in enumerate(rows):
            gallery.done = k / len(rows)
            captures = gallery.render(row)
            if not images_only:
                entries.append(gallery.measure(row, captures))
                say(_sentence(entries[-1], k + 1, len(rows)))
                write_gallery(folder, entries, about)
    if images_only:
        return {**about, "rows": [row.name for row in rows]}
    totals = write_gallery(folder, entries, about)
    show_table(f"Bodies of the virtual rig, {about['settings']}; mm", [entry.short_cells() for entry in entries])
    for entry in entries:
        if entry.refusal:
            say(f"{entry.name}: {entry.refusal}")
    say(AIMS)
    say(f"{totals['reached']} of {len(entries)} rows reach all aims; table and pictures in {folder}")
    return totals


def gallery_settings(scale: float, overrides: Sequence[str] = ()) -> Settings:
    """The default settings, or others where they are given, with subsets for images of a scale."""
    return load_settings(None, overrides).at_scale(scale)


@dataclass
class _Gallery:
    """The gallery in a folder at a scale. done : share of the rows that are done, for the progress report."""

    folder: Path
    scale: float
    settings: Settings
    report: Report
    done: float = 0.0
    calibrated: dict[str, Path] = field(default_factory=dict)

    @property
    def images(self) -> ImageCache:
        """The rendered images, in the folder ``images``."""
        return ImageCache(self.folder / "images")

    def render(self, row: GalleryRow) -> Captures:
        """Render the missing images of a row: those of its rig's calibration and those of its body."""
        rig = gallery_rig(row.rig, self.scale)
        scenes = [*calibration_scenes(), *(("specimen", specimen) for specimen in row.specimens)]
        captures = rendered_shots(rig, scenes)
        shots = [shot for _, each in captures for shot in each.values()]
        self.images.render_missing(shots, lambda done: self._tell(f"{row.name}: render", f"{100 * done:.0f} %"))
        return captures

    def measure(self, row: GalleryRow, captures: Captures) -> GalleryEntry:
        """Process a row and compare it with the truth; a refusal is an entry with its sentence."""
        began = time.monotonic()
        try:
            session = self._session(row.name, row.rig, captures, self._calibrated(row, captures))
            began = time.monotonic()
            run = process_session(session, self.settings, self._renamed(row.name))
        except RingdicError as error:
            return GalleryEntry(row.name, time.monotonic() - began, refusal=str(error))
        except FAULTS as error:
            sentence = f"a fault of the program: {type(error).__name__}: {' '.join(str(error).split())}"
            return GalleryEntry(row.name, time.monotonic() - began, refusal=sentence)
        seconds = time.monotonic() - began
        self._tell(row.name, "compared with the truth")
        results = read_results(run / "results.h5")
        before, after = row.specimens
        sample = SurfaceSample.of(before, after, gallery_rig(row.rig, self.scale).cameras)
        judgement = judged(results, before, after, sample)
        warnings = tuple(results.summary.get("warnings", ()))
        entry = GalleryEntry(row.name, round(seconds, 1), judgement.figures, warnings=warnings)
        picture = self.folder / f"{row.name}.png"
        draw_row(picture, _sentence(entry), judgement, results.vertices_ref)
        return GalleryEntry(row.name, entry.seconds, entry.figures, warnings=warnings, picture=picture.name)

    def _calibrated(self, row: GalleryRow, captures: Captures) -> Path:
        """The session in which the row's rig is calibrated, once for all rows."""
        if row.rig not in self.calibrated:
            alone = [each for each in captures if each[0] != "specimen"]
            path = self._session(f"calibration-{row.rig}", row.rig, alone)
            report = partial(self._calibrating, row.rig)
            calibrate_rig(open_session(path), self.settings.calibration, report)
            self.calibrated[row.rig] = path
        return self.calibrated[row.rig]

    def _session(self, name: str, rig: str, captures: Captures, calibration: Path | None = None) -> Path:
        """A new session folder; one of an earlier run is replaced."""
        path = self.folder / "sessions" / name
        shutil.rmtree(path, ignore_errors=True)
        path.parent.mkdir(exist_ok=True)
        toml = gallery_rig(rig, self.scale).rig_toml()
        return make_session(path, toml, captures, self.images, calibration=calibration)

    def _calibrating(self, rig: str, _: float, who: str) -> None:
        self._tell(f"{rig}: calibrate", who)

    def _tell(self, stage: str, message: str) -> None:
        self.report(Progress(stage, self.done, message))

    def _renamed(self, what: str) -> Callable[[Progress], None]:
        return lambda progress: self._tell(what, f"{progress.stage} {100 * progress.done:.0f} % {progress.message}")


def _sentence(entry: GalleryEntry, number: int = 0, total: int = 0) -> str:
    """The figures of a row in one line, with its number where there is one."""
    head = f"{number} of {total}: " if total else ""
    if entry.figures is None:
        return f"{head}{entry.name}: refused after {entry.seconds:.0f} s: {entry.refusal}"
    cells = entry.cells()
    figures = ", ".join(f"{name} {cells[name]}" for name in list(cells)[1:-1])
    return f"{head}{entry.name}: {figures}" + (f"; missed: {cells['missed']}" if cells["missed"] else "")
