"""Sections: fields along a cut of the reference surface, followed as a material line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ringdic.arrays import Floats, Indices, Mask
from ringdic.errors import InputError
from ringdic.measure.table import Table
from ringdic.mesh.mesh import Mesh
from ringdic.results.evaluation import EvaluatedResults
from ringdic.results.fields import Field


@dataclass(frozen=True)
class Cut:
    """A plane, or a half-plane, that cuts the reference surface.

    origin : (3,) mm, a point of the plane. normal : (3,), of any length. towards : (3,); if given, only the half where
    ``(x - origin) · towards > 0`` counts.
    """

    origin: tuple[float, float, float]
    normal: tuple[float, float, float]
    towards: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if not np.isfinite(self.normal).all() or np.linalg.norm(self.normal) == 0:
            raise InputError(f"a plane needs a normal with a direction, not {self.normal}")

    @classmethod
    def at_height(cls, z: float) -> Cut:
        """The plane of constant z, mm."""
        return cls((0.0, 0.0, z), (0.0, 0.0, 1.0))

    @classmethod
    def at_azimuth(cls, theta: float) -> Cut:
        """The half-plane from the axis at an azimuth about +z from +x, rad."""
        c, s = float(np.cos(theta)), float(np.sin(theta))
        return cls((0.0, 0.0, 0.0), (-s, c, 0.0), (c, s, 0.0))


@dataclass(frozen=True)
class Crossings:
    """The K triangles that a cut crosses, in order along its lines.

    faces : (K,). edges : (K, 2, 2) the two edges crossed, shares : (K, 2) where. line : (K,) number of the line.
    along : (K,) mm, arc length from the line's begin to the middle of the crossing, in the reference.
    """

    faces: Indices
    edges: Indices
    shares: Floats
    line: Indices
    along: Floats

    def at(self, values: Floats) -> Floats:
        """Values, in their unit, at the middle of each crossing, (K, ...). values : (N, ...) of the vertices."""
        shares = self.shares.reshape(*self.shares.shape, *[1] * (values.ndim - 1))
        first, second = values[self.edges[..., 0]], values[self.edges[..., 1]]
        return np.asarray((first + shares * (second - first)).mean(axis=1))


def section(results: EvaluatedResults, cut: Cut, fields: Sequence[str] = ()) -> Table:
    """Fields along a section, one row per crossed triangle and step.

    A row holds the number of the line, the arc length in the reference, the position and the fields. fields : names;
    all fields unless given. Raises InputError for an unknown field or a cut that misses the surface.
    """
    entries: list[Field] = [results.field(name) for name in fields] if fields else list(results.fields)
    segments = crossings(results.results.mesh, cut)
    reference = segments.at(results.results.vertices_ref)
    rows: list[dict[str, Any]] = []
    for step, name in enumerate(results.steps):
        arrays, now = results.step(step), segments.at(results.positions(step))
        columns = {
            entry.name: segments.at(values) if entry.location == "point" else values[segments.faces]
            for entry in entries
            for values in [arrays.scalar(entry)]
        }
        for k in range(len(segments.faces)):
            row: dict[str, Any] = {"line": int(segments.line[k]), "step": step, "capture": name, "s": segments.along[k]}
            row |= {f"{axis}_reference": reference[k, i] for i, axis in enumerate("xyz")}
            row |= {axis: now[k, i] for i, axis in enumerate("xyz")}
            rows.append(row | {entry: values[k] for entry, values in columns.items()})
    lengths = ("s", "x", "y", "z", "x_reference", "y_reference", "z_reference")
    units = {**dict.fromkeys(lengths, "mm"), **{entry.name: entry.unit for entry in entries}}
    lines = int(segments.line.max()) + 1
    return Table.of_rows(rows, units, [f"{len(segments.faces)} triangles crossed on {lines} line{'s' * (lines > 1)}"])


def crossings(mesh: Mesh, cut: Cut) -> Crossings:
    """The triangles of a surface that a cut crosses. Raises InputError if the cut misses the surface."""
    normal = np.array(cut.normal) / np.linalg.norm(cut.normal)
    height = (mesh.vertices - np.array(cut.origin)) @ normal
    above = height >= 0  # a vertex on the plane counts as above: every triangle is crossed twice or not at all
    sides = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]]
    crossed = above[sides[..., 0]] != above[sides[..., 1]]
    which = np.flatnonzero(crossed.any(axis=1) & mesh.whole_faces())
    edges = np.sort(sides[which][crossed[which]].reshape(-1, 2, 2), axis=-1)
    h = height[edges]
    shares = h[..., 0] / (h[..., 0] - h[..., 1])
    if cut.towards is not None:
        middle = _points(mesh, edges, shares).mean(axis=1)
        side = (middle - np.array(cut.origin)) @ np.array(cut.towards) > 0
        which, edges, shares = which[side], edges[side], shares[side]
    if not len(which):
        low, high = np.nanmin(mesh.vertices, axis=0), np.nanmax(mesh.vertices, axis=0)
        spans = ", ".join(f"{a} {low[i]:.1f} … {high[i]:.1f}" for i, a in enumerate("xyz"))
        raise InputError(f"the section misses the surface, which spans {spans} mm")
    order, flipped, line = _chained(edges, len(mesh.vertices))
    edges, shares = edges[order], shares[order]
    edges[flipped], shares[flipped] = edges[flipped][:, ::-1], shares[flipped][:, ::-1]
    steps = np.linalg.norm(np.diff(_points(mesh, edges, shares), axis=1)[:, 0], axis=1)
    total = np.cumsum(steps)
    begin = np.concatenate([[0.0], total[:-1]])[np.searchsorted(line, line)]
    return Crossings(which[order], edges, shares, line, total - 0.5 * steps - begin)


def _points(mesh: Mesh, edges: Indices, shares: Floats) -> Floats:
    """Positions at which edges (K, 2, 2) are crossed, (K, 2, 3) mm. shares : (K, 2) of the way along each edge."""
    a, b = mesh.vertices[edges[..., 0]], mesh.vertices[edges[..., 1]]
    return np.asarray(a + shares[..., None] * (b - a))


def _chained(edges: Indices, vertices: int) -> tuple[Indices, Mask, Indices]:
    """The order of segments between edges (K, 2, 2) along the lines that they form.

    Returns the order (K,), which of the ordered segments run backwards (K,), and the number of the line of each (K,),
    rising. Open lines begin at an end; closed ones at the segment that comes first.
    """
    nodes = edges[..., 0] * vertices + edges[..., 1]  # (K, 2)
    _, index = np.unique(nodes, return_inverse=True)
    index = index.reshape(-1, 2)
    at: list[list[int]] = [[] for _ in range(int(index.max()) + 1)]
    for segment, ends in enumerate(index.tolist()):
        for node in ends:
            at[node].append(segment)
    left = [True] * len(index)
    order: list[int] = []
    flipped: list[bool] = []
    line: list[int] = []
    open_ends = [node for node, segments in enumerate(at) if len(segments) == 1]
    number = 0
    for node in [*open_ends, *index[:, 0].tolist()]:
        began = len(order)
        while following := [segment for segment in at[node] if left[segment]]:
            segment = following[0]
            left[segment] = False
            backwards = int(index[segment, 0]) != node
            order.append(segment)
            flipped.append(backwards)
            line.append(number)
            node = int(index[segment, 0 if backwards else 1])
        number += len(order) > began
    return np.array(order), np.array(flipped), np.array(line)
