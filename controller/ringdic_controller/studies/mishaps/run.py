"""``ringdic validate --mishaps``: render every mishap, process it, and show what the program said."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ringdic.cli.console import say, show_table
from ringdic.progress import Report
from ringdic.settings import Settings

from ringdic_controller.studies.gallery.rows import gallery_rig
from ringdic_controller.studies.mishaps.catalogue import all_rows
from ringdic_controller.studies.mishaps.errors import run_errors, uncovered_shares
from ringdic_controller.studies.mishaps.judgement import NOT_MEASURED, RunRecord, judged_mishap
from ringdic_controller.studies.mishaps.measurement import Captures
from ringdic_controller.studies.mishaps.rows import MishapRow, selected_rows
from ringdic_controller.studies.mishaps.tables import AIMS, MishapEntry, outcome_counts, write_mishaps
from ringdic_controller.studies.row_study import RowStudy, about_study, run_rows, scaled_settings


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
    rows, settings = selected_rows(all_rows(), only), scaled_settings(scale, overrides)
    about = about_study(folder, scale, overrides)
    write = None if images_only else partial(write_mishaps, folder, about=about)
    entries = run_rows(_Mishaps, rows, folder, scale, settings, write)
    if images_only:
        return {**about, "rows": [row.name for row in rows]}
    totals = write_mishaps(folder, entries, about)
    show_table(f"Mishaps in the virtual rig, {about['settings']}", [entry.short_cells() for entry in entries])
    say(AIMS)
    counts = ", ".join(f"{count} {outcome}" for outcome, count in outcome_counts(entries).items())
    say(f"{totals['good']} of {len(entries)} rows are as they should be ({counts}); what was said in {folder}")
    return totals


class _Mishaps(RowStudy[MishapRow, MishapEntry]):
    """The rows of the mishaps, each judged beside the calm row of its body and rig, which is processed once."""

    def __init__(self, folder: Path, scale: float, settings: Settings, report: Report) -> None:
        super().__init__(folder, scale, settings, report)
        self._calm: dict[str, tuple[RunRecord, float]] = {}

    def captures(self, row: MishapRow) -> Captures:
        """The images of a row: those of its rig's calibration and those of its body."""
        return row.planned(self.scale).captures

    def measured(self, row: MishapRow) -> MishapEntry:
        """Process a row and judge it; a refusal is judged by its sentence."""
        calm = row.calm
        if calm.name not in self._calm:
            self.render(calm)
            self._calm[calm.name] = self._record(calm)
        run, seconds = self._calm[calm.name] if row.name == calm.name else self._record(row)
        judgement = judged_mishap(row, run, self._calm[calm.name][0])
        return MishapEntry(row.name, row.group, run, judgement, round(seconds, 1))

    def sentence(self, entry: MishapEntry) -> str:
        """The outcome of a row in one line."""
        reason = f": {entry.judgement.reason}" if entry.judgement.reason else ""
        codes = " ".join((*entry.judgement.naming, *entry.judgement.others))
        said = f"; said: {codes}" if codes else ""
        return f"{entry.name}: {entry.judgement.outcome}{reason}{said} ({entry.seconds:.0f} s)"

    def _record(self, row: MishapRow) -> tuple[RunRecord, float]:
        """What processing a row gives, and the seconds that it took."""
        run = self.processed(row.name, lambda: self._session(row))
        if run.results is None:
            return RunRecord((), refusal=run.refusal, fault=run.fault), run.seconds
        steps, summary = run.results.steps, run.results.summary
        errors, findings = run_errors(run.results, row.specimens[: len(steps)]), tuple(summary["findings"])
        uncovered: dict[str, float] = {}
        if row.expected is None and any(each["code"] in NOT_MEASURED for each in findings):
            uncovered = uncovered_shares(run.results, row.specimens, gallery_rig(row.rig, self.scale, row.seed).cameras)
        record = RunRecord(steps, errors, findings, verdict=summary["verdict"], uncovered=uncovered)
        return record, run.seconds

    def _session(self, row: MishapRow) -> Path:
        """The session of a row; the stored calibration of its calm row goes with it, and is used where it fits."""
        planned, calm = row.planned(self.scale), row.calm.name
        calibration = None if row.name == calm else self.folder / "sessions" / calm
        return self.session(row.name, planned.rig_toml, planned.captures, calibration)
