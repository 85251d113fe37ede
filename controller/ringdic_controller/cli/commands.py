"""The commands ``demo``, ``controller``, ``rig``, ``users``, ``validate``, ``chaos``, ``bench``, added to ``ringdic``.

Importing this module needs no package of the extra ``controller``, so that ``ringdic --help`` lists the commands
wherever the library is installed; a command whose packages are missing says which extra to install.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer
from ringdic.cli.console import print_json, say
from ringdic.cli.options import AsJson
from ringdic.cli.rig import rig_app

from ringdic_controller.cli.rig import RIG_COMMANDS
from ringdic_controller.cli.users import users_app
from ringdic_controller.studies.bench.command import bench_command


def add_commands(app: typer.Typer) -> None:
    """Add the controller's commands to the application ``ringdic``."""
    app.command("demo")(demo_command)
    app.command("controller")(controller_command)
    app.command("validate")(validate_command)
    app.command("chaos")(chaos_command)
    app.command("bench")(bench_command)
    app.add_typer(users_app)
    for name, command in RIG_COMMANDS.items():
        rig_app.command(name)(command)


def demo_command(
    cameras: Annotated[int, typer.Option(min=6, max=30, help="Cameras; neighbours must share a view.")] = 12,
    scale: Annotated[float, typer.Option(min=0.1, max=1.0, help="Size of the images; 1 is 2464 x 3280 px.")] = 0.25,
    steps: Annotated[int, typer.Option(min=1, max=20, help="Deformed steps after the reference.")] = 3,
    no_serve: Annotated[
        bool, typer.Option("--no-serve", help="End after the table, without keeping the page up.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for everything the demo writes.")] = Path("ringdic-demo"),
    as_json: AsJson = False,
) -> None:
    """Capture with a simulated rig, process and show the results: each node is a process, images go over Zenoh."""
    _need_controller()
    from ringdic_controller.studies.demo import run_demo

    comparison = run_demo(out, cameras=cameras, scale=scale, steps=steps, serve=not no_serve)
    if as_json:
        print_json(comparison)


def controller_command(
    config: Annotated[Path | None, typer.Option(help="The controller's configuration (TOML).")] = None,
) -> None:
    """Run the controller: router, archive, jobs and the page."""
    _need_controller()
    from ringdic_controller.service.config import read_controller_config
    from ringdic_controller.service.service import run_controller

    run_controller(read_controller_config(config), on_ready=typer.echo)


def validate_command(
    scale: Annotated[
        float | None,
        typer.Option(
            min=0.1, max=1.0, help="Size of the images, 1 is 2464 x 3280 px; by default 1, for bodies and mishaps 0.3."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for images, sessions and tables; kept for the next run.")] = Path(
        "ringdic-validate"
    ),
    bodies: Annotated[
        bool, typer.Option("--bodies", help="A gallery of bodies on different rigs, instead of the experiments.")
    ] = False,
    mishaps: Annotated[
        bool,
        typer.Option("--mishaps", help="What goes wrong in a laboratory, and what the program says, instead of those."),
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer board views and steps of the experiments.")] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="One experiment; or bodies, rigs and rows of the gallery, or mishaps, their groups "
            "and rigs, by commas; repeatable.",
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="A setting other than the default, for bodies and mishaps; repeatable."
        ),
    ] = None,
    images_only: Annotated[bool, typer.Option("--images-only", help="Render the images and stop.")] = False,
    as_json: AsJson = False,
) -> None:
    """Repeat the paper's experiments on the virtual rig and compare with the paper's figures."""
    if bodies or mishaps:
        from ringdic_controller.studies.gallery import run_gallery
        from ringdic_controller.studies.mishaps import run_mishaps

        names = [name for each in only or () for name in each.split(",")]
        size, study = 0.3 if scale is None else scale, run_mishaps if mishaps else run_gallery
        findings = study(out, scale=size, only=names, overrides=overrides or (), images_only=images_only)
    else:
        from ringdic_controller.studies.validate import run_validation

        size = 1.0 if scale is None else scale
        findings = run_validation(out, scale=size, quick=quick, only=only or (), images_only=images_only)
    if as_json:
        print_json(findings)


def chaos_command(
    cameras: Annotated[int, typer.Option(min=1, max=60, help="Nodes.")] = 12,
    captures: Annotated[int, typer.Option(min=1, help="Captures, one after the other.")] = 300,
    scale: Annotated[float, typer.Option(min=0.02, max=1.0, help="Size of the images; 1 is 3280 x 2464 px.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the plan of what fails when.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for archive, spools and logs.")] = Path("ringdic-chaos"),
    as_json: AsJson = False,
) -> None:
    """Capture while nodes, controller, disks and network fail as planned, and audit that nothing was lost."""
    _need_controller()
    from ringdic_controller.studies.chaos import run_chaos

    pixels = (round(3280 * scale), round(2464 * scale))
    audit = run_chaos(out, cameras=cameras, captures=captures, size=pixels, seed=seed, say=say)
    if as_json:
        print_json(audit)


def _need_controller() -> None:
    """Fail at once, and not only in a child process, if packages of the extra ``controller`` are missing."""
    for package in ("fastapi", "uvicorn"):
        import_module(package)
