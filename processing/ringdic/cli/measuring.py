"""The commands ``ringdic measure …`` and ``ringdic strain``: measurements on results, as tables in CSV or JSON.

CSV goes to standard output, or to a file; notes go to standard error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ringdic.cli.console import print_json, say
from ringdic.cli.options import AsJson, FamilyChoice, RunChoice, Session, spread_options
from ringdic.errors import InputError

if TYPE_CHECKING:
    from ringdic.measure.region import Region
    from ringdic.measure.section import Cut
    from ringdic.measure.table import Table

measure_app = typer.Typer(
    name="measure",
    help="Measure on results: places and lengths through time, sections, statistics of regions.",
    no_args_is_help=True,
)

Fields = Annotated[list[str] | None, typer.Option("--field", help="Field to give; repeatable. All unless given.")]
Out = Annotated[Path | None, typer.Option(help="CSV file to write; standard output unless given.")]
Within = Annotated[float, typer.Option(metavar="MM", help="How far a position may be from the surface.")]


@dataclass(frozen=True)
class TableOutput:
    """Options that choose where a table goes: a CSV file, standard output, or standard output as JSON."""

    out: Out = None
    as_json: AsJson = False

    def give(self, table: Table, session: Path) -> None:
        """Write the table with the session's load, and its notes to standard error.

        Raises InputError where there is no folder for the file, or the load is damaged.
        """
        from ringdic.measure.load import with_load

        table = with_load(table, session)
        if self.out is not None:
            if not self.out.parent.is_dir():
                raise InputError(f"{self.out.parent}: no such folder to write into")
            self.out.write_text(table.to_csv(), encoding="utf-8")
            say(f"written {self.out}")
        for note in table.notes:
            say(note)
        if self.as_json:
            print_json(table.to_json())
        elif self.out is None:
            typer.echo(table.to_csv(), nl=False)


@measure_app.command("point")
@spread_options
def point_command(
    session: Session,
    at: Annotated[list[str] | None, typer.Option(metavar="X,Y,Z", help="Position, mm; repeatable.")] = None,
    vertex: Annotated[list[int] | None, typer.Option(help="Point by its index from 0; repeatable.")] = None,
    face: Annotated[list[int] | None, typer.Option(help="Face by its index from 0; repeatable.")] = None,
    within: Within = 5.0,
    field: Fields = None,
    *,
    evaluation: FamilyChoice,
    output: TableOutput,
) -> None:
    """Time series at material points: the nearest to positions in the reference, vertices or centroids of faces."""
    from ringdic.measure.place import nearest_place, place_of_face, place_of_vertex
    from ringdic.measure.series import time_series

    positions = [_numbers("--at", text, 3) for text in at or ()]
    if not (positions or vertex or face):
        raise InputError("name a place: --at X,Y,Z, --vertex INDEX or --face INDEX")
    results = evaluation.results(session)
    mesh = results.results.mesh
    places = [nearest_place(mesh, xyz, within) for xyz in positions]
    places += [place_of_vertex(mesh, index) for index in vertex or ()]
    places += [place_of_face(mesh, index) for index in face or ()]
    output.give(time_series(results, places, field or ()), session)


@measure_app.command("extensometer")
@spread_options
def extensometer_command(
    session: Session,
    from_: Annotated[str, typer.Option("--from", metavar="X,Y,Z", help="One end in the reference, mm.")],
    to: Annotated[str, typer.Option(metavar="X,Y,Z", help="The other end, mm.")],
    within: Within = 5.0,
    *,
    choice: RunChoice,
    output: TableOutput,
) -> None:
    """Virtual extensometer: length between two material points at every step, along the surface and straight."""
    from ringdic.measure.extensometer import extensometer
    from ringdic.measure.place import nearest_place

    ends = _numbers("--from", from_, 3), _numbers("--to", to, 3)
    results = choice.results(session)
    start, end = (nearest_place(results.results.mesh, xyz, within) for xyz in ends)
    output.give(extensometer(results, start, end), session)


@measure_app.command("section")
@spread_options
def section_command(
    session: Session,
    z: Annotated[float | None, typer.Option(help="The plane of this height, mm.")] = None,
    theta: Annotated[float | None, typer.Option(help="The half-plane from the axis at this azimuth, degrees.")] = None,
    plane: Annotated[str | None, typer.Option(metavar="X,Y,Z,NX,NY,NZ", help="Point, mm, and normal.")] = None,
    field: Fields = None,
    *,
    evaluation: FamilyChoice,
    output: TableOutput,
) -> None:
    """Fields along a cut of the reference surface, followed through all steps."""
    from ringdic.measure.section import section

    cut = _cut(z, theta, plane)
    results = evaluation.results(session)
    output.give(section(results, cut, field or ()), session)


@measure_app.command("region")
@spread_options
def region_command(
    session: Session,
    box: Annotated[str | None, typer.Option(metavar="X,Y,Z,X,Y,Z", help="Lower and upper corner, mm.")] = None,
    sphere: Annotated[str | None, typer.Option(metavar="X,Y,Z,R", help="Centre and radius, mm.")] = None,
    patch: Annotated[
        str | None, typer.Option(metavar="DEG,DEG,Z,Z", help="Azimuths, degrees, and heights, mm.")
    ] = None,
    faces: Annotated[str | None, typer.Option(metavar="I,I,…", help="Faces by their indices from 0.")] = None,
    field: Fields = None,
    *,
    evaluation: FamilyChoice,
    output: TableOutput,
) -> None:
    """Statistics of fields over a part of the reference surface; over all of it unless a part is named."""
    from ringdic.measure.region import region_statistics

    part = _region(box, sphere, patch, faces)
    results = evaluation.results(session)
    output.give(region_statistics(results, part, field or ()), session)


@spread_options
def strain_command(
    session: Session,
    window: Annotated[list[float] | None, typer.Option(metavar="MM", help="Width; repeatable. 0: no window.")] = None,
    *,
    choice: RunChoice,
    output: TableOutput,
) -> None:
    """Study the strain window: strain and its scatter over windows of several widths, without correlating again."""
    from ringdic.measure.window_study import window_study

    results = choice.results(session)
    widths = window or [0.0, 3.0, 5.0, 8.0, 12.0]
    output.give(window_study(results.results, widths, results.evaluation.previous), session)


def _cut(z: float | None, theta: float | None, plane: str | None) -> Cut:
    from ringdic.measure.section import Cut

    if sum(choice is not None for choice in (z, theta, plane)) != 1:
        raise InputError("name one section: --z MM, --theta DEGREES or --plane X,Y,Z,NX,NY,NZ")
    if z is not None:
        return Cut.at_height(z)
    if theta is not None:
        return Cut.at_azimuth(math.radians(theta))
    x, y, z, u, v, w = _numbers("--plane", plane or "", 6)
    return Cut((x, y, z), (u, v, w))


def _region(box: str | None, sphere: str | None, patch: str | None, faces: str | None) -> Region:
    from ringdic.measure.region import AngularPatch, Ball, Box, Everything, Listed

    if sum(choice is not None for choice in (box, sphere, patch, faces)) > 1:
        raise InputError("name one region: --box, --sphere, --patch or --faces")
    if box is not None:
        a, b, c, d, e, f = _numbers("--box", box, 6)
        return Box((a, b, c), (d, e, f))
    if sphere is not None:
        a, b, c, radius = _numbers("--sphere", sphere, 4)
        return Ball((a, b, c), radius)
    if patch is not None:
        begin, end, low, high = _numbers("--patch", patch, 4)
        return AngularPatch((math.radians(begin), math.radians(end)), (low, high))
    if faces is not None:
        try:
            return Listed(tuple(int(index) for index in faces.split(",")))
        except ValueError:
            raise InputError(f"--faces {faces}: wanted indices with commas between them, such as 3,17,18") from None
    return Everything()


def _numbers(option: str, text: str, count: int) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{option} {text}: wanted {count} numbers with commas between them")
    return values
