"""The command ``ringdic bench``: which parts are measured, and how they compare with an earlier result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from ringdic.cli.console import print_json, say
from ringdic.errors import InputError

Ratios = Callable[[dict[str, Any], dict[str, Any]], list[dict[str, Any]]]

_FOLDER = Path("ringdic-bench")


def bench_command(
    data: Annotated[Path | None, typer.Option(help="Folder of the MultiDIC rig; else synthetic.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of which the best counts.")] = 5,
    interpolation: Annotated[str, typer.Option(help="cubic or quintic.")] = "cubic",
    job: Annotated[bool, typer.Option("--job", help="A whole job, from the specimen's images to the results.")] = False,
    capture: Annotated[bool, typer.Option("--capture", help="Captures of 12 and 30 nodes over loopback.")] = False,
    live: Annotated[bool, typer.Option("--live", help="Steps every 5 s until each is on the page.")] = False,
    all_: Annotated[bool, typer.Option("--all", help="Every part; alone, the correlation is measured.")] = False,
    steps: Annotated[str, typer.Option(help="Of the job: images of the specimen a camera, such as 2,5,10,20.")] = "5",
    scale: Annotated[
        float, typer.Option(min=0.1, max=1.0, help="Of the images of job and live; 1 is 2464 x 3280 px.")
    ] = 1.0,
    cameras: Annotated[int, typer.Option(min=6, max=30, help="Of job and live.")] = 12,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="GROUP.NAME=VALUE", help="Of job and live.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of images that are rendered, kept for the next time.")] = _FOLDER,
    compare: Annotated[Path | None, typer.Option(help="An earlier result (JSON) to compare with.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Measure how fast the correlation is on this machine and, if asked for, a whole job, captures and live steps."""
    from ringdic.correlation.bench import bench_correlation, read_result

    before = read_result(compare) if compare is not None else None
    counts = _counts(steps)
    result: dict[str, Any] = {}
    if all_ or not (job or capture or live):
        result["correlation"] = bench_correlation(data, repeats=repeats, interpolation=interpolation, say=say)
    if all_ or job:
        from ringdic_controller.studies.bench.job import bench_job

        result["job"] = bench_job(out, counts, scale=scale, cameras=cameras, settings=set_ or [], say=say)
    if all_ or capture:
        from ringdic_controller.studies.bench.capture import bench_capture

        result["capture"] = bench_capture(say=say)
    if all_ or live:
        from ringdic.settings import load_settings

        from ringdic_controller.studies.bench.live import bench_live

        chosen = load_settings(None, set_ or [])
        result["live"] = bench_live(out / "live", cameras=cameras, scale=scale, settings=chosen, say=say)
    if before is not None:
        result["ratios"] = compared(result, before)
        for row in result["ratios"]:
            say("  ".join(f"{name} {value:.3g}" if name != "part" else value for name, value in row.items()))
    if as_json:
        print_json(result)


def compared(new: dict[str, Any], old: dict[str, Any]) -> list[dict[str, Any]]:
    """Ratios to an earlier result, a row for each run that both results have; a ratio above 1 is better.

    Each row names its part of the benchmark. Raises InputError if they have no part in common.
    """
    from ringdic.correlation.bench import ratios

    from ringdic_controller.studies.bench.capture import capture_ratios
    from ringdic_controller.studies.bench.job import job_ratios
    from ringdic_controller.studies.bench.live import live_ratios

    known: dict[str, Ratios] = {
        "correlation": lambda one, other: ratios({"correlation": one}, {"correlation": other}),
        "job": job_ratios,
        "capture": capture_ratios,
        "live": live_ratios,
    }
    shared = {part: ratios_of for part, ratios_of in known.items() if part in new and part in old}
    if not shared:
        raise InputError("the two results have no part in common; compare results of the same command")
    return [{"part": part, **row} for part, ratios_of in shared.items() for row in ratios_of(new[part], old[part])]


def _counts(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"--steps {text}: give whole numbers with commas between, such as 2,5,10,20") from None
