"""Tables of the studies as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def markdown_table(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """The lines of a table in Markdown, with an empty line after it; a row is its cells by column, all alike."""
    columns = list(rows[0]) if rows else []
    lines = ("| " + " | ".join(row[name].replace("|", "\\|") for name in columns) + " |" for row in rows)
    return ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns), *lines, ""]
