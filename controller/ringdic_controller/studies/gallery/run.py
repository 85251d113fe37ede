"""``ringdic validate --bodies``: render the gallery, measure every row, and show the errors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ringdic.calibration.calibrated_rig import calibrate_rig
from ringdic.cli.console import say, show_table
from ringdic.progress import Report
from ringdic.session.folder import open_session
from ringdic.settings import Settings

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
from ringdic_controller.studies.row_study import RowStudy, about_study, run_rows, scaled_settings
from ringdic_controller.studies.validate.image_cache import RenderedShot

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
    rows, settings = gallery_rows(only), scaled_settings(scale, overrides)
    about = about_study(folder, scale, overrides)
    write = None if images_only else partial(write_gallery, folder, about=about)
    entries = run_rows(_Gallery, rows, folder, scale, settings, write)
    if images_only:
        return {**about, "rows": [row.name for row in rows]}
    totals = write_gallery(folder, entries, about)
    show_table(f"Bodies of the virtual rig, {about['settings']}; mm", [entry.short_cells() for entry in entries])
    for entry in entries:
        if entry.refusal:
            say(f"{entry.name}: {entry.refusal}")
    say(AIMS)
    say(f"{totals['reached']} of {len(entries)} rows reach all aims; tables and pictures in {folder}")
    return totals


class _Gallery(RowStudy[GalleryRow, GalleryEntry]):
    """The rows of the gallery; every rig is calibrated once."""

    def __init__(self, folder: Path, scale: float, settings: Settings, report: Report) -> None:
        super().__init__(folder, scale, settings, report)
        self._calibrated: dict[str, Path] = {}

    def captures(self, row: GalleryRow) -> Captures:
        """The images of a row: those of its rig's calibration and those of its body."""
        scenes = [*calibration_scenes(), *(("specimen", specimen) for specimen in row.specimens)]
        return rendered_shots(gallery_rig(row.rig, self.scale), scenes)

    def measured(self, row: GalleryRow) -> GalleryEntry:
        """Process a row and compare it with the truth; a refusal is an entry with its sentence."""
        run = self.processed(row.name, lambda: self._session(row))
        if run.results is None:
            return GalleryEntry(row.name, run.seconds, refusal=run.refusal)
        before, after = row.specimens
        sample = SurfaceSample.of(before, after, gallery_rig(row.rig, self.scale).cameras)
        judgement = judged(run.results, before, after, sample)
        warnings, seconds = tuple(run.results.summary.get("warnings", ())), round(run.seconds, 1)
        picture = self.folder / f"{row.name}.png"
        entry = GalleryEntry(
            row.name, seconds, judgement.figures, warnings=warnings, picture=picture.name, calm=not row.variant
        )
        draw_row(picture, self.sentence(entry), judgement, run.results.vertices_ref)
        return entry

    def sentence(self, entry: GalleryEntry) -> str:
        """The figures of a row in one line."""
        if entry.figures is None:
            return f"{entry.name}: refused after {entry.seconds:.0f} s: {entry.refusal}"
        cells = entry.cells()
        figures = ", ".join(f"{name} {cells[name]}" for name in list(cells)[1:-1])
        return f"{entry.name}: {figures}" + (f"; missed: {cells['missed']}" if cells["missed"] else "")

    def _session(self, row: GalleryRow) -> Path:
        """The session of a row, with the calibration of its rig, which is computed once."""
        toml, captures = gallery_rig(row.rig, self.scale).rig_toml(), self.captures(row)
        if row.rig not in self._calibrated:
            alone = [each for each in captures if each[0] != "specimen"]
            path = self.session(f"calibration-{row.rig}", toml, alone)
            report = partial(self._calibrating, row.rig)
            calibrate_rig(open_session(path), self.settings.calibration, report)
            self._calibrated[row.rig] = path
        return self.session(row.name, toml, captures, self._calibrated[row.rig])

    def _calibrating(self, rig: str, _: float, who: str) -> None:
        self.tell(f"{rig}: calibrate", who)
