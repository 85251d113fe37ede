"""The figures as tables for the terminal, as JSON, and as a page of Markdown with plots."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ringdic_controller.studies.tables import markdown_table
from ringdic_controller.studies.validate.figures import BETTER, PAPER, Figure

#: A figure shows the systematic errors if it is at least this many times larger by the paper's way.
_SEEN = 3.0
#: The paper's figures of quality, by experiment and the beginning of their name.
_QUALITY = (
    ("Table 2", "control points, RMS"),
    ("Fig. 6", "5 mm stage: superimposed RMS"),
    ("Fig. 6", "5 mm stage: length"),
    ("Fig. 7a", "merging mismatch, mean"),
    ("Fig. 7b", "displacement, STD, all views, first step"),
    ("Fig. 7b", "|E|, median, first step"),
    ("diameter", "bias, all views"),
)


def rows(figures: Sequence[Figure], ways: Sequence[str]) -> list[dict[str, str]]:
    """The figures as rows of a table, with a column for every way; empty columns are left out."""
    names = list(dict.fromkeys([*ways, *(way for figure in figures for way in figure.values)]))
    table = [figure.row(names) for figure in figures]
    filled = [name for name in (table[0] if table else {}) if any(row[name] for row in table)]
    return [{name: row[name] for name in filled} for row in table]


def blindness(figures: Sequence[Figure]) -> list[dict[str, str]]:
    """Table of the paper's figures of quality: does each show the systematic errors of the paper's way?

    A row has the magnitude by both ways and a verdict.
    """
    table = []
    for experiment, name in _QUALITY:
        for figure in figures:
            both = {PAPER, BETTER} <= figure.values.keys()
            if figure.experiment != experiment or not figure.quantity.startswith(name) or not both:
                continue
            paper, better = abs(figure.values[PAPER]), abs(figure.values[BETTER])
            table.append(
                {
                    "figure": f"{experiment}: {figure.quantity}",
                    "paper": figure.paper,
                    PAPER: figure.text(paper),
                    BETTER: figure.text(better),
                    "sees the errors": "yes" if paper > _SEEN * better else "no",
                }
            )
    return table


def summary(figures: Sequence[Figure], about: Mapping[str, Any]) -> dict[str, Any]:
    """All figures, the number of aims reached and a description of the run (``about``) as JSON values."""
    judged = [figure for figure in figures if figure.reached is not None]
    return {
        **about,
        "reached": sum(bool(figure.reached) for figure in judged),
        "aimed_at": len(judged),
        "missed": [f"{figure.experiment}: {figure.quantity}" for figure in judged if not figure.reached],
        "blindness": blindness(figures),
        "figures": [figure.to_dict() for figure in figures],
    }


def write(
    folder: Path, figures: Sequence[Figure], ways: Sequence[str], about: Mapping[str, Any], plots: Mapping[str, Path]
) -> dict[str, Any]:
    """Write ``validation.json`` and ``validation.md`` and return the summary."""
    totals = summary(figures, about)
    (folder / "validation.json").write_text(json.dumps(totals, indent=1, ensure_ascii=False), encoding="utf-8")
    (folder / "validation.md").write_text(_page(figures, ways, totals, plots), encoding="utf-8")
    return totals


def _page(figures: Sequence[Figure], ways: Sequence[str], totals: Mapping[str, Any], plots: Mapping[str, Path]) -> str:
    lines = [
        "# The paper's experiments on the virtual rig",
        "",
        f"{totals['cameras']} cameras of {totals['size'][0]} × {totals['size'][1]} px, subset radius "
        f"{totals['radius_px']} px, step {totals['step_px']} px; "
        f"{totals['reached']} of {totals['aimed_at']} aims reached.",
        "The paper: D. Solav et al., IEEE Access 6 (2018) 30520.",
        "",
        *markdown_table(rows(figures, ways)),
        *(f"{figure.experiment}, {figure.quantity}: {figure.note}" for figure in figures if figure.note),
        "",
    ]
    blind = blindness(figures)
    if blind:
        lines += ["## Which figures see the systematic errors of the paper's way", "", *markdown_table(blind)]
    lines += [
        *(f"![{name}]({path.name})" for name, path in plots.items()),
        "",
        *markdown_table([{"step": name, "seconds": f"{value:.1f}"} for name, value in totals["seconds"].items()]),
    ]
    return "\n".join(lines)
