"""The report as one HTML file: sections, tables and embedded pictures; nothing is fetched from a network."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure
from PIL import Image

from ringdic.findings import Finding, Verdict, verdict_headline
from ringdic.pictures.scale import Picture

UNKNOWN = "not recorded"
_DPI = 105


class Document:
    """The blocks of a report in order: sections, tables, pictures. The template ``page.html`` renders them.

    Texts and values are escaped by the template: markup in them is shown, not interpreted.
    """

    def __init__(self, title: str, subtitle: str) -> None:
        self._title = title
        self._subtitle = subtitle
        self._blocks: list[dict[str, Any]] = []

    def section(self, key: str, title: str) -> None:
        """Begin a section; the head of the document links to it by its key."""
        self._add("section", key=key, title=title)

    def heading(self, text: str) -> None:
        """Add a heading inside a section."""
        self._add("heading", text=text)

    def text(self, sentence: str) -> None:
        """Add a paragraph."""
        self._add("text", text=sentence)

    def sentences(self, sentences: Iterable[str]) -> None:
        """Add a list with one item a sentence."""
        self._add("sentences", sentences=list(sentences))

    def verdict(self, verdict: Verdict, findings: Iterable[Finding]) -> None:
        """Add whether the results can be used, and the findings that say why not."""
        listed = list(findings)
        self._add("verdict", verdict=verdict, headline=verdict_headline(listed), findings=listed)

    def facts(self, key: str, rows: Mapping[str, Any]) -> None:
        """Add a table of names and values; None is shown as not recorded."""
        self._add("facts", key=key, rows=dict(rows))

    def table(self, key: str, columns: Sequence[str], rows: Iterable[Sequence[Any]], caption: str = "") -> None:
        """Add a table; columns of numbers are aligned to the right. Numbers are given as :func:`figure` writes them."""
        cells = [list(row) for row in rows]
        numeric = [bool(cells) and all(_is_number(row[i]) for row in cells) for i in range(len(columns))]
        self._add("table", key=key, columns=list(columns), rows=cells, numeric=numeric, caption=caption)

    def verbatim(self, key: str, text: str) -> None:
        """Add text with its line breaks, such as that of a file."""
        self._add("verbatim", key=key, text=text)

    def picture(self, key: str, drawing: Figure, description: str, colours: Picture | None = None) -> None:
        """Add a drawing as an embedded PNG of 256 colours.

        colours : (256, 3) uint8 sRGB; without them the most frequent colours are taken.
        """
        full = io.BytesIO()
        drawing.savefig(full, format="png", dpi=_DPI)
        palette = None
        if colours is not None:
            palette = Image.new("P", (1, 1))
            palette.putpalette(colours.ravel().tolist())
        few = Image.open(full).convert("RGB").quantize(256, palette=palette, dither=Image.Dither.NONE)
        small = io.BytesIO()
        few.save(small, format="png", optimize=True)
        png = base64.b64encode(small.getvalue()).decode("ascii")
        self._add("picture", key=key, description=description, width=few.width, height=few.height, png=png)

    def to_html(self) -> str:
        """The whole document as one HTML page that fetches nothing."""
        environment = Environment(loader=PackageLoader("ringdic.report", "."), autoescape=True, trim_blocks=True)
        page = environment.get_template("page.html")
        return page.render(title=self._title, subtitle=self._subtitle, blocks=self._blocks, unknown=UNKNOWN)

    def _add(self, kind: str, **content: Any) -> None:
        self._blocks.append({"kind": kind, **content})


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


def _is_number(value: Any) -> bool:
    text = str(value).replace(",", "").replace("−", "-").replace("–", "nan").replace("%", "")
    try:
        float(text)
    except ValueError:
        return False
    return True
