"""A picture of a row of the gallery: the measured surface coloured by its error, and what was not measured."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from ringdic.arrays import Floats, Points
from ringdic_node.virtual_rig.rig import FACING

from ringdic_controller.studies.gallery.comparison import JudgedRun

_LIMIT = 50.0  # µm, at the ends of the colours
_DOT = 4.0  # points²


def draw_row(path: Path, title: str, run: JudgedRun, vertices: Points) -> None:
    """Draw the vertices (N, 3) mm from the front, from behind and from above, with the points of the sample missed."""
    picture = Picture(figsize=(12.0, 4.6), layout="constrained")
    picture.suptitle(textwrap.fill(title, 140), fontsize=9)
    views = picture.subplots(1, 4)
    front, side = np.radians(FACING), np.radians(FACING + 90.0)
    views_of = (("front", front), ("back", front + np.pi), ("from the side", side))
    for axes, (name, azimuth) in zip(views[:3], views_of, strict=True):
        _side_view(axes, name, azimuth, run, vertices)
    shown = _dots(views[3], vertices[:, 0], vertices[:, 1], 1000.0 * run.distance)
    missed = run.sample.points[~run.covered]
    views[3].scatter(missed[:, 0], missed[:, 1], s=_DOT, c="black", linewidths=0)
    views[3].set(title="from above", aspect="equal", xlabel="x, mm", ylabel="y, mm")
    picture.colorbar(shown, ax=views, label="distance from the surface, µm (black: not measured)", shrink=0.8)
    picture.savefig(path, dpi=90)


def _side_view(axes: Axes, name: str, azimuth: float, run: JudgedRun, vertices: Points) -> None:
    """What faces a camera at an azimuth, rad."""
    outwards = np.array([np.cos(azimuth), np.sin(azimuth)])
    right = np.array([-outwards[1], outwards[0]])
    facing = run.normals[:, :2] @ outwards > 0.0
    _dots(axes, vertices[facing, :2] @ right, vertices[facing, 2], 1000.0 * run.distance[facing])
    missed = ~run.covered & (run.sample.normals[:, :2] @ outwards > 0.0)
    points = run.sample.points[missed]
    axes.scatter(points[:, :2] @ right, points[:, 2], s=_DOT, c="black", linewidths=0)
    axes.set(title=name, aspect="equal", xlabel="mm")


def _dots(axes: Axes, x: Floats, y: Floats, values: Floats):  # type: ignore[no-untyped-def]
    """Dots at x, y (n,) mm, coloured by values (n,) µm; returns what a colour bar is made of."""
    return axes.scatter(x, y, s=_DOT, c=values, vmin=-_LIMIT, vmax=_LIMIT, cmap="coolwarm", linewidths=0)
