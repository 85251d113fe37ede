"""An HTML document in one file: sections, tables, pictures inside it, nothing fetched from anywhere."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

from ringdic.pictures.scale import Picture

UNKNOWN = "not recorded"
_DPI = 105

_STYLE = """
:root { color-scheme: light; --line: #d5d9de; --soft: #f4f6f8; --text: #1b2530; --muted: #5b6773; --mark: #2f6fb3; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem; max-width: 1180px; background: #fff; color: var(--text);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; } h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem; padding-top: .6rem;
  border-top: 2px solid var(--mark); } h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
p { max-width: 80ch; margin: .4rem 0; } .muted { color: var(--muted); }
nav ul { display: flex; flex-wrap: wrap; gap: .2rem 1.1rem; list-style: none; margin: .8rem 0 0; padding: 0; }
a { color: var(--mark); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .5rem 0; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: .25rem .7rem .25rem 0; text-align: left; vertical-align: top; }
thead th { border-bottom: 2px solid var(--line); background: #fff; }
td.number, th.number { text-align: right; } td.number { white-space: nowrap; } thead th { vertical-align: bottom; }
table.facts th { font-weight: 500; width: 17rem; } table.facts td { max-width: 50rem; }
ul.sentences { margin: .4rem 0; padding-left: 1.2rem; } ul.warnings li::marker { color: #b3261e; }
figure { margin: .8rem 0 1.4rem; } figure img { max-width: 100%; height: auto; display: block; }
figcaption { color: var(--muted); font-size: .86rem; max-width: 90ch; }
pre { background: var(--soft); padding: .8rem; overflow-x: auto; font-size: .82rem; }
.unknown { color: var(--muted); font-style: italic; }
@media print { body { max-width: none; padding: 0; font-size: 10pt; } h2 { break-after: avoid; }
  figure, table { break-inside: avoid; } nav { display: none; } }
"""


class Document:
    """HTML written from top to bottom. Text given to it is text, never markup."""

    def __init__(self, title: str, subtitle: str) -> None:
        self._title = title
        self._head = f"<header><h1>{escape(title)}</h1><p class='muted'>{escape(subtitle)}</p></header>"
        self._sections: list[tuple[str, str]] = []
        self._body: list[str] = []

    def section(self, key: str, title: str) -> None:
        """Begin a section; the document's head leads to it."""
        self._sections.append((key, title))
        self._body.append(f'<h2 id="{escape(key)}">{escape(title)}</h2>')

    def heading(self, text: str) -> None:
        """A heading inside a section."""
        self._body.append(f"<h3>{escape(text)}</h3>")

    def text(self, sentence: str, muted: bool = False) -> None:
        """A paragraph."""
        self._body.append(f"<p{' class=muted' if muted else ''}>{escape(sentence)}</p>")

    def sentences(self, sentences: Iterable[str], warnings: bool = False) -> None:
        """A list, a sentence each."""
        items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
        self._body.append(f'<ul class="sentences{" warnings" if warnings else ""}">{items}</ul>')

    def facts(self, key: str, rows: Mapping[str, Any]) -> None:
        """A table of a name and a value each; what is None is told to be unknown."""
        cells = "".join(
            f'<tr><th scope="row">{escape(name)}</th>{_cell(value, number=False)}</tr>' for name, value in rows.items()
        )
        self._body.append(
            f'<div class="wide"><table class="facts" id="{escape(key)}"><tbody>{cells}</tbody></table></div>'
        )

    def table(self, key: str, columns: Sequence[str], rows: Iterable[Sequence[Any]], caption: str = "") -> None:
        """A table; numbers are aligned to the right. Give numbers as :func:`figure` writes them."""
        rows = [list(row) for row in rows]
        numeric = [bool(rows) and all(_is_number(row[i]) for row in rows) for i in range(len(columns))]
        head = "".join(
            f'<th scope="col"{" class=number" if n else ""}>{escape(name)}</th>'
            for name, n in zip(columns, numeric, strict=True)
        )
        body = "".join(
            "<tr>" + "".join(_cell(value, n) for value, n in zip(row, numeric, strict=True)) + "</tr>" for row in rows
        )
        told = f'<p class="muted" id="{escape(key)}-caption">{escape(caption)}</p>' if caption else ""
        named = f' aria-describedby="{escape(key)}-caption"' if caption else ""
        self._body.append(
            f'{told}<div class="wide"><table id="{escape(key)}"{named}><thead><tr>{head}</tr></thead>'
            f"<tbody>{body}</tbody></table></div>"
        )

    def verbatim(self, key: str, text: str) -> None:
        """Text as it stands, such as a file's."""
        self._body.append(f'<pre id="{escape(key)}" tabindex="0">{escape(text)}</pre>')

    def picture(
        self, key: str, drawn: Figure, description: str, colours: Picture | None = None, dpi: float = 110.0
    ) -> None:
        """A drawing, embedded as a PNG of 256 colours: those given (256, 3), else the most frequent ones."""
        made = io.BytesIO()
        drawn.savefig(made, format="png", dpi=_DPI)
        palette = None
        if colours is not None:
            palette = Image.new("P", (1, 1))
            palette.putpalette(colours.ravel().tolist())
        few = Image.open(made).convert("RGB").quantize(256, palette=palette, dither=Image.Dither.NONE)
        small = io.BytesIO()
        few.save(small, format="png", optimize=True)
        source = base64.b64encode(small.getvalue()).decode("ascii")
        self._body.append(
            f'<figure id="{escape(key)}"><img alt="{escape(description)}" width="{few.width}" height="{few.height}" '
            f'src="data:image/png;base64,{source}"><figcaption>{escape(description)}</figcaption></figure>'
        )

    def to_html(self) -> str:
        """The whole document."""
        links = "".join(f'<li><a href="#{escape(key)}">{escape(title)}</a></li>' for key, title in self._sections)
        return (
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{escape(self._title)}</title>\n"
            '<link rel="icon" href="data:,">\n'
            f"<style>{_STYLE}</style>\n</head>\n<body>\n{self._head}\n"
            f'<nav aria-label="Sections"><ul>{links}</ul></nav>\n<main>\n' + "\n".join(self._body) + "\n</main>\n"
            "</body>\n</html>\n"
        )


def figure(value: float | None, digits: int = 4) -> str:
    """A number with so many significant digits; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{decimals}f}"


def _cell(value: Any, number: bool) -> str:
    if value is None or value == UNKNOWN:
        return f'<td class="unknown">{UNKNOWN}</td>'
    return f"<td{' class=number' if number else ''}>{escape(str(value))}</td>"


def _is_number(value: Any) -> bool:
    text = str(value).replace(",", "").replace("−", "-").replace("–", "nan").replace("%", "")
    try:
        float(text)
    except ValueError:
        return False
    return True
