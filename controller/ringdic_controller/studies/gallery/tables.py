"""The gallery's table: on the terminal, as JSON and as a page of Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ringdic.session.json_values import json_value

from ringdic_controller.studies.gallery.comparison import COVERED, SHAPE, SPREAD, RowFigures
from ringdic_controller.studies.sigma_tables import SigmaRow, write_sigma_tables
from ringdic_controller.studies.tables import markdown_table

AIMS = (
    f"Aims: at least {100 * COVERED:.0f} % covered of what two cameras see below 60°, no point wrong by more than "
    f"1 mm, shape at most {SHAPE} σ (RMS), displacements and stretches {SPREAD[0]:.2f} to {SPREAD[1]:.2f} σ (robust)."
)


@dataclass(frozen=True)
class GalleryEntry:
    """One row of the gallery as it was measured: its figures, or the sentence by which it was refused.

    calm : whether neither blur nor a large turn disturbs the measurement.
    """

    name: str
    seconds: float
    figures: RowFigures | None = None
    refusal: str = ""
    warnings: tuple[str, ...] = ()
    picture: str = ""
    calm: bool = True

    @property
    def missed(self) -> list[str]:
        """Names of the aims that are not reached."""
        return ["measured"] if self.figures is None else self.figures.missed

    def cells(self) -> dict[str, str]:
        """The row of the table."""
        f = self.figures
        if f is None:
            return {**dict.fromkeys(_COLUMNS, ""), "row": self.name, "s": f"{self.seconds:.0f}", "missed": "refused"}
        values = (
            self.name,
            f"{f.seen_cm2:.0f}",
            f"{100 * f.covered:.1f}",
            f"{100 * f.covered_later:.1f}",
            f"{f.points}",
            f"{f.wrong}",
            f"{f.shape_mm:.4f}",
            f"{f.spreads.position.plain:.2f} / {f.spreads.position.robust:.2f}",
            f"{f.displacement_mm:.4f}",
            f"{f.spreads.displacement.plain:.2f} / {f.spreads.displacement.robust:.2f}",
            f"{f.stretch_rms:.5f}",
            f"{f.spreads.stretch.plain:.2f} / {f.spreads.stretch.robust:.2f}",
            f"{self.seconds:.0f}",
            ", ".join(f.missed),
        )
        return dict(zip(_COLUMNS, values, strict=True))

    def short_cells(self) -> dict[str, str]:
        """The row of a narrower table: the figures that are aimed at, shape as RMS, spreads as robust."""
        f = self.figures
        if f is None:
            return {**dict.fromkeys(_SHORT, ""), "row": self.name, "s": f"{self.seconds:.0f}", "missed": "refused"}
        values = (
            self.name,
            f"{100 * f.covered:.1f}",
            f"{100 * f.covered_later:.1f}",
            f"{f.wrong}",
            f"{f.shape_mm:.3f}",
            f"{f.spreads.position.plain:.2f}",
            f"{f.displacement_mm:.3f}",
            f"{f.spreads.displacement.robust:.2f}",
            f"{f.spreads.stretch.robust:.2f}",
            f"{self.seconds:.0f}",
            ", ".join(f.missed),
        )
        return dict(zip(_SHORT, values, strict=True))

    def to_dict(self) -> dict[str, Any]:
        """The row as JSON values; figures that do not exist are null."""
        values: dict[str, Any] = json_value(self)
        return {**values, "missed": self.missed}


_COLUMNS = (
    "row", "seen cm²", "covered %", "later %", "points", "wrong", "shape mm", "shape/σ", "displ. mm", "displ./σ",
    "stretch", "stretch/σ", "s", "missed",
)  # fmt: skip

_SHORT = ("row", "cov. %", "later", "wrong", "shape", "s/σ", "displ.", "d/σ", "λ/σ", "s", "missed")


def write_gallery(folder: Path, entries: Sequence[GalleryEntry], about: Mapping[str, Any]) -> dict[str, Any]:
    """Write ``gallery.json``, ``gallery.md`` and the tables of σ into a folder; returns what the JSON file holds."""
    reached = sum(not entry.missed for entry in entries)
    totals = {**about, "rows": len(entries), "reached": reached, "entries": [entry.to_dict() for entry in entries]}
    (folder / "gallery.json").write_text(json.dumps(totals, indent=1, ensure_ascii=False), encoding="utf-8")
    lines = [
        f"# Bodies of the virtual rig, {about.get('settings', 'at the defaults')}",
        "",
        f"Images of scale {about['scale']}; {reached} of {len(entries)} rows reach all aims. {AIMS}",
        "Over σ: RMS / robust. Later: covered before and after the motion.",
        "",
        *markdown_table([entry.cells() for entry in entries]),
        *(f"- {entry.name}: refused: {entry.refusal}" for entry in entries if entry.refusal),
        *(f"- {entry.name}: {warning}" for entry in entries for warning in entry.warnings),
        "",
        *(f"![{entry.name}]({entry.picture})" for entry in entries if entry.picture),
        "",
    ]
    (folder / "gallery.md").write_text("\n".join(lines), encoding="utf-8")
    known = [SigmaRow(each.name, each.figures.spreads, each.calm) for each in entries if each.figures is not None]
    write_sigma_tables(folder, known, "Bodies of the virtual rig")
    return totals
