"""Statistics of fields over a part of the reference surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ringdic.arrays import Floats, Mask
from ringdic.errors import InputError
from ringdic.measure.table import Table
from ringdic.mesh.mesh import Mesh
from ringdic.results.evaluation import EvaluatedResults


class Region(Protocol):
    """A part of the reference surface over which statistics are taken."""

    def faces(self, mesh: Mesh) -> Mask:
        """Which triangles of the reference surface have their centroid in the region, (M,) bool."""
        ...


@dataclass(frozen=True)
class Everything:
    """The whole surface."""

    def faces(self, mesh: Mesh) -> Mask:
        """Every triangle, (M,) bool."""
        return np.ones(len(mesh.faces), dtype=bool)


@dataclass(frozen=True)
class Box:
    """A box with edges along the axes, between two corners in mm."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise InputError(f"the first corner of a box is the lower one in x, y and z, not {self.low} to {self.high}")

    def faces(self, mesh: Mesh) -> Mask:
        """Which triangles have their centroid inside, (M,) bool."""
        centroids = mesh.centroids
        return np.asarray(((centroids >= self.low) & (centroids <= self.high)).all(axis=1))


@dataclass(frozen=True)
class Ball:
    """A sphere of ``radius`` mm about a centre in mm."""

    centre: tuple[float, float, float]
    radius: float

    def __post_init__(self) -> None:
        if not self.radius > 0:
            raise InputError(f"the radius of a sphere is above 0 mm, not {self.radius:g}")

    def faces(self, mesh: Mesh) -> Mask:
        """Which triangles have their centroid inside, (M,) bool."""
        return np.asarray(np.linalg.norm(mesh.centroids - self.centre, axis=1) <= self.radius)


@dataclass(frozen=True)
class AngularPatch:
    """A window in azimuth, rad, counter-clockwise from the first to the second, and in height z, mm."""

    azimuth: tuple[float, float]
    height: tuple[float, float]

    def __post_init__(self) -> None:
        if not self.height[0] < self.height[1]:
            raise InputError(f"the first height of a patch is the lower one, not {self.height[0]:g}")

    def faces(self, mesh: Mesh) -> Mask:
        """Which triangles have their centroid inside, (M,) bool."""
        x, y, z = mesh.centroids.T
        begin, end = self.azimuth
        span = 2 * np.pi if end - begin >= 2 * np.pi else np.mod(end - begin, 2 * np.pi)
        turned = np.mod(np.arctan2(y, x) - begin, 2 * np.pi) <= span
        return np.asarray(turned & (z >= self.height[0]) & (z <= self.height[1]))


@dataclass(frozen=True)
class Listed:
    """Triangles chosen by their indices from 0."""

    indices: tuple[int, ...]

    def faces(self, mesh: Mesh) -> Mask:
        """The listed triangles, (M,) bool. Raises InputError for an index beyond the mesh."""
        chosen = np.zeros(len(mesh.faces), dtype=bool)
        for index in self.indices:
            if not 0 <= index < len(mesh.faces):
                raise InputError(f"no face {index}; there are {len(mesh.faces)}, from 0")
            chosen[index] = True
        return chosen


def region_statistics(results: EvaluatedResults, region: Region, fields: Sequence[str] = ()) -> Table:
    """Statistics of fields over a region, one row per field and step.

    Fields of triangles are taken over the triangles of the region, fields of points over the corners of these.

    ``mean``, ``std`` and ``rms`` are weighted by the area in the reference (a point has a third of its triangles in the
    region); ``min``, ``p5``, ``median``, ``p95``, ``max`` count triangles or points alike; ``measured`` and ``lost``
    are numbers of them. Raises InputError for a region without triangles or an unknown field.
    """
    entries = [results.field(name) for name in fields] if fields else list(results.fields)
    mesh = results.results.mesh
    inside = region.faces(mesh)
    if not inside.any():
        raise InputError("the region holds no triangle of the surface")
    areas = np.where(inside, mesh.areas, 0.0)
    weights = area_weights(mesh, areas)
    rows: list[dict[str, Any]] = []
    for entry in entries:
        for step, name in enumerate(results.steps):
            weight = weights[entry.location]
            inside_region = weight > 0
            figures = statistics(results.step(step).scalar(entry)[inside_region], weight[inside_region])
            rows.append({"field": entry.name, "unit": entry.unit, "step": step, "capture": name, **figures})
    note = f"{int(inside.sum())} triangles, {areas.sum():.2f} mm² in the reference"
    return Table.of_rows(rows, {}, [note])


def statistics(values: Floats, weights: Floats) -> dict[str, float | int]:
    """Weighted mean, standard deviation and RMS, unweighted percentiles, numbers of measured and lost values.

    values : (n,) in any unit, NaN where lost. weights : (n,), such as areas.
    """
    known = np.isfinite(values)
    lost = int((~known).sum())
    names = ("mean", "std", "rms", "min", "p5", "median", "p95", "max")
    if not known.any():
        return {**dict.fromkeys(names, float("nan")), "measured": 0, "lost": lost}
    v, w = values[known], weights[known] / weights[known].sum()
    mean = float(w @ v)
    figures = (
        mean,
        float(np.sqrt(w @ (v - mean) ** 2)),
        float(np.sqrt(w @ v**2)),
        *np.percentile(v, [0, 5, 50, 95, 100]),
    )
    return {**dict(zip(names, map(float, figures), strict=True)), "measured": len(v), "lost": lost}


def area_weights(mesh: Mesh, areas: Floats) -> dict[str, Floats]:
    """Weights in mm²: areas (M,) of the triangles, and for each of the N points a third of those of its triangles."""
    shares = np.bincount(mesh.faces.ravel(), np.repeat(areas / 3.0, 3), len(mesh.vertices))
    return {"face": areas, "point": np.asarray(shares, dtype=float)}
