"""The commands of ``ringdic``, each a thin call of the library's public functions.

Commands of other packages are added through the entry-point group ``ringdic.commands``: each entry names a function
that is called with the :class:`typer.Typer` application and adds its commands to it. This is how ``demo``,
``controller``, ``validate`` and ``bench`` get here without the library knowing the controller.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated

import typer

import ringdic
from ringdic.cli.archive import archive_app
from ringdic.cli.console import print_json, say, show_table
from ringdic.cli.measuring import measure_app, strain_command
from ringdic.cli.options import Accepted, AsJson, FamilyChoice, Session, spread_options
from ringdic.cli.reporting import animate_command, overlay_command, report_command
from ringdic.cli.rig import rig_app
from ringdic.findings import DO_NOT_USE_EXIT, Verdict

PLUGINS = "ringdic.commands"

Overrides = Annotated[list[str] | None, typer.Option("--set", metavar="GROUP.NAME=VALUE", help="Repeatable.")]
SettingsFile = Annotated[Path | None, typer.Option("--settings", help="Settings as a TOML file.")]


def run() -> None:
    """Read the command line and carry out its command."""
    application()()


@cache
def application() -> typer.Typer:
    """The application with the library's commands and those of the entry points ``ringdic.commands``."""
    app = typer.Typer(
        name="ringdic",
        help="Multi-view 3D digital image correlation, from trigger to strain map.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    app.callback()(_common_options)
    app.command("import")(import_command)
    app.command("load")(load_command)
    app.command("process")(process_command)
    app.command("correlate")(correlate_command)
    app.command("export")(export_command)
    app.command("report")(report_command)
    app.command("overlay")(overlay_command)
    app.command("animate")(animate_command)
    app.add_typer(measure_app)
    app.command("strain")(strain_command)
    app.add_typer(archive_app)
    app.add_typer(rig_app)
    for entry in entry_points(group=PLUGINS):
        entry.load()(app)
    return app


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ringdic {ringdic.__version__}")
        raise typer.Exit


def _common_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Multi-view 3D digital image correlation, from trigger to strain map."""


def import_command(
    source: Annotated[Path, typer.Argument(help="A folder with rig.toml, board, target and specimen.")],
    session: Annotated[Path, typer.Argument(help="The session folder to create.")],
    as_json: AsJson = False,
) -> None:
    """Create a session folder from a folder of images."""
    ringdic.import_folder(source, session)
    if as_json:
        print_json({"session": str(session)})
    else:
        say(f"imported {source} as session {session}")


def load_command(
    session: Session,
    table: Annotated[Path, typer.Argument(metavar="FILE.csv", help="Columns step or capture, and force [N], ….")],
    replace: Annotated[bool, typer.Option("--replace", help="Replace values that are archived already.")] = False,
    as_json: AsJson = False,
) -> None:
    """Archive load channels, such as force and travel, beside the captures; tables and exports then have them."""
    from ringdic.session.load_table import archive_load_table

    stored = archive_load_table(table, session, replace=replace)
    if as_json:
        print_json({"captures": {id_: [channel.name for channel in channels] for id_, channels in stored.items()}})
    else:
        for id_, channels in stored.items():
            say(f"{id_}: {', '.join(channel.name for channel in channels)}")


def process_command(
    session: Session,
    settings: SettingsFile = None,
    set_: Overrides = None,
    cluster: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Scheduler of a dask cluster.")] = None,
    accept: Accepted = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate, correlate, triangulate and compute strain, with nothing to click.

    Ends with exit code 4 where the verdict is "do not use".
    """
    finished = ringdic.process(session, settings, set=set_ or (), cluster=cluster, accept=accept or ())
    if as_json:
        print_json({"run": str(finished.path), **finished.summary})
    else:
        show_table(f"{session}: results in {finished.path}", finished.summary["table"])
    if finished.verdict is Verdict.DO_NOT_USE:
        raise typer.Exit(DO_NOT_USE_EXIT)


def correlate_command(
    ref: Annotated[Path, typer.Argument(metavar="REF", help="Reference image.")],
    cur: Annotated[Path, typer.Argument(metavar="CUR", help="Current image.")],
    out: Annotated[Path, typer.Option(help="Where the points go (npz).")],
    mask: Annotated[Path | None, typer.Option(help="Region of interest: an image, not 0 inside.")] = None,
    radius: Annotated[int, typer.Option(min=2, max=500, help="Subset radius, px.")] = 20,
    step: Annotated[int, typer.Option(min=1, help="Grid step, px.")] = 10,
    order: Annotated[int, typer.Option(min=1, max=2, help="Order of the shape function.")] = 1,
    subset: Annotated[str, typer.Option(help="circle or square.")] = "circle",
    threads: Annotated[int | None, typer.Option(min=1, help="Threads; all cores unless given.")] = None,
    accept: Accepted = None,
    as_json: AsJson = False,
) -> None:
    """2D digital image correlation of one pair of images.

    Ends with exit code 4 where the verdict is "do not use".
    """
    from ringdic.correlation.command import correlate_files
    from ringdic.correlation.settings import CorrelationSettings

    settings = CorrelationSettings(radius=radius, step=step, order=order, subset=subset)
    summary = correlate_files(ref, cur, out, settings, mask=mask, threads=threads, accept=accept or ())
    if as_json:
        print_json(summary)
    else:
        for finding in summary["findings"]:
            say(f"{finding['verdict']}: {finding['sentence']}")
        say(f"{summary['good']} of {summary['points']} points matched, written to {out}")
    if summary["verdict"] == Verdict.DO_NOT_USE:
        raise typer.Exit(DO_NOT_USE_EXIT)


@spread_options
def export_command(
    session: Session,
    format_: Annotated[str, typer.Option("--format", help="npz, vtkhdf, vtp, mat, csv, ply or glb.")] = "npz",
    out: Annotated[Path | None, typer.Option(help="File or folder to write; in the run's folder unless given.")] = None,
    colour: Annotated[str | None, typer.Option(help="Field that ply and glb are coloured by.")] = None,
    *,
    choice: FamilyChoice,
    as_json: AsJson = False,
) -> None:
    """Export results in a file format of other programs, with fields evaluated from the stored positions."""
    from ringdic.export import export as export_session

    written = export_session(session, format_, out, choice.evaluation(), colour, choice.run)
    if as_json:
        print_json({"written": str(written)})
    else:
        say(f"written {written}")
