"""The report's section on what was not measured: areas by reason, and the photographs with the places drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ringdic.errors import InputError
from ringdic.pictures.overlay import no_larger, photograph
from ringdic.pictures.scale import Picture
from ringdic.pictures.unmeasured import LegendRow, unmeasured_legend, unmeasured_picture
from ringdic.report.document import Document
from ringdic.results.results import Results
from ringdic.session.folder import Session

_SIDE = 480  # px, of a photograph in the report
_COLUMNS = 4


def unmeasured(document: Document, session: Session, results: Results) -> None:
    """Write the section on unmeasured texture; none where the run did not determine it."""
    areas = results.summary.get("unmeasured")
    if not areas:
        return
    document.section("unmeasured", "Not measured")
    legend = unmeasured_legend(areas)
    total, measured = areas["total_cm2"], areas["measured_cm2"]
    document.text(
        f"Of the texture that at least two cameras see at the reference, {measured:,.1f} cm² were measured and "
        f"{total:,.1f} cm² were not."
    )
    document.table(
        "unmeasured-areas",
        ("why", "cm²", "in the total"),
        ((row.reason, f"{row.cm2:,.1f}", "yes" if row.counted else "no") for row in legend),
        "Places without a depth are taken to lie on the plane of the nearest that has one: their areas are estimates. "
        "The edge of the pattern is an upper bound, since it reaches into the background.",
    )
    pictures = []
    for places in results.unmeasured:
        try:
            image = photograph(session, results.steps[0], places.camera)
        except InputError:
            continue  # the photographs are not where the results are
        pictures.append((places.camera, no_larger(unmeasured_picture(image, places), _SIDE)))
    if pictures:
        document.picture(
            "unmeasured-picture",
            _photographs(pictures, legend),
            "Photographs of the reference with the textured places that were not measured, by reason.",
        )


def _photographs(pictures: Sequence[tuple[str, Picture]], legend: Sequence[LegendRow]) -> Figure:
    """Photographs side by side, each under its camera's id, above a legend of the reasons."""
    columns = min(_COLUMNS, len(pictures))
    rows = math.ceil(len(pictures) / columns)
    height, width = pictures[0][1].shape[:2]
    side = 11.0 / columns
    drawn = Figure(
        figsize=(11.0, rows * (side * height / width + 0.2) + 0.25 * len(legend) + 0.2), layout="constrained"
    )
    axes = drawn.subplots(rows, columns, squeeze=False).ravel()
    for each in axes:
        each.set_axis_off()
    for each, (camera, picture) in zip(axes, pictures, strict=False):
        each.imshow(picture, interpolation="antialiased")
        each.set_title(camera, fontsize=9, loc="left")
    keys = [Patch(color=row.colour, label=f"{row.reason}: {row.cm2:,.1f} cm²") for row in legend]
    if keys:
        drawn.legend(handles=keys, loc="outside lower left", fontsize=8, frameon=False)
    return drawn
