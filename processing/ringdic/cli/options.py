"""Options that several commands share, and the results that they select."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ringdic.results.evaluation import EvaluatedResults

Session = Annotated[Path, typer.Argument(help="The session folder.")]
Run = Annotated[int | None, typer.Option(help="Number of the processing run; the newest unless given.")]
Reference = Annotated[str, typer.Option(help="What a step is compared with: first or previous.")]
WithoutRigidMotion = Annotated[bool, typer.Option("--without-rigid-motion", help="Move each step back first.")]
Window = Annotated[float | None, typer.Option(metavar="MM", help="Strain window; the run's own unless given.")]
SethHill = Annotated[float | None, typer.Option(metavar="M", help="Strains of this exponent as well.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]


def results_of(
    session: Path,
    run: int | None,
    reference: str,
    without_rigid_motion: bool = False,
    window: float | None = None,
    exponent: float | None = None,
) -> EvaluatedResults:
    """Read the results of a run for evaluation with the given options. Raises InputError where there is no such run."""
    from ringdic.results.evaluation import Evaluation, evaluate_results
    from ringdic.session.folder import newest_results

    how = Evaluation.of(reference, without_rigid_motion, window, exponent)
    return evaluate_results(newest_results(session, run), how)
