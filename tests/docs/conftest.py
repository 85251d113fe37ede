"""The tutorial's session, made once for all tests of the documentation."""

import importlib.util
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).parents[2] / "docs"


def load(name: str) -> ModuleType:
    """A program of the folder docs as a module."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Tutorial:
    """Where the tutorial was followed, and what it printed."""

    folder: Path
    printed: str

    @property
    def session(self) -> Path:
        return self.folder / "session"

    @property
    def results(self) -> Path:
        return self.session / "results" / "0001" / "results.h5"


@pytest.fixture(scope="session")
def tutorial(tmp_path_factory: pytest.TempPathFactory) -> Tutorial:
    """The tutorial, followed literally. Not to be written to."""
    folder = tmp_path_factory.mktemp("tutorial")
    return Tutorial(folder, load("tutorial").follow(folder))


@pytest.fixture(scope="session")
def pages() -> Path:
    """The folder of the pages."""
    return DOCS / "pages"


def _rows(page: Path, heading: str) -> list[list[str]]:
    text = page.read_text(encoding="utf-8")
    section = re.search(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", text, re.MULTILINE | re.DOTALL)
    assert section is not None, f"{page.name} has no heading '{heading}'"
    lines = [line for line in section[1].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[2:]]


@pytest.fixture(scope="session")
def table(pages: Path) -> Callable[[str, str], list[list[str]]]:
    """Call it with a page and a heading: the cells of the table below it, without its header."""
    return lambda page, heading: _rows(pages / page, heading)


@pytest.fixture(scope="session")
def named(table: Callable[[str, str], list[list[str]]]) -> Callable[[str, str], list[str]]:
    """Call it with a page and a heading: the first cells of the table below it, without their backticks."""
    return lambda page, heading: [row[0].strip("`") for row in table(page, heading)]
