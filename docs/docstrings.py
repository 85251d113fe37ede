"""Docstrings as Markdown: what mkdocstrings is given in place of the reStructuredText habits of the code.

An extension of griffe, named in ``mkdocs.yml``. Literal blocks that ``::`` opens, definition lists, simple tables and
roles are rewritten; everything else is Markdown as it stands.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|mod|attr|data):`~?([^`]+)`")
_TERM = re.compile(r"^(?P<term>\S[^\n]*)\n(?P<body>(?:    [^\n]*(?:\n|\Z))+)", re.MULTILINE)
_TABLE = re.compile(r"^(?:=+ +)+=+\n(?:.*\n)+?(?:=+ +)+=+\n(?:(?:.*\n)+?(?:=+ +)+=+(?:\n|\Z))?", re.MULTILINE)
_TITLE = re.compile(r"^(\S.*)\n-{3,}\n", re.MULTILINE)
_NAMED = re.compile(r"\n+``(\w+)`` {2,}(?=\S)")
_PARAMETER = re.compile(r"\n+(\w+(?:, \w+)*) : (?=\S)")
_SECTIONS = {"Parameters", "Attributes", "Returns", "Yields", "Raises", "Notes", "Examples", "See Also", "References"}


def markdown(text: str) -> str:
    """The text of a docstring as Markdown."""
    text = _ROLE.sub(r"`\1`", text)
    parts = re.split(r"^((?:.+)?::)$\n", text, flags=re.MULTILINE)
    whole = _prose(parts[0])
    for opening, rest in zip(parts[1::2], parts[2::2], strict=True):
        block, after = _literal(rest)
        whole += f"{opening[:-2].rstrip()}\n\n" if opening == "::" else f"{opening[:-1]}\n\n"
        whole += f"```text\n{block}\n```\n\n{_prose(after)}"
    return whole


def _literal(text: str) -> tuple[str, str]:
    """The indented block that a text begins with, and what comes after it."""
    lines = text.splitlines()
    end = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith(" ")), len(lines))
    depth = min((len(line) - len(line.lstrip()) for line in lines[:end] if line.strip()), default=0)
    return "\n".join(line[depth:] for line in lines[:end]).strip("\n"), "\n".join(lines[end:])


def _prose(text: str) -> str:
    """Text without literal blocks: simple tables become blocks, everything between them paragraphs and lists."""
    pieces, end = [], 0
    for table in _TABLE.finditer(text):
        pieces += [_paragraphs(text[end : table.start()]), f"```text\n{table[0].rstrip()}\n```\n"]
        end = table.end()
    return "".join([*pieces, _paragraphs(text[end:])])


def _paragraphs(text: str) -> str:
    text = _TITLE.sub(lambda match: match[0] if match[1] in _SECTIONS else f"**{match[1]}**\n\n", text)
    text = _NAMED.sub(r"\n\n- `\1`: ", text)
    if _SECTIONS & set(text.splitlines()):  # numpydoc: the parser of docstrings knows these indentations
        return text
    text = _PARAMETER.sub(r"\n\n- `\1`: ", text)
    return _TERM.sub(lambda match: f"{match['term']}\n:   {match['body'].strip()}\n\n", text)


class MarkdownDocstrings(griffe.Extension):
    """Rewrites every docstring that is collected."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)
