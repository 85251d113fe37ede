"""``ringdic …``: a thin table of commands over the packages' public functions.

Exit codes: 0 done, 2 bad input, 3 could not be computed, 1 a bug.
"""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from ringdic.cli import measuring, reporting
from ringdic.cli.console import narrated, show_table
from ringdic.cli.options import AsJson, Reference, Run, Session, SethHill, Window, WithoutRigidMotion
from ringdic.errors import InputError, RingdicError
from ringdic.progress import Progress
from ringdic.session.folder import open_session
from ringdic.settings import CorrelationGroup

from ringdic_controller.studies.bench.command import bench

app = typer.Typer(
    name="ringdic",
    help="Multi-view 3D digital image correlation, from trigger to strain map.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_DEFAULTS = CorrelationGroup()
Overrides = Annotated[list[str] | None, typer.Option("--set", metavar="GROUP.NAME=VALUE", help="Repeatable.")]
SettingsFile = Annotated[Path | None, typer.Option("--settings", help="Settings as a TOML file.")]
app.add_typer(measuring.measure)
app.command()(measuring.strain)
for _command in (reporting.report, reporting.overlay, reporting.animate, bench):
    app.command()(_command)


@app.command()
def demo(
    cameras: Annotated[int, typer.Option(min=6, max=30, help="Cameras; neighbours must share a view.")] = 12,
    scale: Annotated[float, typer.Option(min=0.1, max=1.0, help="Image size; 1 is 2464 x 3280 px.")] = 0.25,
    steps: Annotated[int, typer.Option(min=1, max=20, help="Deformed steps after the reference.")] = 3,
    no_serve: Annotated[bool, typer.Option("--no-serve", help="End after the table.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for everything the demo writes.")] = Path("ringdic-demo"),
    as_json: AsJson = False,
) -> None:
    """Capture, process and show a simulated rig: every node a process, every image over Zenoh."""
    from ringdic_controller.studies.demo import run_demo

    comparison = run_demo(out, cameras=cameras, scale=scale, steps=steps, serve=not no_serve)
    if as_json:
        _print_json(comparison)


@app.command()
def controller(
    config: Annotated[Path | None, typer.Option(help="The controller's configuration (TOML).")] = None,
) -> None:
    """Run the controller: router, archive, jobs and the page."""
    from ringdic_controller.service.config import read_controller_config
    from ringdic_controller.service.service import run_controller

    run_controller(read_controller_config(config), on_ready=typer.echo)


@app.command(name="import")
def import_(
    source: Annotated[Path, typer.Argument(help="A folder with rig.toml, board, target and specimen.")],
    session: Annotated[Path, typer.Argument(help="The session folder to make.")],
    as_json: AsJson = False,
) -> None:
    """Make a session of a folder of images."""
    from ringdic.session.importing import import_folder

    import_folder(source, session)
    if as_json:
        _print_json({"session": str(session)})
    else:
        typer.echo(f"imported {source} as session {session}", err=True)


@app.command()
def process(
    session: Session,
    settings: SettingsFile = None,
    set_: Overrides = None,
    cluster: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Scheduler of a dask cluster.")] = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate, correlate, triangulate and compute strain, with nothing to click."""
    from ringdic.settings import load_settings

    chosen = load_settings(settings, set_ or [])
    from ringdic.jobs.pipeline import process_session  # takes a while: what was typed is checked first

    executor = None
    if cluster is not None:
        from ringdic.jobs.cluster import ClusterExecutor

        executor = ClusterExecutor(cluster)
        session = open_session(session.resolve()).path  # the workers' working folders are others
    with narrated() as report:
        if executor is not None:
            report(Progress("prepare", 0.0, f"asking the workers of {cluster}"))
            executor.check(session)
        run = process_session(session, chosen, report, executor)
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    if as_json:
        _print_json({"run": str(run), **summary})
    else:
        show_table(f"{session}: results in {run}", summary["table"])


def _setting(name: str, text: str) -> Any:
    """An option with the bounds of a setting of the correlation."""
    limits: dict[str, Any] = CorrelationGroup.limits(name)
    return typer.Option(**limits, help=text)


@app.command()
def correlate(
    ref: Annotated[Path, typer.Argument(metavar="REF", help="Reference image.")],
    cur: Annotated[Path, typer.Argument(metavar="CUR", help="Current image.")],
    out: Annotated[Path, typer.Option(help="Where the points go (npz).")],
    mask: Annotated[Path | None, typer.Option(help="Region of interest: an image, not 0 inside.")] = None,
    radius: Annotated[int, _setting("radius_px", "Subset radius, px.")] = _DEFAULTS.radius_px,
    step: Annotated[int, _setting("step_px", "Grid step, px.")] = _DEFAULTS.step_px,
    order: Annotated[int, _setting("order", "Order of the shape function.")] = _DEFAULTS.order,
    subset: Annotated[str, typer.Option(help="circle or square.")] = _DEFAULTS.subset,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads; all cores unless given.")] = None,
    as_json: AsJson = False,
) -> None:
    """2D correlation of one pair of images."""
    from ringdic.correlation.command import correlate_files
    from ringdic.correlation.settings import CorrelationSettings

    settings = CorrelationSettings(radius=radius, step=step, order=order, subset=subset)
    summary = correlate_files(ref, cur, out, settings, mask=mask, threads=threads)
    if as_json:
        _print_json(summary)
    else:
        typer.echo(f"{summary['good']} of {summary['points']} points matched, written to {out}", err=True)


@app.command()
def export(
    session: Session,
    format_: Annotated[str, typer.Option("--format", help="npz, vtkhdf, vtp, mat, csv, ply or glb.")] = "npz",
    out: Annotated[Path | None, typer.Option(help="Where to; beside the results unless given.")] = None,
    reference: Reference = "first",
    without_rigid_motion: WithoutRigidMotion = False,
    window: Window = None,
    seth_hill: SethHill = None,
    colour: Annotated[str | None, typer.Option(help="Field that ply and glb are coloured by.")] = None,
    run: Run = None,
    as_json: AsJson = False,
) -> None:
    """Results in another program's form, evaluated anew from their positions."""
    from ringdic.export import export as export_session
    from ringdic.results.evaluation import Evaluation

    how = Evaluation.of(reference, without_rigid_motion, window, seth_hill)
    written = export_session(session, format_, out, how, colour, run)
    if as_json:
        _print_json({"written": str(written)})
    else:
        typer.echo(f"written {written}", err=True)


@app.command()
def validate(
    scale: Annotated[float, typer.Option(min=0.1, max=1.0, help="Image size; 1 is 2464 x 3280 px.")] = 1.0,
    out: Annotated[Path, typer.Option(help="Folder for images, sessions and tables; kept for the next run.")] = Path(
        "ringdic-validate"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer board views and steps.")] = False,
    only: Annotated[list[str] | None, typer.Option(metavar="EXPERIMENT", help="One experiment; repeatable.")] = None,
    images_only: Annotated[bool, typer.Option("--images-only", help="Render the images and stop.")] = False,
    as_json: AsJson = False,
) -> None:
    """The paper's experiments on the virtual rig, beside the paper's figures."""
    from ringdic_controller.studies.validate import run_validation

    found = run_validation(out, scale=scale, quick=quick, only=only or (), images_only=images_only)
    if as_json:
        _print_json(found)


def main() -> None:
    """The command's entry: sentences instead of tracebacks for whatever an operator can mend."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s", stream=sys.stderr)
    try:
        app()
    except RingdicError as error:
        typer.echo(f"ringdic: {error}", err=True)
        sys.exit(error.exit_code)
    except OSError as error:  # a folder that may not be written, a full disk: the operator's to mend
        if error.filename is None:
            raise
        typer.echo(
            f"ringdic: {error.filename}: {error.strerror}; check the path, its permissions and the disk", err=True
        )
        sys.exit(InputError.exit_code)


def _print_json(value: dict[str, Any]) -> None:
    typer.echo(json.dumps(value, ensure_ascii=False, default=float))
