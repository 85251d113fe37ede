"""Docstrings as Markdown: what mkdocstrings is given in place of the reStructuredText habits of the code.

An extension of griffe, named in ``mkdocs.yml``. Headings, lists of parameters, literal blocks that ``::`` opens,
examples, definition lists, simple tables and roles are rewritten; everything else is Markdown as it stands.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|mod|attr|data):`~?([^`]+)`")
_RULE = r"^(?:=+ +)+=+\n"
_TABLE = re.compile(rf"{_RULE}(?:.*\n)+?{_RULE}(?:(?:.*\n)+?(?:=+ +)+=+(?:\n|\Z))?", re.MULTILINE)
_EXAMPLE = re.compile(r"^>>> .*(?:\n\S.*)*", re.MULTILINE)
_TITLE = re.compile(r"^(\S.*)\n-{3,}\n", re.MULTILINE)
_NAMED = re.compile(r"\n+``(\w+)`` {2,}(?=\S)")
_PARAMETER = re.compile(r"\n+(\w+(?:, \w+)*) : (?=\S)")
_TERM = re.compile(r"^(?P<term>[^\s-][^\n]*)\n(?P<body>(?:    [^\n]*(?:\n|\Z))+)", re.MULTILINE)


def markdown(text: str) -> str:
    """The text of a docstring as Markdown."""
    text = _ROLE.sub(r"`\1`", text)
    parts = re.split(r"^((?:.+)?::)$\n", text, flags=re.MULTILINE)
    whole = _prose(parts[0])
    for opening, rest in zip(parts[1::2], parts[2::2], strict=True):
        block, after = _literal(rest)
        whole += f"\n\n{opening[:-1].rstrip(':')}\n\n{_fenced(block)}{_prose(after)}"
    return whole


def _fenced(block: str, language: str = "text") -> str:
    return f"\n\n```{language}\n{block.rstrip()}\n```\n\n"


def _literal(text: str) -> tuple[str, str]:
    """The indented block that a text begins with, and what comes after it."""
    lines = text.splitlines()
    end = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith(" ")), len(lines))
    depth = min((len(line) - len(line.lstrip()) for line in lines[:end] if line.strip()), default=0)
    return "\n".join(line[depth:] for line in lines[:end]).strip("\n"), "\n".join(lines[end:])


def _prose(text: str) -> str:
    """Text without literal blocks: tables and examples become blocks, everything between them paragraphs and lists."""
    blocks = [(found.span(), _fenced(found[0])) for found in _TABLE.finditer(text)]
    blocks += [(found.span(), _fenced(found[0], "pycon")) for found in _EXAMPLE.finditer(text)]
    whole, end = "", 0
    for (start, stop), block in sorted(blocks):
        whole += _paragraphs(text[end:start]) + block
        end = stop
    return whole + _paragraphs(text[end:])


def _paragraphs(text: str) -> str:
    text = _TITLE.sub(r"**\1**\n\n", text)
    text = _NAMED.sub(r"\n\n- `\1`: ", text)
    text = _PARAMETER.sub(r"\n\n- `\1`: ", text)
    return _TERM.sub(lambda match: f"{match['term']}\n:   {match['body'].strip()}\n\n", text)


class MarkdownDocstrings(griffe.Extension):
    """Rewrites every docstring that is collected."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)
