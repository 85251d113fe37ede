"""``ringdic validate --mishaps``: render every mishap, process it, and show what the program said."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ringdic.cli.console import say, show_table
from ringdic.errors import RingdicError
from ringdic.jobs.pipeline import process_session
from ringdic.progress import Progress, Report, progress_bar
from ringdic.results.reader import read_results
from ringdic.session.folder import open_session
from ringdic.settings import Settings
from ringdic.tasks.work import work_folder
from ringdic_node.virtual_rig.render import load_renderer

from ringdic_controller.studies.gallery.run import FAULTS, gallery_settings
from ringdic_controller.studies.mishaps.catalogue import all_rows
from ringdic_controller.studies.mishaps.errors import run_errors
from ringdic_controller.studies.mishaps.judgement import RunRecord, judged_mishap
from ringdic_controller.studies.mishaps.measurement import PlannedMeasurement
from ringdic_controller.studies.mishaps.rows import MishapRow, selected_rows
from ringdic_controller.studies.mishaps.tables import AIMS, MishapEntry, outcome_counts, write_mishaps
from ringdic_controller.studies.validate.folders import make_session
from ringdic_controller.studies.validate.image_cache import ImageCache


def run_mishaps(
    folder: Path,
    *,
    scale: float,
    only: Sequence[str] = (),
    overrides: Sequence[str] = (),
    images_only: bool = False,
) -> dict[str, Any]:
    """Measure and judge the mishaps, write the tables into ``folder`` and return the table as JSON values.

    scale : of the images. only : names of rows, groups or rigs, or how rows' names begin; all if empty. overrides :
    settings other than the defaults, as ``group.name=value``. images_only : render missing images and stop. Images
    of an earlier run in the folder are used again; every row is measured anew.
    Raises InputError for a name or a setting that does not exist.
    """
    rows, settings = selected_rows(all_rows(), only), gallery_settings(scale, overrides)
    about = {"folder": str(folder), "scale": scale, "settings": ", ".join(overrides) or "at the defaults"}
    folder.mkdir(parents=True, exist_ok=True)
    load_renderer()
    entries: list[MishapEntry] = []
    with progress_bar() as report:
        study = _Study(folder, scale, settings, report)
        for k, row in enumerate(rows):
            study.done = k / len(rows)
            if images_only:
                study.render(row)
                continue
            entries.append(study.judged(row))
            say(f"{k + 1} of {len(rows)}: {_entry_sentence(entries[-1])}")
            write_mishaps(folder, entries, about)
    if images_only:
        return {**about, "rows": [row.name for row in rows]}
    totals = write_mishaps(folder, entries, about)
    show_table(f"Mishaps in the virtual rig, {about['settings']}", [entry.short_cells() for entry in entries])
    say(AIMS)
    counts = ", ".join(f"{count} {outcome}" for outcome, count in outcome_counts(entries).items())
    say(f"{totals['good']} of {len(entries)} rows are as they should be ({counts}); what was said in {folder}")
    return totals


@dataclass
class _Study:
    """The study in a folder at a scale. done : share of the rows that are done, for the progress report."""

    folder: Path
    scale: float
    settings: Settings
    report: Report
    done: float = 0.0
    calm: dict[str, tuple[RunRecord, float]] = field(default_factory=dict)

    def judged(self, row: MishapRow) -> MishapEntry:
        """Process a row and judge it beside the calm row of its body and rig, which is processed once."""
        name = row.calm.name
        if name not in self.calm:
            self.calm[name] = self._processed(row.calm)
        run, seconds = self.calm[name] if row.name == name else self._processed(row)
        return MishapEntry(row.name, row.group, run, judged_mishap(row, run, self.calm[name][0]), round(seconds, 1))

    def render(self, row: MishapRow) -> PlannedMeasurement:
        """Render the missing images of a row; returns what they are of."""
        planned = row.planned(self.scale)
        shots = [shot for _, each in planned.captures for shot in each.values()]
        self._images.render_missing(shots, lambda done: self._tell(f"{row.name}: render", f"{100 * done:.0f} %"))
        return planned

    @property
    def _images(self) -> ImageCache:
        return ImageCache(self.folder / "images")

    def _processed(self, row: MishapRow) -> tuple[RunRecord, float]:
        """What processing a row gives, and the seconds that it took."""
        planned = self.render(row)
        path = self._session(row, planned)
        steps: tuple[str, ...] = ()
        began = time.monotonic()
        try:
            steps = tuple(capture.id for capture in open_session(path).of_kind("specimen"))
            run = process_session(path, self.settings, self._renamed(row.name))
        except RingdicError as error:
            return RunRecord(steps, refusal=str(error)), time.monotonic() - began
        except FAULTS as error:
            sentence = f"a fault of the program: {type(error).__name__}: {' '.join(str(error).split())}"
            return RunRecord(steps, refusal=sentence, fault=True), time.monotonic() - began
        seconds = time.monotonic() - began
        results = read_results(run / "results.h5")
        shutil.rmtree(work_folder(path))
        summary = results.summary
        errors = run_errors(results, [row.specimens[steps.index(step)] for step in results.steps])
        return RunRecord(steps, errors, tuple(summary["findings"]), verdict=summary["verdict"]), seconds

    def _session(self, row: MishapRow, planned: PlannedMeasurement) -> Path:
        """A new session folder, with the calibration of the calm row; one of an earlier run is replaced."""
        path, calm = (self.folder / "sessions" / each.name for each in (row, row.calm))
        shutil.rmtree(path, ignore_errors=True)
        path.parent.mkdir(exist_ok=True)
        calibration = calm if row.name != row.calm.name else None
        return make_session(path, planned.rig_toml, planned.captures, self._images, calibration=calibration)

    def _tell(self, stage: str, message: str) -> None:
        self.report(Progress(stage, self.done, message))

    def _renamed(self, what: str) -> Callable[[Progress], None]:
        return lambda progress: self._tell(what, f"{progress.stage} {100 * progress.done:.0f} % {progress.message}")


def _entry_sentence(entry: MishapEntry) -> str:
    """The outcome of a row in one line."""
    reason = f": {entry.judgement.reason}" if entry.judgement.reason else ""
    codes = " ".join((*entry.judgement.naming, *entry.judgement.others))
    said = f"; said: {codes}" if codes else ""
    return f"{entry.name}: {entry.judgement.outcome}{reason}{said} ({entry.seconds:.0f} s)"
