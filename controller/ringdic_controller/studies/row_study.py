"""A study of many rows on the virtual rig: each is rendered, processed, compared with the truth, and tabulated."""

from __future__ import annotations

import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import cv2
from ringdic.cli.console import say
from ringdic.errors import RingdicError
from ringdic.jobs.pipeline import process_session
from ringdic.progress import Progress, Report, progress_bar
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.settings import Settings, load_settings
from ringdic.tasks.work import work_folder
from ringdic_node.virtual_rig.render import load_renderer

from ringdic_controller.studies.validate.folders import make_session
from ringdic_controller.studies.validate.image_cache import ImageCache, RenderedShot

#: What faults of the program raise: they end a row of a study, and the others are still measured.
FAULTS = (cv2.error, ValueError, IndexError, ArithmeticError)


class NamedRow(Protocol):
    """A row of a study, which has a name."""

    @property
    def name(self) -> str:
        """Name of the row, unique in its study."""


R = TypeVar("R", bound=NamedRow)
E = TypeVar("E")


@dataclass(frozen=True)
class RowRun:
    """What processing a row of a study gave.

    seconds : that it took. results : None where it was refused. refusal : the sentence of the refusal, or of the fault
    of the program. fault : whether the program failed.
    """

    seconds: float
    results: Results | None = None
    refusal: str = ""
    fault: bool = False


class RowStudy(ABC, Generic[R, E]):
    """A study in a folder, whose rows (R) are rendered and measured one after the other; each gives an entry (E).

    folder : of images, sessions and tables. scale : of the images. settings : that rows are processed with. report :
    called with the progress.
    """

    def __init__(self, folder: Path, scale: float, settings: Settings, report: Report) -> None:
        self.folder, self.scale, self.settings = folder, scale, settings
        self.images = ImageCache(folder / "images")
        self.done = 0.0  # share of the rows
        self._report = report

    @abstractmethod
    def captures(self, row: R) -> Sequence[tuple[str, Mapping[str, RenderedShot]]]:
        """What a row's session is made of: the kind of each capture, and its images by camera."""

    @abstractmethod
    def measured(self, row: R) -> E:
        """Process a row, whose images are rendered, and compare it with the truth."""

    @abstractmethod
    def sentence(self, entry: E) -> str:
        """The figures of an entry in one line."""

    def render(self, row: R) -> None:
        """Render the missing images of a row."""
        shots = [shot for _, each in self.captures(row) for shot in each.values()]
        self.images.render_missing(shots, lambda done: self.tell(f"{row.name}: render", f"{100 * done:.0f} %"))

    def session(
        self, name: str, rig_toml: str, captures: Sequence[tuple[str, Mapping[str, RenderedShot]]],
        calibration: Path | None = None,
    ) -> Path:  # fmt: skip
        """Make a new session folder; one of an earlier run is replaced.

        rig_toml : text of its rig file. calibration : a session whose stored calibrations are used where they fit.
        """
        path = self.folder / "sessions" / name
        shutil.rmtree(path, ignore_errors=True)
        path.parent.mkdir(exist_ok=True)
        return make_session(path, rig_toml, captures, self.images, calibration=calibration)

    def processed(self, name: str, session: Callable[[], Path]) -> RowRun:
        """Process the session of a row; a refusal, or a fault of the program, is a sentence. session : makes it."""
        began = time.monotonic()
        try:
            path = session()
            began = time.monotonic()
            run = process_session(path, self.settings, self._renamed(name))
        except RingdicError as error:
            return RowRun(time.monotonic() - began, refusal=str(error))
        except FAULTS as error:
            sentence = f"a fault of the program: {type(error).__name__}: {' '.join(str(error).split())}"
            return RowRun(time.monotonic() - began, refusal=sentence, fault=True)
        seconds = time.monotonic() - began
        self.tell(name, "compared with the truth")
        results = read_results(run / "results.h5")
        shutil.rmtree(work_folder(path))
        return RowRun(seconds, results)

    def tell(self, stage: str, message: str) -> None:
        """Report a stage of the row at work, and a message about it."""
        self._report(Progress(stage, self.done, message))

    def _renamed(self, what: str) -> Callable[[Progress], None]:
        return lambda progress: self.tell(what, f"{progress.stage} {100 * progress.done:.0f} % {progress.message}")


def scaled_settings(scale: float, overrides: Sequence[str] = ()) -> Settings:
    """The default settings, or others where they are given, with subsets for images of a scale.

    Raises InputError for a setting that does not exist.
    """
    return load_settings(None, overrides).at_scale(scale)


def about_study(folder: Path, scale: float, overrides: Sequence[str]) -> dict[str, Any]:
    """Folder, scale of the images, and settings other than the defaults of a study, as JSON values."""
    return {"folder": str(folder), "scale": scale, "settings": ", ".join(overrides) or "at the defaults"}


def run_rows(
    study: type[RowStudy[R, E]],
    rows: Sequence[R],
    folder: Path,
    scale: float,
    settings: Settings,
    write: Callable[[Sequence[E]], object] | None,
) -> list[E]:
    """Render and measure the rows of a study in a folder; returns their entries.

    Images of an earlier run in the folder are used again. write : called with the entries so far after each row; None
    renders missing images only.
    """
    folder.mkdir(parents=True, exist_ok=True)
    load_renderer()
    entries: list[E] = []
    with progress_bar() as report:
        work = study(folder, scale, settings, report)
        for k, row in enumerate(rows):
            work.done = k / len(rows)
            work.render(row)
            if write is not None:
                entries.append(work.measured(row))
                say(f"{k + 1} of {len(rows)}: {work.sentence(entries[-1])}")
                write(entries)
    return entries
