"""A finished processing run of a session as an object: its fields, drawings, measurements and exports."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

from ringdic.arrays import Floats
from ringdic.errors import InputError
from ringdic.findings import Finding, Verdict
from ringdic.geometry.camera import Camera
from ringdic.measure.table import Table
from ringdic.mesh.mesh import Mesh
from ringdic.results.evaluation import EvaluatedResults, Evaluation
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.session.folder import Session

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pyvista import Plotter

Position = Sequence[float]
"""A position in space in the world frame, (x, y, z) mm."""


class EvaluationOptions(TypedDict, total=False):
    """Options by which fields are computed from the measured positions; keyword arguments of a run's methods.

    reference : what a step is compared with: the "first" step, the reference (default), or the "previous" one.
    without_rigid_motion : move each step back by its rigid motion first; False unless given.
    window : width of the strain window, mm; 0 for none; the run's own setting unless given.
    seth_hill : exponent of a further family of strains, whose fields are then ``seth_hill1:M`` and so on.
    """

    reference: Literal["first", "previous"]
    without_rigid_motion: bool
    window: float
    seth_hill: float


class Run:
    """A finished processing run: access to all that was measured on a session's specimen, at every step.

    Fields are evaluated from the stored positions on request, so that a step may be compared with the
    one before it, without its rigid motion, or given strains over another window than the run's, without correlating
    again; see :class:`EvaluationOptions` for these keywords. Steps are given by their number from 0, the reference,
    or by the name of their capture; -1 is the last. What was not measured at a step is NaN there.

    Attributes
    ----------
    session : the session that was processed.
    path : folder of the run, with ``results.h5``, ``settings.toml``, ``calibration.json`` and ``summary.json``.

    Examples
    --------
    >>> run = ringdic.read_run(session)
    >>> run.steps
    ('0006-specimen', '0007-specimen', '0008-specimen')
    >>> stretch = run.field("lambda2", step=-1)
    >>> stretch.shape == (len(run.mesh().faces),)
    True
    """

    def __init__(self, session: Session, path: Path) -> None:
        self.session = session
        self.path = path
        self._evaluated: dict[Evaluation, EvaluatedResults] = {}

    def __repr__(self) -> str:
        return f"Run(session={str(self.session.path)!r}, number={self.number})"

    @property
    def number(self) -> int:
        """Number of the run in its session, from 1."""
        return int(self.path.name)

    @cached_property
    def results(self) -> Results:
        """The stored arrays of the run, without the 2D matches; read on first use.

        Its standard deviations are kept in parts, by image noise alone and by the calibration alone; fields join them.
        """
        return read_results(self.path / "results.h5", matches=False)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Summary of the run as JSON values: verdict, findings, cameras, agreement, noise floor, table of steps."""
        summary: dict[str, Any] = json.loads((self.path / "summary.json").read_text(encoding="utf-8"))
        return summary

    @property
    def verdict(self) -> Verdict:
        """Whether the results can be used: sound, look at this (at the findings), or do not use.

        Runs of versions that did not state it are to be looked at.
        """
        return Verdict(self.summary.get("verdict", Verdict.LOOK))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What may make the results wrong or incomplete, the gravest first.

        >>> [finding.code for finding in run.findings]
        ['area-unmeasured']
        """
        return tuple(map(Finding.from_json, self.summary.get("findings", [])))

    @property
    def steps(self) -> tuple[str, ...]:
        """Names of the captures that are the steps, the reference first."""
        return self.results.steps

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The calibrated cameras."""
        return self.results.cameras

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of all available fields, on points and on triangles."""
        return tuple(field.name for field in self.evaluated().fields)

    def evaluated(self, **evaluation: Unpack[EvaluationOptions]) -> EvaluatedResults:
        """The results evaluated with given options, for the functions of `ringdic.measure` and `ringdic.pictures`.

        Raises InputError for a reference, window or exponent that does not exist.
        """
        how = Evaluation.of(**evaluation)
        return self._evaluated.setdefault(how, EvaluatedResults(self.results, how))

    def field(self, name: str, step: int | str = -1, **evaluation: Unpack[EvaluationOptions]) -> Floats:
        """Values of a field at a step: of every point, (N,), or of every triangle, (M,).

        Units are mm for lengths and none for stretches, strains and correlation; see `ringdic.results.fields`.
        Standard deviations such as ``sigma_displacement`` are those by image noise and calibration together, or by the
        noise alone where the part of the calibration is unknown; ``sigma_displacement_noise`` and
        ``sigma_displacement_calibration`` are the parts.
        Raises InputError for a field or a step that does not exist.

        >>> float(run.field("displacement", step=0).max())
        0.0
        """
        results = self.evaluated(**evaluation)
        return results.step(self._step(step)).scalar(results.field(name))

    def mesh(self, step: int | str = 0) -> Mesh:
        """The surface at a step: vertices (N, 3) mm in the world frame, NaN where lost, and faces (M, 3).

        Points and triangles are numbered alike at every step; normals point outwards.

        >>> run.mesh().vertices.shape[1], run.mesh().faces.shape[1]
        (3, 3)
        """
        return Mesh(self.results.vertices[self._step(step)], self.results.faces)

    def plot(
        self,
        name: str = "displacement",
        step: int | str = -1,
        *,
        azimuth: float | None = None,
        elevation: float = 15.0,
        limits: tuple[float, float] | None = None,
        axes: Axes | None = None,
        **evaluation: Unpack[EvaluationOptions],
    ) -> Axes:
        """Draw the surface at a step, coloured by a field, into matplotlib axes, which are returned.

        Parameters
        ----------
        name : the field.
        step : number or name of the step; the last unless given.
        azimuth : direction about z from which the surface is seen, degrees from +x; the side that it faces unless
            given.
        elevation : angle from which it is seen above the horizontal, degrees.
        limits : of the colours, in the field's unit; from all steps unless given.
        axes : where to draw; a new figure unless given.

        >>> run.plot("lambda2", azimuth=60.0).get_title(loc="left")
        '0008-specimen'
        """
        from ringdic.pictures.axes import draw_surface
        from ringdic.pictures.scale import scale_of

        results = self.evaluated(**evaluation)
        number = self._step(step)
        return draw_surface(axes, results, scale_of(results, name, limits), number, azimuth, elevation)

    def view(
        self,
        name: str = "displacement",
        step: int | str = -1,
        *,
        limits: tuple[float, float] | None = None,
        show: bool = True,
        **evaluation: Unpack[EvaluationOptions],
    ) -> Plotter:
        """Show the surface at a step, coloured by a field, in an interactive 3D view in a window or notebook.

        Parameters
        ----------
        name : the field.
        step : number or name of the step; the last unless given.
        limits : of the colours, in the field's unit; from all steps unless given.
        show : open the view; False only returns the plotter of pyvista.

        Raises InputError where the extra ``viewer`` is not installed.
        """
        from ringdic.pictures.axes import surface_in_viewer
        from ringdic.pictures.scale import scale_of

        results = self.evaluated(**evaluation)
        plotter = surface_in_viewer(results, scale_of(results, name, limits), self._step(step))
        if show:
            plotter.show()
        return plotter

    def measure_point(
        self,
        position: Position,
        fields: Sequence[str] = (),
        *,
        within: float = 5.0,
        **evaluation: Unpack[EvaluationOptions],
    ) -> Table:
        """Position and fields of one material point through all steps, one row per step.

        Parameters
        ----------
        position : (x, y, z) mm in the reference; the nearest point of the surface is followed.
        fields : names; all unless given.
        within : largest distance from the position to the surface, mm.

        Raises InputError where the surface is farther away, or a field does not exist.

        >>> place = run.mesh().centroids[0]
        >>> table = run.measure_point(place, ["displacement", "lambda2"])
        >>> len(table["displacement"]) == len(run.steps)
        True
        """
        from ringdic.measure.place import nearest_place
        from ringdic.measure.series import time_series

        place = nearest_place(self.results.mesh, position, within)
        return time_series(self.evaluated(**evaluation), [place], fields)

    def measure_distance(
        self,
        start: Position,
        end: Position,
        *,
        within: float = 5.0,
        reference: Literal["first", "previous"] = "first",
    ) -> Table:
        """Virtual extensometer: length between two material points along the surface and straight, one row per step.

        Parameters
        ----------
        start, end : (x, y, z) mm in the reference; the nearest points of the surface are followed.
        within : largest distance from the positions to the surface, mm.
        reference : the step whose length a strain is related to: the "first" or the "previous" one.

        Raises InputError where the surface is farther away, ComputationError where no path along it joins the points.
        """
        from ringdic.measure.extensometer import extensometer
        from ringdic.measure.place import nearest_place

        ends = (nearest_place(self.results.mesh, position, within) for position in (start, end))
        return extensometer(self.evaluated(reference=reference), *ends)

    def measure_region(
        self,
        fields: Sequence[str] = (),
        *,
        box: tuple[Position, Position] | None = None,
        ball: tuple[Position, float] | None = None,
        faces: Sequence[int] | None = None,
        **evaluation: Unpack[EvaluationOptions],
    ) -> Table:
        """Statistics of fields, weighted by area, over a part of the reference surface at every step.

        Parameters
        ----------
        fields : names; all unless given.
        box : lower and upper corner, mm. ball : centre and radius, mm. faces : indices of triangles. At most one of
            them; the whole surface unless given.

        Raises InputError where more than one part is given, the part is empty, or a field does not exist.

        >>> float(run.measure_region(["displacement"])["mean"][0])
        0.0
        """
        from ringdic.measure.region import Ball, Box, Everything, Listed, Region, region_statistics

        if sum(part is not None for part in (box, ball, faces)) > 1:
            raise InputError("name one region: box, ball or faces")
        region: Region = Everything()
        if box is not None:
            region = Box(_three(box[0]), _three(box[1]))
        elif ball is not None:
            region = Ball(_three(ball[0]), float(ball[1]))
        elif faces is not None:
            region = Listed(tuple(int(face) for face in faces))
        return region_statistics(self.evaluated(**evaluation), region, fields)

    def measure_section(
        self,
        fields: Sequence[str] = (),
        *,
        z: float | None = None,
        azimuth: float | None = None,
        plane: tuple[Position, Position] | None = None,
        **evaluation: Unpack[EvaluationOptions],
    ) -> Table:
        """Fields along a cut through the reference surface, whose points are followed through all steps.

        Parameters
        ----------
        fields : names; all unless given.
        z : height of a horizontal plane, mm. azimuth : of a half-plane from the z axis, degrees from +x. plane : a
            point, mm, and a normal. Exactly one of them.

        Raises InputError where not exactly one cut is given, it misses the surface, or a field does not exist.
        """
        from math import radians

        from ringdic.measure.section import Cut, section

        if sum(choice is not None for choice in (z, azimuth, plane)) != 1:
            raise InputError("name one section: z, azimuth or plane")
        if z is not None:
            cut = Cut.at_height(z)
        elif azimuth is not None:
            cut = Cut.at_azimuth(radians(azimuth))
        else:
            assert plane is not None
            cut = Cut(_three(plane[0]), _three(plane[1]))
        return section(self.evaluated(**evaluation), cut, fields)

    def strain(
        self,
        window_mm: float | Sequence[float] = (0.0, 3.0, 5.0, 8.0, 12.0),
        *,
        reference: Literal["first", "previous"] = "first",
    ) -> Table:
        """Study of the strain window: strain, its scatter and the virtual strain gauge length for several widths.

        window_mm : widths of the window, mm; 0 for the strain of each triangle alone. reference : a step is compared
        with the "first" or the "previous" one. A row for each width and step.
        """
        from ringdic.measure.window_study import window_study

        widths = [window_mm] if isinstance(window_mm, int | float) else list(window_mm)
        return window_study(self.results, widths, reference == "previous")

    def export(
        self,
        path: str | Path,
        *,
        format: str | None = None,
        colour: str | None = None,
        **evaluation: Unpack[EvaluationOptions],
    ) -> Path:
        """Export the results in a file format of other programs; returns the file or folder that was written.

        Parameters
        ----------
        path : its suffix gives the format: .npz, .vtkhdf, .mat write one file; .vtp, .csv, .ply, .glb write one file a
            step into a folder of this name without the suffix.
        format : the format, where the path has another suffix or none; the path is then used unchanged.
        colour : field that ply and glb are coloured by; displacement unless given.

        Raises InputError for an unknown format or field, and where nothing can be written to the path.

        >>> run.export(folder / "results.npz").name
        'results.npz'
        """
        from ringdic.export import FOLDERS, FORMATS
        from ringdic.export import export as export_run

        path = Path(path)
        chosen = format or path.suffix.removeprefix(".").lower()
        if not chosen:
            raise InputError(f"{path}: end the name with one of .{', .'.join(FORMATS)}, or give the format")
        if format is None and chosen in FOLDERS:
            path = path.with_suffix("")
        return export_run(self.session.path, chosen, path, Evaluation.of(**evaluation), colour, self.number)

    def report(self, path: str | Path | None = None, progress: Callable[[float], None] = lambda _: None) -> Path:
        """Write the run's report as one self-contained HTML file; returns its path.

        path : the file; ``report.html`` in the run's folder unless given. progress : called with the share done.
        Raises InputError where nothing can be written to the path.
        """
        from ringdic.report import write_report

        return write_report(self.session.path, None if path is None else Path(path), self.number, progress)

    def _step(self, step: int | str) -> int:
        """Number of a step, from 0, given by a number, which may be negative, or by name."""
        count = len(self.steps)
        if isinstance(step, str):
            if step not in self.steps:
                raise InputError(f"no step '{step}'; there are {', '.join(self.steps)}")
            return self.steps.index(step)
        if not -count <= step < count:
            raise InputError(f"no step {step}; there are {count}, from 0, the reference")
        return int(step) % count


def _three(position: Position) -> tuple[float, float, float]:
    x, y, z = (float(coordinate) for coordinate in position)
    return x, y, z
