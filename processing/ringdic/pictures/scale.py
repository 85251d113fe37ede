"""Colour scales of fields: limits, colours of values, and the colour bar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.errors import InputError
from ringdic.results.colours import colours
from ringdic.results.evaluation import EvaluatedResults
from ringdic.results.fields import Field

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Scale:
    """Colour scale of a field between two limits; diverging where the field has a centre, else sequential."""

    field: Field
    low: float
    high: float

    def __post_init__(self) -> None:
        if not (np.isfinite([self.low, self.high]).all() and self.high > self.low):
            raise InputError(
                f"the limits of the colours are two numbers, the first one smaller, not {self.low:g} and {self.high:g}"
            )

    @property
    def diverging(self) -> bool:
        """Whether the scale diverges from the field's centre."""
        return self.field.centre is not None

    @property
    def title(self) -> str:
        """The field's label with its unit."""
        return f"{self.field.label}, {self.field.unit}" if self.field.unit else self.field.label

    def colours(self, values: Floats) -> Floats:
        """Colours of values (...) in the unit of the field: sRGB (..., 3), 0 to 1."""
        return colours(values, self.low, self.high, self.diverging)

    def mappable(self) -> ScalarMappable:
        """The colour scale as matplotlib's mappable, for the colour bar of a plot."""
        listed = ListedColormap(colours(np.linspace(0.0, 1.0, 256), 0.0, 1.0, self.diverging).tolist())
        return ScalarMappable(Normalize(self.low, self.high), listed)

    def bar(self, height: int) -> Picture:
        """Picture of the colour bar with its title, (height, width, 3), black on white. height : px."""
        dpi = max(70.0, height / 7.0)
        picture = Figure(figsize=(1.15, height / dpi), dpi=dpi, layout="constrained")
        axes = picture.subplots()
        bar = picture.colorbar(self.mappable(), cax=axes)
        bar.ax.tick_params(labelsize=8)
        bar.set_label(self.title, fontsize=8)
        canvas = FigureCanvasAgg(picture)
        canvas.draw()
        drawn = np.asarray(canvas.buffer_rgba())[..., :3]
        whole = np.full((height, drawn.shape[1], 3), 255, dtype=np.uint8)
        whole[: min(height, len(drawn))] = drawn[:height]
        return whole


def scale_of(results: EvaluatedResults, name: str, limits: tuple[float, float] | None = None) -> Scale:
    """Colour scale of a field, between ``limits`` or limits that suit all steps. Raises InputError if unknown."""
    low, high = results.limits(name) if limits is None else limits
    return Scale(results.field(name), float(low), float(high))


def on_faces(results: EvaluatedResults, entry: Field, step: int) -> Floats:
    """Values of a field on the triangles (M,), in its unit, NaN where a corner was not measured at the step.

    Values of points are averaged over a triangle's corners.
    """
    faces, values = results.results.faces, results.step(step).scalar(entry)
    if entry.location == "point":
        values = values[faces].mean(axis=1)
    lost = ~np.isfinite(results.results.vertices[step]).all(axis=1)
    return np.asarray(np.where(lost[faces].any(axis=1), np.nan, values))


def palette(scale: Scale) -> Picture:
    """Palette (256, 3), uint8 sRGB, for drawings in this scale: 224 of its colours and 32 greys for lines and text."""
    steps = scale.colours(np.linspace(scale.low, scale.high, 224))
    greys = np.repeat(np.linspace(0.0, 1.0, 32)[:, None], 3, axis=1)
    return np.rint(255.0 * np.concatenate([steps, greys])).astype(np.uint8)


def face_colours(faces: NDArray[np.int32], values: Floats, scale: Scale) -> Floats:
    """Colours of an image of triangle numbers: RGBA (height, width, 4), 0 to 1, clear where nothing was measured.

    faces : (height, width), −1 for none, as `ringdic.pictures.painter.paint` makes it. values : (M,) of the field.
    """
    of_face = np.zeros((len(values) + 1, 4))
    of_face[:-1, :3] = scale.colours(values)
    of_face[:-1, 3] = np.isfinite(values)
    return np.asarray(of_face[faces])
