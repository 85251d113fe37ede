"""Evaluation of stored results with another reference step, strain window or family of strains than the run's.

Every field is computed from the stored positions; no image is correlated again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ringdic.arrays import Indices, Mask, Points
from ringdic.errors import InputError
from ringdic.mesh.mesh import Mesh
from ringdic.results.fields import Field, StepFields, available, field, seth_hill_fields
from ringdic.results.ranges import Ranges, even_limits
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.strain.window import StrainWindow, strain_window
from ringdic.uncertainty.window import WindowScatter


@dataclass(frozen=True)
class Evaluation:
    """Options by which fields are computed from the measured positions.

    previous : each step is compared with the one before it, instead of with the reference.
    rigid_motion_removed : each step is first moved back by its rigid motion.
    window : width of the strain window, mm; 0 for none, None for that of the run's settings.
    exponent : of a Seth-Hill family of strains to add to the others; None for none.

    Raises InputError for a width outside 0 … 1000 mm or an exponent outside -20 … 20.
    """

    previous: bool = False
    rigid_motion_removed: bool = False
    window: float | None = None
    exponent: float | None = None

    def __post_init__(self) -> None:
        if self.window is not None and not 0 <= self.window <= 1000:
            raise InputError(f"a strain window is from 0 (none) to 1000 mm wide, not {self.window:g}")
        if self.exponent is not None and not -20 <= self.exponent <= 20:
            raise InputError(f"the exponent of a family of strains is from -20 to 20, not {self.exponent:g}")

    @classmethod
    def of(
        cls,
        reference: str = "first",
        without_rigid_motion: bool = False,
        window: float | None = None,
        seth_hill: float | None = None,
    ) -> Evaluation:
        """Evaluation by the names that its options have on the command line and in a run's methods.

        reference : "first", or "previous" for the step before each step. without_rigid_motion, window, seth_hill :
        rigid_motion_removed, window and exponent of the class. Raises InputError for another reference.
        """
        if reference not in ("first", "previous"):
            raise InputError(f"a step is compared with the 'first' or the 'previous' one, not with '{reference}'")
        return cls(reference == "previous", without_rigid_motion, window, seth_hill)


class EvaluatedResults:
    """Results with the fields of an evaluation, computed one step at a time on request."""

    def __init__(self, results: Results, evaluation: Evaluation = Evaluation()) -> None:
        self.results = results
        self.evaluation = evaluation
        self._last: tuple[int, StepFields] | None = None

    @property
    def steps(self) -> tuple[str, ...]:
        """Capture ids of the steps, the reference first."""
        return self.results.steps

    @cached_property
    def window(self) -> StrainWindow | None:
        """The windows over which strain is fitted; None for strain of the triangles alone."""
        width = self.results.window_mm if self.evaluation.window is None else self.evaluation.window
        return strain_window(self.results.mesh, width) if width > 0 else None

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """All fields that these results have with this evaluation."""
        exponent = self.evaluation.exponent
        return (*available(self._names), *(() if exponent is None else seth_hill_fields(exponent)))

    @cached_property
    def _scatter(self) -> WindowScatter | None:
        return None if self.window is None else self.results.scatter(self.window)

    @cached_property
    def _names(self) -> set[str]:
        return self.step(0).names

    def field(self, name: str) -> Field:
        """The field of a name; raises InputError if the results do not have it with this evaluation."""
        try:
            entry = field(name)
        except KeyError:
            entry = None
        if entry is None or not set(entry.of) <= self._names:
            known = ", ".join(known.name for known in self.fields)
            hint = "; give a window" if name.startswith("window_") and self.window is None else ""
            raise InputError(f"no field '{name}'; there are {known}{hint}")
        return entry

    def step(self, step: int) -> StepFields:
        """The arrays of a step from which every field follows; those of the last requested step are cached."""
        if self._last is None or self._last[0] != step:
            how = self.evaluation
            self._last = (
                step,
                self.results.fields(step, self.window, how.previous, how.rigid_motion_removed, self._scatter),
            )
        return self._last[1]

    def positions(self, step: int) -> Points:
        """Positions of the vertices at a step, (N, 3) mm, NaN where lost; without the rigid motion if it is removed."""
        current = self.results.vertices[step]
        if self.evaluation.rigid_motion_removed:
            return self.results.motion(step, self.evaluation.previous).apply(current)
        return current

    def measured(self, step: int) -> tuple[Mesh, Indices, Mask]:
        """The measured part of the surface at a step.

        Returns its mesh of K vertices, mm; (K,) indices of these vertices in the results; and (M,) bool, which
        triangles of the results it consists of.
        """
        surface = Mesh(self.positions(step), self.results.faces)
        whole = surface.whole_faces()
        mesh, index = Mesh(surface.vertices, surface.faces[whole]).compact()
        return mesh, index, whole

    def limits(self, name: str) -> tuple[float, float]:
        """Limits of a field's colour scale over all steps, symmetric about the field's centre where it has one."""
        entry = self.field(name)
        ranges = Ranges((entry,))
        for step in range(len(self.steps)):
            ranges.add(self.step(step))
        return even_limits(ranges.table()[0]["range"], entry.centre)


def evaluate_results(results_path: Path, evaluation: Evaluation = Evaluation()) -> EvaluatedResults:
    """Read the results in a file, without the 2D matches, for evaluation with given options."""
    return EvaluatedResults(read_results(results_path, matches=False), evaluation)
