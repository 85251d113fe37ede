"""Photographs of the reference with the places that were not measured, in a colour for each reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ringdic.arrays import Image
from ringdic.pictures.scale import Picture
from ringdic.results.unmeasured import REASONS, UncountedPlace, UnmeasuredPlaces

_SERIES = ("#e6194b", "#f58231", "#ffe119", "#bfef45", "#3cb44b", "#42d4f4", "#4363d8", "#911eb4", "#fabed4", "#f032e6")
#: Colour of each reason, sRGB, by its code; what is not counted is grey.
COLOURS = dict(zip((reason.code for reason in REASONS), (*_SERIES, "#d0d0d0", "#808080"), strict=True))
_OPACITY = 0.6


@dataclass(frozen=True)
class LegendRow:
    """A reason with its colour, sRGB as #rrggbb, and its area, cm².

    counted : whether the area is part of the total.
    """

    reason: str
    colour: str
    cm2: float
    counted: bool


def unmeasured_legend(areas: dict[str, Any]) -> list[LegendRow]:
    """The reasons that occur, the largest area first, then what is not counted. areas : cm², of a run's summary."""
    area = {**areas["by_reason"], "one_view": areas["seen_by_one_cm2"], "rim": areas["rim_cm2"]}
    rows = [
        LegendRow(reason.sentence, COLOURS[reason.code], area[reason.name], reason.code < UncountedPlace.ONE_VIEW)
        for reason in REASONS
        if area.get(reason.name)
    ]
    return sorted(rows, key=lambda row: (not row.counted, -row.cm2))


def unmeasured_picture(image: Image, places: UnmeasuredPlaces) -> Picture:
    """A photograph with the unmeasured places drawn over it, (height, width, 3) uint8 sRGB.

    image : (height, width) grey levels, of the reference. places : of that camera, px.
    """
    grey = np.asarray(image, dtype=np.float32) * (255.0 / np.iinfo(image.dtype).max)
    out = np.repeat(grey[..., None], 3, axis=2)
    half = 0.5 * places.spacing
    for (x, y), status in zip(places.px, places.status.tolist(), strict=True):
        left, top = max(round(x - half), 0), max(round(y - half), 0)
        square = out[top : max(round(y + half), 0), left : max(round(x + half), 0)]
        square += _OPACITY * (np.array(_rgb(COLOURS[status]), np.float32) - square)
    return np.asarray(np.rint(out), dtype=np.uint8)


def _rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue (0 to 255) of a colour as #rrggbb."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
