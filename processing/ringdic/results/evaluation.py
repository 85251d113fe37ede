"""Results looked at in another way than they were stored in: another reference, another window, another strain.

Everything follows from the stored positions; nothing is correlated again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ringdic.arrays import Floats, Indices, Mask
from ringdic.errors import InputError
from ringdic.mesh.mesh import Mesh
from ringdic.results.fields import Field, StepFields, available, field, seth_hill_fields
from ringdic.results.ranges import Ranges, even_limits
from ringdic.results.results import Results, read_results
from ringdic.strain.window import StrainWindow, strain_window
from ringdic.uncertainty.window import WindowScatter


@dataclass(frozen=True)
class Evaluation:
    """How fields are made of positions.

    previous : each step is compared with the one before it, not with the reference.
    rigid_motion_removed : each step is first moved back onto what it is compared with.
    window : width of the strain window, mm; 0 for none, None for the one that the run was told to use.
    exponent : of a Seth-Hill family of strains that is wanted beside the others.
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
        rigid_motion_removed: bool = False,
        window: float | None = None,
        exponent: float | None = None,
    ) -> Evaluation:
        """The same by words: reference is "first" or "previous". Raises InputError for anything else."""
        if reference not in ("first", "previous"):
            raise InputError(f"a step is compared with the 'first' or the 'previous' one, not with '{reference}'")
        return cls(reference == "previous", rigid_motion_removed, window, exponent)


class EvaluatedResults:
    """Results under an evaluation. Steps are computed when they are asked for, one at a time."""

    def __init__(self, results: Results, evaluation: Evaluation = Evaluation()) -> None:
        self.results = results
        self.evaluation = evaluation
        self._last: tuple[int, StepFields] | None = None

    @property
    def steps(self) -> tuple[str, ...]:
        """Names of the steps, the reference first."""
        return self.results.steps

    @cached_property
    def window(self) -> StrainWindow | None:
        """The windows that strain is fitted over, if any."""
        width = self.results.window_mm if self.evaluation.window is None else self.evaluation.window
        return strain_window(self.results.mesh, width) if width > 0 else None

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """The fields there are."""
        exponent = self.evaluation.exponent
        return (*available(self._names), *(() if exponent is None else seth_hill_fields(exponent)))

    @cached_property
    def _scatter(self) -> WindowScatter | None:
        return None if self.window is None else self.results.scatter(self.window)

    @cached_property
    def _names(self) -> set[str]:
        return self.step(0).names

    def field(self, name: str) -> Field:
        """The field of a name. Raises InputError if these results, so evaluated, do not have it."""
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
        """The arrays of a step; those of the step asked for last are kept."""
        if self._last is None or self._last[0] != step:
            how = self.evaluation
            self._last = (
                step,
                self.results.fields(step, self.window, how.previous, how.rigid_motion_removed, self._scatter),
            )
        return self._last[1]

    def positions(self, step: int) -> Floats:
        """Positions of the vertices, (N, 3) mm, NaN where lost; moved back if the rigid motion is removed."""
        current = self.results.vertices[step]
        if self.evaluation.rigid_motion_removed:
            return self.results.motion(step, self.evaluation.previous).apply(current)
        return current

    def measured(self, step: int) -> tuple[Mesh, Indices, Mask]:
        """The measured part of a step, the old index (K,) of its vertices, and which triangles (M,) it has."""
        moved = Mesh(self.positions(step), self.results.faces)
        whole = moved.whole_faces()
        mesh, kept = Mesh(moved.vertices, moved.faces[whole]).compact()
        return mesh, kept, whole

    def limits(self, name: str) -> tuple[float, float]:
        """Limits of a colour scale over all steps; even about the centre where the field has one."""
        entry = self.field(name)
        ranges = Ranges((entry,))
        for step in range(len(self.steps)):
            ranges.add(self.step(step))
        return even_limits(ranges.table()[0]["range"], entry.centre)


def evaluated(results_path: Path, evaluation: Evaluation = Evaluation()) -> EvaluatedResults:
    """The results of a file under an evaluation, without the 2D matches."""
    return EvaluatedResults(read_results(results_path, matches=False), evaluation)
