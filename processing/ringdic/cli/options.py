"""Options that several commands share, alone and in groups, and the results that they select."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from ringdic.results.evaluation import EvaluatedResults, Evaluation

Session = Annotated[Path, typer.Argument(help="The session folder.")]
Run = Annotated[int | None, typer.Option(help="Number of the processing run; the newest unless given.")]
Reference = Annotated[str, typer.Option(help="What a step is compared with: first or previous.")]
WithoutRigidMotion = Annotated[bool, typer.Option("--without-rigid-motion", help="Move each step back first.")]
Window = Annotated[float | None, typer.Option(metavar="MM", help="Strain window; the run's own unless given.")]
SethHill = Annotated[float | None, typer.Option(metavar="M", help="Strains of this exponent as well.")]
Accepted = Annotated[list[str] | None, typer.Option(metavar="CODE", help="A finding to accept. Repeatable.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]


@dataclass(frozen=True)
class RunChoice:
    """Options that choose a run of a session, and what its steps are compared with."""

    run: Run = None
    reference: Reference = "first"

    def evaluation(self) -> Evaluation:
        """How the fields of the run are evaluated. Raises InputError for an option that is not allowed."""
        from ringdic.results.evaluation import Evaluation

        return Evaluation.of(**{name: value for name, value in vars(self).items() if name != "run"})

    def results(self, session: Path) -> EvaluatedResults:
        """Read the results of the run for evaluation with these options. Raises InputError where there is none."""
        from ringdic.results.evaluation import evaluate_results
        from ringdic.session.folder import newest_results

        return evaluate_results(newest_results(session, self.run), self.evaluation())


@dataclass(frozen=True)
class EvaluationChoice(RunChoice):
    """Options that choose a run of a session, and how its fields are evaluated."""

    without_rigid_motion: WithoutRigidMotion = False
    window: Window = None


@dataclass(frozen=True)
class FamilyChoice(EvaluationChoice):
    """Options that choose a run of a session, how its fields are evaluated, and one more family of strains."""

    seth_hill: SethHill = None


def spread_options(command: Callable[..., None]) -> Callable[..., None]:
    """The command with each parameter that is a class of options replaced by these options, each by itself.

    command : function with annotations for typer; a parameter may be a dataclass whose fields have such annotations.
    """
    signature = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {
        name: one.annotation for name, one in signature.parameters.items() if is_dataclass(one.annotation)
    }

    @wraps(command)
    def spread(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{option.name: given.pop(option.name) for option in fields(group)})
        command(**given)

    parameters: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        options = inspect.signature(groups[name], eval_str=True).parameters.values() if name in groups else [parameter]
        parameters += [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    spread.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return spread
