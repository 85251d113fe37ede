"""``ringdic validate``: run the experiments at a scale and write tables, JSON, Markdown and plots."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ringdic import settings as presets
from ringdic.cli.console import say, show_table
from ringdic.errors import InputError
from ringdic.progress import progress_bar
from ringdic.settings import Settings
from ringdic_node.virtual_rig.render import load_renderer

from ringdic_controller.studies.validate import report
from ringdic_controller.studies.validate.experiments import EXPERIMENTS, Validation, figures
from ringdic_controller.studies.validate.figures import BETTER, PAPER
from ringdic_controller.studies.validate.plots import draw
from ringdic_controller.studies.validate.scenery import Scenery

_QUICK = {"boards": 8, "cylinder": 2, "limb": 2}


def run_validation(
    folder: Path, *, scale: float, quick: bool = False, only: Sequence[str] = (), images_only: bool = False
) -> dict[str, Any]:
    """Run the experiments both ways, write the comparison into ``folder`` and return it as JSON values.

    quick : fewer views of the board and fewer steps. only : names of experiments; all if empty. images_only : render
    missing images and stop. Images and results of an earlier run with the same settings in the folder are used again.
    Raises InputError for an experiment that does not exist.
    """
    unknown = [name for name in only if name not in EXPERIMENTS]
    if unknown:
        raise InputError(f"--only: there is no experiment '{unknown[0]}'; use {', '.join(EXPERIMENTS)}")
    began = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    scenery = Scenery(scale, **(_QUICK if quick else {}))
    ways = {PAPER: scaled(presets.PAPER, scale), BETTER: scaled(presets.Settings(), scale)}
    chosen = tuple(only) or EXPERIMENTS
    load_renderer()
    with progress_bar() as progress:
        validation = Validation(folder, scenery, ways, progress)
        if images_only:
            validation.render(chosen)
            return {"folder": str(folder), "seconds": validation.seconds}
        findings = validation.run(chosen)
    shown = figures(findings)
    camera = scenery.rig.cameras[0]
    about = {
        "folder": str(folder),
        "scale": scale,
        "cameras": len(scenery.rig.cameras),
        "size": [camera.width, camera.height],
        "boards": scenery.boards,
        "radius_px": ways[PAPER].correlation.radius_px,
        "step_px": ways[PAPER].correlation.step_px,
        "seconds": {**validation.seconds, "all": round(time.monotonic() - began, 1)},
    }
    plots = draw(folder, findings)
    totals = report.write(folder, shown, list(ways), about, plots)
    for experiment in dict.fromkeys(figure.experiment for figure in shown):
        own = [figure for figure in shown if figure.experiment == experiment]
        show_table(experiment, report.rows(own, list(ways)))
    show_table("which figures see the systematic errors of the paper's way", report.blindness(shown))
    say(f"{totals['reached']} of {totals['aimed_at']} aims reached; tables and plots in {folder}")
    return totals


def scaled(settings: Settings, scale: float) -> Settings:
    """Settings for images of a smaller scale; the subsets keep the least size that they need."""
    return settings.at_scale(scale)
