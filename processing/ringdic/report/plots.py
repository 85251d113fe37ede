"""The report's plots: maps, time courses, histograms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ringdic.arrays import Floats
from ringdic.pictures.scale import Scale, face_colours
from ringdic.pictures.views import View
from ringdic.report.gathered import Gathered

_INSIDE = np.array([0.86, 0.87, 0.89])
_LINES = ("#1d6ec4", "#c4581d", "#2c8a4b", "#7b3fa0", "#a0762f")


class StepViews:
    """The views of one step: the unrolled map at the reference, and the body at that step from its sides."""

    def __init__(self, step: int, name: str, unrolled: View, sides: Sequence[tuple[str, View]]) -> None:
        self.step, self.name, self.unrolled, self.sides = step, name, unrolled, tuple(sides)


def maps(gathered: Gathered, scale: Scale, shown: Sequence[StepViews]) -> Figure:
    """Maps of one field: one row per step with the unrolled map and views of the body, all with one colour scale."""
    views = [(step.unrolled, *(view for _, view in step.sides)) for step in shown]
    widths = [max(1.0, 2.9 * min(view.aspect, 2.0)) for view in views[0]]
    drawn = Figure(figsize=(sum(widths) + 1.6, 3.2 * len(shown) + 0.5), layout="constrained")
    axes = drawn.subplots(len(shown), len(widths), squeeze=False, width_ratios=widths)
    for row, step in zip(axes, shown, strict=True):
        values = gathered.faces[scale.field.name, step.step].astype(float)
        _map(row[0], step.unrolled, face_colours(step.unrolled.faces, values, scale), step.name)
        for each, (side, view) in zip(row[1:], step.sides, strict=True):
            _body(each, view, face_colours(view.faces, values, scale), side)
    drawn.colorbar(scale.mappable(), ax=axes, label=scale.title, shrink=min(1.0, 3.0 / len(shown)), pad=0.01)
    return drawn


def _map(axes: Axes, view: View, picture: Floats, name: str) -> None:
    axes.imshow(picture, extent=view.extent, aspect="auto", interpolation="nearest")
    axes.set_title(name, fontsize=9, loc="left")
    axes.set_xlabel("azimuth, °", fontsize=8)
    axes.set_ylabel("z, mm", fontsize=8)
    axes.tick_params(labelsize=8)


def _body(axes: Axes, view: View, picture: Floats, side: str) -> None:
    picture = picture.copy()
    picture[view.inside] = (*_INSIDE, 1.0)
    axes.imshow(picture, extent=view.extent, interpolation="antialiased")
    axes.set_title(side, fontsize=8)
    axes.set_axis_off()


def courses(gathered: Gathered, names: Sequence[str]) -> Figure:
    """Plots of the median of each field over the steps, with the band from the 5th to the 95th percentile."""
    scales = [gathered.scales[name] for name in names]
    drawn = Figure(figsize=(10.5, 2.7 * ((len(names) + 1) // 2)), layout="constrained")
    axes = drawn.subplots((len(names) + 1) // 2, 2, squeeze=False).ravel()
    steps = np.arange(len(gathered.steps))
    for each, scale in zip(axes, scales, strict=False):
        rows = [gathered.statistics[scale.field.name, int(k)] for k in steps]
        low, middle, high = (np.array([row[name] for row in rows]) for name in ("p5", "median", "p95"))
        each.fill_between(steps, low, high, color=_LINES[0], alpha=0.18, lw=0)
        each.plot(steps, middle, "o-", ms=4, color=_LINES[0])
        each.set_ylabel(scale.title, fontsize=8)
        each.set_xticks(steps if len(steps) <= 12 else steps[:: -(-len(steps) // 12)])
        each.set_xlabel("step (0: reference)", fontsize=8)
        each.tick_params(labelsize=8)
        each.grid(alpha=0.3)
    for spare in axes[len(scales) :]:
        spare.set_axis_off()
    return drawn


def histograms(gathered: Gathered, names: Sequence[str]) -> Figure:
    """Histograms of each field at the steps shown: shares of the points or triangles."""
    scales = [gathered.scales[name] for name in names]
    rows = (len(scales) + 2) // 3
    drawn = Figure(figsize=(10.5, 2.3 * rows), layout="constrained")
    axes = drawn.subplots(rows, 3, squeeze=False).ravel()
    for j, step in enumerate(gathered.shown):
        for each, scale in zip(axes, scales, strict=False):
            values = gathered.values[scale.field.name, step]
            if len(values):
                edges = np.linspace(scale.low, scale.high, 81)
                share = 100.0 * np.histogram(np.clip(values, scale.low, scale.high), edges)[0] / len(values)
                each.stairs(share, edges, color=_LINES[j % len(_LINES)], label=gathered.steps[step])
    for each, scale in zip(axes, scales, strict=False):
        each.set_xlabel(scale.title, fontsize=8)
        each.set_ylabel("share, %", fontsize=8)
        each.tick_params(labelsize=8)
    if len(scales):
        axes[0].legend(fontsize=7)
    for spare in axes[len(scales) :]:
        spare.set_axis_off()
    return drawn
