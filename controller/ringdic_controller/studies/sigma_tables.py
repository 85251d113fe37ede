"""What stated standard deviations are worth, row by row of a study: a table in Markdown and one as CSV.

Between cameras, errors of the position at the reference are held against its σ; in time, those of displacements and
stretches.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ringdic_controller.studies.solid_errors import FAR, Spread, StatedSpreads
from ringdic_controller.studies.tables import markdown_table

CALM, DISTURBED = (0.80, 1.25), (0.0, 1.5)  # what robust errors over σ should be, where nothing disturbs and elsewhere
BEYOND = 1e-3  # share of the errors that may lie beyond 5 σ
SIGMA_AIMS = (
    f"Aims: robust ratio {CALM[0]:.2f} to {CALM[1]:.2f} in calm rows, at most {DISTURBED[1]} in others that may be "
    f"used, and at most {100 * BEYOND:.1f} % of the errors beyond {FAR:.0f} σ."
)


@dataclass(frozen=True)
class SigmaRow:
    """Errors over stated standard deviations of one row of a study.

    calm : whether nothing disturbs the measurement. usable : whether its verdict lets its results be used.
    """

    name: str
    spreads: StatedSpreads
    calm: bool = True
    usable: bool = True

    @property
    def quantities(self) -> dict[str, Spread]:
        """The spreads by the name of their quantity."""
        found = self.spreads
        return {"position": found.position, "displacement": found.displacement, "stretch": found.stretch}

    @property
    def missed(self) -> list[str]:
        """Names of the quantities whose standard deviations miss an aim; none where the results are not to be used."""
        low, high = CALM if self.calm else DISTURBED
        return [
            name
            for name, each in self.quantities.items()
            if self.usable and each.count and not (low <= each.robust <= high and each.beyond <= BEYOND)
        ]

    def values(self) -> dict[str, str | float]:
        """The row as values by column: robust and RMS ratio, and the percentage beyond 5 σ, of every quantity."""
        figures: dict[str, str | float] = {"row": self.name}
        for name, each in self.quantities.items():
            figures[f"{name}: robust"], figures[f"{name}: RMS"] = round(each.robust, 3), round(each.plain, 3)
            figures[f"{name}: > 5 σ, %"] = round(100 * each.beyond, 3)
        return {**figures, "missed": ", ".join(self.missed) if self.usable else "not to be used"}

    def cells(self) -> dict[str, str]:
        """The row of the table in Markdown, which puts robust ratio, RMS ratio and percentage into one column."""
        figures = {
            f"{name} / σ": f"{each.robust:.2f} / {each.plain:.2f} / {100 * each.beyond:.2f}"
            for name, each in self.quantities.items()
        }
        return {"row": self.name, **figures, "missed": str(self.values()["missed"])}


def write_sigma_tables(folder: Path, rows: Sequence[SigmaRow], heading: str) -> int:
    """Write ``sigma.md`` and ``sigma.csv`` into a folder; returns the number of rows that reach all aims."""
    reached = sum(not row.missed for row in rows)
    lines = [
        f"# {heading}: what the stated standard deviations are worth",
        "",
        f"{reached} of {len(rows)} rows reach all aims. {SIGMA_AIMS}",
        f"Errors over σ: robust / RMS / percentage beyond {FAR:.0f} σ. Position: distance from the true surface at the "
        "reference, between cameras. Displacement, its components, and principal stretches: in time, over all steps.",
        "",
        *markdown_table([row.cells() for row in rows]),
    ]
    (folder / "sigma.md").write_text("\n".join(lines), encoding="utf-8")
    with (folder / "sigma.csv").open("w", encoding="utf-8", newline="") as file:
        values = [row.values() for row in rows]
        writer = csv.DictWriter(file, list(values[0]) if values else [])
        writer.writeheader()
        writer.writerows(values)
    return reached
