"""Fields drawn into matplotlib axes, for notebooks and scripts: over a photograph, and on the surface in space."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from ringdic.arrays import Floats, Pixels
from ringdic.errors import missing_extra
from ringdic.mesh.mesh import Mesh
from ringdic.pictures.scale import Scale, face_colours, on_faces
from ringdic.pictures.views import Extent, from_side, mean_azimuth
from ringdic.results.evaluation import EvaluatedResults

if TYPE_CHECKING:
    from pyvista import Plotter

_INNER_SIDE = (0.86, 0.87, 0.89, 1.0)
_HEIGHT = 900  # px of the painted surface
_LARGEST = (7.7, 3.9)  # inches, width and height of the picture in a new figure
_AROUND = (1.7, 0.8)  # inches that labels, title and colour bar take beside and above it
_FORMS = (0.3, 3.0)  # width over height of the narrowest and of the widest axes: there is room for their labels


def draw_over_image(
    axes: Axes | None,
    image: NDArray,
    xy: Pixels,
    faces: NDArray[np.integer],
    values: Floats,
    scale: Scale,
    opacity: float = 0.65,
) -> Axes:
    """Draw values of points in colours over a photograph, with a colour bar; returns the axes.

    Parameters
    ----------
    axes : where to draw; None makes a new figure.
    image : (height, width), grey levels.
    xy : (n, 2) px, positions of the points in the image.
    faces : (m, 3), indices of the points of each triangle.
    values : (n,), in the scale's unit; triangles with a NaN corner stay clear.
    scale : colours, limits and title.
    opacity : of the colours, 0 to 1.
    """
    axes = _axes(axes, image.shape[1] / image.shape[0])
    axes.imshow(image, cmap="gray")
    colours = scale.mappable()
    look: dict[str, Any] = {"cmap": colours.cmap, "norm": colours.norm, "alpha": opacity}
    of_faces = np.ma.masked_invalid(values[faces].mean(axis=1))
    if of_faces.count():
        look["facecolors"] = of_faces
        axes.tripcolor(Triangulation(xy[:, 0], xy[:, 1], faces), **look)
    else:  # points too far apart, or too few, for a triangle
        axes.scatter(xy[:, 0], xy[:, 1], c=values, **look)
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")
    axes.figure.colorbar(colours, ax=axes, label=scale.title)
    return axes


def draw_surface(
    axes: Axes | None,
    results: EvaluatedResults,
    scale: Scale,
    step: int,
    azimuth: float | None = None,
    elevation: float = 15.0,
) -> Axes:
    """Draw the surface at a step as seen from afar, coloured by a field, with a colour bar; returns the axes.

    Parameters
    ----------
    axes : where to draw; None makes a new figure.
    results : under the evaluation that the field is to have.
    scale : the field, its colours and limits.
    step : number of the step, from 0, the reference.
    azimuth : direction about z from which the surface is seen, degrees from +x; None takes the side that it faces.
    elevation : angle from which it is seen above the horizontal, degrees.
    """
    mesh = Mesh(results.positions(step), results.results.faces)
    towards = mean_azimuth(results.results.mesh) if azimuth is None else float(np.radians(azimuth))
    view = from_side(mesh, towards, _HEIGHT, float(np.radians(elevation)))
    axes = _axes(axes, float(np.clip(view.aspect, *_FORMS)))
    picture = face_colours(view.faces, on_faces(results, scale.field, step), scale)
    picture[view.inside] = _INNER_SIDE
    axes.imshow(picture, extent=view.extent, interpolation="antialiased")
    _widen(axes, view.extent)
    axes.set_xlabel("mm, to the right")
    axes.set_ylabel("mm, upwards")
    axes.set_title(results.steps[step], fontsize="medium", loc="left")
    axes.figure.colorbar(scale.mappable(), ax=axes, label=scale.title)
    return axes


def surface_in_viewer(results: EvaluatedResults, scale: Scale, step: int) -> Plotter:
    """A pyvista plotter with the surface at a step coloured by a field, to be turned and zoomed with the mouse.

    results : under the evaluation that the field is to have. scale : the field, its colours and limits. step : number
    of the step, from 0, the reference. Raises InputError where the extra ``viewer`` is not installed.
    """
    try:
        import pyvista
    except ModuleNotFoundError as error:
        raise missing_extra(error) or error from error
    mesh, _, measured = results.measured(step)
    body = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)
    body.cell_data[scale.title] = on_faces(results, scale.field, step)[measured]
    plotter = pyvista.Plotter()
    plotter.add_mesh(
        body, scalars=scale.title, cmap=scale.mappable().cmap, clim=(scale.low, scale.high),
        scalar_bar_args={"title": scale.title}, lighting=False,  # the colours are those of the bar
    )  # fmt: skip
    plotter.add_text(results.steps[step], font_size=10)
    return plotter


def _axes(axes: Axes | None, aspect: float) -> Axes:
    """The axes, or those of a new figure of the form that a picture needs; aspect : its width over its height."""
    if axes is not None:
        return axes
    height = min(_LARGEST[1], _LARGEST[0] / aspect)
    size = aspect * height + _AROUND[0], height + _AROUND[1]
    return pyplot.subplots(figsize=size, layout="constrained")[1]


def _widen(axes: Axes, extent: Extent) -> None:
    """Let axes of a very narrow or very flat picture show more than its extent (mm), evenly on both sides."""
    left, right, low, high = extent
    width, height = right - left, high - low
    wider, higher = max(width, _FORMS[0] * height) - width, max(height, width / _FORMS[1]) - height
    axes.set_xlim(left - 0.5 * wider, right + 0.5 * wider)
    axes.set_ylim(low - 0.5 * higher, high + 0.5 * higher)
