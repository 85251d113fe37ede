"""``ringdic report``, ``ringdic overlay`` and ``ringdic animate``: results as a page, as pictures, as films."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from controller.console import narrated, say
from controller.measuring import AsJson, Run
from processing.progress import Progress

Session = Annotated[Path, typer.Argument(help="The session folder.")]


def report(
    session: Session,
    out: Annotated[Path | None, typer.Option(help="HTML file; report.html beside the results unless given.")] = None,
    run: Run = None,
    as_json: AsJson = False,
) -> None:
    """One self-contained HTML page of a run: reporting tables, calibration, noise floor, maps."""
    from processing.report import write_report

    with narrated() as narrate:
        written = write_report(session, out, run, lambda done: narrate(Progress("report", done)))
    _told(written, as_json)


def _told(written: Path, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"written": str(written)}, ensure_ascii=False))
    else:
        say(f"written {written}")
