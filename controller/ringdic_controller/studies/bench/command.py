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
    data: Annotated[
        Path | None, typer.Option(help="Folder of MultiDIC's sample images; without it, synthetic ones.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Number of runs, of which the fastest counts.")] = 5,
    interpolation: Annotated[str, typer.Option(help="Spline of the images: cubic or quintic.")] = "cubic",
    job: Annotated[bool, typer.Option("--job", help="Time whole jobs, from images to results.")] = False,
    capture: Annotated[bool, typer.Option("--capture", help="Time captures of 12 and 30 nodes over loopback.")] = False,
    live: Annotated[bool, typer.Option("--live", help="Time live steps, captured one every 5 s.")] = False,
    all_: Annotated[bool, typer.Option("--all", help="Measure all parts; without any, the correlation.")] = False,
    steps: Annotated[str, typer.Option(help="For --job: specimen images a camera, such as 2,5,10,20.")] = "5",
    scale: Annotated[
        float, typer.Option(min=0.1, max=1.0, help="For --job and --live: size of the images; 1 is 2464 x 3280 px.")
    ] = 1.0,
    cameras: Annotated[int, typer.Option(min=6, max=30, help="For --job and --live: number of cameras.")] = 12,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="GROUP.NAME=VALUE", help="For --job and --live: a setting; repeatable."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of rendered images, kept for the next time.")] = _FOLDER,
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
