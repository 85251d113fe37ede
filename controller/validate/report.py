"""The findings as a table on the terminal, as JSON, and as a page of Markdown with plots."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from controller.validate.figures import Figure


def rows(figures: Sequence[Figure], ways: Sequence[str]) -> list[dict[str, str]]:
    """The figures as rows of a table; a column for every way that has a value anywhere, none that is empty."""
    names = list(dict.fromkeys([*ways, *(way for figure in figures for way in figure.values)]))
    table = [figure.row(names) for figure in figures]
    filled = [name for name in (table[0] if table else {}) if any(row[name] for row in table)]
    return [{name: row[name] for name in filled} for row in table]


def summary(figures: Sequence[Figure], about: Mapping[str, Any]) -> dict[str, Any]:
    """Everything as JSON values."""
    judged = [figure for figure in figures if figure.reached is not None]
    return {
        **about,
        "reached": sum(bool(figure.reached) for figure in judged),
        "aimed_at": len(judged),
        "missed": [f"{figure.experiment}: {figure.quantity}" for figure in judged if not figure.reached],
        "figures": [figure.to_dict() for figure in figures],
    }


def write(
    folder: Path, figures: Sequence[Figure], ways: Sequence[str], about: Mapping[str, Any], plots: Mapping[str, Path]
) -> dict[str, Any]:
    """Write ``validation.json`` and ``validation.md`` and return the summary."""
    found = summary(figures, about)
    (folder / "validation.json").write_text(json.dumps(found, indent=1, ensure_ascii=False), encoding="utf-8")
    (folder / "validation.md").write_text(_page(figures, ways, found, plots), encoding="utf-8")
    return found


def _page(figures: Sequence[Figure], ways: Sequence[str], found: Mapping[str, Any], plots: Mapping[str, Path]) -> str:
    table = rows(figures, ways)
    head = list(table[0]) if table else []
    lines = [
        "# The paper's experiments on the virtual rig",
        "",
        f"{found['cameras']} cameras of {found['size'][0]} × {found['size'][1]} px, subset radius "
        f"{found['radius_px']} px, step {found['step_px']} px; {found['reached']} of {found['aimed_at']} aims reached.",
        "The paper: D. Solav et al., IEEE Access 6 (2018) 30520.",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(row[name].replace("|", "\\|") for name in head) + " |" for row in table),
        "",
        *(f"{figure.experiment}, {figure.quantity}: {figure.note}" for figure in figures if figure.note),
        "",
        *(f"![{name}]({path.name})" for name, path in plots.items()),
        "",
        "| step | seconds |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in found["seconds"].items()),
    ]
    return "\n".join(lines) + "\n"
