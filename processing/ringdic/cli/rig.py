"""The commands ``ringdic rig …``: what is needed to build and to run a rig. The controller's package adds more."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ringdic.cli.console import print_json, say
from ringdic.cli.options import AsJson, Run, Session
from ringdic.errors import InputError

rig_app = typer.Typer(name="rig", help="Build a rig: what to print, to write and to check.", no_args_is_help=True)


@rig_app.command("target")
def target_command(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="The file rig.toml, or the folder that holds it.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the sheets.")] = Path("."),
    charuco: Annotated[bool, typer.Option("--charuco", help="Also the board with markers in it.")] = False,
    speckle: Annotated[float | None, typer.Option(metavar="MM", help="Also a sheet of speckles of this size.")] = None,
    speckle_sheet: Annotated[str, typer.Option(metavar="MMxMM", help="Width and height of that sheet.")] = "180x250",
    seed: Annotated[int, typer.Option(min=0, help="Another number gives other speckles.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Write the calibration target, the board and speckles as PDF at true scale, with rulers to check the print by."""
    from ringdic.prints.patterns import board_sheet, charuco_sheet, dot_sheet
    from ringdic.prints.patterns import speckle_sheet as sheet_of_speckles
    from ringdic.prints.sheet import write_sheet
    from ringdic.session.rig import read_rig

    described = read_rig(rig / "rig.toml" if rig.is_dir() else rig)
    sheets = {"target": dot_sheet(described.target), "board": board_sheet(described.board)}
    if charuco:
        sheets["charuco"] = charuco_sheet(described.board)
    if speckle is not None:
        sheets["speckles"] = sheet_of_speckles(speckle, *_two_lengths(speckle_sheet), seed=seed)
    out.mkdir(parents=True, exist_ok=True)
    written = {name: out / f"{name}.pdf" for name in sheets}
    for name, path in written.items():
        write_sheet(sheets[name], path)
        if not as_json:
            width, height = sheets[name].page
            say(f"written {path}, {width:.0f} × {height:.0f} mm: {sheets[name].name}")
    if as_json:
        print_json({name: str(path) for name, path in written.items()})


@rig_app.command("synchrony")
def synchrony_command(
    session: Session,
    run: Run = None,
    period: Annotated[float | None, typer.Option(metavar="S", help="Time between steps, of imported images.")] = None,
    as_json: AsJson = False,
) -> None:
    """Measure each camera's true time of exposure from a moving body: at rest first, then at six steps or more."""
    from ringdic.measure.synchrony_of_session import session_synchrony

    report = session_synchrony(session, run, period)
    if as_json:
        print_json(report.to_json())
        return
    for line in report.lines():
        say(line)


def _two_lengths(text: str) -> tuple[float, float]:
    """Width and height, mm, from text such as ``180x250``. Raises InputError for any other text."""
    try:
        width, height = (float(each) for each in text.lower().split("x"))
    except ValueError as error:
        raise InputError(f"--speckle-sheet is width x height in mm, such as 180x250, not '{text}'") from error
    return width, height
