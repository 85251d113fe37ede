"""The commands ``ringdic report``, ``ringdic overlay`` and ``ringdic animate``: results as report, pictures, films."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ringdic.cli.console import print_json, say
from ringdic.cli.options import AsJson, EvaluationChoice, Run, Session, spread_options
from ringdic.errors import InputError
from ringdic.progress import Progress, progress_bar

if TYPE_CHECKING:
    from ringdic.pictures.scale import Scale
    from ringdic.results.evaluation import EvaluatedResults
    from ringdic.session.folder import Session as Captured

FieldName = Annotated[str, typer.Option("--field", help="Field that gives the colours.")]
Limits = Annotated[str | None, typer.Option(metavar="LOW,HIGH", help="Of the colours; from all steps unless given.")]
Opacity = Annotated[float, typer.Option(min=0.0, max=1.0, help="Of the colours over the photograph.")]
Camera = Annotated[str | None, typer.Option(help="Camera whose photographs are used.")]


def report_command(
    session: Session,
    out: Annotated[Path | None, typer.Option(help="HTML file; report.html in the run's folder unless given.")] = None,
    run: Run = None,
    as_json: AsJson = False,
) -> None:
    """Write the report of a run as one HTML page: reporting tables, calibration, noise floor, maps."""
    from ringdic.report import write_report

    with progress_bar() as show:
        written = write_report(session, out, run, lambda done: show(Progress("report", done)))
    _tell_written([written], as_json)


@spread_options
def overlay_command(
    session: Session,
    field: FieldName = "lambda2",
    camera: Annotated[list[str] | None, typer.Option(help="Camera; repeatable. All unless given.")] = None,
    step: Annotated[int | None, typer.Option(help="Step from 0, the reference; the last unless given.")] = None,
    limits: Limits = None,
    opacity: Opacity = 0.65,
    out: Annotated[Path, typer.Option(help="Folder for the pictures, one PNG a camera.")] = Path("."),
    bar: Annotated[bool, typer.Option(help="Whether to add the colour bar.")] = True,
    *,
    evaluation: EvaluationChoice,
    as_json: AsJson = False,
) -> None:
    """Draw a field over the cameras' photographs of a step."""
    from PIL import Image

    from ringdic.pictures.overlay import overlay, photograph, with_bar
    from ringdic.session.folder import open_session

    results = evaluation.results(session)
    scale = _scale(results, field, limits)
    number = _step(results, step)
    captured = open_session(session)
    name = results.steps[number]
    cameras = camera or _photographed(captured, name, results)
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for id_ in cameras:
        picture = overlay(results, id_, photograph(captured, name, id_), scale, number, opacity)
        path = out / f"{field.replace(':', '-')}-{name}-{id_}.png"
        Image.fromarray(with_bar(picture, scale) if bar else picture).save(path)
        written.append(path)
    _tell_written(written, as_json)


@spread_options
def animate_command(
    session: Session,
    out: Annotated[Path, typer.Option(help="The .gif or .mp4 file.")],
    field: FieldName = "lambda2",
    camera: Camera = None,
    azimuth: Annotated[float | None, typer.Option(help="Degrees from which the body is seen.")] = None,
    limits: Limits = None,
    seconds: Annotated[float, typer.Option(min=0.02, max=60.0, help="Each step is shown for.")] = 0.8,
    size: Annotated[int, typer.Option(min=64, max=4096, help="Longer side of the picture, px.")] = 720,
    opacity: Opacity = 0.65,
    *,
    evaluation: EvaluationChoice,
    as_json: AsJson = False,
) -> None:
    """Animate a field over all steps as GIF or MP4: on one camera's photographs, or on the body seen from a side."""
    from ringdic.pictures.animation import overlay_frames, surface_frames, write_animation
    from ringdic.pictures.views import mean_azimuth
    from ringdic.session.folder import open_session

    if camera is not None and azimuth is not None:
        raise InputError("--camera shows its photographs, --azimuth the body without them; give one of them")
    results = evaluation.results(session)
    scale = _scale(results, field, limits)
    if camera is not None:
        frames = overlay_frames(results, open_session(session), camera, scale, size, opacity)
    else:
        front = mean_azimuth(results.results.mesh) if azimuth is None else math.radians(azimuth)
        frames = surface_frames(results, scale, front, size)
    write_animation(out, list(frames), seconds)
    _tell_written([out], as_json)


def _scale(results: EvaluatedResults, field: str, limits: str | None) -> Scale:
    from ringdic.pictures.scale import scale_of

    return scale_of(results, field, None if limits is None else _two(limits))


def _two(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--limits {text}: not two numbers with a comma between, such as 0.9,1.1") from None
    return low, high


def _step(results: EvaluatedResults, step: int | None) -> int:
    count = len(results.steps)
    if step is None:
        return count - 1
    if not 0 <= step < count:
        raise InputError(f"--step {step}: there are {count} steps, from 0, the reference")
    return step


def _photographed(session: Captured, capture_id: str, results: EvaluatedResults) -> list[str]:
    """Cameras of the run that have an image in a capture."""
    images = {id_ for capture in session.captures if capture.id == capture_id for id_ in capture.images}
    return [camera.id for camera in results.results.cameras if camera.id in images]


def _tell_written(written: list[Path], as_json: bool) -> None:
    if as_json:
        paths = [str(path) for path in written]
        print_json({"written": paths[0] if len(paths) == 1 else paths})
    else:
        for path in written:
            say(f"written {path}")
