"""The table of mishaps: on the terminal, as JSON and as a page of Markdown."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ringdic.findings import Verdict
from ringdic.session.json_values import json_value

from ringdic_controller.studies.mishaps.judgement import MishapJudgement, Outcome, RunRecord
from ringdic_controller.studies.mishaps.rows import RANDOM
from ringdic_controller.studies.sigma_tables import SigmaRow, write_sigma_tables
from ringdic_controller.studies.tables import markdown_table

AIMS = (
    "Followed: all errors within 3 times those of the calm row. Within σ: larger, and the stated standard deviations "
    "say so. Named: wrong, and a finding names camera and step, or the thing. Measured less: values are missing, none "
    "is wrong, and it is said. Capitals must not happen: SILENT is wrong, and nothing that is said names it; MISNAMED "
    "blames other cameras or steps."
)
_COLUMNS = ("row", "outcome", "verdict", "wrong %", "shape mm", "displ. mm", "stretch", ">5σ %", "d/σ", "findings")


@dataclass(frozen=True)
class MishapEntry:
    """One row of the study as it was measured and judged. seconds : of the processing."""

    name: str
    group: str
    run: RunRecord
    judgement: MishapJudgement
    seconds: float

    def cells(self) -> dict[str, str]:
        """The row of the table."""
        e = self.run.errors
        figures = [""] * 6
        if e is not None:
            figures = [
                f"{100 * e.wrong:.1f}", f"{e.shape_mm:.4f}", f"{e.displacement_mm:.4f}", f"{e.stretch:.5f}",
                f"{100 * e.beyond:.2f}", f"{e.spread:.2f}",
            ]  # fmt: skip
        codes = [*(f"**{code}**" for code in self.judgement.naming), *self.judgement.others]
        values = (self.name, str(self.judgement.outcome), self.run.verdict, *figures, " ".join(codes))
        return dict(zip(_COLUMNS, values, strict=True))

    def short_cells(self) -> dict[str, str]:
        """The row of a narrower table."""
        cells = self.cells()
        return {name: cells[name] for name in ("row", "outcome", "wrong %", "shape mm", "displ. mm", ">5σ %")}

    def sigma_row(self) -> SigmaRow | None:
        """Errors over stated σ; None where nothing was measured. Calm are the rows in which nothing is otherwise."""
        if self.run.errors is None or self.run.errors.spreads is None:
            return None
        calm, usable = self.name.startswith(("calm-", RANDOM)), self.run.verdict != Verdict.DO_NOT_USE
        return SigmaRow(self.name, self.run.errors.spreads, calm, usable)

    def to_dict(self) -> dict[str, Any]:
        """The row as JSON values; figures that do not exist are null."""
        return json_value({**dataclasses.asdict(self), "good": self.judgement.outcome.is_good})  # type: ignore[no-any-return]


def outcome_counts(entries: Sequence[MishapEntry]) -> dict[str, int]:
    """Number of rows by outcome, in the order of the outcomes."""
    counts = Counter(entry.judgement.outcome for entry in entries)
    return {str(outcome): counts[outcome] for outcome in Outcome if counts[outcome]}


def write_mishaps(folder: Path, entries: Sequence[MishapEntry], about: Mapping[str, Any]) -> dict[str, Any]:
    """Write ``mishaps.json``, ``mishaps.md`` and the tables of σ into a folder; returns what the JSON file holds."""
    counts = outcome_counts(entries)
    good = sum(entry.judgement.outcome.is_good for entry in entries)
    totals = {
        **about, "rows": len(entries), "good": good, "outcomes": counts, "alarms": _alarms(entries),
        "entries": [entry.to_dict() for entry in entries],
    }  # fmt: skip
    (folder / "mishaps.json").write_text(json.dumps(totals, indent=1, ensure_ascii=False), encoding="utf-8")
    lines = [
        f"# Mishaps in the virtual rig, {about.get('settings', 'at the defaults')}",
        "",
        f"Images of scale {about['scale']}; {good} of {len(entries)} rows are as they should be: {_counted(counts)}.",
        AIMS + " Findings in bold name the mishap.",
        "",
        *markdown_table([entry.cells() for entry in entries]),
        "What was said:",
        "",
        *(line for entry in entries for line in _said(entry)),
        "",
    ]
    (folder / "mishaps.md").write_text("\n".join(lines), encoding="utf-8")
    known = [row for entry in entries if (row := entry.sigma_row()) is not None]
    write_sigma_tables(folder, known, "Mishaps in the virtual rig")
    return totals


def _alarms(entries: Sequence[MishapEntry]) -> dict[str, int]:
    """Number of calm rows, and of those with false alarms by their verdict."""
    calm = [entry for entry in entries if entry.group in ("calm", RANDOM)]
    alarms = [entry.run.verdict for entry in calm if entry.judgement.outcome is Outcome.ALARM]
    return {"calm": len(calm), **{str(verdict): alarms.count(str(verdict)) for verdict in list(Verdict)[1:]}}


def _said(entry: MishapEntry) -> list[str]:
    reason = f": {entry.judgement.reason}" if entry.judgement.reason else ""
    lines = [f"- {entry.name}: {entry.judgement.outcome}{reason}"]
    for each in entry.run.findings:
        where = ", ".join([*each["cameras"], *([each["step"]] if each["step"] else [])])
        lines.append(f"  - {each['verdict']}, {each['code']} ({where or 'all'}): {each['sentence']}")
    return lines


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
