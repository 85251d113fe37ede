"""Writing the report of a run: gather its fields, fill the sections, write the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from uuid import uuid4

import numpy as np

from ringdic.errors import InputError
from ringdic.findings import Finding, Verdict
from ringdic.mesh.mesh import Mesh
from ringdic.pictures.scale import Scale, palette
from ringdic.pictures.views import View, from_side, mean_azimuth, unrolled
from ringdic.report import plots, tables
from ringdic.report.document import Document, figure
from ringdic.report.gathered import Gathered, gather
from ringdic.report.hardware import camera_facts
from ringdic.report.noise import STATED, noise, noise_rows
from ringdic.report.unmeasured import unmeasured
from ringdic.results.evaluation import EvaluatedResults, evaluate_results
from ringdic.results.results import Results
from ringdic.session.folder import Session, newest_results, open_session

#: Fields that get maps, where the run has them.
_MAPS = (
    "displacement", "displacement_x", "displacement_y", "displacement_z", "lambda1", "lambda2", "J", "E1", "E2",
    "E_equivalent", "window_lambda1", "window_lambda2",
)  # fmt: skip
_CERTAINTY = (
    "sigma", "sigma_displacement", "sigma_lambda1", "sigma_lambda2", "sigma_calibration", "chi2", "correlation",
)  # fmt: skip
_COURSES = ("displacement", "J", "lambda1", "lambda2", "E_equivalent", "correlation")
_STEPS_SHOWN = 4
_WORTHWHILE = 0.2  # share of a view that must show the surface's outer side


def write_report(
    session_path: Path,
    out: Path | None = None,
    run: int | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Path:
    """Write the report of a run and return the path of its HTML file.

    session_path : the session's folder. out : the HTML file, by default ``report.html`` in the run's folder. run : its
    number, the newest unless given. progress : called with the share done.
    Raises InputError where there is no run, or nothing can be written to ``out``.
    """
    results_path = newest_results(session_path, run)
    out = results_path.parent / "report.html" if out is None else Path(out)
    if out.is_dir() or not out.parent.is_dir():
        raise InputError(f"{out}: not a file in a folder that is there; give the name of an HTML file")
    session, results = open_session(session_path), evaluate_results(results_path)
    source = results.results
    document = Document(
        f"{session.name}: report of run {results_path.parent.name}",
        f"Rig {source.rig}, {len(source.cameras)} cameras, {len(source.steps) - 1} steps after the reference; "
        f"measured by RingDIC {_version()}",
    )
    _summary(document, source)
    gathered = gather(
        results,
        list(dict.fromkeys((*_MAPS, *_CERTAINTY, *STATED))),
        shown_steps(len(results.steps)),
        lambda s: progress(0.3 * s),
    )
    _describe(document, session, source, gathered)
    progress(0.5)
    _pictures(document, results, gathered, lambda share: progress(0.5 + 0.45 * share))
    document.section("settings", "Settings of the run")
    document.verbatim("settings-toml", source.settings)
    aside = out.with_name(f".{out.name}.{uuid4().hex}.partial")
    try:
        aside.write_text(document.to_html(), encoding="utf-8")
        aside.replace(out)
    finally:
        aside.unlink(missing_ok=True)
    progress(1.0)
    return out


def _summary(document: Document, results: Results) -> None:
    document.section("summary", "At a glance")
    if "verdict" in results.summary:
        findings = map(Finding.from_json, results.summary["findings"])
        document.verdict(Verdict(results.summary["verdict"]), findings)
    else:  # a run of version 0.1.0
        document.sentences(results.summary.get("warnings", []))
    own = {"verdict", "warning", *Verdict}
    rows = [list(row.values()) for row in results.summary.get("table", []) if row.get("figure") not in own]
    document.facts("figures", {str(row[0]): row[1] for row in rows if len(row) > 1})


def _describe(document: Document, session: Session, results: Results, gathered: Gathered) -> None:
    document.section("hardware", "Hardware")
    tables.hardware(document, session, results, camera_facts(session, results))
    document.section("analysis", "Analysis")
    tables.analysis(document, results, _version(), noise_rows(results, gathered))
    document.section("calibration", "Calibration")
    tables.calibration(document, session, results)
    document.section("noise", "Noise and uncertainty")
    noise(document, results, gathered)
    document.section("measured", "Steps")
    tables.steps(document, session, results)
    unmeasured(document, session, results)


def _pictures(
    document: Document, results: EvaluatedResults, gathered: Gathered, progress: Callable[[float], None]
) -> None:
    document.section("courses", "Courses and statistics")
    document.picture(
        "courses-plot",
        plots.courses(gathered, [name for name in _COURSES if name in gathered.scales]),
        "Medians over the surface, and the band from the 5th to the 95th percentile.",
    )
    _statistics(document, gathered)
    document.picture(
        "histograms-plot",
        plots.histograms(gathered, [name for name in (*_MAPS, *_CERTAINTY) if name in gathered.scales]),
        "Shares of points or triangles; what lies beyond a scale's limits is counted at its ends.",
    )
    views = _views(results, gathered.shown)
    progress(0.2)
    done = 0
    for key, title, chosen in (("maps", "Maps", _MAPS), ("certainty", "Maps of uncertainty and quality", _CERTAINTY)):
        document.section(key, title)
        if key == "maps":
            document.text(_how_to_read(results, gathered.shown))
        for name in chosen:
            if name in gathered.scales:
                scale = gathered.scales[name]
                document.picture(f"map-{name}", plots.maps(gathered, scale, views), _caption(scale), palette(scale))
                done += 1
                progress(0.2 + 0.8 * done / len(gathered.scales))


def _statistics(document: Document, gathered: Gathered) -> None:
    names = ("mean", "std", "median", "p5", "p95", "min", "max")

    def digits(field: str) -> int:
        return 6 if gathered.scales[field].field.centre == 1.0 else 4  # stretches differ in the last ones

    document.heading("Statistics over the whole surface")
    document.table(
        "statistics",
        ("field", "step", "mean", "STD", "median", "5 %", "95 %", "least", "greatest"),
        (
            (gathered.scales[field].title, gathered.steps[step], *(figure(row[name], digits(field)) for name in names))
            for (field, step), row in sorted(
                gathered.statistics.items(), key=lambda item: (list(gathered.scales).index(item[0][0]), item[0][1])
            )
            if step > 0 or len(gathered.steps) == 1
        ),
        "Mean and standard deviation are weighted by the area in the reference.",
    )


def shown_steps(count: int) -> list[int]:
    """Indices of the steps that get maps: all after the reference, or a few spread evenly that include the last."""
    if count == 1:
        return [0]
    return sorted({int(k) for k in np.rint(np.linspace(1, count - 1, min(_STEPS_SHOWN, count - 1)))})


def _views(results: EvaluatedResults, steps: Sequence[int]) -> list[plots.StepViews]:
    """Views of the steps shown. Maps are drawn over the reference, so that material points keep their positions."""
    reference = unrolled(results.results.mesh)
    front = mean_azimuth(results.results.mesh)
    views = []
    for step in steps:
        mesh = Mesh(results.positions(step), results.results.faces)
        sides: list[tuple[str, View]] = []
        for azimuth in (front, front + np.pi) if mesh.whole_faces().any() else ():
            view = from_side(mesh, azimuth)
            if not sides or view.outside_share > _WORTHWHILE:
                sides.append((f"from {np.degrees(azimuth) % 360:.0f}°", view))
        views.append(plots.StepViews(step, results.steps[step], reference, sides))
    fewest = min(len(step.sides) for step in views)
    return [plots.StepViews(each.step, each.name, each.unrolled, each.sides[:fewest]) for each in views]


def _how_to_read(results: EvaluatedResults, steps: Sequence[int]) -> str:
    which = (
        "all steps" if len(steps) >= len(results.steps) - 1 else f"{len(steps)} of the {len(results.steps) - 1} steps"
    )
    return (
        f"Shown are {which}: left the surface unrolled over azimuth and height of the reference, so that a place of "
        "the material stays where it is; right the body as it stood, from 15° above. Blank: not measured. Light grey: "
        "the inner side. One scale serves all steps of a field; it spans the 2nd to the 98th percentile."
    )


def _caption(scale: Scale) -> str:
    about = f", about {scale.field.centre:g}" if scale.field.centre is not None else ""
    return f"{scale.title}. Colours from {figure(scale.low)} to {figure(scale.high)}{about}."


def _version() -> str:
    try:
        return version("ringdic")
    except PackageNotFoundError:
        return "(not installed)"
